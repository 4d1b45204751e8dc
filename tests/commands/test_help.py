"""`--help` of the large commands, defaults that are true, and completion by the shell."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from command_line import REPOSITORY, environment

from mjxball import config
from mjxball.commands.evaluate import parser as eval_parser
from mjxball.commands.train import COMMON
from mjxball.commands.train import parser as train_parser
from mjxfly.main import make_parser as fly_parser

PARSERS = {"train": train_parser, "eval": eval_parser, "fly": fly_parser}
Helped = Callable[..., str]


@pytest.fixture
def helped(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Helped:
    """What a program prints for some words, in so many columns, before it exits with a code."""

    def call(program: str, *words: str, columns: int = 80, code: int = 0) -> str:
        monkeypatch.setenv("COLUMNS", str(columns))
        with pytest.raises(SystemExit) as stop:
            PARSERS[program]().parse_args(list(words))
        assert stop.value.code == code
        out, err = capsys.readouterr()
        return err if code else out

    return call


def flags(text: str) -> set[str]:
    return set(re.findall(r"^ +(?:-h .*)?(--[\w.-]+)", text, re.MULTILINE))


def test_help_fits_three_screens_and_all_has_everything(helped: Helped) -> None:
    common, every = helped("train", "--help"), helped("train", "--help", "all")
    assert len(common.splitlines()) <= 120
    assert list(config.PRESETS_ABOUT) == list(config.PRESETS)
    for name, about in config.PRESETS_ABOUT.items():
        assert f" {name}: {about}\n" in common
    assert {f"--{path}" for path in COMMON} | {"--seed", "--out", "--resume", "--plant"} <= flags(common)
    assert flags(common) < flags(every)
    assert {f"--{path}" for path, _, _ in config.leaves(config.Config())} <= flags(every)
    assert common.index("--seed") < common.index("--env") < common.index("--distributed") < common.index("--sac.")


def test_help_of_fly_ends_with_the_faults_of_the_twin(helped: Helped) -> None:
    common, every = helped("fly", "--help"), helped("fly", "--help", "all")
    assert len(common.splitlines()) <= 60
    assert {"--leader", "--follower", "--rehearse", "--dry-run", "--seconds", "--log", "--mocap"} <= flags(common)
    assert not flags(common) & {"--fault", "--loss", "--twin-noise", "--hover", "--mocap-std"}
    assert len(flags(every)) >= 35
    assert every.index("--seconds") < every.index("--mocap ") < every.index("--hover") < every.index("--fault")


@pytest.mark.parametrize("program", PARSERS)
@pytest.mark.parametrize("columns", [20, 40, 80, 100, 130])
def test_no_line_is_longer_than_the_terminal(program: str, columns: int, helped: Helped) -> None:
    """But one long word."""
    every = [["bench", "--help"], ["figures", "--help"]] if program == "eval" else [["--help", "all"]]
    for words in (["--help"], *every):
        for line in helped(program, *words, columns=columns).splitlines():
            assert len(line) <= columns or (columns < 40 and len(line.split()) == 1), line


@pytest.mark.parametrize("name", config.PRESETS)
def test_defaults_are_those_of_the_preset(name: str, helped: Helped) -> None:
    """Of every setting; a preset may also be named behind `--help`."""
    text = " ".join(helped("train", name, "--help", "all").split())
    assert f"those of the preset {name}" in text
    for path, value, _ in config.leaves(config.preset(name)):
        if path in {known for known, _, _ in config.leaves(config.Config())}:
            found = re.search(rf"--{re.escape(path)} VALUE .*?\(default ([^)]*)\)", text)
            assert found is not None, path
            assert found[1] == (config.to_text(value) or "none"), path
    assert helped("train", "--help", name) == helped("train", name, "--help")


def test_help_of_one_section_and_of_none_that_there_is(helped: Helped) -> None:
    assert flags(helped("train", "--help", "bounds")) == {
        f"--{path}" for path, _, _ in config.leaves(config.Config()) if path.startswith("bounds.")
    }
    for words in (("--help", "nonsense"), ("nonsense", "--help")):
        said = helped("train", *words, code=2)
        assert "'nonsense'" in said
        assert said.count("\n") == 1
    assert "did you mean --scenario.cg_speed?" in helped("train", "--scenario.cg_sped", "1", code=2)


BASH = """
source {script}
COMP_WORDS=({words}); COMP_CWORD=$(({count} - 1))
$(complete -p {program} | sed 's/.*-F \\([^ ]*\\).*/\\1/') {program} "${{COMP_WORDS[COMP_CWORD]}}"
echo "${{COMPREPLY[@]}}"
"""


@pytest.mark.slow
def test_bash_completes_what_the_script_says(helped: Helped, tmp_path: Path) -> None:
    for name in ("train", "eval"):
        (tmp_path / name).write_text(helped(name, "--print-completion", "bash"))

    def completed(name: str, *words: str) -> list[str]:
        given = [f"{name}.py", *words]
        program = BASH.format(script=tmp_path / name, program=given[0], words=" ".join(given), count=len(given))
        done = subprocess.run(["bash", "--norc", "-c", program], capture_output=True, text=True, check=True)
        return done.stdout.split()

    assert completed("train", "bal") == ["balance"]
    assert completed("train", "--scenario.cg_w") == ["--scenario.cg_width", "--scenario.cg_waypoint_probability"]
    assert completed("train", "--physics", "n") == ["newton-euler"]
    assert completed("eval", "--physics", "n") == completed("eval", "fly", "--physics", "n") == ["newton-euler"]
    assert completed("eval", "fi") == ["figures"]
    assert completed("eval", "bench", "--tracks", "pair-") == ["pair-unknown"]
    assert "#compdef" in helped("eval", "--print-completion", "zsh")


@pytest.mark.slow
def test_no_command_imports_what_only_completion_and_tables_need() -> None:
    """They would be a fifth of a second of every start."""
    look = "import sys; from {} import {} as p; p(); print(sorted({{'rich', 'shtab', 'IPython'}} & set(sys.modules)))"
    for module, name in (("mjxfly.main", "make_parser"), ("mjxball.commands.train", "parser")):
        command = [sys.executable, "-c", look.format(module, name)]
        done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=REPOSITORY, env=environment())
        assert done.stdout == "[]\n", module

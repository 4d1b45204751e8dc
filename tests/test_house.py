"""The house files say what is so: local hooks, a workflow that runs `.ci/run`, documents without dead ends."""

from __future__ import annotations

import re
from pathlib import Path

import yaml
from command_line import REPOSITORY
from tables import rows

PYTHONS = ["3.11", "3.12", "3.13", "3.14"]
DOCUMENTS = sorted([*REPOSITORY.glob("*.md"), *(REPOSITORY / "docs").rglob("*.md")])


def test_hooks_are_local() -> None:
    (repository,) = yaml.safe_load((REPOSITORY / ".pre-commit-config.yaml").read_text())["repos"]
    assert repository["repo"] == "local"
    assert {hook["language"] for hook in repository["hooks"]} == {"system"}
    assert {hook["entry"].split()[0] for hook in repository["hooks"]} == {"ruff", "mypy"}


def test_the_workflow_runs_ci_on_every_supported_python_and_on_the_lowest_versions() -> None:
    jobs = yaml.safe_load((REPOSITORY / ".github" / "workflows" / "ci.yml").read_text())["jobs"]
    whole, lowest = jobs["test"], jobs["lowest"]
    assert whole["strategy"]["matrix"]["python"] == PYTHONS
    assert whole["steps"][-1]["run"] == ".ci/run"
    *_, install, tests = (step.get("run", "") for step in lowest["steps"])
    assert "--resolution lowest-direct -e '.[dev,fly]'" in install
    assert tests == "python -m pytest -n 2 --dist loadfile"


def test_packages_are_installed_every_week_with_the_lowest_and_highest_versions() -> None:
    job = yaml.safe_load((REPOSITORY / ".github" / "workflows" / "weekly.yml").read_text())["jobs"]["install"]
    assert job["strategy"]["matrix"] == {"python": PYTHONS, "versions": ["highest", "lowest-direct"]}
    assert job["steps"][-1]["run"] == ".ci/release python3 ${{ matrix.versions }}"
    script = (REPOSITORY / ".ci" / "release").read_text()
    (wanted,) = re.findall(r"/\^(python )/", script)
    readme = (REPOSITORY / "README.md").read_text()
    typed = [line for block in re.findall(r"```bash\n(.*?)```", readme, flags=re.S) for line in block.splitlines()]
    assert sum(line.startswith(wanted) for line in typed) >= 3  # to train, to compare, to watch


def test_what_ci_leaves_out_runs_every_week() -> None:
    workflow = yaml.safe_load((REPOSITORY / ".github" / "workflows" / "weekly.yml").read_text())
    assert workflow["permissions"] == {"contents": "read"}
    assert workflow[True]["schedule"]  # `on` in YAML
    *_, whole, foreign, held = (step.get("run", "") for step in workflow["jobs"]["test"]["steps"])
    assert whole.endswith("-m release")
    assert {"kubeflow-trainer-api", "skypilot", "wandb", "mlflow-skinny", "stable-baselines3"} == {
        part.partition("==")[0] for part in foreign.split() if "==" in part
    }
    assert "tests/test_manifests.py tests/train/test_tracker.py" in held


def test_a_release_gets_files_that_were_tried_and_signed() -> None:
    text = (REPOSITORY / ".github" / "workflows" / "release.yml").read_text()
    workflow = yaml.safe_load(text)
    job, upload = workflow["jobs"]["attach"], workflow["jobs"]["pypi"]
    assert workflow["permissions"] == {"contents": "read"}
    assert job["permissions"] == {"contents": "write", "id-token": "write", "attestations": "write"}
    steps = [step.get("run") or step["uses"] for step in job["steps"]]
    order = ("build && ", "mjxball-eval", "actions/attest-build-provenance@", "gh release upload")
    places = [next(place for place, step in enumerate(steps) if word in step) for word in order]
    assert places == sorted(places)
    assert not any("${{" in step for step in steps)  # a tag's name would be run
    assert (upload["needs"], upload["if"], upload["environment"]) == ("attach", "vars.PYPI == 'yes'", "pypi")
    assert upload["permissions"] == {"id-token": "write"}


def test_ci_checks_style_and_types() -> None:
    text = (REPOSITORY / ".ci" / "run").read_text()
    for command in ("ruff check .", "ruff format --check .", "mypy"):
        assert f".venv/bin/{command}\n" in text


@rows("path", DOCUMENTS)
def test_links_lead_somewhere(path: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", path.read_text()):
        if "://" not in target:
            assert (path.parent / target).exists(), target


@rows("path", [path for path in DOCUMENTS if path.parent.name != "archive" and path.name != "CHANGELOG.md"])
def test_scripts_that_documents_name_exist(path: Path) -> None:
    """An archive and a changelog tell of scripts as they were."""
    for name in re.findall(r"(?:python |`)((?:benchmarks|docs|tests)/[\w/]+\.py)", path.read_text()):
        assert (REPOSITORY / name).exists(), name


def test_no_document_cites_what_readers_do_not_have() -> None:
    sources = [*DOCUMENTS, *REPOSITORY.glob("*.py"), *REPOSITORY.glob("mjx*/**/*.py")]
    cited = [path for path in sources if re.search(r"\bdesign section \d", path.read_text(), re.IGNORECASE)]
    assert cited == []

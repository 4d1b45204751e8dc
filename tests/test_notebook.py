"""What a notebook shows: a training that goes on, short words and pictures, the viewer, and no noise."""

from __future__ import annotations

import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import REPOSITORY, TINY, environment

from mjxball import Policy, Scenario, pictures, simulate
from mjxball.baselines import make_baseline
from mjxball.config import Config, override, preset
from mjxball.errors import InputError
from mjxball.notebook import View
from mjxball.policy import shipped_policy
from mjxball.sim.rollout import simulate_batch
from mjxball.train.live import in_notebook


def svg(shown: str) -> ET.Element:
    """The picture in some HTML; it has to be well-formed."""
    found = re.search(r"<svg.*</svg>", shown, re.DOTALL)
    assert found is not None
    return ET.fromstring(found[0])


def drawn(shown: str, kind: str) -> list[ET.Element]:
    return svg(shown).findall(f"{{http://www.w3.org/2000/svg}}{kind}")


@pytest.fixture(scope="module")
def config() -> Config:
    return preset("transport")


def test_reprs_are_short_and_have_a_picture(config: Config) -> None:
    copy = make_baseline("copy", config)
    flight = simulate(config, copy, Scenario(seconds=1.0), "newton-euler")
    both = simulate_batch(config, [(copy, [Scenario(seconds=1.0), Scenario(seconds=1.0, omega=1.0)])], "newton-euler")
    policy = Policy.load(shipped_policy("balance"))
    curve = policy.metadata["curve"]
    for shown, words, kind, count in (
        (flight, "<Trajectory 1 s, 51 steps>", "polyline", 3),
        (both, "<Trajectory 1 s, 51 steps, 2 flights>", "polyline", 2),
        (policy, "<Policy balance: preset balance, seed 211, ", "circle", len(curve["eval_steps"])),
        (config.plant, "<Plant of 2 drones, 2.2 kg, object 0.2 kg along x>", "circle", 2),
        (preset("team").plant, "<Plant of 6 drones, ", "circle", 6),
    ):
        assert repr(shown).startswith(words)
        assert len(repr(shown)) < 120
        assert len(drawn(shown._repr_html_(), kind)) == count, words
        assert len(shown._repr_html_()) < 20_000


def test_a_curve_is_where_its_numbers_are() -> None:
    """From 0 to 10 along x and 5 to 7 along y; what is not finite is left out."""
    shown = pictures.curves([pictures.Curve("a < b", [0, 5, 7, 10], [5, 7, np.nan, 6])], "x", "y", 480, 170)
    points = np.array([pair.split(",") for pair in drawn(shown, "polyline")[0].get("points").split()], float)
    frame = {name: float(drawn(shown, "rect")[0].get(name)) for name in ("x", "y", "width", "height")}
    across = (points[:, 0] - frame["x"]) / frame["width"]
    up = (frame["y"] + frame["height"] - points[:, 1]) / frame["height"]
    np.testing.assert_allclose(across, [0, 0.5, 1], atol=1e-3)
    np.testing.assert_allclose(up, [0, 1, 0.5], atol=1e-3)
    assert "a &lt; b" in shown
    assert len(drawn(pictures.curves([], "x", "y"), "polyline")) == 0


def test_the_viewer_is_inline(config: Config) -> None:
    flight = simulate(config, make_baseline("copy", config), Scenario(seconds=1.0), "newton-euler")
    shown = View(flight, config.plant, "mine & yours")._repr_html_()
    frame = ET.fromstring(shown)
    assert frame.tag == "iframe"
    assert frame.get("title") == "mine & yours"
    assert frame.get("srcdoc").startswith("<!")
    assert "src" not in frame.attrib  # nothing is fetched


# --- training --------------------------------------------------------------------------------------------------------


# So short that no difference of rounding grows: 32 steps of warm-up and 32 of training.
SHORT = {flag[2:]: str(text) for flag, text in TINY.items() if "." in flag} | {"sac.total_steps": "2048"}


@pytest.fixture(scope="module")
def short() -> Config:
    found = preset("transport")
    for path, text in SHORT.items():
        found = override(found, path, text)
    return found


@pytest.mark.slow
def test_progress_is_told_and_changes_nothing(short: Config) -> None:
    import jax

    from mjxball.train import train

    said: list[Any] = []
    key = jax.random.PRNGKey(0)
    quiet, expected = train(short, key, physics="newton-euler", on_progress=False)
    told, found = train(short, key, physics="newton-euler", on_progress=said.append)
    for name, values in expected.items():
        np.testing.assert_allclose(found[name], values, rtol=2e-5, err_msg=name)  # sums in another order
    seen = np.linspace(-0.5, 0.5, 18, dtype=np.float32)
    np.testing.assert_allclose(told(seen), quiet(seen), rtol=2e-5, atol=1e-6)
    steps = [one["steps"] for one in said]
    assert steps == sorted(steps)
    assert steps[-1] == said[-1]["total"] == short.sac.total_steps
    evaluated = [one["eval_return"] for one in said if "eval_return" in one]
    np.testing.assert_allclose(evaluated, expected["eval_return"], rtol=2e-5)
    assert sum("episode_return" in one for one in said) > len(evaluated)
    with pytest.raises(InputError, match="traced"):
        jax.jit(lambda key: train(short, key, physics="newton-euler", on_progress=True))(key)


@pytest.mark.slow
def test_ctrl_c_leaves_the_policy_of_then(short: Config, capsys: pytest.CaptureFixture[str]) -> None:
    import jax

    from mjxball.train import train

    told = []

    def interrupting(said: Any) -> None:
        told.append(said["steps"])
        if len(told) == 4:
            raise KeyboardInterrupt

    policy, metrics = train(short, jax.random.PRNGKey(0), physics="newton-euler", on_progress=interrupting)
    assert 0 < told[-1] < short.sac.total_steps
    assert capsys.readouterr().err.startswith(f"stopped after {told[-1]:,.0f} of {short.sac.total_steps:,} steps")
    assert np.isfinite(policy(np.zeros(18, np.float32))).all()
    assert len(metrics["eval_return"]) < short.sac.num_evaluations

    def at_once(said: Any) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(short, jax.random.PRNGKey(0), physics="newton-euler", on_progress=at_once)


def test_no_notebook_here(config: Config) -> None:
    import jax

    from mjxball.train import train

    assert not in_notebook()
    with pytest.raises(InputError, match="give a function"):
        train(config, jax.random.PRNGKey(0), on_progress=True)


@pytest.mark.release
def test_a_training_in_a_notebook_draws_itself(short: Config) -> None:
    import nbformat
    from nbclient import NotebookClient

    source = f"""
import jax
from mjxball.config import override, preset
from mjxball.train import train
config = preset("transport")
for name, text in {SHORT!r}.items():
    config = override(config, name, text)
policy, metrics = train(config, jax.random.PRNGKey(0), physics="newton-euler")
"""
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source)])
    NotebookClient(notebook, timeout=300, kernel_name="python3").execute()
    (output,) = notebook.cells[0].outputs  # no stderr beside it
    shown = output["data"]["text/html"]
    assert "100%" in shown
    assert len(drawn(shown, "circle")) == short.sac.num_evaluations
    assert len(drawn(shown, "polyline")[0].get("points").split()) > short.sac.num_evaluations


NOISE = """
import jax, jax.numpy as jnp
jnp.zeros(3).block_until_ready()
import mjxball
from mjxball import Scenario, config, simulate
from mjxball.baselines import make_baseline
from mjxball.xla import enable_compilation_cache
enable_compilation_cache()
plant = config.preset("transport")
simulate(plant, make_baseline("copy", plant), Scenario(seconds=0.1), "newton-euler")
"""


@pytest.mark.slow
def test_jax_imported_first_is_silent(tmp_path: Path) -> None:
    """The second process loads what the first has compiled, of which XLA would say 3.5 kB."""
    variables = {**environment(), "MJXBALL_CACHE": str(tmp_path), "JAX_PLATFORMS": "cpu"}
    for _ in range(2):
        command = [sys.executable, "-c", NOISE]
        done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=REPOSITORY, env=variables)
        assert done.stderr == ""
    assert any(tmp_path.iterdir())

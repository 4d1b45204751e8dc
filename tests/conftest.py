"""Shared fixtures. JAX runs on the CPU unless told otherwise; environments and networks compile once a session."""

from __future__ import annotations

import surroundings  # noqa: F401  (before JAX reads what it sets)

# isort: split
import atexit
import contextlib
import dataclasses
import fcntl
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import short_train
from command_line import HASTY

from mjxball import config as configs
from mjxball import running, xla
from mjxball.algorithms import sac
from mjxball.algorithms.base import PolicyNetwork
from mjxball.algorithms.gradient import FirstOrderGradient
from mjxball.config import Config
from mjxball.env import TransportEnv
from mjxball.policy import PolicyFile, save_file
from mjxball.policy.export import policy_file
from mjxball.policy.file import interface_of, observing_stale
from mjxball.sim.follower import network_interface
from mjxball.train.environments import Environments

# The same as in `command_line.environment`: a cached program is found by the flags that it was compiled with.
if HASTY not in os.environ.get("XLA_FLAGS", ""):
    os.environ["XLA_FLAGS"] = f"{HASTY} {os.environ.get('XLA_FLAGS', '')}".strip()
# A training by gradients in this process would leave its two devices to processes that later tests start. (Of this
# flag programs in the cache do not depend.)
if xla.CPU_DEVICES.partition("=")[0] not in os.environ["XLA_FLAGS"]:
    os.environ["XLA_FLAGS"] += f" {xla.CPU_DEVICES.partition('=')[0]}=1"
if xla.VARIABLE not in os.environ:  # one compilation cache a run: of its workers and of the processes they start
    os.environ[xla.VARIABLE] = tempfile.mkdtemp(prefix="mjxball-cache-")
    atexit.register(shutil.rmtree, os.environ[xla.VARIABLE], ignore_errors=True)
xla.enable_compilation_cache()
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)  # tests share hundreds of tiny programs
running.collect_seldom()  # as the commands do

# Derandomised: the same examples on every machine, so that a red build is never a matter of luck.
hypothesis.settings.register_profile("mjxball", deadline=None, derandomize=True, database=None, max_examples=60)
hypothesis.settings.load_profile("mjxball")

BROWSERS = ("chromium-headless-shell", "chromium", "google-chrome")
# Locked, never written: they are there on every machine. Tests by the clock share one room, all others the other.
QUEUE, CLOCKED, OTHERS, SKY = (
    Path(__file__).parents[1] / name for name in ("tests/conftest.py", "tests", ".", "mjxball")
)


@contextlib.contextmanager
def locked(place: Path, kind: int) -> Iterator[None]:
    """Hold a lock of `kind` on `place`, as all processes of the machine see it."""
    handle = os.open(place, os.O_RDONLY)
    try:
        fcntl.flock(handle, kind)
        yield
    finally:
        os.close(handle)


ATTEMPTS = 3  # of a test that flies by the clock, on a machine that others may keep busy


def by_the_clock(item: pytest.Item) -> bool:
    """Whether a busy machine would spoil the test."""
    return any(item.get_closest_marker(name) for name in ("alone", "clock"))


TESTS = Path(__file__).parent
# Files that take longest, which begin first, so that no worker is left with one of them at the end.
LONGEST = (
    *("fly/test_link", "fly/test_mocap_flight", "fly/test_main", "fly/test_watchdog", "fly/test_rehearsal"),
    *("fly/rig/test_rehearsal", "train/test_population", "train/test_distributed", "commands/test_evaluate"),
    *("train/test_cluster", "train/test_two_devices", "fly/app/test_flights", "fly/test_faults", "fly/test_measured"),
    *("test_docs", "test_team_env", "commands/test_train", "baselines/test_mpc", "algorithms/test_algorithms"),
    *("train/test_extensions", "commands/test_figures", "baselines/test_baselines", "fly/test_defects"),
    *("train/test_resume", "physics/test_engines", "train/test_program", "gym/test_gym"),
)


def pytest_configure(config: pytest.Config) -> None:
    """With `--dist loadfile`, files begin in the order of `pytest_collection_modifyitems`."""
    config.option.loadscopereorder = False
    asked = config.option.markexpr  # what is for a release is for that alone, also in a file of the second tier
    if asked and "release" not in asked:
        config.option.markexpr = f"({asked}) and not release"


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The second tier is what is marked `slow`, what goes by the clock (`alone`, `clock`) and what opens a browser.

    Files with what goes by the clock begin first, on all workers together, then those that take longest.
    """
    for item in items:
        if by_the_clock(item):
            item.add_marker(pytest.mark.flaky(reruns=ATTEMPTS - 1, reruns_delay=1))
            item.add_marker(pytest.mark.slow)
        if "browser" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.slow)
    clocked = {item.path for item in items if by_the_clock(item)}
    places = {name: number for number, name in enumerate(LONGEST)}
    items.sort(
        key=lambda item: (
            item.path not in clocked,
            places.get(os.path.relpath(item.path.with_suffix(""), TESTS), len(places)),
        )
    )


TOO_SLOW = "this computer is too slow for a rehearsal"


def too_busy(reason: str) -> NoReturn:
    """The machine was too busy for this flight by the clock: try again; the last attempt skips the test."""
    raise pytest.fail.Exception(f"{TOO_SLOW}: {reason}", pytrace=False)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo) -> Iterator[None]:
    """A test by the clock that fails where a rehearsal said that the machine was too slow skips at its last attempt."""
    report = yield
    said = f"{call.excinfo.value}{report.capstderr}" if report.failed and by_the_clock(item) else ""
    found = re.search(f"{TOO_SLOW}.*", said)
    if found and getattr(item, "execution_count", ATTEMPTS) >= ATTEMPTS:
        report.outcome, report.longrepr = "skipped", (str(item.path), item.location[1] or 0, f"Skipped: {found[0]}")
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """With workers side by side (`-n 2`), nothing that computes much runs beside a test by the clock.

    One marked `alone` is alone or beside tests marked `clock`, which mostly wait. Whoever waits for a room to be left
    stands in the queue, so that nobody is passed for ever.
    """
    if "PYTEST_XDIST_WORKER" not in os.environ:
        return (yield)
    mine, theirs = (CLOCKED, OTHERS) if by_the_clock(item) else (OTHERS, CLOCKED)
    with contextlib.ExitStack() as stack:
        if item.get_closest_marker("alone"):
            stack.enter_context(locked(SKY, fcntl.LOCK_EX))
        with locked(QUEUE, fcntl.LOCK_EX), locked(theirs, fcntl.LOCK_EX):
            stack.enter_context(locked(mine, fcntl.LOCK_SH))
        return (yield)


def with_settings(config: Config, **sections: dict[str, Any]) -> Config:
    """`config` with leaves replaced, one dictionary for each section: `scenario={"goal_range": 0.0}`."""
    changed = {
        name: dataclasses.replace(getattr(config, name), **leaves) if isinstance(leaves, dict) else leaves
        for name, leaves in sections.items()
    }
    return configs.validate(dataclasses.replace(config, **changed))


class CompiledEnv(NamedTuple):
    """One environment with its jitted functions."""

    env: TransportEnv
    reset: Any  # key -> State
    step: Any  # (State, action (3,)) -> State

    def roll(self, state: Any, actions: Any) -> Any:
        """States after each of `actions` (T, 3), stacked over T, in NumPy."""
        states = []
        for action in actions:
            state = self.step(state, action)
            states.append(state)
        return jax.tree.map(lambda *leaves: np.stack(leaves), *states)


def compile_env(config: Config, physics: str) -> CompiledEnv:
    """Environment of `config` with its functions jitted."""
    env = TransportEnv(config, physics)
    return CompiledEnv(env, jax.jit(env.reset), jax.jit(env.step))


@pytest.fixture(scope="session")
def transport() -> Config:
    return configs.preset("transport")


@pytest.fixture(scope="session", params=[pytest.param("mjx", marks=pytest.mark.slow), "newton-euler"])
def engine(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="session")
def pair(transport: Config, engine: str) -> CompiledEnv:
    """The transport environment on each engine."""
    return compile_env(transport, engine)


@pytest.fixture(scope="session")
def mimic(transport: Config) -> CompiledEnv:
    """The transport environment with the paper's reward, on closed-form physics."""
    return compile_env(with_settings(transport, reward={"kind": "paper"}), "newton-euler")


@pytest.fixture(scope="session")
def fast_pair(transport: Config) -> CompiledEnv:
    """The transport environment on closed-form physics, for tests that do not concern the engine."""
    return compile_env(transport, "newton-euler")


def policy_of(env: TransportEnv, learner: sac.Learner) -> PolicyNetwork:
    """What SAC exports."""
    return PolicyNetwork(
        learner.average["params"], learner.normaliser.mean, learner.normaliser.std, np.array(env.input_mask)
    )


class Trained(NamedTuple):
    """A learner with lived-in weights and statistics, and what is needed to run it."""

    config: Config
    networks: Any
    learner: sac.Learner
    contents: PolicyFile


def make_trained(config: Config) -> Trained:
    """A learner whose observation statistics have seen data of very different scales, as in a real run."""
    env = TransportEnv(config, "newton-euler")
    networks = sac.make_networks(config.sac, env.input_mask, env.action_size, env.critic_mask)
    learner = sac.create(networks, config.sac, env.observation_size, jax.random.key(3))
    random = np.random.default_rng(4)
    spread, centre = random.uniform(0.05, 3.0, env.observation_size), random.normal(size=env.observation_size)
    seen = jnp.asarray(centre + spread * random.normal(size=(500, env.observation_size)), jnp.float32)
    learner = learner._replace(normaliser=sac.brax.running_statistics.update(learner.normaliser, seen))
    return Trained(
        config, networks, learner, policy_file(config, network_interface(config), policy_of(env, learner), steps=1234)
    )


@pytest.fixture(scope="session")
def trained(transport: Config) -> Trained:
    """Transport follower: it sees 18 numbers, remembers none, and ignores the absolute position."""
    return make_trained(transport)


@pytest.fixture(scope="session")
def remembering(transport: Config) -> Trained:
    """A follower with everything that it can remember; its critics are told more than it."""
    follower = {"previous_action": True, "observation_averages": (0.1, 0.5), "privileged_critic": True}
    return make_trained(with_settings(transport, follower=follower))


class Recurrent(NamedTuple):
    """A follower with a GRU, lived-in, and what is needed to run it."""

    config: Config
    network: PolicyNetwork
    contents: PolicyFile


@pytest.fixture(scope="session")
def recurrent(transport: Config) -> Recurrent:
    """A follower with 7 recurrent units, a head of two layers and critics that are told more than it."""
    follower = {"recurrent_units": 7, "previous_action": True, "privileged_critic": True}
    config = with_settings(transport, follower=follower, gradient={"policy_layers": (9, 5)})
    env = TransportEnv(config, "newton-euler")
    algorithm = FirstOrderGradient(config, Environments(env, 4))
    random = np.random.default_rng(4)
    state = algorithm.init(jax.random.key(3))
    # Weights that make the most of every input: none is near 0, as those of the last layer are at the start.
    layers = jax.tree.map(lambda leaf: np.float32(random.normal(scale=0.5, size=leaf.shape)), state.layers)
    spread, centre = random.uniform(0.05, 3.0, env.observation_size), random.normal(size=env.observation_size)
    square = np.float32(spread**2 + centre**2)
    network = algorithm.policy(
        state._replace(layers=layers, mean=np.float32(centre), square=square, seen=np.float32(1))
    )
    assert network.units
    return Recurrent(config, network, policy_file(config, network_interface(config), network, steps=1234))


def noticing_stale(contents: PolicyFile) -> PolicyFile:
    """`contents` with the input of `follower.stale`, which changes its commands."""
    added = observing_stale(contents)
    interface = interface_of(added.metadata)
    place, first = 18 + interface.history.input_size - 1, added.weights[0].copy()
    first[interface.units + place] = np.linspace(-1, 1, first.shape[1])
    gru = added.gru and (added.gru[0].copy(), *added.gru[1:])
    if gru:
        gru[0][place] = np.linspace(-1, 1, gru[0].shape[1])
    return dataclasses.replace(added, weights=(first, *added.weights[1:]), gru=gru)


def with_repeats(seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(`seen` (T, 18) with measurements that repeat the one before, whether they do (T,)).

    The object's error goes on. At other steps one number differs from the one before by a bit, the others repeat.
    """
    seen, steps = seen.copy(), np.arange(len(seen))
    repeat, almost = (steps % 4 == 3) | (steps % 20 == 12), steps % 4 == 2
    for step in range(1, len(seen)):
        if repeat[step] or almost[step]:
            seen[step, :12] = seen[step - 1, :12]
        if almost[step]:
            slot = step // 4 % 12
            seen[step, slot] = np.nextafter(seen[step, slot], np.float32(9))
    return seen, repeat


@pytest.fixture(scope="session")
def remembering_pair(remembering: Trained) -> CompiledEnv:
    """The environment that such a follower is trained in."""
    return compile_env(remembering.config, "newton-euler")


@pytest.fixture
def short_verdict(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trainings in this process judge their policy by one second of flight."""
    monkeypatch.setattr("mjxball.commands.compare.standard_scenarios", short_train.one_second)


@pytest.fixture
def saved(trained: Trained, tmp_path: Path) -> Path:
    """The transport follower's policy file."""
    path = tmp_path / "follower.npz"
    save_file(path, trained.contents)
    return path


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """A real Chromium without a window."""
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        pytest.skip("no Chromium is installed")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as play:
        running = play.chromium.launch(executable_path=program, args=["--no-sandbox"])
        yield running
        running.close()


def opened(browser: Any, page: Path, width: int) -> Any:
    """A tab `width` pixels wide with `page`, which fetches nothing else, makes no error, and fits."""
    tab = browser.new_page(viewport={"width": width, "height": 800})
    requests, errors = [], []
    tab.on("request", lambda request: requests.append(request.url))
    tab.on("pageerror", lambda error: errors.append(str(error)))
    tab.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    tab.goto(page.as_uri())
    assert [url for url in requests if not url.startswith("data:")] == [page.as_uri()]
    assert errors == []
    assert tab.evaluate("document.documentElement.scrollWidth") <= width  # nothing hangs out at the side
    return tab

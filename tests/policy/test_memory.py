"""What a follower remembers: no observation that is none spoils it, and one memory serves one thread."""

from __future__ import annotations

import copy
import re
import threading
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tables import rows

from mjxball.baselines import make_baseline
from mjxball.cli import plant_setup
from mjxball.config import preset
from mjxball.control.observation import OBSERVATION
from mjxball.errors import InputError
from mjxball.export import in_team
from mjxball.policy import Policy, load_file, shipped_policy

# One of every format, without and with a history, alone and in a batch of two; and classical followers.
POLICIES = ("paper", "flight", "balance", "universal")
SEEN = 0.1 * np.random.default_rng(3).standard_normal((40, 18))


def policy(name: str, dtype: type = np.float32) -> Policy:
    """The shipped policy `name`, told that it flies in a pair or in a team of three."""
    contents = load_file(shipped_policy(name))
    if name == "universal":
        contents = in_team(contents, name, Path("team3"), 1)
    return Policy(contents, name, dtype)


def followers() -> dict[str, Callable[[], Any]]:
    """Makers of followers by name."""
    config = preset("paper")
    ours: dict[str, Callable[[], Any]] = {name: lambda name=name: policy(name) for name in POLICIES}  # type: ignore[misc]
    return {
        **ours,
        "float64": lambda: policy("universal", np.float64),
        "lqg": lambda: make_baseline("lqg", config),
        "copy": lambda: make_baseline("copy", config),
    }


def spoilt(slot: int, value: float) -> np.ndarray:
    seen = SEEN[20].copy()
    seen[slot] = value
    return seen


NO_OBSERVATIONS = {
    "nan": (spoilt(4, np.nan), "nan for pitch"),
    "infinity": (spoilt(0, np.inf), "inf for follower_x"),
    "minus infinity": (spoilt(17, -np.inf), "-inf for object_error_rate_z"),
    "1e38": (spoilt(9, 1e38), "1e[+]38 for rate_x"),
    "more than float32 holds": (spoilt(9, -1e300), "-1e[+]300 for rate_x"),
    "beyond any flight": (spoilt(12, 2e6), "2e[+]06 for object_error_x"),
    "the least integer": (np.full(18, -(2**63)), "follower_x"),
    "words": (np.full(18, "0.5"), "<U3"),
    "bytes": (np.full(18, b"0.5"), "S3"),
    "dates": (np.full(18, np.datetime64("2026-01-01")), "datetime64"),
    "durations": (np.full(18, np.timedelta64(3, "s")), "timedelta64"),
    "objects": (np.full(18, None), "object"),
    "complex numbers": (np.full(18, 0.5 + 0.5j), "complex"),
    "truths": (np.full(18, True), "bool"),
    "what is masked": (np.ma.masked_invalid(spoilt(3, np.nan)), "masked"),
    "what is masked, in a list": ([np.ma.masked, *SEEN[0, 1:]], "masked"),
    "fractions": (np.full(18, Fraction(1, 2)), "object"),
    "a ragged list": ([[0.5]] * 17 + [[0.5, 0.5]], "no array"),
    "17 numbers": (SEEN[0, :17], "18"),
    "one number": (np.array(0.5), "18"),
}


@rows("name", followers())
def test_what_is_no_observation_is_refused_and_not_remembered(name: str) -> None:
    """Before the first sound observation and after it, alone and in a batch, the flight goes on as without it."""
    make = followers()[name]
    for shape in ((), (2,)):
        flown, alone = make(), make()
        for number, row in enumerate(SEEN[:20]):
            sound = np.broadcast_to(row, (*shape, 18))
            if number in (0, 10):
                for bad, named in NO_OBSERVATIONS.values():
                    both = [bad, bad] if shape else bad
                    with pytest.raises(InputError, match=named):
                        flown(both)
            np.testing.assert_array_equal(flown(sound), alone(sound))
    mixed = np.stack([SEEN[0], spoilt(4, np.nan)])
    with pytest.raises(InputError, match="nan for pitch"):
        flown(mixed)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_after_any_observation_that_is_taken_commands_are_finite(dtype: type) -> None:
    """Up to the largest that is: float32 can filter it, and it never spoils the rest."""
    for name in POLICIES:
        flown = policy(name, dtype)
        for slot in range(18):
            flown.reset()
            for value in (1e3, 3e5, 9.9e5):
                for seen in (SEEN[0], spoilt(slot, value), *SEEN[1:4]):
                    assert np.isfinite(flown(seen)).all(), (name, slot, value)
                    assert flown.memory is None or np.isfinite(flown.memory).all(), (name, slot, value)


def test_a_network_that_answers_nothing_finite_is_named() -> None:
    for name in POLICIES:
        flown = policy(name)
        flown._weights[0] = np.full_like(flown._weights[0], np.nan)
        with pytest.raises(InputError, match=f"policy {name} .*not finite"):
            flown(SEEN[0])
        assert flown.memory is None


def test_a_memory_that_is_none_is_refused() -> None:
    flown = policy("universal")
    flown(SEEN[0])
    size = flown.memory.size
    for memory, named in (
        (np.full(size, np.nan), "not finite"),
        (np.full(size, 1e39), "not finite"),
        (np.zeros(size - 1), f"{size}"),
        (np.full(size, "0"), "<U1"),
        (np.ma.array(flown.memory, mask=True), "masked"),
    ):
        kept = flown.memory
        with pytest.raises(InputError, match=named):
            flown.memory = memory
        np.testing.assert_array_equal(flown.memory, kept)


def in_another_thread(call: Callable[[Any], Any], given: Any) -> Any:
    """What `call` returns or raises there."""
    found: list[Any] = []

    def run() -> None:
        try:
            found.append(call(given))
        except Exception as error:  # looked at by who asks
            found.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    return found[0]


def test_one_memory_serves_one_thread() -> None:
    for name, make in followers().items():
        flown, alone = make(), make()
        if name in ("paper", "copy"):  # it remembers nothing, so that anybody may ask
            for row in SEEN[:5]:
                np.testing.assert_array_equal(in_another_thread(flown, row), alone(row))
                flown(row + 0.1)
            continue
        for row in SEEN[:5]:
            np.testing.assert_array_equal(flown(row), alone(row))
            refused = in_another_thread(flown, row + 0.1)
            assert isinstance(refused, RuntimeError), name
            assert "thread" in str(refused)
        flown.reset()  # the next flight may be another thread's
        alone.reset()
        np.testing.assert_array_equal(in_another_thread(flown, SEEN[7]), alone(SEEN[7]))
        with pytest.raises(RuntimeError, match="thread"):
            flown(SEEN[8])
        own = copy.copy(flown)  # goes on by itself, in any thread
        np.testing.assert_array_equal(own(SEEN[8]), alone(SEEN[8]))


def test_a_later_thread_does_not_go_on_with_the_flight_of_one_that_has_ended() -> None:
    """Its number is the ended one's, as often as not; nobody has reset the follower."""
    for name in ("balance", "universal", "lqg"):
        flown = followers()[name]()
        found = [in_another_thread(flown, row) for row in SEEN[:20]]
        assert isinstance(found[0], np.ndarray)
        assert [type(one) for one in found[1:]] == [RuntimeError] * 19, name
        flown.reset()
        assert isinstance(in_another_thread(flown, SEEN[0]), np.ndarray)


def test_another_number_of_flights_is_refused_before_a_reset() -> None:
    """One, several, none, with an axis more; the flight goes on as without them."""
    shapes: list[tuple[int, ...]] = [(), (2,), (3,), (0,), (3, 1), (1, 3)]
    for name, make in followers().items():
        for shape in shapes if name not in ("paper", "copy") else ():  # these remember nothing
            flown, alone = make(), make()
            for row in SEEN[:4]:
                seen = np.broadcast_to(row, (*shape, 18))
                np.testing.assert_array_equal(flown(seen), alone(seen))
                for other in shapes:
                    if other != shape:
                        with pytest.raises(InputError, match=re.escape(f"of shape {(*shape, 18)}, not {(*other, 18)}")):
                            flown(np.broadcast_to(row, (*other, 18)))
            flown.reset()
            assert flown(np.zeros((5, 18))).shape == (5, 3)
    team = Policy(load_file(shipped_policy("universal")), "universal")
    team.join(plant_setup(Path("team3")).plant)
    for shape in ((), (3,), (2, 4)):
        with pytest.raises(InputError, match="joined a team of 2 followers"):
            team(np.zeros((*shape, 18)))
    assert team(np.zeros((3, 2, 18))).shape == (3, 2, 3)


def test_many_threads_with_the_pure_law_fly_as_one_does() -> None:
    """State in, state out: four flights at once on one policy, each as if it were alone."""
    for name in POLICIES:
        controller = policy(name).controller

        def flight(number: int, controller: Any = controller) -> np.ndarray:
            flown, commands = SEEN[:15].astype(np.float32) + np.float32(0.01 * number), []
            memory = controller.start(flown[0])
            for seen in flown:
                _, command, memory = controller.answer(memory, seen)
                commands.append(command)
            return np.array(commands)

        found: dict[int, np.ndarray] = {}

        def keep(number: int, found: dict[int, np.ndarray] = found, flight: Any = flight) -> None:
            found[number] = flight(number)

        threads = [threading.Thread(target=keep, args=(number,)) for number in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        for number in range(4):
            np.testing.assert_array_equal(found[number], flight(number))
        single = policy(name)
        # One observation may be answered in double precision: float32 rounds what `universal` filters to some 1e-4.
        tolerance = 5e-4 if name == "universal" else 2e-6
        np.testing.assert_allclose(
            [single(seen) for seen in SEEN[:15].astype(np.float32)], flight(0), rtol=0, atol=tolerance
        )


def test_every_number_of_an_observation_has_a_name_for_the_refusal() -> None:
    flown = policy("balance")
    for slot, (name, unit) in enumerate(OBSERVATION):
        with pytest.raises(InputError, match=rf"nan for {name} \[{unit}\]"):
            flown(spoilt(slot, np.nan))

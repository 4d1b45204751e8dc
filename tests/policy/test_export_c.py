"""Exported C99 headers: several in one program, and observations that cannot be."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import call
from conftest import Recurrent, noticing_stale, with_repeats
from onboard_bench import compilers, needs_gcc
from tables import weekly

from mjxball.errors import InputError
from mjxball.export import in_team, main
from mjxball.policy import Policy, PolicyFile, load_file
from mjxball.policy.file import interface_of, shipped_policy
from mjxball.policy.formats import c_header

STRICT = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wshadow", "-Wconversion", "-Werror")
TWO = """
#include <stdio.h>
#include "first.h"
#include "Other-2.h"
#include "first.h"

int main(void) {
    mjxball_first_follower first = {0};
    mjxball_other_2_follower other = {0};
    float seen[18], action[3], command[2][3];
    mjxball_first_reset(&first);
    mjxball_other_2_reset(&other);
    while (fread(seen, sizeof seen, 1, stdin) == 1) {
        if (mjxball_first_follow(&first, seen, action, command[0])) return 1;
        if (mjxball_other_2_follow(&other, seen, action, command[1])) return 1;
        fwrite(command, sizeof command, 1, stdout);
    }
    return 0;
}
"""
# Each record: observation -> status, action, command.
ONE = """
#include <stdio.h>
#include "first.h"

int main(void) {
    mjxball_first_follower first = {0};
    mjxball_first_real observation[18], found[6];
    float seen[18], out[7];
    mjxball_first_reset(&first);
    while (fread(seen, sizeof seen, 1, stdin) == 1) {
        for (int k = 0; k < 18; k++) observation[k] = seen[k];
        SPOIL
        out[0] = (float)mjxball_first_follow(&first, observation, found, found + 3);
        for (int k = 0; k < 6; k++) out[1 + k] = (float)found[k];
        fwrite(out, sizeof out, 1, stdout);
    }
    return 0;
}
"""


def answers(place: Path, main_c: str, seen: np.ndarray, compiler: Sequence[str] = ("gcc", "-O1")) -> np.ndarray:
    """What the program answers to each observation of `seen` (T, 18)."""
    (place / "main.c").write_text(main_c.replace("SPOIL", ""))
    command = [*compiler, *STRICT, "main.c", "-o", "main"]
    built = subprocess.run(command, cwd=place, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    done = subprocess.run(
        ["./main"], cwd=place, input=seen.astype(np.float32).tobytes(), capture_output=True, check=True
    )
    return np.frombuffer(done.stdout, np.float32).reshape(len(seen), -1)


def observations(steps: int = 40) -> np.ndarray:
    return np.cumsum(np.random.default_rng(7).normal(scale=0.02, size=(steps, 18)), axis=0).astype(np.float32)


@needs_gcc
def test_two_policies_in_one_program(tmp_path: Path, capsys: pytest.CaptureFixture):
    """Each gives its own numbers, also with names that only an identifier has; a header is included twice."""
    names = {"first.h": "balance", "Other-2.h": "flight"}
    for file, name in names.items():
        assert call(main, [shipped_policy(name), tmp_path / file]) == 0
    seen = observations()
    found = answers(tmp_path, TWO, seen)
    wanted = []
    for name in names.values():
        policy = Policy.load(shipped_policy(name))
        wanted.append(np.array([policy(one) for one in seen]))
    np.testing.assert_allclose(found, np.hstack(wanted), rtol=0, atol=1e-5)
    assert np.abs(wanted[0] - wanted[1]).max() > 0.01


@needs_gcc
def test_two_policies_of_one_name_do_not_compile(tmp_path: Path, capsys: pytest.CaptureFixture):
    for folder, name in (("a", "balance"), ("b", "flight")):
        (tmp_path / folder).mkdir()
        assert call(main, [shipped_policy(name), tmp_path / folder / "same.h"]) == 0
    (tmp_path / "main.c").write_text('#include "a/same.h"\n#include "b/same.h"\nint main(void) { return 0; }\n')
    built = subprocess.run(["gcc", "main.c"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert built.returncode != 0
    assert "redefinition" in built.stderr


def spoilt(value: float, slot: int) -> np.ndarray:
    one = observations()[10].copy()
    one[slot] = value
    return one


def assert_leaves_no_trace(place: Path, compiler: Sequence[str] = ("gcc", "-O1")) -> np.ndarray:
    """Status 1, level, and every later answer is that of a flight which has not seen it. The calm flight's answers."""
    seen = observations()
    odd = [spoilt(value, slot) for value in (np.nan, np.inf, -np.inf, 3e38, 1e7) for slot in range(18)]
    calm = answers(place, ONE, seen, compiler)
    assert (calm[:, 0] == 0).all()
    mixed: list[Any] = [*odd[:3], *seen[:20], *odd, *seen[20:]]
    found = answers(place, ONE, np.array(mixed), compiler)
    bad = np.array([*[True] * 3, *[False] * 20, *[True] * len(odd), *[False] * 20])
    np.testing.assert_array_equal(found[~bad], calm)
    assert (found[bad, 0] == 1).all()
    assert (found[bad, 1:] == 0).all()
    return calm


@needs_gcc
@pytest.mark.parametrize(
    "name",
    ["balance", "flight", "universal", *weekly("paper", "robust")],
)
@pytest.mark.parametrize("int8", [False, True])
def test_an_observation_that_cannot_be_leaves_no_trace(name: str, int8: bool, tmp_path: Path):
    policy = load_file(shipped_policy(name))
    policy = in_team(policy, name, Path("pair")) if name == "universal" else policy
    (tmp_path / "first.h").write_text(c_header.c_header(policy, "first", int8))
    assert_leaves_no_trace(tmp_path)


@needs_gcc
@pytest.mark.parametrize("name", ["recurrent", *weekly("flight", "universal", "paper")])
def test_a_repeated_measurement_is_noticed_as_by_policy(name: str, recurrent: Recurrent, tmp_path: Path):
    """Also beside an observation that cannot be, and after a memory that cannot be, with which a flight begins anew."""
    plain = recurrent.contents if name == "recurrent" else load_file(shipped_policy(name))
    plain = in_team(plain, name, Path("pair")) if name == "universal" else plain
    contents = noticing_stale(plain)
    seen, repeats = with_repeats(observations(48))
    policy, unaware = Policy(contents, name), Policy(plain, name)
    wanted = np.array([policy(one) for one in seen])
    assert np.abs(wanted - [unaware(one) for one in seen])[repeats].max(axis=1).min() > 1e-4
    (tmp_path / "first.h").write_text(c_header.c_header(contents, "first"))
    found = answers(tmp_path, ONE, seen)
    assert (found[:, 0] == 0).all()
    np.testing.assert_allclose(found[:, 4:], wanted, rtol=0, atol=2e-5)
    between = np.insert(seen, np.flatnonzero(repeats), np.nan, axis=0)
    np.testing.assert_array_equal(answers(tmp_path, ONE, between)[np.isfinite(between[:, 0])], found)
    for slot in (0, 11):
        place = interface_of(contents.metadata).history.past_size + slot
        spoil = f"""
            static int n;
            volatile union {{ unsigned bits; float value; }} wild;
            wild.bits = 0x7FC00000u;
            if (n++ == 6) first.memory[{place}] = wild.value;"""
        after = answers(tmp_path, ONE.replace("SPOIL", spoil), seen)
        assert after[:, 0].tolist() == [0] * 6 + [2] + [0] * 41
        policy.reset()
        np.testing.assert_allclose(after[7:, 4:], [policy(one) for one in seen[7:]], rtol=0, atol=2e-5)


@needs_gcc
@pytest.mark.parametrize("int8", [False, True])
def test_compilers_that_are_told_of_finite_numbers_only_remove_no_guard(int8: bool, tmp_path: Path):
    """Of observation, memory and result, in float and double; sums that they reorder hardly differ."""
    policy = load_file(shipped_policy("balance"))
    (tmp_path / "first.h").write_text(c_header.c_header(policy, "first", int8))
    size, wanted = interface_of(policy.metadata).size, answers(tmp_path, ONE, observations())
    # In each of 20 steps another number of the memory is spoilt, and the flight begins anew with the next one.
    spoil = f"""
        static int n;
        volatile union {{ unsigned bits; float value; }} wild;
        wild.bits = BITS;
        if (n++ & 1) first.memory[n * {size // 40} + 1] = wild.value;"""
    steps = np.repeat(observations(20), 2, axis=0)
    for compiler in compilers():
        own = [*compiler, *(["-DMJXBALL_REAL=double"] if "-Ofast" in compiler else [])]
        calm = assert_leaves_no_trace(tmp_path, own)
        np.testing.assert_allclose(calm, wanted, rtol=0, atol=2e-3 if int8 else 2e-5)  # steps of 8 bits, floats
        for bits in ("0x7FC00000u", "0x7F800000u", "0xFF800000u"):  # NaN, infinity, minus infinity
            found = answers(tmp_path, ONE.replace("SPOIL", spoil.replace("BITS", bits)), steps, own)
            assert found[:, 0].tolist() == [0, 2] * 20, own
            assert not found[1::2, 1:].any()
            assert np.isfinite(found).all()


@needs_gcc
def test_a_network_without_an_answer_says_so(tmp_path: Path):
    """Weights whose products overflow: status 2 and level, never a number that is not one."""
    policy = load_file(shipped_policy("flight"))
    huge = tuple(np.full_like(weight, 3e37) * np.sign(weight) for weight in policy.weights)
    broken = PolicyFile(**{**policy.__dict__, "weights": huge})
    (tmp_path / "first.h").write_text(c_header.c_header(broken, "first"))
    found = answers(tmp_path, ONE, observations())
    assert (found[:, 0] == 2).all()
    assert (found[:, 1:] == 0).all()


def test_sums_of_wide_layers_must_fit_into_32_bits(monkeypatch: pytest.MonkeyPatch):
    policy = load_file(shipped_policy("balance"))
    bound = c_header.WIDEST_INT8
    assert 128 * 32767 * bound < 2**31 <= 128 * 32767 * (bound + 8)
    monkeypatch.setattr(c_header, "WIDEST_INT8", 63)  # of its hidden layers of 64
    c_header.c_header(policy, "balance")
    with pytest.raises(InputError, match="8 bits 63 at most"):
        c_header.c_header(policy, "balance", int8=True)

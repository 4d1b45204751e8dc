"""Followers on board: both roles under everything at once, and faults in the app that this must report."""

from __future__ import annotations

import onboard_fuzz as fuzz
import pytest
from onboard_bench import needs_gcc

TICKS = 200_000
# A fault: file, what is replaced by what, roles in which it must be reported.
FAULTS = (
    ("checks.h", "if (!fault) app->set = *asked;", "app->set = *asked;", (0, 1)),
    ("checks.h", "within(state->velocity, 3, MOST_SPEED)", "true", (0, 1)),
    ("packets.h", "!within(beat.velocity, 3, MOST_SPEED)", "false", (0, 1)),
    ("packets.h", "at + count > app->upload.size", "false", (1,)),
    ("packets.h", "if (!weights_are_good(memory)) return MJXBALL_BAD_UPLOAD;", "(void)weights_are_good;", (1,)),
    ("packets.h", "if (app->phase != MJXBALL_IDLE) return MJXBALL_NOT_ON_GROUND;", "", (1,)),
    (
        "core.c",
        "if (out->active && !setpoint_is_good(out)) distrust(app, map, out);",
        "(void)setpoint_is_good;",
        (0, 1),
    ),
)


@needs_gcc
def test_nothing_makes_an_app_command_what_it_must_not():
    """No report of the sanitizers, no output outside the limits; and nearly everything was reached on the way."""
    for number in range(2):
        reached: set[str] = set()
        for place, (name, int8) in enumerate(fuzz.POLICIES):
            found = fuzz.fuzz(fuzz.sources_of(name, int8), number, TICKS // len(fuzz.POLICIES), 1 + place)
            assert found.get("report") is None, (number, name, found)
            assert found["ticks"] == TICKS // len(fuzz.POLICIES)
            assert min(found["phases"].values()) > 0.01 * found["ticks"]
            reached |= set(found["causes"]) | set(found["refusals"])
            if number and int8:
                assert found["accepted"] > 0
                assert found["refused"] > found["accepted"]
        assert len(reached) >= 18, reached


@pytest.mark.release
@needs_gcc
def test_a_check_that_is_missing_is_reported():
    files = fuzz.sources_of("flight", True)
    for name, old, new, roles in FAULTS:
        assert files[name].count(old) == 1, old
        for role in roles:
            faulty = {**files, name: files[name].replace(old, new)}
            assert "report" in fuzz.fuzz(faulty, role, TICKS, 1), (role, old)

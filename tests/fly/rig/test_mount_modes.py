"""Loops on elastic mounts: closed forms, the criterion against C MuJoCo and the twin, the gains that are chosen."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tables import rows

from mjxball.config import Autopilot, Config, preset
from mjxball.control.axes import axes
from mjxball.control.constants import hover
from mjxball.control.crazyflie import pair_gains
from mjxball.errors import InputError
from mjxball.physics.autopilot import make_autopilot
from mjxball.physics.engine import Load
from mjxball.physics.mujoco import make_engine
from mjxball.physics.step import make_plant_step, start_state
from mjxfly.gain_design import apply, design, design_axis, keeps_margins
from mjxfly.main import main as fly
from mjxfly.margins import REQUIREMENTS, Gains, delivered_gains, gains_of, loop_gain
from mjxfly.mount_modes import (
    RIGID,
    Loop,
    Mount,
    fraction,
    has_mode_margin,
    is_stable_on,
    loop_on_mount,
    lowest_mode,
    peak_gain,
)
from mjxfly.parameters import check_mount
from mjxfly.policy_setup import variants
from mjxfly.rig import gains as command
from mjxfly.twin.conditions import Conditions, Surroundings
from mjxfly.twin.coupled import CoupledPair

PAIR = preset("flight")
ROLL, PITCH, _ = axes(PAIR)
SHIPPED = gains_of(PAIR.autopilot, ROLL)
SOFT = Gains((1.08, 0.0, 0.0), (840.0, 742.0, 0.0))
STIFF = Mount(100.0)


@pytest.fixture(scope="module")
def chosen():
    """Designs for modes from 100 Hz on."""
    return design(PAIR, STIFF)


class TestLoop:
    LOOP = Loop(SHIPPED, ROLL.gain, 0.0235, 0.05, 0.01, math.inf)

    def test_slow_motion_is_that_of_the_rigid_pair(self) -> None:
        """At a twentieth of the mode's frequency the mount adds 1 / 20^2 of the drone's share, far below 1 %."""
        frequency = np.geomspace(0.1, 30.0, 40)
        top, bottom = fraction(self.LOOP, Mount(100.0), False, 1j * frequency)
        found = top / bottom * np.exp(-0.01j * frequency)
        np.testing.assert_allclose(found, loop_gain(SHIPPED, ROLL.gain, 0.05, 0.01, frequency), rtol=0.15)
        top, bottom = fraction(self.LOOP, Mount(1e5), False, 1j * frequency)
        found = top / bottom * np.exp(-0.01j * frequency)
        np.testing.assert_allclose(found, loop_gain(SHIPPED, ROLL.gain, 0.05, 0.01, frequency), rtol=1e-4)

    def test_fast_motion_is_that_of_a_drone_alone(self) -> None:
        frequency = np.geomspace(3e4, 1e5, 10)
        alone = loop_gain(SHIPPED, ROLL.gain / 0.0235, 0.05, 0.0, frequency)
        for opposed in (False, True):
            top, bottom = fraction(self.LOOP, Mount(5.0), opposed, 1j * frequency)
            np.testing.assert_allclose(top / bottom, alone, rtol=1e-4)

    def test_peak(self) -> None:
        """A rate loop alone on drones that turn against each other: kp g / share / (2 zeta w) / |1 + lag j w|."""
        omega = 2 * math.pi * 60
        loop = self.LOOP._replace(gains=Gains((0.0, 0.0, 0.0), (1000.0, 0.0, 0.0)))
        expected = 1000 * ROLL.gain / 0.0235 / (2 * 0.02 * omega) / math.hypot(1, 0.05 * omega)
        assert peak_gain(loop, np.array([60.0]), 0.02)[0] == pytest.approx(
            expected, rel=0.02
        )  # the other peak is 1.2 % on

    def test_the_lowest_mode_is_where_the_margin_begins(self) -> None:
        for gains in (SHIPPED, SOFT):
            loop = loop_on_mount(gains, ROLL, PAIR)
            lowest = lowest_mode(loop, 0.02)
            assert has_mode_margin(loop, Mount(1.02 * lowest))
            assert not has_mode_margin(loop, Mount(0.97 * lowest))
            assert peak_gain(loop, np.array([lowest]), 0.02)[0] == pytest.approx(1 / REQUIREMENTS.gain, rel=0.05)
        assert lowest_mode(loop, 0.1) < 0.6 * lowest  # five times the damping: the gain falls with w^2 zeta

    def test_shipped_roll_gains_are_unstable_on_a_wooden_stick(self) -> None:
        """At 10 ms of delay, for modes of 5 to 80 Hz with 2 % of damping; those for 100 Hz from 60 Hz on are stable."""
        loop, soft = (loop_on_mount(gains, ROLL, PAIR) for gains in (SHIPPED, SOFT))
        for frequency in (5.0, 10.0, 20.0, 35.0, 60.0, 80.0):
            assert not is_stable_on(loop, Mount(frequency)), frequency
        for frequency in (60.0, 80.0, 100.0, 200.0, 400.0):
            assert is_stable_on(soft, Mount(frequency)), frequency


def with_gains(roll: Gains, pitch: Gains) -> Autopilot:
    return replace(PAIR.autopilot, roll=roll.attitude, roll_rate=roll.rate, pitch=pitch.attitude, pitch_rate=pitch.rate)


def swing(autopilot: Autopilot, mount: Mount, axis: int, size: float) -> float:
    """Largest swing of a drone at the end over that at the beginning of 0.8 s of hover in C MuJoCo.

    Both drones are pushed by `size` [rad], together and against each other. Motor commands come four ticks late: with
    their hold of 2 ms a delay of 9 ms.
    """
    plant = replace(PAIR.plant, mount_frequency=mount.frequency, mount_damping=mount.damping)
    config = replace(PAIR, plant=plant, autopilot=autopilot)
    zero, mass, vector = np.zeros(2), np.full(2, plant.object_mass), np.zeros((2, 3))
    state = start_state(config, vector, vector, vector, mass, zero)
    rate = np.zeros((2, 2, 2))
    rate[..., axis] = size * 2 * math.pi * mount.frequency * np.array([[1.0, 1.0], [1.0, -1.0]])
    own, sent = make_autopilot(config), []

    def late(state, commands, load):
        loops, target = own(state, commands, load)
        sent.append(target)
        return loops, sent[max(0, len(sent) - 5)]

    step = make_plant_step(config, make_engine(plant, config.attitude, config.physics_step), autopilot=late)
    state = state._replace(mount_rate=rate)
    load = Load(mass, mass, zero, zero, zero, np.zeros((2, 0)), np.zeros((2, 0)))
    seen = []
    for _ in range(80):
        state = step(state, np.zeros((2, 2, 3)), load)
        seen.append(np.abs(state.mount_angle[..., axis]).max(axis=1))
    return float((np.max(seen[-20:], axis=0) / np.max(seen[:20], axis=0)).max())


@rows(
    ("axis", "gains", "frequency", "size"),
    [
        # Saturation bounds what grows, and the motor commands' whole numbers stop what is tiny.
        (0, SOFT, 30.0, 1e-3),
        (0, SOFT, 60.0, 1e-3),
        (0, SHIPPED, 60.0, 1e-5),
        (1, delivered_gains(PITCH), 40.0, 1e-4),
        (1, delivered_gains(PITCH), 75.0, 1e-4),
    ],
)
def test_the_criterion_says_what_mujoco_does(axis: int, gains: Gains, frequency: float, size: float) -> None:
    """A swing together or against each other grows where the criterion says unstable, else both decay."""
    loop = loop_on_mount(gains, (ROLL, PITCH)[axis], PAIR)._replace(delay=0.009, cutoff=math.inf)
    autopilot = with_gains(*((gains, delivered_gains(PITCH)) if axis == 0 else (SOFT, gains)))
    left = swing(autopilot, Mount(frequency), axis, size)
    if is_stable_on(loop, Mount(frequency)):
        assert left < 0.3
    else:
        assert left > 1.0


class TestDesign:
    def test_lower_gains_where_the_margin_is_missing(self, chosen) -> None:
        rigid = design(PAIR)
        for one, before in zip(chosen[:2], rigid[:2], strict=True):
            assert before.lowest > STIFF.frequency >= one.lowest
            assert one.gains.rate[0] < before.gains.rate[0]
            assert keeps_margins(one.gains, one.axis, PAIR.plant.rotor_lag)
            loop = loop_on_mount(one.gains, one.axis, PAIR)
            assert all(is_stable_on(loop, Mount(frequency)) for frequency in np.geomspace(100.0, 1000.0, 25))
        assert chosen[2] == rigid[2]  # nothing turns about yaw

    def test_stiff_mounts_change_nothing(self) -> None:
        assert [one.gains for one in design(PAIR, Mount(400.0))] == [one.gains for one in design(PAIR)]

    def test_soft_mounts_are_refused_with_what_would_help(self) -> None:
        with pytest.raises(
            InputError, match=r"from 20 Hz on: at a damping of 0\.02 the softest ones need \d\d Hz; stiffer"
        ):
            design_axis(ROLL, PAIR, Mount(20.0))
        assert design_axis(ROLL, PAIR, Mount(60.0, 0.1)).lowest <= 60.0  # damping helps

    def test_they_still_swing_on_the_twin_and_stop(self, chosen) -> None:
        """A push of both drones in hover, with the twin's sensors: gone after a second with the gains for this mount,
        while the shipped ones keep it up."""
        left = {}
        for name, autopilot in (("chosen", apply(PAIR.autopilot, chosen)), ("shipped", PAIR.autopilot)):
            around = Surroundings(noise=0.0, mount=Mount(60.0 if name == "shipped" else 100.0))
            pair = CoupledPair(PAIR, Conditions(PAIR.plant.object_mass), surroundings=around)
            for drone, gains in enumerate(pair_gains(autopilot)):
                for parameter, value in gains.items():
                    pair.set_parameter(drone, parameter, value)
            left[name] = push_on_twin(pair, PAIR)
        assert left["chosen"] < 0.02
        assert left["shipped"] > 0.3


def push_on_twin(pair: CoupledPair, config: Config) -> float:
    """Amplitude of the mounts' roll in the last quarter of a second of hover over that in the first."""
    zero, above = np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]])
    state = start_state(config, above, zero, zero, np.array([config.plant.object_mass]), np.zeros(1))
    rate = np.array([[2.0, 0.0], [2.0, 0.0]])
    pair.place(state.each(lambda leaf: leaf[0])._replace(mount_angle=0 * rate, mount_rate=rate))
    seen = []
    for _ in range(100):
        pair.advance(np.array([[0, 0, 0, hover(config)[0]]] * 2), 0.01)
        seen.append(max(abs(float(pair.data.joint(f"{name}_roll").qpos[0])) for name in ("leader", "follower")))
    return max(seen[-25:]) / max(seen[:25])


class TestFlight:
    def test_gains_are_checked_before_they_are_uploaded(self, chosen) -> None:
        check_mount(PAIR, variants(PAIR), RIGID)
        check_mount(PAIR, variants(PAIR), Mount(500.0))
        with pytest.raises(InputError, match="the leader's roll gains need mounts of"):
            check_mount(PAIR, variants(PAIR), STIFF)
        linear = {name: each["linear"] for name, each in zip(("leader", "follower"), variants(PAIR), strict=True)}
        soft = pair_gains(apply(PAIR.autopilot, chosen))
        both = [{"linear": linear[name]._replace(gains=own)} for name, own in zip(linear, soft, strict=True)]
        check_mount(PAIR, both, STIFF)
        with pytest.raises(InputError, match="trained on Crazyflies"):
            check_mount(preset("transport"), variants(PAIR), STIFF)

    def test_commands(self, tmp_path: Path, capsys) -> None:
        out = tmp_path / "gains.json"
        assert command.main(["--mount-hz", "100", "--out", str(out)]) == 0
        assert "from 90 Hz" in capsys.readouterr().out
        assert out.exists()
        (tmp_path / "soft.json").write_text('{"plant.mount_frequency": 100}')
        assert command.main(["--plant", str(tmp_path / "soft.json")]) == 0
        assert "from 90 Hz" in capsys.readouterr().out
        for flags, said in (
            (("--mount-hz", "0.5"), "1 to 1000"),
            (("--mount-damping", "0.1"), "needs --mount-hz"),
            (("--mount-hz", "90", "--mount-damping", "1"), "below 1"),
            (("--mount-hz", "25"), "stiffer mounts"),
        ):
            assert command.main([*flags, "--out", str(tmp_path / "no.json")]) == 2
            assert said in capsys.readouterr().err
        assert not (tmp_path / "no.json").exists()
        assert fly(["policies/flight.npz", "--rehearse", "--mount-hz", "50"]) == 2
        assert "roll gains need mounts of" in capsys.readouterr().err
        assert fly(["policies/balance.npz", "--rehearse", "--twin-mount", "50", "0.02"]) == 2
        assert "--twin-mount is for policies" in capsys.readouterr().err
        assert fly(["policies/flight.npz", "--rehearse", "--twin-mount", "500", "0.02"]) == 2
        assert "--twin-mount: HZ must be 1 to 250" in capsys.readouterr().err

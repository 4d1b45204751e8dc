"""The mode of a mount from taps: exact signals, taps on the twin with its sensors' noise, the command."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from tables import rows
from wire import pack_state

from mjxball.config import preset, to_dict
from mjxball.control.crazyflie import gains_to_json, pair_gains
from mjxfly.flight_log import Journal
from mjxfly.mount_modes import Mount
from mjxfly.packets import DroneState
from mjxfly.rig import mount as command
from mjxfly.rig.ring_down import find_mode
from mjxfly.twin.conditions import Conditions, Surroundings
from mjxfly.twin.coupled import CoupledPair

PAIR = preset("flight")


def ringing(frequency: float, damping: float, period: float = 0.01, seconds: float = 4.0) -> tuple[np.ndarray, ...]:
    """Time and rate of a gyroscope on a hand-held mode that is tapped at 0.5, 1.5, 2.5 s."""
    random = np.random.default_rng(3)
    time = np.arange(0.0, seconds, period)
    rate = 0.1 * np.sin(1.3 * time) + 2e-3 * random.standard_normal(len(time))
    omega = 2 * math.pi * frequency
    for begin, size in ((0.5, 1.0), (1.5, -0.7), (2.5, 0.8)):
        since = np.maximum(time - begin, 0.0)
        swing = np.exp(-damping * omega * since) * np.cos(omega * math.sqrt(1 - damping**2) * since)
        rate = rate + size * swing * (time >= begin)
    return time, rate


@rows(("frequency", "damping"), [(6.0, 0.02), (20.0, 0.01), (23.4, 0.02), (35.0, 0.05), (46.0, 0.02), (25.0, 0.15)])
def test_a_damped_oscillation(frequency: float, damping: float) -> None:
    """Noise of 2 mrad/s and a swaying hand; a tenth of the rows lost. Rates of 0.7 rad/s leave errors far below 1 %."""
    time, rate = ringing(frequency, damping)
    kept = np.random.default_rng(4).random(len(time)) > 0.1
    found = find_mode(time[kept], rate[kept])
    assert found is not None
    assert found.taps >= 2  # a slow one still rings at the next tap
    assert found.frequency == pytest.approx(frequency, rel=0.005)
    assert found.damping == pytest.approx(damping, rel=0.1)


def test_what_does_not_ring() -> None:
    """Noise, a swaying hand, and steps that decay without a swing."""
    time, _ = ringing(20.0, 0.02)
    noise = 2e-3 * np.random.default_rng(5).standard_normal(len(time))
    for rate in (noise, noise + np.sin(3 * time), noise + np.exp(-8 * (time % 1.0))):
        assert find_mode(time, rate) is None


def tapped(frequency: float, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Time (T,) and rates (T, 2, 3) as the twin's drones log them, floating and tapped three times, motors off."""
    around = Surroundings(seed=2, mount=Mount(frequency, damping))
    pair = CoupledPair(PAIR, Conditions(PAIR.plant.object_mass), surroundings=around)
    pair.model.opt.gravity[:] = 0.0
    pair.data.qpos[2] = 1.0
    found = []
    for size in (1.0, -1.5, 1.2):
        for name, share in (("leader_roll", 1.0), ("leader_pitch", 0.6)):
            pair.data.joint(name).qvel += share * size
        for _ in range(110):
            found.append(np.round(pair.advance(np.zeros((2, 4)), 0.01).report.rates, 3))  # sent in mrad/s
    return 0.01 * np.arange(len(found)), np.stack(found)


@pytest.mark.parametrize("frequency", [12.0, 23.4, 41.0])
def test_taps_on_the_twin(frequency: float, tmp_path: Path, capsys) -> None:
    """Within 3 %. About roll the tapped drone beats between f and the 1.2 % faster mode of both against the stick."""
    time, rates = tapped(frequency, 0.02)
    for axis in (0, 1):
        found = find_mode(time, rates[:, 0, axis])
        assert found is not None
        assert found.frequency == pytest.approx(frequency, rel=0.03)
        assert found.damping == pytest.approx(0.02, rel=0.25)
    np.savez(tmp_path / "taps.npz", time=time, rates=rates[:, 0])
    assert command.main([str(tmp_path / "taps.npz")]) == 0
    text = capsys.readouterr().out
    least = float(text.partition("--mount-hz ")[2].split()[0])
    assert 0.95 * frequency - 1 < least <= 1.03 * frequency
    assert "above 50 Hz" in text


def test_a_dry_run(tmp_path: Path, capsys) -> None:
    """States as the drones send them, by their clocks, which begin anew meanwhile; arrivals are late at random."""
    path, random = tmp_path / "taps.jsonl", np.random.default_rng(6)
    header = {"policy": "nobody", "config": to_dict(PAIR), "gains": gains_to_json(pair_gains(PAIR.autopilot))}
    signals = {"leader": ringing(31.0, 0.02), "follower": ringing(27.0, 0.02)}
    with Journal(path, **header) as log:
        for number in range(400):
            for name, (time, rate) in signals.items():
                state = DroneState(np.zeros(3), np.zeros(3), np.eye(4)[0], np.array([0.0, rate[number], 0.0]), 3, 3.9)
                stamp = (2**24 - 1000 + 10 * number) % 2**24
                raw = (b"\x01" + stamp.to_bytes(3, "little") + pack_state(state)).hex()
                log.note("state", float(time[number]) + 0.008 * random.random(), drone=name, raw=raw)
    assert command.main([str(path)]) == 0
    text = capsys.readouterr().out
    assert "leader   pitch 31.0 Hz, damping 2.0 %" in text
    assert "mount mode: 27.0 Hz, damping 2.0 %; gains need --mount-hz 26" in text


def test_a_fast_log_shows_a_fast_mode(tmp_path: Path, capsys) -> None:
    time, rate = ringing(120.0, 0.02, period=0.002)
    np.savez(tmp_path / "card.npz", time=time, rates=np.stack([0 * rate, rate, 0 * rate], axis=1))
    assert command.main([str(tmp_path / "card.npz")]) == 0
    text = capsys.readouterr().out
    assert "mount mode: 120.0 Hz, damping 2.0 %" in text
    assert "tape" not in text


@rows(
    ("content", "said"),
    [
        ({"time": np.zeros(3)}, "no .npz of time and rates"),
        ({"time": np.arange(99.0), "rates": np.zeros((99, 2))}, "must hold time"),
        ({"time": np.arange(9.0), "rates": np.zeros((9, 3))}, "taps need a second"),
        ({"time": np.arange(99) / 100, "rates": np.zeros((99, 3))}, "no oscillation is found"),
    ],
)
def test_other_logs_are_refused(tmp_path: Path, capsys, content: dict, said: str) -> None:
    np.savez(tmp_path / "a.npz", **content)
    assert command.main([str(tmp_path / "a.npz")]) == 2
    assert said in capsys.readouterr().err
    (tmp_path / "a.npz").unlink()

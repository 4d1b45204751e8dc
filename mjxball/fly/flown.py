"""What a pair flew with, as its log tells: the force curve of each drone's firmware, and the gains that it had."""

from __future__ import annotations

import math
from typing import NamedTuple

from mjxball.config import Config
from mjxball.control.firmware_gains import PARAMETERS, Gains, PairGains
from mjxball.fly.card import ThrustChoice, command_maps, gains_of, with_curve
from mjxball.fly.command import CURVE_NAMES, CurveName, ForceCurve
from mjxball.fly.limits import NAMES
from mjxball.fly.log_schema import Record

RECORDS = ("thrust", "parameter")  # kinds that `Flown.after` takes
SAME = 1e-5  # of two gains of which one was sent as a 32-bit float


class Flown(NamedTuple):
    """See the module; leader and follower."""

    curves: tuple[CurveName, CurveName]
    gains: PairGains

    @classmethod
    def of(cls, header: Record) -> Flown:
        """What a log's `header` says; a curve that it does not name is the one that the policy's numbers are for."""
        curve = header.get("curve") or own_curve(header["config"])
        return cls((curve, curve), header["gains"])

    def after(self, record: Record, config: Config) -> Flown:
        """What holds after one more record of `RECORDS`, of a flight by a policy of `config`.

        A firmware that is found to have another curve is given the card's gains for it, and keeps those that were
        not the card's.
        """
        number = NAMES.index(record["drone"])
        curves, gains = list(self.curves), list(self.gains)
        if record["kind"] == "thrust":
            gains[number] = _for_curve(gains[number], config, number, curves[number], record["curve"])
            curves[number] = record["curve"]
        elif record["name"] in PARAMETERS:
            gains[number] = {**gains[number], record["name"]: record["value"]}
        return Flown((curves[0], curves[1]), (gains[0], gains[1]))

    def force_curves(self, config: Config) -> tuple[ForceCurve, ForceCurve]:
        """Force of both drones' motors by the thrust that they are sent."""
        leader, follower = (force_curve(config, name) for name in self.curves)
        return leader, follower


def own_curve(config: Config) -> CurveName:
    """The curve of the firmware that the numbers of `config` are for."""
    return next(name for name in CURVE_NAMES if with_curve(config, name) is config)


def force_curve(config: Config, name: CurveName) -> ForceCurve:
    """Force of a motor of the rig of `config` on a firmware of the curve `name`."""
    return command_maps(with_curve(config, name), ThrustChoice(curve=name))[0].curve


def one_curve(curves: tuple[CurveName, CurveName]) -> CurveName | None:
    """The curve of both drones, None if they have different ones."""
    return curves[0] if curves[0] == curves[1] else None


def _for_curve(gains: Gains, config: Config, number: int, before: CurveName, after: CurveName) -> Gains:
    """`gains` of drone `number`, of which those that were the card's for one curve become the card's for another."""
    old, new = (gains_of(with_curve(config, name))[number] for name in (before, after))
    return {
        name: new[name] if name in old and math.isclose(value, old[name], rel_tol=SAME) else value
        for name, value in gains.items()
    }

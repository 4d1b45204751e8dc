"""The ablation of disturbances leaves out what it names, and flies the same plant if a follower is given its loops."""

from __future__ import annotations

import dataclasses

import numpy as np

import ablation
from mjxball.baselines import make_baseline
from mjxball.bench.draw import groups_of
from mjxball.bench.flying import ENGINE
from mjxball.sim.rollout import simulate

(GROUP,) = groups_of(ablation.TRACK, 0)
FLIGHTS = ablation.without(GROUP, ablation.PARTS["nothing"]).flights


def test_every_part_is_left_out_and_nothing_else() -> None:
    assert {one.condition for one in FLIGHTS} == {"disturbed"}
    assert tuple(one for one in GROUP.flights if one.condition == "disturbed") == FLIGHTS
    changed = {
        name: {
            field.name
            for one, other in zip(FLIGHTS, ablation.without(GROUP, part).flights, strict=True)
            for field in dataclasses.fields(one.scenario)
            if getattr(one.scenario, field.name) != getattr(other.scenario, field.name)
        }
        for name, part in ablation.PARTS.items()
    }
    assert changed.pop("nothing") == set()
    assert changed.pop("off-nominal attitude loops") == {"loop_scale"}
    assert changed.pop("other thrusts") == {"thrust", "thrust_fade"}
    assert changed.pop("air") == {"disturbance", *ablation.NO_AIR}
    assert set(map(frozenset, changed.values())) == {frozenset({"disturbance"})}
    calm = ablation.PARTS["all of these"](FLIGHTS[0].scenario).disturbance
    assert {name for name, value in dataclasses.asdict(calm).items() if value} <= {"gust", "gust_seed", "seed"}


def test_the_flight_is_the_same_if_the_nominal_loops_are_its_own() -> None:
    flight = next(one for one in FLIGHTS if one.scenario.loop_scale > 1.5)
    (own,) = (group := ablation.with_own_loops(GROUP.config, flight)).flights
    assert own.scenario.loop_scale == 1.0
    flown = [
        simulate(config, make_baseline("copy", config), dataclasses.replace(scenario, seconds=3.0), ENGINE)
        for config, scenario in ((GROUP.config, flight.scenario), (group.config, own.scenario))
    ]
    np.testing.assert_allclose(flown[0].position, flown[1].position, atol=1e-9)

"""Teams that lose a drone in flight."""

from __future__ import annotations

import dataclasses

import numpy as np

from mjxball import config as configs
from mjxball.baselines import make_baseline
from mjxball.config import preset
from mjxball.sim.rollout import simulate_batch
from mjxball.sim.scenario import CIRCLE, Scenario

ENGINE = "newton-euler"


def test_a_controller_that_knows_of_the_loss_makes_up_for_it() -> None:
    """Six drones with a load on a circle lose each follower in turn; commands reach what the rotors left over can do.

    Undisturbed, what is left to it is the discrete time of commands: half a millimetre. A follower that knows nothing
    of the loss is lost, so that it is one that matters.
    """
    config = configs.replace(preset("lost"), "command.vertical_limit", 12.0)
    flight = Scenario(omega=1.0, amplitude=0.1, mass=0.6, path=CIRCLE, goal=(0.0, 0.0, 0.0), seconds=12.0)
    losses = [dataclasses.replace(flight, lost=((k, 3.0),)) for k in config.plant.followers]
    found = {}
    for name in ("oracle", "adaptive-mass"):
        flown = simulate_batch(config, [(make_baseline(name, config), losses)], ENGINE)
        found[name] = np.linalg.norm(flown.error, axis=-1)
    assert found["oracle"].max() < 1e-3
    assert found["adaptive-mass"][-1].min() > 0.1

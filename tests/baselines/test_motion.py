"""The linear motion that all controllers of the family share."""

from __future__ import annotations

import numpy as np
from tables import rows

from mjxball.baselines.assembly_model import ideal_model
from mjxball.baselines.linear import discretise
from mjxball.baselines.lqg import OffsetFree
from mjxball.baselines.motion import AXES, EZ, LIFT, LIFT_ERROR, STATES, VZ, motion
from mjxball.config import Config, preset
from mjxball.plant.teams import ring_config


@rows("config", [preset("paper"), ring_config(preset("team"), 4)])
def test_one_period_is_that_of_the_equations_of_motion(config: Config) -> None:
    """From a random state, against RK4 in steps of 0.2 ms."""
    model, tuning = ideal_model(config, "test"), OffsetFree.tuning._replace(load_time=3.0, rate_time=0.3, lift_time=5.0)
    random, steps = np.random.default_rng(0), 100
    start, drive, h = 0.1 * random.normal(size=STATES), random.normal(size=3), model.period / steps

    def slope(x: np.ndarray) -> np.ndarray:
        found, count = np.zeros(STATES), config.plant.count
        for axis, (error, velocity, angle, rate, torque, load, growth) in enumerate(AXES):
            found[error], found[velocity] = x[velocity], (9.81, -9.81)[axis] * x[angle]
            found[angle], found[rate] = x[rate], (x[torque] + x[load]) / model.inertia[axis]
            asked = drive[axis] - count * (model.kp[axis] * x[angle] + model.kd[axis] * x[rate])
            found[torque] = (asked - x[torque]) / model.lag
            found[load], found[growth] = x[growth] - x[load] / 3.0, -x[growth] / 0.3
        found[EZ], found[VZ] = x[VZ], -x[LIFT] - x[LIFT_ERROR]
        found[LIFT], found[LIFT_ERROR] = (drive[2] - x[LIFT]) / model.lag, -x[LIFT_ERROR] / 5.0
        return found

    x = start
    for _ in range(steps):
        k1 = slope(x)
        k2 = slope(x + h / 2 * k1)
        k3 = slope(x + h / 2 * k2)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + slope(x + h * k3))
    transition, held = discretise(*motion(model, tuning), model.period)
    np.testing.assert_allclose(transition @ start + held @ drive, x, rtol=1e-6, atol=1e-9)

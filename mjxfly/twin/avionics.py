"""`OnboardComputers` of both drones, from sensors to motor PWM, and their `BatteriesAndMotors`."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mjxball.config import Autopilot
from mjxball.control import crazyflie, motors
from mjxball.control.crazyflie import PARAMETERS, gains_of, with_gains
from mjxfly.twin.conditions import OLDER_FORCE, Battery, DroneKind, Surroundings
from mjxfly.twin.estimators import Complementary, Imu, Kalman, euler_of
from mjxfly.twin.pair import RUNNING, Report, SupervisorOutputs, remembered
from mjxfly.twin.parameters import COMPLEMENTARY, ESTIMATOR, KALMAN
from mjxfly.twin.positioning import SWITCHES, Deck, positioning_of

FILTER_GAIN = 0.01  # of the firmware's low-pass filter of the voltage, at 1000 Hz
FILTER_START = 4.2  # [V]


class BatteriesAndMotors:
    """Batteries of both drones, the firmware's filtered voltage and compensation, and the motors' force."""

    def __init__(self, kind: DroneKind, battery: Battery, strength: tuple[float, float]):
        self.kind, self.strength = kind, np.array(strength, float)[:, None]
        self._battery = battery
        self.charge = np.full(2, battery.full)  # [V] without load
        self.sag = np.full(2, battery.sag)  # [V] at full power
        self.fading = np.zeros(2)  # [V/s] discharge of a faulty cell, independent of the load
        self._filtered = np.full((2, 1), FILTER_START)
        self.requested = np.zeros((2, 4))
        self.voltage = self.charge.copy()

    def compensate(self, thrust: np.ndarray) -> np.ndarray:
        """Return the PWM (2, 4), before clipping, for `thrust` commands (2, 4) [thrust units]."""
        self.requested = self._compensated(thrust, self._filtered)
        return self.requested

    def one(self, drone: int) -> Callable[[np.ndarray], np.ndarray]:
        """Return the function `compensate` of one drone, for thrust commands (4,)."""

        def compensate(thrust: np.ndarray) -> np.ndarray:
            requested = self._compensated(thrust, self._filtered[drone])
            self.requested = self.requested.copy()
            self.requested[drone] = requested
            return requested

        return compensate

    def _compensated(self, thrust: np.ndarray, voltage: np.ndarray) -> np.ndarray:
        found = motors.compensated(self.kind.constants, thrust, voltage) if self.kind.compensated else thrust
        return np.asarray(np.trunc(found))

    def drain(self, pwm: np.ndarray, seconds: float) -> None:
        """Discharge for `seconds` [s] at `pwm` (2, 4); the voltage follows the load without delay."""
        load = pwm.mean(axis=1) / motors.FULL
        self.charge = self.charge - (self._battery.drain * load + self.fading) * seconds
        self.voltage = self.charge - self.sag * load
        share = 1 - (1 - FILTER_GAIN) ** round(1000 * seconds)
        self._filtered = self._filtered + share * (self.voltage[:, None] - self._filtered)

    def force(self, pwm: np.ndarray) -> np.ndarray:
        """Return the steady force (2, 4) [N] of every motor at `pwm` (2, 4)."""
        if self.kind.older_force:
            return self.strength * crazyflie.motor_force(OLDER_FORCE, pwm)
        return self.strength * motors.force(self.kind.constants, pwm, self.voltage[:, None])


TICK = 2  # [ms] period of the cascade
PREDICTION = 10  # [ms] period of the Kalman filter's predictions
COMPLEMENTARY_PERIOD = 4  # [ms]
# Parameters with an effect on `OnboardComputers`, each with the index of the value that it sets.
INITIAL = {f"kalman.initial{axis}": place for place, axis in enumerate("XYZ")}
DEVIATIONS = {"locSrv.extPosStdDev": 0, "locSrv.extQuatStdDev": 1}
RESET, IDLE = "kalman.resetEstimation", "powerDist.idleThrust"
ACTED = frozenset({*PARAMETERS, *INITIAL, *DEVIATIONS, *SWITCHES, RESET, IDLE, ESTIMATOR})


class OnboardComputers:
    """Both drones' sensors, estimators and controllers. Times in whole milliseconds since the start."""

    def __init__(self, kind: DroneKind, surroundings: Surroundings, autopilot: Autopilot, power: BatteriesAndMotors):
        self.kind, self.surroundings, self.power = kind, surroundings, power
        random = np.random.default_rng([surroundings.seed, 7])
        self.imu = Imu(random, surroundings.noise)
        self.filters = [Kalman(), Kalman()]
        self.plain = [Complementary(random), Complementary(random)]
        self.positioning = [positioning_of(surroundings, random, drone) for drone in range(2)]
        self.estimators = [KALMAN if surroundings.deck else COMPLEMENTARY] * 2
        self.deviations = [[0.01, 4.5e-3], [0.01, 4.5e-3]]  # of poses [m, rad]: locSrv.extPosStdDev, extQuatStdDev
        self.poses = np.zeros((2, 7))
        self.initial = np.zeros((2, 3))  # [m] position after a reset of the filter: kalman.initialX, Y, Z
        self.idle = [float(kind.idle)] * 2
        self._autopilots = [autopilot] * 2
        self._compare_gains()
        self.pwm, self.thrust = np.zeros((2, 4)), np.zeros(2)
        self._setpoints, self._modes = np.zeros((2, 4)), RUNNING
        self._summed, self._counts = np.zeros((2, 6)), [0, 0]
        self._resets: set[int] = set()
        self._euler = np.zeros((2, 3))

    def start(self, positions: np.ndarray, quaternions: np.ndarray, velocity: np.ndarray | None = None) -> None:
        """Initialise the estimators to the true `positions` (2, 3), `quaternions` (2, 4), `velocity` (2, 3) or rest."""
        for number, one in enumerate(self.filters):
            if self.estimators[number] == KALMAN:
                one.reset(positions[number], quaternions[number])
                for _ in range(20):
                    one.correct(positions[number], quaternions[number], (0.01, 4.5e-3))
                if velocity is not None:
                    one.body_velocity = one.matrix.T @ velocity[number]
            self.plain[number].quaternion = np.array(quaternions[number])
            self._update_euler(number)
        self._loops = crazyflie.start_loops(self._euler, self.imu.filtered[:, 3:])

    # Packets of the laptop.

    def set_parameter(self, drone: int, name: str, value: float) -> None:
        """Apply a written parameter; names that are not in `ACTED` have no effect."""
        if name in PARAMETERS:
            self._autopilots[drone] = with_gains(self._autopilots[drone], {name: value})
            self._compare_gains()
        elif name == RESET and value:
            self._resets.add(drone)
        elif name == ESTIMATOR:
            self._switch(drone, int(value))
        elif name in INITIAL:
            self.initial[drone, INITIAL[name]] = value
        elif name == IDLE and not self.kind.auto_arm:
            self.idle[drone] = value
        elif name in DEVIATIONS:
            self.deviations[drone][DEVIATIONS[name]] = max(value, 1e-6)
        elif name in SWITCHES:
            self.positioning[drone].switch(name, value)

    def receive_pose(self, drone: int, position: np.ndarray, quaternion: np.ndarray | None) -> None:
        """Record a pose from outside and correct the Kalman filter by it; the complementary filter ignores it."""
        if self._modes.held[drone]:
            return
        self.poses[drone] = remembered(self.poses[drone], position, quaternion)
        if self.estimators[drone] == KALMAN:
            std = self.deviations[drone]
            self.filters[drone].correct(position, quaternion, (std[0], std[1]))
            self._update_euler(drone)

    def _switch(self, drone: int, kind: int) -> None:
        if kind != self.estimators[drone]:
            self.estimators[drone] = kind
            if kind == KALMAN:
                self.filters[drone].reset()
            self._update_euler(drone)

    def _compare_gains(self) -> None:
        """Set `_alike`: gains equal but for one factor on all ki. One batched cascade then serves both drones."""
        one, other = (gains_of(autopilot) for autopilot in self._autopilots)
        integral = [name for name in one if name.endswith("_ki")]
        shares = {round(other[name] / one[name], 9) for name in integral if one[name]} or {1.0}
        same = all(one[name] == other[name] for name in one if name not in integral or not one[name])
        self._alike = same and len(shares) == 1
        self._shares = np.array([[1.0], [next(iter(shares))]])

    # Every millisecond.

    def order(self, setpoints: np.ndarray, modes: SupervisorOutputs) -> None:
        """Set the `setpoints` (2, 4) and supervisor outputs that hold from now on."""
        self._setpoints, self._modes = setpoints, modes

    def sense(self, step: int, raw: np.ndarray, where: Callable[[], tuple[np.ndarray, np.ndarray, np.ndarray]]) -> None:
        """Run the estimators at millisecond `step` on `raw` (2, 6) specific force [m/s2] and rates [rad/s].

        `where` returns the true positions (2, 3), quaternions (2, 4) and the carrier's rotation matrix (3, 3).
        """
        held = self._modes.held
        before = self.imu.filtered
        samples = self.imu.sample(raw, self.pwm.max(axis=1, keepdims=True) > 0)
        if held[0] or held[1]:
            samples = self.imu.filtered = np.where(np.array(held)[:, None], before, samples)
        self._summed += samples
        for drone in range(2):
            if held[drone]:
                continue
            self._counts[drone] += 1
            if drone in self._resets:
                self._resets.discard(drone)
                self.filters[drone].reset(self.initial[drone])
            if self.estimators[drone] == KALMAN:
                self._filter(step + drone * PREDICTION // 2, drone)
                system = self.positioning[drone]
                if system.due(step):
                    positions, quaternions, _ = where()
                    if isinstance(system, Deck):
                        system.correct(
                            self.filters[drone], positions[drone], quaternions[drone], samples[drone, 3:], step
                        )
                        self._update_euler(drone)
                    else:
                        self.receive_pose(drone, *system.measure(positions[drone], quaternions[drone]))
            elif step % COMPLEMENTARY_PERIOD == 0:
                height = float(where()[0][drone, 2])
                self.plain[drone].update(samples[drone, :3], samples[drone, 3:], height, COMPLEMENTARY_PERIOD * 1e-3)
                self._update_euler(drone)

    def _filter(self, step: int, drone: int) -> None:
        if step % PREDICTION:
            return
        mean = self._summed[drone] / max(self._counts[drone], 1)
        self._summed[drone], self._counts[drone] = 0.0, 0
        self.filters[drone].predict(mean[:3], mean[3:], self._modes.flying[drone])
        self._update_euler(drone)

    def _update_euler(self, drone: int) -> None:
        self._euler[drone] = euler_of(self._attitude(drone))

    def _attitude(self, drone: int) -> np.ndarray:
        return (self.filters if self.estimators[drone] == KALMAN else self.plain)[drone].quaternion

    # Every second millisecond.

    def control(self, euler: np.ndarray | None = None, rates: np.ndarray | None = None) -> np.ndarray:
        """Run both cascades; return the PWM (2, 4) until the next call.

        `euler` (2, 3) [rad] and `rates` (2, 3) [rad/s] replace the estimates, if given.
        """
        measured = self._euler if euler is None else euler, self.imu.filtered[:, 3:] if rates is None else rates
        autopilots, setpoints, power = self._autopilots, self._setpoints, self.power
        if self._alike:
            shared = self._loops, setpoints, *measured, self._shares, power.compensate
            loops, pwm = crazyflie.cascade(autopilots[0], *shared)
        else:
            inputs = [(autopilots[n], self._loops[n], setpoints[n], measured[0][n], measured[1][n]) for n in range(2)]
            rows = [crazyflie.cascade(*one, compensate=power.one(n)) for n, one in enumerate(inputs)]
            loops, pwm = (np.stack(part) for part in zip(*rows, strict=True))
        run, held, _ = self._modes
        pwm = np.maximum(np.trunc(pwm), np.array(self.idle)[:, None])
        thrust = setpoints[:, 3]
        if run != (True, True):
            pwm = np.where(np.array(run)[:, None], pwm, 0.0)
        if held != (False, False):
            frozen = np.array(held)
            pwm, thrust = np.where(frozen[:, None], self.pwm, pwm), np.where(frozen, self.thrust, thrust)
        self._loops, self.pwm, self.thrust = loops, pwm, thrust
        return pwm

    def report(self) -> Report:
        """Return the drones' report from their estimators."""
        position, velocity, attitude = (np.zeros((2, size)) for size in (3, 3, 4))
        variance = np.zeros((2, 9))
        for drone, one in enumerate(self.filters):
            plain = self.plain[drone]
            attitude[drone] = self._attitude(drone)
            variance[drone] = one.covariance.ravel()[::10]
            if self.estimators[drone] == KALMAN:
                position[drone], velocity[drone] = one.position, one.velocity
            else:
                position[drone, 2], velocity[drone, 2] = plain.height, plain.climb
        return self.reported(position, velocity, attitude, self.imu.filtered[:, 3:], variance)

    def reported(
        self, position: np.ndarray, velocity: np.ndarray, attitude: np.ndarray, rates: np.ndarray, variance: np.ndarray
    ) -> Report:
        """Return a report with the given estimates, shapes as in `Report`."""
        acceleration = self.imu.filtered[:, :3].copy()
        kinds = (self.estimators[0], self.estimators[1])
        drive = self.pwm, self.power.requested, self.thrust
        poses = self.poses.copy()
        return Report(position, velocity, attitude, rates.copy(), acceleration, variance, kinds, *drive, poses)

"""The coupled Crazyflie model of the twin: both drones' computers, motors and batteries on C MuJoCo.

MuJoCo steps the model of `twin.grounded` every millisecond. Each drone runs the cascade of `control.crazyflie` on its
estimates. `physics.motion` moves the ball, as in simulation.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np

from mjxball.assembly import BALL_JOINT, FOLLOWER, LEADER
from mjxball.config import Config
from mjxball.control import crazyflie, rotations
from mjxball.control.crazyflie import with_stock_gains
from mjxball.physics import motion
from mjxball.physics.engine import Load, PlantState
from mjxball.physics.mounts import own_quaternion, own_rates
from mjxball.physics.mujoco import slide_force
from mjxball.plant.rotors import lag_weights
from mjxfly.twin.avionics import TICK, BatteriesAndMotors, OnboardComputers
from mjxfly.twin.conditions import DELIVERED, QUIET, Conditions, DroneKind, Surroundings
from mjxfly.twin.grounded import STEP, attach_load, grounded_model, with_mount
from mjxfly.twin.pair import RUNNING, PairState, SupervisorOutputs

WORN_SAG = 0.47  # [V] at full power; with 3.0 V the pair falls as with the real firmware: 1.15 m/s after 0.65 s
SENSED = 6  # values of one drone's accelerometer and gyroscope


class CoupledPair:
    """Implements `Pair`. `start` resets the state and keeps the written parameters."""

    def __init__(
        self,
        config: Config,
        conditions: Conditions | None = None,
        kind: DroneKind = DELIVERED,
        surroundings: Surroundings = QUIET,
    ):
        config = with_mount(config, surroundings.mount)
        self.config, self.conditions = config, conditions or Conditions.of(config)
        self.kind, self.surroundings = kind, surroundings
        plant = config.plant
        self.model = grounded_model(config, self.conditions.object_mass)
        self._loaded = False
        self._free, self._heaves = plant.stand == "free", plant.stand == "heave"
        self._elastic = plant.mount_frequency > 0
        self._roll = 1 if self._heaves else 0  # joint of a stand's roll
        self._mounts = np.array([drone.mount for drone in plant.pair])
        self._slide = self.model.joint(BALL_JOINT).dofadr[0]
        self._slide_position = self.model.joint(BALL_JOINT).qposadr[0]
        self._drones = [self.model.body(name).id for name in (LEADER, FOLLOWER)]
        self._share = plant.moving_fraction
        self._rolling = config.motion.kind == "rolling"
        self._roll_force = motion.make_rolling_force(config)
        self._prescribed = None if self._rolling else motion.make_cg_motion(config)
        load = self.conditions
        mass, amplitude, speed, zero = map(np.float64, (load.object_mass, load.cg_amplitude, load.cg_speed, 0.0))
        self._load = Load(mass, mass, amplitude, speed, zero, np.zeros(0), np.zeros(0))
        self._keep, self._mean = lag_weights(plant.rotor_lag * self.conditions.rotor_lag, None, STEP)
        self.onboard = OnboardComputers(kind, surroundings, with_stock_gains(config.autopilot), self._new_power())
        self.start()

    def _new_power(self) -> BatteriesAndMotors:
        one, other = (a * b for a, b in zip(self.conditions.thrust, self.surroundings.gains, strict=True))
        return BatteriesAndMotors(self.kind, self.conditions.battery, (one, other))

    def start(self) -> PairState:
        """See `Pair.start`."""
        if self._loaded:
            self.model, self._loaded = grounded_model(self.config, self.conditions.object_mass), False
        self.data = mujoco.MjData(self.model)
        self._rotors, self._targets = np.zeros((2, 4)), np.zeros((2, 4))
        self.power = self.onboard.power = self._new_power()
        self._steps, self._flown = 0, 0.0
        self._time_left, self._moving = 0.0, False
        self._place_ball()
        return self._settle()

    def place(self, state: PlantState) -> PairState:
        """Set the pair to a simulation's `state` (no batch), with running motors, and return the new state."""
        data = self.data
        if self._free:
            data.qpos[:7], data.qvel[:6] = [*state.position, *state.quaternion], [*state.velocity, *state.rates]
        else:
            roll, root = float(rotations.roll_of_quaternion(state.quaternion)), self._roll + 1
            data.qpos[:root] = [state.position[2], roll][-root:]
            data.qvel[:root] = [state.velocity[2], state.rates[0]][-root:]
        if self._elastic and state.mount_angle is not None:
            self._hinges(data.qpos)[:], self._hinges(data.qvel)[:] = state.mount_angle, state.mount_rate
        data.qpos[self._slide_position], data.qvel[self._slide] = state.ball_offset, state.ball_rate
        self._rotors = np.array(state.rotor_force)
        data.ctrl[:] = self._rotors.ravel()
        self._moving, self._flown, self._steps = True, float(state.time), 2 * TICK
        self._place_ball()
        placed = self._settle()
        self.onboard._loops = np.array(state.loops)
        return placed

    def _settle(self) -> PairState:
        """Initialise sensors and estimators at the pair's true state; return it."""
        mujoco.mj_forward(self.model, self.data)
        position, quaternions, matrix = self._pose()
        velocity = self._velocity(matrix)
        self.onboard.imu.settle(self._sensed())
        self.onboard.start(position, quaternions, velocity)
        return self._state()

    def set_parameter(self, drone: int, name: str, value: float) -> None:
        """See `Pair.set_parameter`."""
        self.onboard.set_parameter(drone, name, value)

    def receive_pose(self, drone: int, position: np.ndarray, quaternion: np.ndarray | None) -> None:
        """See `Pair.receive_pose`."""
        self.onboard.receive_pose(drone, position, quaternion)

    def disturb(self, drone: int, what: str, value: float) -> None:
        """See `Pair.disturb`."""
        match what:
            case "battery":  # a failing cell has a higher resistance
                self.power.charge[drone], self.power.sag[drone] = value, WORN_SAG
            case "fade":
                self.power.fading[drone] = value
            case "gain":
                self.power.strength[drone] *= value
            case _:
                self.onboard.positioning[drone].disturb(what, value)

    def advance(self, setpoints: np.ndarray, dt: float, modes: SupervisorOutputs = RUNNING) -> PairState:
        """See `Pair.advance`. Steps are whole milliseconds; the rest of `dt` is carried over to the next call."""
        self._time_left += dt
        self.onboard.order(np.asarray(setpoints, float), modes)
        count = round(self._time_left / STEP)
        self._time_left -= count * STEP
        for _ in range(count):
            self._step()
        return self._state()

    def _step(self) -> None:
        model, data = self.model, self.data
        load = self.surroundings.load
        if load is not None and not self._loaded and self._moving and self._flown >= load.after:
            attach_load(model, self.config.plant, load.mass, load.offset)
            self._loaded = True
        mujoco.mj_step1(model, data)
        if self._steps % TICK == 0:
            self._run_cascades()
        gap = (
            self._rotors - self._targets
        )  # at the start of the step; `_keep` of it is left at the end, `_mean` on average
        self._rotors = self._targets + self._keep * gap
        data.ctrl[:] = (self._targets + self._mean * gap).ravel()
        data.qfrc_applied[self._slide] = self._push_ball()
        mujoco.mj_step2(model, data)
        self._steps += 1
        self._flown += STEP * self._moving
        self._place_ball()
        if not self.surroundings.exact:
            self.onboard.sense(self._steps, self._sensed(), self._pose)

    def _run_cascades(self) -> None:
        """Run both cascades once and set the motors' target forces."""
        if self.surroundings.exact:
            euler = rotations.euler_from_matrix(self.data.xmat[self._drones].reshape(2, 3, 3))
            pwm = self.onboard.control(euler, self._turning())
        else:
            pwm = self.onboard.control()
        self._moving = self._moving or bool((self.onboard.thrust >= crazyflie.IDLE).any())
        self.power.drain(pwm, TICK * STEP)
        self._targets = self.power.force(pwm)

    def _rates(self) -> np.ndarray:
        velocity = self.data.qvel
        return velocity[3:6].copy() if self._free else np.array([velocity[self._roll], 0.0, 0.0])

    def _hinges(self, joints: np.ndarray) -> np.ndarray:
        """(2, 2) view of positions or velocities: each drone on its elastic mount about its own x and y."""
        end = len(joints) - 1  # the ball's slide is last
        return joints[end - 4 : end].reshape(2, 2)

    def _turning(self) -> np.ndarray:
        """Rates (2, 3) of both drones."""
        both = np.stack([self._rates()] * 2)
        if not self._elastic:
            return both
        return own_rates(both[0], self._hinges(self.data.qpos), self._hinges(self.data.qvel), np.zeros(2))

    # The ball.

    def _push_ball(self) -> float:
        """Force on the ball along its slide [N]: friction and stops, or the force that its prescribed motion needs."""
        model, data = self.model, self.data
        if self._rolling:
            offset, rate = data.qpos[self._slide_position], data.qvel[self._slide]
            return float(self._roll_force(offset, rate, self._share * self._load.object_mass))
        if not self._moving:
            return 0.0
        assert self._prescribed is not None
        data.qfrc_applied[self._slide] = 0.0
        mujoco.mj_fwdActuation(model, data)
        acceleration = self._prescribed(np.float64(self._flown), self._load).acceleration / self._share
        slides = slice(self._slide, self._slide + 1)
        return float(slide_force(model, data, slides, acceleration, data.qfrc_actuator - data.qfrc_bias)[0])

    def _place_ball(self) -> None:
        """Set a prescribed ball to its trajectory, against integration drift; a rolling one to its start in step 0."""
        if self._rolling:
            if self._steps == 0:
                self.data.qpos[self._slide_position] = self.conditions.ball
            return
        assert self._prescribed is not None
        cg = self._prescribed(np.float64(self._flown), self._load)
        self.data.qpos[self._slide_position] = cg.offset / self._share
        self.data.qvel[self._slide] = cg.rate / self._share if self._moving else 0.0

    @property
    def cg_offset(self) -> float:
        """See `Pair.cg_offset`."""
        return float(self._share * self.data.qpos[self._slide_position])

    @property
    def rotor_force(self) -> np.ndarray:
        """See `Pair.rotor_force`."""
        return self._rotors.copy()

    # Sensor inputs and true state.

    def _sensed(self) -> np.ndarray:
        """(2, 6) specific force [m/s2] and rates [rad/s] of both drones, body axes, of the previous step."""
        return self.data.sensordata.reshape(2, SENSED)

    def _quaternion(self) -> np.ndarray:
        q = self.data.qpos
        half = 0.0 if self._free else q[self._roll] / 2
        return q[3:7].copy() if self._free else np.array([math.cos(half), math.sin(half), 0.0, 0.0])

    def _of_origin(self, joints: np.ndarray) -> np.ndarray:
        """O's position or velocity (3,) in the world from the joints' positions or velocities."""
        return joints[:3] if self._free else np.array([0.0, 0.0, joints[0] if self._heaves else 0.0])

    def _pose(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions (2, 3) and quaternions (2, 4) of both drones, and the stick's rotation matrix (3, 3)."""
        quaternion = self._quaternion()
        matrix = rotations.matrix_from_quaternion(quaternion)
        both = np.stack([quaternion] * 2)
        if self._elastic:
            both = own_quaternion(quaternion, self._hinges(self.data.qpos), np.zeros(2))
        return self._of_origin(self.data.qpos) + self._mounts @ matrix.T, both, matrix

    def _velocity(self, matrix: np.ndarray) -> np.ndarray:
        """Velocities (2, 3) of both drones in the world."""
        return self._of_origin(self.data.qvel) + rotations.cross(self._rates(), self._mounts) @ matrix.T

    def _state(self) -> PairState:
        position, both, matrix = self._pose()
        velocity, turning = self._velocity(matrix), self._turning()
        if self.surroundings.exact:
            self.onboard.imu.settle(self._sensed())
            report = self.onboard.reported(position, velocity, both, turning, np.full((2, 9), 1e-5))
        else:
            report = self.onboard.report()
        force, battery = self._sensed()[:, :3].copy(), self.power.voltage.copy()
        return PairState(position, velocity, both, turning, force, battery, report)

"""The coupled Crazyflie model behind the twin: both firmwares' cascades, motors and batteries over C MuJoCo.

MuJoCo steps the model of `mjxball.assembly` every millisecond, with legs and a floor added, so that the pair stands on
the ground (a stand: on its rest, its lowest place) and takes off and lands by contact. The laws are those of
`control.crazyflie`; what moves the ball is `physics.motion`, as in simulation.
"""

from __future__ import annotations

import dataclasses
import math

import mujoco
import numpy as np

from mjxball.assembly import ASSEMBLY, BALL_JOINT, FOLLOWER, LEADER, build_spec
from mjxball.config import Config
from mjxball.control import crazyflie, rotations
from mjxball.control.firmware_gains import PARAMETERS, with_gains, with_stock_gains
from mjxball.fly.twin.body import PairState
from mjxball.fly.twin.conditions import Conditions
from mjxball.physics import motion
from mjxball.physics.engine import Load, PlantState

STEP = 0.001  # [s] of MuJoCo and the motors; the cascade runs at every second one
TICK = round(crazyflie.PERIOD / STEP)
LEG = 0.03  # [m] from a drone's centre down to what it stands on
REACH = 0.03  # [m] from a drone's centre sideways to each of its legs
FOOT = 0.003  # [m] radius


class CoupledPair:
    """See `body.Pair`. One instance is one pair; `start` begins anew and keeps the gains."""

    def __init__(self, config: Config, conditions: Conditions | None = None):
        self.config, self.conditions = config, conditions or Conditions.of(config)
        plant = dataclasses.replace(config.plant, object_mass=self.conditions.object_mass)
        self.model = grounded_model(config, self.conditions.object_mass)
        self.data = mujoco.MjData(self.model)
        self._free = plant.stand == "free"
        self._mounts = np.array([plant.leader_mount, plant.follower_mount])
        self._slide = self.model.joint(BALL_JOINT).dofadr[0]
        self._slide_position = self.model.joint(BALL_JOINT).qposadr[0]
        self._body = self.model.body(ASSEMBLY).id
        self._share = plant.moving_fraction
        self._rolling = config.motion.kind == "rolling"
        self._roll_force = motion.make_rolling_force(config)
        self._prescribed = None if self._rolling else motion.make_prescribed(config)
        mass, amplitude, speed, zero = map(
            np.float64, (self.conditions.object_mass, self.conditions.cg_amplitude, self.conditions.cg_speed, 0.0)
        )
        self._load = Load(mass, mass, amplitude, speed, zero, np.zeros(0), np.zeros(0))
        self._unit = np.zeros((1, self.model.nv))
        self._unit[0, self._slide] = 1.0
        lag = plant.rotor_lag * self.conditions.rotor_lag
        self._keep = math.exp(-STEP / lag)
        self._mean = lag / STEP * (1 - self._keep)
        self._strength = np.array(self.conditions.thrust)[:, None]
        self._autopilots = [with_stock_gains(config.autopilot)] * 2
        self._alike = True
        self.start()

    def start(self) -> PairState:
        """See `Pair.start`."""
        mujoco.mj_resetData(self.model, self.data)
        self._rotors, self._targets, self._motors = np.zeros((2, 4)), np.zeros((2, 4)), np.zeros((2, 4))
        self._charge = np.full(2, self.conditions.battery.full)
        self._steps, self._flown = 0, 0.0
        self._left, self._moving = 0.0, False
        self._place_ball()
        mujoco.mj_forward(self.model, self.data)
        self._loops = crazyflie.start_loops(*self._seen())
        return self._state()

    def place(self, state: PlantState) -> PairState:
        """Put the pair, motors running, into a simulation's `state` (one world) and return it."""
        data = self.data
        if self._free:
            data.qpos[:7], data.qvel[:6] = [*state.position, *state.quaternion], [*state.velocity, *state.rates]
        else:
            roll = float(rotations.roll_of_quaternion(state.quaternion))
            data.qpos[:-1] = [state.position[2], roll][-len(data.qpos) + 1 :]
            data.qvel[:-1] = [state.velocity[2], state.rates[0]][-len(data.qvel) + 1 :]
        data.qpos[self._slide_position], data.qvel[self._slide] = state.ball_offset, state.ball_rate
        self._rotors, self._loops = np.array(state.rotor_force), np.array(state.loops)
        self._moving, self._flown, self._steps = True, float(state.time), 2 * TICK
        self._place_ball()
        mujoco.mj_forward(self.model, data)
        return self._state()

    def set_parameter(self, drone: int, name: str, value: float) -> None:
        """See `Pair.set_parameter`."""
        if name not in PARAMETERS:
            return
        self._autopilots[drone] = with_gains(self._autopilots[drone], {name: value})
        self._alike = self._autopilots[0] == self._autopilots[1]

    def advance(self, setpoints: np.ndarray, dt: float) -> PairState:
        """See `Pair.advance`; `dt` is made of whole milliseconds, what is left over is made good later."""
        self._left += dt
        self._moving = self._moving or bool((setpoints[:, 3] >= crazyflie.IDLE).any())
        count = round(self._left / STEP)
        self._left -= count * STEP
        for _ in range(count):
            self._step(setpoints)
        battery = self.conditions.battery
        self._charge = self._charge - battery.drain * dt * self._power()
        return self._state()

    def _step(self, setpoints: np.ndarray) -> None:
        model, data = self.model, self.data
        mujoco.mj_step1(model, data)
        if self._steps % TICK == 0:
            self._fly(setpoints)
        acting = self._targets + self._mean * (self._rotors - self._targets)
        self._rotors = self._targets + self._keep * (self._rotors - self._targets)
        data.ctrl[:] = acting.ravel()
        data.qfrc_applied[self._slide] = self._push_ball()
        mujoco.mj_step2(model, data)
        self._steps += 1
        self._flown += STEP * self._moving
        self._place_ball()

    def _fly(self, setpoints: np.ndarray) -> None:
        """Both cascades, once: what the motors are to give from now on."""
        seen, law = self._seen(), self._autopilots
        if self._alike:
            self._loops, self._motors = crazyflie.cascade(law[0], self._loops, setpoints, *seen)
        else:
            rows = [
                crazyflie.cascade(law[n], self._loops[n], setpoints[n], *(part[n] for part in seen)) for n in range(2)
            ]
            self._loops, self._motors = (np.stack(part) for part in zip(*rows, strict=True))
        left = max(1.0 - law[0].sag * self._flown, 0.0)
        self._targets = left * self._strength * crazyflie.motor_force(law[0].motor_curve, self._motors)

    def _seen(self) -> tuple[np.ndarray, np.ndarray]:
        """Euler angles and body rates (2, 3) of both drones, which are the assembly's."""
        euler = rotations.euler_from_matrix(self.data.xmat[self._body].reshape(3, 3))
        return np.stack([euler] * 2), np.stack([self._rates()] * 2)

    def _rates(self) -> np.ndarray:
        velocity = self.data.qvel
        return velocity[3:6].copy() if self._free else np.array([velocity[1 if self._heaves else 0], 0.0, 0.0])

    @property
    def _heaves(self) -> bool:
        return self.config.plant.stand == "heave"

    # The ball.

    def _push_ball(self) -> float:
        """Force on the ball along its slide [N]: friction and stops, or what its prescribed motion takes."""
        model, data = self.model, self.data
        if self._rolling:
            offset, rate = data.qpos[self._slide_position], data.qvel[self._slide]
            return float(self._roll_force(offset, rate, self._share * self._load.object_mass))
        if not self._moving:
            return 0.0
        assert self._prescribed is not None
        data.qfrc_applied[self._slide] = 0.0
        mujoco.mj_fwdActuation(model, data)
        free, response = np.zeros((1, model.nv)), np.zeros((1, model.nv))
        mujoco.mj_solveM(model, data, free, (data.qfrc_actuator - data.qfrc_bias)[None])
        mujoco.mj_solveM(model, data, response, self._unit)
        wanted = self._prescribed(np.float64(self._flown), self._load).acceleration / self._share
        return float((wanted - free[0, self._slide]) / response[0, self._slide])

    def _place_ball(self) -> None:
        """Put a prescribed ball where it is to be, so that no error adds up; a rolling one at its start."""
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
        """Where the CG is, from O along the stick [m]."""
        return float(self._share * self.data.qpos[self._slide_position])

    @property
    def rotor_force(self) -> np.ndarray:
        """(2, 4) of leader and follower [N]."""
        return self._rotors.copy()

    # What the firmware is shown.

    def _power(self) -> np.ndarray:
        return self._motors.mean(axis=1) / crazyflie.FULL

    def _state(self) -> PairState:
        position, quaternion, velocity, acceleration, turning = self._root()
        rates, matrix = self._rates(), rotations.matrix_from_quaternion(quaternion)
        swing = rotations.cross(rates, self._mounts)
        whirl = rotations.cross(turning, self._mounts) + rotations.cross(rates, swing)
        felt = (acceleration + np.array([0.0, 0.0, self.config.plant.gravity])) @ matrix + whirl
        return PairState(
            position=position + self._mounts @ matrix.T,
            velocity=velocity + swing @ matrix.T,
            quaternion=np.stack([quaternion] * 2),
            rates=np.stack([rates] * 2),
            specific_force=felt,
            battery=self._charge - self.conditions.battery.sag * self._power(),
        )

    def _root(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """O's position, attitude, velocity, acceleration, and the angular acceleration in body axes."""
        q, v, a = self.data.qpos, self.data.qvel, self.data.qacc
        if self._free:
            return q[:3].copy(), q[3:7].copy(), v[:3].copy(), a[:3].copy(), a[3:6].copy()
        first = 1 if self._heaves else 0
        rise = np.array([[part[0] if self._heaves else 0.0] for part in (q, v, a)]) * np.array([0.0, 0.0, 1.0])
        half = q[first] / 2
        quaternion = np.array([math.cos(half), math.sin(half), 0.0, 0.0])
        return rise[0], quaternion, rise[1], rise[2], np.array([a[first], 0.0, 0.0])


def grounded_model(config: Config, object_mass: float) -> mujoco.MjModel:
    """The assembly's model with contact: O is at height 0 while the drones' legs stand on the floor."""
    plant = dataclasses.replace(config.plant, object_mass=object_mass)
    spec = build_spec(plant, STEP)
    disabled = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    spec.option.disableflags &= ~int(disabled)
    floor = spec.geom("floor")
    lowest = min(plant.leader_mount[2], plant.follower_mount[2])
    floor.pos = [0.0, 0.0, lowest - LEG - FOOT if plant.stand != "pivot" else -1.0]
    floor.contype, floor.conaffinity = 1, 2
    for name in (LEADER, FOLLOWER):
        drone = spec.body(name)
        places = [(x, y, -LEG) for x in (-REACH, REACH) for y in (-REACH, REACH)]
        for place in (*places, (0.0, 0.0, LEG)):
            leg = drone.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[FOOT, 0, 0], pos=place, mass=0.0)
            leg.contype, leg.conaffinity, leg.solref = 2, 1, [0.008, 1.0]
    return spec.compile()

"""Numbers of the pages that follow from the code: its constants, its settings, its shipped rigs and policies."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
from command_line import REPOSITORY
from tables import rows, says

from mjxball import config as configs
from mjxball import xla
from mjxball.cli import plant_setup
from mjxball.config import Autopilot, apply_overrides, preset, thrust_over_weight, total_mass
from mjxball.control import crazyflie, follower_law, motors
from mjxball.control.axes import axes
from mjxball.control.constants import hover
from mjxball.control.margins import REQUIREMENTS as NEED
from mjxball.evaluate import metrics
from mjxball.physics import engine
from mjxball.plant import plant_parameters
from mjxball.plant.trim import heaviest_object, largest_amplitude
from mjxball.policy import container, file
from mjxball.policy.formats.c_header import weight_bytes
from mjxball.sim import disturbances
from mjxball.sim.rigs import HELD_OUT_RIGS
from mjxball.train import loop
from mjxball.train.program import EVALUATION_SECONDS
from mjxfly import card, measured, monitor, positioning, preflight, probe, setpoints, takeoff, uri, watchdog
from mjxfly.app import protocol
from mjxfly.limits import Limits, Times
from mjxfly.mocap_supervision import MocapLimits
from mjxfly.twin.conditions import Battery
from mjxfly.twin.coupled import WORN_SAG
from mjxfly.view import live

DEG = 180 / math.pi
PAIR, OLDER, UPGRADE, BRUSHLESS = (
    plant_setup(Path(f"crazyflie{name}")) for name in ("", "-older", "-thrust-upgrade", "-brushless")
)
GRAMS = [1e3 * one.plant.drones[0].mass for one in (PAIR, UPGRADE, BRUSHLESS)]
RIG, LIMITS, TIMES, MOCAP, READY = PAIR.plant, Limits(), Times(), MocapLimits(), preflight.Preflight()
BALL = 1e3 * RIG.object_mass * RIG.moving_fraction
LAW, REFERENCE, FLIGHT, STAND = Autopilot(), preset("paper"), preset("flight"), preset("stand").leader
TWO, OWN, ADDED, DRAWN = REFERENCE.plant, REFERENCE.command, preset("transport").follower, FLIGHT.scenario
KP = [float(gain) for gain in plant_parameters(TWO, REFERENCE.attitude).gains.kp]
WN = REFERENCE.attitude.natural_frequency
TILT = 0.2 * 9.81 * 0.05 / KP[1]  # [rad] of a command that holds 0.2 kg 5 cm off
TEAM, PLATE = (plant_setup(Path(name)).plant for name in ("team3", "plate4"))
WIDE = apply_overrides(REFERENCE, {"plant.cg_axis": "xy", "plant.object_size": (0.34, 0.3, 0.05)})
REACH = [100 * largest_amplitude(one, 0.2, 0.0, (0.0, 1.0)) for one in (WIDE.plant, WIDE)]
FULL = float(motors.force(motors.MOTORS["2.1"], np.array(crazyflie.FULL), 3.0 - WORN_SAG))
LIFT = 8 * FULL / 9.81 / total_mass(RIG)  # share of the weight that a battery of 3 V carries
NOISE = disturbances.NOISE[[0, 3, 6, 9]] * [1e3, DEG, 1, 1]
APP = "".join(path.read_text() for path in sorted((REPOSITORY / "mjxfly/app").glob("*.[ch]")))
C = {name: float(value) for name, value in re.findall(r"#define (\w+) ([\d.e-]+)[fu]?\b", APP)}


def script(name: str) -> dict[str, float]:
    """Numbers that a benchmark names at its head, several in a line."""
    text = (REPOSITORY / "benchmarks" / f"{name}.py").read_text()
    lines = re.findall(r"^([A-Z]+(?:, [A-Z]+)*) = ([\d.]+(?:, [\d.]+)*)(?=$|  #)", text, flags=re.MULTILINE)
    pairs = [pair for names, numbers in lines for pair in zip(names.split(", "), numbers.split(", "), strict=True)]
    return {name: float(number) for name, number in pairs}


def weights(name: str) -> list[int]:
    """Recurrent units, units of the layer, and all numbers of a shipped policy."""
    with np.load(REPOSITORY / "policies" / f"{name}.npz") as found:
        sizes = [found[key].size for key in found if key.startswith(("weight", "bias", "gru"))]
        return [len(found["gru_recurrent"]), len(found["bias_0"]), sum(sizes)]


STEADY, RIGS, CELLS = script("horizon"), script("rigs"), script("cells")
UPLOAD = len(weight_bytes(file.load_file(file.shipped_policy("flight"))))
UNITS = [*weights("balance")[:2], *weights("universal")[:2]]
SAID: dict[str, tuple[tuple[Any, ...], ...]] = {  # page: phrase with # for its numbers, and these
    "README": (("a recurrent network of # numbers", weights("balance")[2]),),
    "docs/followers": (
        ("has # recurrent units and a layer of #, `universal` # and #", *UNITS),
        ("at most # times those of its first minute and # mm", STEADY["GROWTH"], 1e3 * STEADY["SLACK"]),
        ("limit in less than # % of the time", 100 * STEADY["LIMITED"]),
        ("(# ms; # ms for", 1e3 * REFERENCE.timing.control_period, 1e3 * FLIGHT.timing.control_period),
    ),
    "docs/gym": (("`truncated` after # steps", REFERENCE.timing.episode_steps),),
    "docs/training": (
        ("needs # GB of address", xla.ADDRESS_SPACE / 1e9),
        ("`mjxball.sim.rigs.held_out` has # rigs", HELD_OUT_RIGS),
    ),
    "docs/view": (("when nothing new came for # s", live.SILENCE),),
    "docs/results": (
        ("at most # % and # mm above (of longer", 100 * RIGS["LATER"] - 100, 1e3 * RIGS["MORE"]),
        ("mass is believed to be # kg", CELLS["BELIEVED"]),
    ),
    "docs/howto/own-model": (
        ("of a single one: # to # … more than # elements", 2, configs.MOST_DRONES, configs.MAX_ELEMENTS),
        ("textures of more than # × # points", *2 * (math.sqrt(configs.MAX_PIXELS),)),
    ),
    "docs/crazyflie": (
        ("deck: # g; thrust upgrade # g; brushless with guards # g", *GRAMS),
        ("Inertia #, #, # · 10⁻⁶ kg m²", *(1e6 * one for one in RIG.drones[0].inertia)),
        ("varies ±# % … # mm from", 100 * (DRAWN.inertia_scale[1] - 1), 1e3 * RIG.arm),
        ("yaw moment # mm · force; lag # ms", 1e3 * RIG.yaw_per_thrust, 1e3 * RIG.rotor_lag),
        ("in training # to # ms", *(1e3 * RIG.rotor_lag * one for one in DRAWN.rotor_lag_scale)),
        ("`# p` N, upgrade `# p`, brushless `# p`", *(one.plant.rotor_force_max for one in (PAIR, UPGRADE, BRUSHLESS))),
        ("`# p² + # p` N … Battery: # V, in `flight` # to # V", *motors.OLDER, motors.USUAL_BATTERY, *DRAWN.battery),
        ("Stick: # m … # g with mounts, ball # g", RIG.object_size[1], 1e3 * RIG.object_mass - BALL, BALL),
        ("stops at ±# mm … weighs # g", 1e3 * RIG.ball_stop, 1e3 * total_mass(RIG)),
        ("hovers at # of at most # … at # on", hover(PAIR)[0], crazyflie.THRUST_CEILING, hover(OLDER)[0]),
        ("less than # % of … rate loops at # Hz", 100 * configs.THRUST_MARGIN, 1 / crazyflie.PERIOD),
        ("in roll by # and in yaw by #", axes(PAIR)[0].inertia_ratio, axes(PAIR)[2].inertia_ratio),
        ("margin of # degrees and a gain margin of # either", NEED.phase, NEED.gain),
        ("(# degrees and # for lags of # to", NEED.worst_phase, NEED.worst_gain, 1e3 * NEED.lags[0]),
        (" # ms and inertias of # to #), and", 1e3 * NEED.lags[1], *NEED.inertias),
        ("rate loop # times as … stands at # of hover", NEED.bandwidth_ratio, takeoff.MOST_LIFT),
        ("by # % a second until a climb of # m/s", 100 * takeoff.CLIMB_INTEGRAL * takeoff.CLIMB, takeoff.CLIMB),
    ),
    "docs/flying": (
        ("# % too much hover thrust is # m", 5, 0.05 * LAW.hover_thrust / LAW.thrust_per_acceleration / STAND.kp[2]),
        ("twin of # g … hover above # % of", 1e3 * card.UNKNOWN_MASS, 100 * preflight.RESERVE),
        ("along +X within # degrees … at least # MHz apart", DEG * READY.yaw, uri.APART),
        ("is cut after # s … may give # % less", TIMES.drone_watchdog, 100 * setpoints.UNEVEN / 9.81),
        (" # m/s² for the pair … lifts about # of the weight", setpoints.UNEVEN / 2, LIFT),
        ("(1 - #)): # m/s from # m", LIFT, math.sqrt(2 * 9.81 * 0.4 * (1 - LIFT)), 0.4),
        ("battery of # V that sags by # V", Battery().full, Battery().sag),
    ),
    "docs/supervisor": (
        ("level, # units … flown # cm high", setpoints.SPIN_THRUST, 100 * probe.HEIGHT),
        ("the stick by # degrees … below # cm", DEG * probe.TILT, 100 * TIMES.near_ground),
        ("has not sunk by # mm for # s", 1e3 * TIMES.rest_sunk, TIMES.rest),
        ("tilt up to # degrees … emergency stops for # s", DEG * setpoints.BRAKE_TILT, TIMES.stop),
        ("hear for # ms", 1e3 * LIMITS.fresh),
        ("exceeds # · 10⁻⁴ m² … bit for bit for # s", 1e4 * LIMITS.variance, measured.REPEATING),
        ("if for # s a measured pose turns # degrees", measured.CONTRADICTING, DEG * measured.TURN),
        ("gyroscope within # s … differ by # cm", measured.WINDOW, 100 * monitor.HEIGHT),
        ("climb rates by # m/s … its mean of # s by # mm", monitor.CLIMB, monitor.USUAL, 1e3 * monitor.APART),
        ("sent in the last # s … silent in the air for # s", monitor.ECHO, watchdog.SILENCE),
        ("stops and zeros for # s", watchdog.STOPPING + watchdog.ZEROS),
    ),
    "docs/motion-capture": (
        ("origin within # m … no body within # s, or", MOCAP.farthest, MOCAP.answer),
        ("ones within # s … within # cm of each other", MOCAP.appear, 100 * MOCAP.apart),
        ("swapped, # cm off … distance is # cm off", 100 * MOCAP.rig_error, 100 * MOCAP.length_error),
        ("less than # Hz, is tilted by # degrees, points # degrees", MOCAP.rate, DEG * MOCAP.tilt, DEG * MOCAP.yaw),
        ("faster than # m/s since the last good one, # cm", MOCAP.speed, 100 * MOCAP.disagreement),
        ("for # s, or # s if poses repeat", MOCAP.lost, MOCAP.frozen),
        ("turn the pair # degrees about each axis and to move it # m", DEG * measured.TURNED, measured.MOVED),
    ),
    "docs/onboard": (
        ("a heartbeat of # bytes … silent for # s", C["MJXBALL_BEAT_SIZE"], C["LAPTOP_AGE"] / 1e3),
        ("other drone for # s … battery` for # s", C["PEER_AGE"] / 1e3, C["BATTERY_TIME"] / 1e3),
        ("state older than # ms … above # · 10⁻⁴ m², beyond", C["STATE_AGE"], 1e4 * C["VARIANCE"]),
        ("its bound for # s … beyond # degrees", C["SATURATED_TIME"] / 1e3, DEG * math.acos(C["MOST_TILT"])),
        ("descending for # s | stop: zeros for # s", C["DESCEND_TIME"] / 1e3, C["STOP_TIME"] / 1e3),
        ("not up # s after … within # m, # m/s", C["LIFT_TIME"] / 1e3, C["MOST_PLACE"], C["MOST_SPEED"]),
        (" # rad/s, length² … above 0 up to # V", C["MOST_RATE"], C["MOST_VOLTAGE"]),
        ("has # kB, about # packets", UPLOAD / 1e3, round(UPLOAD / protocol.CHUNK, -2)),
        ("within # degrees, thrust # to #", DEG * C["SENT_TILT"], C["FLOOR"], C["CEILING"]),
    ),
    "docs/model": (
        ("(+#, 0, 0) m, follower at $r_f$ = (−#, 0, 0) m", *2 * (TWO.drones[0].mount[0],)),
        ("`team6` | # kg each, rotors of # N", TEAM.drones[0].mass, TEAM.rotor_force_max),
        ("carrier # kg per drone | # kg per", TEAM.carrier_mass / TEAM.count, TEAM.object_mass / TEAM.count),
        ("a free ball of # kg, rim at # m", PLATE.object_mass * PLATE.moving_fraction, PLATE.ball_stop),
        ("arm $L$ = # m, $M_i$ = # m", TWO.arm, TWO.yaw_per_thrust),
        ("(#, #, #)·10⁻³ kg m²", *(1e3 * one for one in TWO.drones[0].inertia)),
        ("box of # × # × # m", *TWO.object_size),
        ("rotors trim # kg up to # cm beside the line", TWO.object_mass, REACH[0]),
        ("roll commands of up to # rad up to # cm", OWN.tilt_limit, REACH[1]),
        (r"margin`, # % … $\omega_n$ = (#, #, #) rad/s", 100 * REFERENCE.scenario.trim_margin, *WN),
        ("$J_O$ = (#, #, #) kg m²", *(2 * gain / wn**2 for gain, wn in zip(KP, WN, strict=True))),
        ("for `copy` # m per kilogram", 9.81 / (2 * 1.1 * REFERENCE.leader.kp[2])),
        ("0 to # N each, clipped one by one, first-order lag of # ms", TWO.rotor_force_max, 1e3 * TWO.rotor_lag),
        ("command at most # rad and # m/s²", OWN.tilt_limit, OWN.vertical_limit),
        ("adds at most # rad and # m/s²", ADDED.action_scale_tilt, ADDED.action_scale_vertical),
    ),
    "docs/mimicking": (
        (r"= #\ \text{m at}\ c = #\ \text{m}", 9.81 / REFERENCE.leader.kp[0] * TILT / 2, 0.05),
        ("$: # rad at # cm and # kg. The paper's reward charges # a step", TILT, 5, TWO.object_mass, 10 * TILT),
    ),
    "docs/metrics": (
        (r"\le #$ s [m] … > #\,\lvert e_o(0)", metrics.RMSE_UNTIL, metrics.SETTLED[0]),
        (r"in the last # s: … \ge #$ s [m]", metrics.NEVER_WITHIN, metrics.STEADY_AFTER),
        ("within # % of 0 or … the first # steps", 100 * metrics.AT_LIMIT_WITHIN, metrics.PAPER_STEPS),
        ("is # mm in positions and the object's error, # deg in angles, # m/s and # rad/s in rates", *NOISE),
        ("exceeds # m or the body rates # rad/s", engine.MAX_POSITION, engine.MAX_RATE),
        ("correlation time of # s … At most # rows a run", disturbances.GUST_TIME, loop.CHUNKS),
        ("Columns with `eval_` are of # s evaluations", EVALUATION_SECONDS),
    ),
    "docs/policy-file": (
        ("over # m and of its rate over # m/s", follower_law.NEAR_ERROR, follower_law.NEAR_ERROR_RATE),
        ("version` (# or #) … units` (1 to #)", *file.FORMAT_VERSIONS, file.MAX_UNITS),
        ("files above # MiB", container.MAX_BYTES / 2**20),
    ),
    "docs/positioning": (
        ("velocity certain to # m/s … waited for during # s", positioning.SLOW, READY.converge),
        ("a variance of # · 10⁻³ m²", 1e3 * positioning.LOCO.variance),
        ("wrong by another # cm", 100 * preflight.NOISY * positioning.LOCO.noise),
    ),
}


@rows("page", SAID)
def test_a_page_says_what_the_code_has(page: str) -> None:
    for phrase, *numbers in SAID[page]:
        says(f"{page}.md", phrase, numbers)


def test_what_the_rig_of_a_page_can_hold(tmp_path: Path) -> None:
    page, path = "docs/howto/own-rig.md", tmp_path / "tri.toml"
    path.write_text((REPOSITORY / page).read_text().partition("# tri.toml\n")[2].partition("```")[0])
    team = plant_setup(path, "transport")
    weak = apply_overrides(team, {"plant.rotor_force_max": TWO.rotor_force_max})
    over, left = (thrust_over_weight(team.plant), heaviest_object(team, 0.05)), heaviest_object(weak, 0.05)
    says(page, "thrust over weight #, and objects of up to # kg that rest # m", [*over, 0.05])
    says(page, "of # N thrust over weight is #", [TWO.rotor_force_max, thrust_over_weight(weak.plant)])
    says(page, "the object of # kg is below the # kg that are left", [team.plant.object_mass, left])

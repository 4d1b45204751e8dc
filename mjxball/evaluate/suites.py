"""Scenarios of the evaluation: the reference, the standard list, waveforms, and the suites of the benchmark."""

from __future__ import annotations

import csv
import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mjxball import config as configs
from mjxball.config import Config, ball_limit, cg_limit
from mjxball.errors import InputError
from mjxball.plant.teams import ring_config
from mjxball.sim.disturbances import Disturbance
from mjxball.sim.scenario import CIRCLE, CgPath, Scenario, check_scenario

REFERENCE = Scenario()
# Copy without CG motion, then five speeds of the CG.
STANDARD = (
    dataclasses.replace(REFERENCE, amplitude=0.0),
    *(dataclasses.replace(REFERENCE, omega=omega) for omega in (0.31, 0.62, 1.0, 2.0, 3.1)),
)
MOST_SAMPLES = 100_000


def cross(
    omegas: Sequence[float], amplitudes: Sequence[float], masses: Sequence[float], **common: Any
) -> tuple[Scenario, ...]:
    """Full cross product of the lists, in the given order."""
    cells = itertools.product(omegas, amplitudes, masses)
    return tuple(Scenario(omega=w, amplitude=a, mass=m, **common) for w, a, m in cells)


def standard_scenarios(settings: Config) -> tuple[Scenario, ...]:
    """The standard scenarios as far as the plant allows them, the reference one last; raise InputError if unsound.

    The object has the plant's mass, the CG keeps to the object and to what training draws, a stand's locked axes have
    goal 0, and the goal is drawn in to what training may draw. A waveform or a rolling ball makes one scenario. In the
    plane the CG goes round in a circle.
    """
    plant = settings.plant
    distance = min(REFERENCE.goal[0], settings.scenario.goal_range)
    free = {"free": (1, 1, 1), "pivot": (0, 0, 0), "heave": (0, 0, 1)}[plant.stand]
    common: dict[str, Any] = {"mass": plant.object_mass, "goal": tuple(distance * float(axis) for axis in free)}
    if len(plant.directions) == 2:
        common["path"] = CIRCLE
    reference = dataclasses.replace(
        REFERENCE,
        amplitude=min(REFERENCE.amplitude, cg_limit(plant), settings.scenario.cg_amplitude[1]),
        ball_start=min(settings.scenario.ball_start, ball_limit(plant)),
        **common,
    )
    others = [
        dataclasses.replace(reference, omega=s.omega, amplitude=min(s.amplitude, reference.amplitude))
        for s in STANDARD
        if s != REFERENCE and settings.motion.kind == "sine"
    ]
    scenarios = (*others, reference)
    for scenario in scenarios:
        check_scenario(settings, scenario)
    return scenarios


def read_waveform(path: Path) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Times [s] and offsets [m] from a CSV file with two columns; a header line is allowed.

    Raises InputError if the file cannot be read; order and range are checked with the configuration.
    """
    try:
        with path.open(newline="") as stream:
            lines = [line for line in csv.reader(stream) if line]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"waveform {path} cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if len(lines) > MOST_SAMPLES:
        raise InputError(f"waveform {path} has more than {MOST_SAMPLES:,} lines")
    samples = []
    for number, line in enumerate(lines, start=1):
        try:
            time, offset = map(float, line)
        except ValueError:
            if number == 1 and not any(field.strip()[:1] in set("+-.0123456789") for field in line):
                continue  # a header: none of its fields begins like a number
            raise InputError(f"waveform {path}, line {number}: expected two numbers, time and offset") from None
        samples.append((time, offset))
    if not samples:
        raise InputError(f"waveform {path} has no samples")
    times, offsets = zip(*samples, strict=True)
    return times, offsets


WALK_STEP, WALK_SIGMA = 0.5, 0.03  # time [s] between the samples of a random walk, deviation of one move [m]


@dataclass(frozen=True)
class Variant:
    """One case of a suite: a scenario, and the settings that differ from the reference."""

    label: str
    scenario: Scenario
    changes: Mapping[str, Any] = field(default_factory=dict)  # config path -> value
    waveform: Callable[[int], tuple[tuple[float, ...], ...]] | None = None  # seed -> times, offsets, offsets across
    team: str = ""  # preset whose plant it flies; empty: the command's
    drones: int = 0  # of a ring of that many; 0: the preset's plant
    known: Mapping[str, Any] = field(default_factory=dict)  # of a team, settings that its followers are made for
    scatter: float = 0.0  # of a team, every drone's numbers are drawn within this share of those that followers know

    def home(self, base: Config) -> Config:
        """What its followers are made for: `base`, or a team of its own."""
        if not self.team:
            return base
        found = configs.preset(self.team)
        if self.drones:
            found = ring_config(found, self.drones)
        for path, value in self.known.items():
            found = configs.replace(found, path, value)
        return configs.validate(found)

    def config(self, base: Config, seed: int) -> Config:
        """The configuration of this variant for one seed; `base` is its `home`."""
        for path, value in self.changes.items():
            base = configs.replace(base, path, value)
        if self.waveform:
            base = dataclasses.replace(base, motion=configs.Motion("waveform", *self.waveform(seed)))
        if self.scatter:
            base = dataclasses.replace(base, plant=_scattered(base.plant, self.scatter, seed))
        return configs.validate(base)

    def seeded(self, seed: int) -> Scenario:
        """The scenario of one seed. Seed 0 starts the CG at phase 0, the others at a place drawn from the seed."""
        random = np.random.default_rng([seed, 7])
        phase = 0.0 if seed == 0 else float(random.uniform(0, 2 * np.pi))
        # A rolling ball has no phase: it starts on either side, up to 30 % nearer to O.
        start = self.scenario.ball_start * (
            1.0 if seed == 0 else float(random.choice([-1, 1]) * random.uniform(0.7, 1))
        )
        disturbance = dataclasses.replace(self.scenario.disturbance, seed=seed)
        return dataclasses.replace(self.scenario, phase=phase, ball_start=start, disturbance=disturbance)


@dataclass(frozen=True)
class Suite:
    """Variants along one axis of difficulty."""

    name: str
    about: str
    axis: str  # what the variants' labels say
    variants: tuple[Variant, ...]


def _steps(seed: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """The CG jumps within 0.3 s to a place up to 5 cm from O, every 5 s."""
    random = np.random.default_rng([seed, 11])
    places = [0.0, *random.uniform(-0.05, 0.05, 8)]
    times, offsets = [], []
    for number, place in enumerate(places):
        begin = 5.0 * number + (0.3 if number else 0.0)
        times += [begin, 5.0 * number + 2.5, 5.0 * number + 5.0]
        offsets += [place] * 3
    return tuple(times), tuple(map(float, offsets))


def _walk(seed: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """A random walk within 10 cm of O."""
    random = np.random.default_rng([seed, 13])
    times = np.arange(0.0, 45.0 + WALK_STEP, WALK_STEP)
    offsets = np.zeros_like(times)
    for number, move in enumerate(random.normal(0.0, WALK_SIGMA * np.sqrt(WALK_STEP), len(times) - 1)):
        offsets[number + 1] = np.clip(offsets[number] + move, -0.1, 0.1)
    return tuple(map(float, times)), tuple(map(float, offsets))


def _variants(name: str, values: tuple[Any, ...], unit: str = "", **common: Any) -> tuple[Variant, ...]:
    return tuple(Variant(f"{value:g}{unit}", Scenario(**{name: value}, **common)) for value in values)


def _disturbed(name: str, values: tuple[Any, ...], unit: str = "") -> tuple[Variant, ...]:
    return tuple(Variant(f"{v * (1e3 if unit == ' ms' else 1):g}{unit}", _with(**{name: v})) for v in values)


def _with(**disturbance: Any) -> Scenario:
    return Scenario(disturbance=Disturbance(**disturbance))


def _places(seed: int) -> tuple[tuple[float, ...], ...]:
    """The CG goes to a place within 7 cm of O in the plane and stays, every 3 s."""
    random, times = np.random.default_rng([seed, 17]), []
    radius, angle = 0.07 * np.sqrt(random.random(15)), 2 * np.pi * random.random(15)
    places = np.insert(radius * np.exp(1j * angle), 0, 0.0)
    for number in range(len(places)):
        times += [3.0 * number + (1.0 if number else 0.0), 3.0 * number + 2.0, 3.0 * number + 3.0]
    offsets = np.repeat(places, 3)
    return tuple(times), tuple(map(float, offsets.real)), tuple(map(float, offsets.imag))


def _scattered(plant: configs.Plant, share: float, seed: int) -> configs.Plant:
    """`plant` whose drones differ in mass, inertia, mount, arm, rotors and lag by up to `share` of each number."""
    random, drones = np.random.default_rng([seed, 19]), []
    for number, drone in enumerate(plant.drones):

        def near(value: Any) -> Any:
            return tuple(map(near, value)) if isinstance(value, tuple) else value * random.uniform(1 - share, 1 + share)

        arm, force, lag, yaw = (
            near(plant.of_drones(name)[number]) for name in ("arm", "rotor_force_max", "rotor_lag", "yaw_per_thrust")
        )
        changed = {"mass": near(drone.mass), "inertia": near(drone.inertia), "mount": near(drone.mount)}
        rotors = {"arm": arm, "rotor_force_max": force, "rotor_lag": lag, "yaw_per_thrust": yaw}
        drones.append(dataclasses.replace(drone, **changed, **rotors))
    return dataclasses.replace(plant, drones=tuple(drones))


SPEEDS = (0.31, 0.62, 1.0, 2.0, 3.1)
MASSES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
GRID = "speed-mass"  # drawn as heat maps
SUITES: tuple[Suite, ...] = (
    Suite("cg-speed", "the CG moves as a sine of 5 cm", "CG speed [rad/s]", _variants("omega", SPEEDS)),
    Suite(
        "cg-amplitude",
        "further, up to a drone's own centre",
        "amplitude",
        _variants("amplitude", (0.05, 0.1, 0.17), " m"),
    ),
    Suite("mass-known", "the hover thrust knows the object's mass", "object mass", _variants("mass", MASSES, " kg")),
    Suite(
        GRID,
        "every CG speed with every object mass, known to the hover thrust",
        "CG speed, mass",
        tuple(Variant(f"{w:g} rad/s, {m:g} kg", Scenario(omega=w, mass=m)) for w in SPEEDS for m in MASSES),
    ),
    Suite(
        "mass-unknown",
        "the hover thrust believes 0.2 kg",
        "object mass",
        _variants("mass", (0.1, 0.2, 0.3, 0.4), " kg", believed_mass=0.2),
    ),
    Suite(
        "mass-change",
        "mass is added to or dropped from the object in flight, unannounced",
        "change",
        (
            Variant("+0.1 kg at 15 s", Scenario(mass_changes=((15.0, 0.1),))),
            Variant("-0.1 kg at 15 s", Scenario(mass_changes=((15.0, -0.1),))),
            Variant("+0.1 kg at 12 s, -0.1 kg at 24 s", Scenario(mass_changes=((12.0, 0.1), (24.0, -0.1)))),
        ),
    ),
    Suite(
        "waveform",
        "the CG moves as no sine does",
        "motion",
        (
            Variant("a jump every 5 s", Scenario(), waveform=_steps),
            Variant("random walk", Scenario(), waveform=_walk),
        ),
    ),
    Suite(
        "rolling-ball",
        "the object is a ball that rolls freely between end stops",
        "start",
        tuple(
            Variant(f"{100 * start:g} cm", Scenario(ball_start=start), {"motion.kind": "rolling"})
            for start in (0.05, 0.1)
        ),
    ),
    Suite("noise", "the follower's measurements are noisy", "noise level", _disturbed("noise", (0.5, 1.0, 2.0))),
    Suite(
        "relay",
        "the object's error reaches the follower as from GPS: rarely, biased, with gaps",
        "relay",
        (
            Variant("10 Hz", _with(relay_rate=10.0)),
            Variant("5 Hz", _with(relay_rate=5.0)),
            Variant("10 Hz, 5 cm bias", _with(relay_rate=10.0, relay_bias=(0.05, 0.05, 0.05))),
            Variant("10 Hz, half lost", _with(relay_rate=10.0, relay_loss=0.5)),
        ),
    ),
    Suite(
        "leader",
        "the leader has other gains than the follower was made for",
        "leader",
        (
            Variant("kp 0.3", Scenario(), {"leader.kp": (0.3, 0.3, 0.3)}),
            Variant("kp 0.8", Scenario(), {"leader.kp": (0.8, 0.8, 0.8)}),
            Variant("kd 0.7", Scenario(), {"leader.kd": (0.7, 0.7, 0.7)}),
            Variant("kd 1.5", Scenario(), {"leader.kd": (1.5, 1.5, 1.5)}),
            Variant("kI 0.05", Scenario(), {"leader.ki": (0.05, 0.05, 0.05)}),
        ),
    ),
    Suite("delay", "the follower's measurements are late", "delay", _disturbed("delay", (0.02, 0.04, 0.06), " ms")),
    Suite(
        "rotor-lag",
        "rotors faster or slower than 30 ms",
        "lag",
        tuple(Variant(f"{1e3 * lag:g} ms", Scenario(), {"plant.rotor_lag": lag}) for lag in (0.015, 0.045, 0.06)),
    ),
    Suite(
        "gusts", "a random force on the object, correlated over 1 s", "rms", _disturbed("gust", (0.1, 0.3, 0.6), " N")
    ),
    Suite(
        "waypoints",
        "three goals in a row",
        "route",
        (
            Variant(
                "a triangle",
                Scenario(goal=(1, 0, 1), waypoints=((15.0, (1.0, 1.0, 1.0)), (30.0, (0.0, 0.0, 1.0)))),
            ),
        ),
    ),
    Suite(
        "start-errors",
        "tilted, moving or far away at the start",
        "start",
        (
            Variant("tilted 10 deg", Scenario(start_tilt=(0.17, -0.17))),
            Variant("moving 0.5 m/s", Scenario(start_velocity=(0.3, -0.3, 0.26))),
            Variant("0.5 m further", Scenario(start_position=(-0.3, -0.3, -0.26))),
        ),
    ),
)
TEAM_SIZES = (2, 3, 4, 5, 6)
EIGHT = CgPath(direction=0.7, width=0.5, ratio=2.0, lead=0.3)


def _ring(drones: int, omega: float = 1.0, share: float = 0.3, **more: Any) -> Scenario:
    """The nominal load of a ring of that many drones on a circle of `share` of its radius."""
    own = ring_config(configs.preset("team"), drones).plant
    radius = own.object_size[0] / 2
    return Scenario(**{"omega": omega, "amplitude": share * radius, "mass": own.object_mass, "path": CIRCLE, **more})


TEAM_SUITES: tuple[Suite, ...] = (
    Suite(
        "team-size",
        "the load goes round on rings of two to six drones; nobody trains with five",
        "drones",
        tuple(Variant(f"{n} drones", _ring(n), team="team", drones=n) for n in TEAM_SIZES),
    ),
    Suite(
        "team-path",
        "four drones, and a load that moves in the plane on other paths",
        "path",
        (
            *(Variant(f"circle, {w:g} rad/s", _ring(4, w), team="team", drones=4) for w in (0.31, 2.0, 3.1)),
            Variant("ellipse", _ring(4, path=dataclasses.replace(CIRCLE, width=0.4)), team="team", drones=4),
            Variant("Lissajous", _ring(4, path=EIGHT), team="team", drones=4),
            Variant("visits of random places", _ring(4), waveform=_places, team="team", drones=4),
        ),
    ),
    Suite(
        "team-plate",
        "four drones carry a plate on which a ball rolls freely; nobody measures it",
        "start",
        tuple(
            Variant(f"{100 * x:g} cm", Scenario(amplitude=0.0, ball_start=x), team="plate") for x in (0.02, 0.05, 0.08)
        ),
    ),
    Suite(
        "team-weak",
        "of four drones the follower opposite to the leader gives less thrust than it is asked for",
        "its thrust",
        tuple(Variant(f"{x:g}", _ring(4, thrust=(1.0, 1.0, x, 1.0)), team="team", drones=4) for x in (0.95, 0.9, 0.8)),
    ),
    Suite(
        "team-lost",
        "of six drones, commanded up to 12 m/s2, the rotors of one follower stop after 10 s",
        "which",
        tuple(
            Variant(
                name,
                _ring(6, share=0.15, lost=((k, 10.0),)),
                team="team",
                drones=6,
                known={"command.vertical_limit": 12.0},
            )
            for name, k in (("next to the leader", 1), ("next but one", 2), ("opposite", 3))
        ),
    ),
    Suite(
        "team-rig",
        "four drones no two of which are alike: mass, inertia, mount, arm, rotors and lag of each are drawn",
        "within",
        tuple(Variant(f"{100 * x:g} %", _ring(4), team="team", drones=4, scatter=x) for x in (0.05, 0.1, 0.2)),
    ),
)
SUITES = (*SUITES, *TEAM_SUITES)
BY_NAME = {suite.name: suite for suite in SUITES}


def find_suites(names: list[str]) -> list[Suite]:
    """The suites called `names`, all of them for 'all'; InputError for an unknown one."""
    unknown = [name for name in names if name not in BY_NAME and name != "all"]
    if unknown:
        raise InputError(f"unknown suite {unknown[0]!r}; there are all, {', '.join(BY_NAME)}")
    return list(SUITES) if "all" in names else [BY_NAME[name] for name in dict.fromkeys(names)]


def list_suites() -> str:
    """One line for each suite and one for its variants."""
    return "\n".join(
        f"{suite.name}: {suite.about}\n    {suite.axis}: {'; '.join(variant.label for variant in suite.variants)}"
        for suite in SUITES
    )

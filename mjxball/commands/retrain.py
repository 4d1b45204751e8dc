"""`python -m mjxball.commands.retrain`: retrains a policy for a load that is put on in flight; started by mjxball.fly.

It reads the running flight's log, finds the load (`rig.load`), fine-tunes the policy for it from where the flight is
(`train.fine_tune`), and prints lines of JSON: {"text"} while it compiles, {"what": "ready"}, then "identified", and
"fine-tuned" with the path of a policy file, or "kept" if nothing better was found. It ends when standard input does.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import select
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjxball.cli import collect_seldom, make_parser
from mjxball.config import Config
from mjxball.errors import InputError
from mjxball.fly.card import Controller, config_of
from mjxball.fly.flight_log import Tail
from mjxball.fly.limits import ticks_per_command
from mjxball.fly.supervisor import GUIDED
from mjxball.policy import Policy, PolicyFile, load_file, save_file
from mjxball.rig.load import IdentifiedLoad, LoadWatch
from mjxball.sim.laws import BodyState, Laws
from mjxball.xla import compile_small_loops_whole

NICE = 15
POLL = 0.02  # [s] between two looks at the log
LOOK = 0.5  # [s] of flight between two looks for a load
SECONDS = 4.0  # [s] in which a policy is to be fine-tuned
GUIDED_NAMES = tuple(state.value for state in GUIDED)


def main(arguments: Sequence[str]) -> int:
    """Compile, watch, identify, fine-tune; return the exit code."""
    parser = make_parser("python -m mjxball.commands.retrain", "Retrain a policy in flight; started by mjxball.fly.")
    parser.add_argument("policy", type=Path, metavar="POLICY.npz")
    parser.add_argument("log", type=Path, metavar="LOG", help="of the flight, may be yet to come")
    parser.add_argument("out", type=Path, metavar="OUT.npz", help="to be written")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="in which a policy is to be fine-tuned")
    options = parser.parse_args(arguments)
    if _input_has_ended():
        parser.error("standard input, whose end ends it, has ended; python -m mjxball.fly --retrain starts it with one")
    threading.Thread(target=_end_with_input, daemon=True).start()
    os.nice(NICE)
    collect_seldom()
    try:
        return retrain(options)
    except InputError as error:
        _say(error=str(error))
        return 2


def retrain(options: argparse.Namespace) -> int:
    """See the module. Raises InputError if policy or log cannot be used, or JAX is not installed."""
    flown = load_file(options.policy)
    config = config_of(flown.card)
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    compile_small_loops_whole()
    _say(text="retraining: loading JAX")
    try:
        from mjxball.cache import enable_compilation_cache
        from mjxball.train.fine_tune import FineTuner
    except ModuleNotFoundError as error:
        raise InputError(f"{error.name} is not installed; pip install 'mjxball[train]'") from None
    enable_compilation_cache()
    tuner = FineTuner(config, flown)
    tuner.compile(lambda text: _say(text=f"retraining: {text}"))
    watch, replay = LoadWatch(config), FlightReplay(Policy(flown, "flown"))
    _say(what="ready")
    load = find(options.log, watch, replay)
    _say(what="identified", text=describe(load), numbers=load._asdict())
    known, place = situation(load, watch, replay, config)
    tuned = tuner.fine_tune(known, place, options.seconds)
    numbers = {name: getattr(tuned, name) for name in ("before", "after", "steps", "seconds")}
    text = f"{tuned.steps} gradient steps in {tuned.seconds:.1f} s, cost {tuned.before:.3f} to "
    text += f"{tuned.after:.3f}"
    if tuned.contents is None:
        _say(what="kept", text=f"{text}: hardly better, the policy stays", numbers=numbers)
    else:
        save_file(options.out, with_origin(tuned.contents, load, numbers))
        _say(what="fine-tuned", text=text, numbers=numbers, policy=str(options.out))
    while True:  # until standard input ends
        time.sleep(1.0)


def situation(load: IdentifiedLoad, watch: LoadWatch, replay: FlightReplay, config: Config) -> Any:
    """(`KnownLoad`, `FlightState`) of `train.fine_tune`: the object with the `load`, and where the flight is."""
    from mjxball.train.fine_tune import FlightState, KnownLoad

    place, mass = replay.place, config.plant.object_mass + load.mass
    assert place is not None  # a load is found in flight only
    known = KnownLoad(
        mass=mass,
        cg_offset=(load.own_moment + load.moment) / mass,
        cg_amplitude=load.swing / mass,
        cg_speed=load.speed,
        cg_phase=load.phase + load.speed * (watch.now - load.time),
        battery=load.volts,
        uncompensated=float(watch.curve == "older"),
    )
    return known, FlightState(*place.body, place.goal, place.integral, place.history)


def find(log: Path, watch: LoadWatch, replay: FlightReplay) -> IdentifiedLoad:
    """Read the growing `log` until a load shows. Raises InputError if it is none or its clock goes back."""
    tail, looked = Tail(log), 0.0
    while True:
        records = tail.read()
        if tail.misplaced:
            raise InputError(f"flight log {log} cannot be placed in time: {tail.misplaced}")
        for record in records or ():
            watch.take(record)
            replay.take(record)
        if records is None:
            time.sleep(POLL)
        elif watch.now - looked >= LOOK:
            looked = watch.now
            load = watch.find()
            if load is not None:
                return load


def describe(load: IdentifiedLoad) -> str:
    """The load in words."""
    where = f"{1e3 * load.offset:+.0f} mm from O toward the leader"
    spread = f"+- {1e3 * load.mass_spread:.1f} g, {1e6 * load.moment:+.0f} +- {1e6 * load.moment_spread:.0f} mg m"
    return f"a load of {1e3 * load.mass:.1f} g, {where} ({spread})"


def with_origin(contents: PolicyFile, load: IdentifiedLoad, numbers: dict[str, Any]) -> PolicyFile:
    """`contents` whose card says what it was retrained for."""
    origin = {"mass": load.mass, "offset": load.offset, **numbers}
    return dataclasses.replace(contents, card={**contents.card, "retrained": origin})


class Place(NamedTuple):
    """Where a flight is."""

    body: BodyState  # as the follower measures it
    goal: np.ndarray  # (3,) of O [m]
    integral: np.ndarray  # of both laws, see `sim.laws.Laws`
    history: np.ndarray  # (m,) of the policy


class FlightReplay:
    """Both laws once more, on the observations in the log: they remember what the runner's remember."""

    def __init__(self, policy: Policy):
        self._controller = Controller(policy)
        self._laws = Laws(self._controller.config)
        self._every = ticks_per_command(policy.control_period)
        self._count = 0
        self.place: Place | None = None

    def take(self, record: Mapping[str, Any]) -> None:
        """One record of the log (`fly.log_schema`), in order."""
        if record["kind"] == "transition" and record["before"] == "ramp":
            self._controller.reset()
            self._count = 0
        if record["kind"] != "tick" or record["state"] not in GUIDED_NAMES or "observation" not in record:
            return
        self._count += 1
        if (self._count - 1) % self._every:
            return
        goal = np.asarray(record["goal"], float)
        body = self._laws.body_from_observation(np.asarray(record["observation"], float), goal)
        self._controller.step(body, goal)
        self.place = Place(body, goal, self._controller.integral, self._controller.policy.memory)


def _input_has_ended() -> bool:
    """Whether there is no standard input, or none that stays open."""
    try:
        return bool(select.select([0], [], [], 0)[0]) and not os.read(0, 4096)
    except OSError:
        return True


def _end_with_input() -> None:
    while os.read(0, 4096):
        pass
    os._exit(0)  # whatever it computes is of no use any more


def _say(**message: Any) -> None:
    os.write(sys.stdout.fileno(), (json.dumps(message) + "\n").encode())


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

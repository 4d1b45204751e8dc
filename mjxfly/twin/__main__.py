"""`python -m mjxfly.twin`: run the twin as a process. Prints its two URIs as one line of JSON.

It ends when standard input is closed and its motors are off, so that it does not outlive the process that started it.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import select
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np

from mjxball.cli import make_parser
from mjxball.errors import InputError
from mjxball.running import run_command
from mjxball.terminal import say
from mjxfly import clock
from mjxfly.app.host import compile_pair
from mjxfly.policy_setup import config_of, is_crazyflie, load_follower, load_policy
from mjxfly.process import urgent
from mjxfly.rehearsal import BEAT, LAST
from mjxfly.telemetry import Rig
from mjxfly.twin.conditions import (
    Injection,
    LinkFaults,
    add_twin_options,
    check_simple,
    drone_kind,
    read_fault,
    surroundings,
)
from mjxfly.twin.physics import make_pair
from mjxfly.twin.server import Twin


def main() -> int:
    """Command line of the twin; returns the exit code."""
    parser = make_parser("python -m mjxfly.twin", __doc__ or "")
    parser.add_argument("--ports", type=int, nargs=2, default=(0, 0), metavar=("LEADER", "FOLLOWER"))
    parser.add_argument("--policy", type=Path, default=None, metavar="FOLLOWER", help="its metadata define the rig")
    parser.add_argument("--plant", type=Path, default=None, metavar="NAME|FILE", help="that of a classical follower")
    for name in ("loss", "delay", "jitter"):
        parser.add_argument(f"--{name}", type=float, default=0.0, metavar="X", help="of both links, once motors turn")
    parser.add_argument("--onboard", choices=("float32", "int8"), help="apps on the drones, with these weights")
    add_twin_options(parser)
    parser.add_argument("--slow", type=float, default=1.0, metavar="FACTOR", help="of the runner's clock")
    parser.add_argument("--fault", type=read_fault, action="append", default=[], metavar="KIND:DRONE@S")
    options = parser.parse_args()
    return run_command(lambda: serve(options))


def serve(options: argparse.Namespace) -> int:
    """Run the twin that `options` describe until standard input ends; return the exit code."""
    clock.slow_down(options.slow)
    metadata = load_follower(options.policy, options.plant).metadata if options.policy else None
    if metadata is None or not is_crazyflie(config_of(metadata)):
        check_simple(options, options.fault)
    cores = None
    if options.policy and options.onboard:
        cores = compile_pair(load_policy(options.policy), options.policy.stem, options.onboard == "int8")
    kind = drone_kind(options.twin_drone or "2.1", options.twin_curve or "linear")
    with urgent(), Twin(make_pair(metadata, kind, surroundings(options)), tuple(options.ports), cores) as twin:
        worse = LinkFaults(options.loss, options.delay, options.jitter)
        links = [Injection(worse, drone, 0.0) for drone in range(2)] if worse != LinkFaults() else []
        waiting = [*links, *options.fault]
        for one in tuple(waiting):
            threading.Thread(target=inject_later, args=(twin, one, waiting), daemon=True).start()
        report(uris=twin.uris)
        with contextlib.suppress(KeyboardInterrupt):
            report_until_end(twin)
        weights = Rig.from_metadata(metadata).weights if metadata else (0.5, 0.5)
        place = np.array(weights) @ (twin.truth.state.position - twin.start.position)
        found = {"place": place.tolist(), "turning": twin.turning, "most_behind": twin.most_behind}
        found["never"] = [one.text for one in waiting if one.text]
        report(**found, failure=str(twin.failure or ""), slow=isinstance(twin.failure, InputError))
    return 0


def report_until_end(twin: Twin) -> None:
    """Report the twin's delay until standard input has ended and the motors are off, or the twin cannot keep up."""
    closed = math.inf  # when standard input ended [s]
    while twin.failure is None and clock.now() < closed + LAST:
        if math.isinf(closed) and is_closed(sys.stdin.fileno(), BEAT):
            closed = clock.now()
        if not math.isinf(closed):
            if not twin.turning:
                return
            clock.sleep(BEAT)
        report(at=clock.now(), behind=twin.behind)


def is_closed(pipe: int, seconds: float) -> bool:
    """Wait for input on `pipe` for at most `seconds`; return whether it was closed. Input is dropped."""
    readable, _, _ = select.select([pipe], [], [], clock.real(seconds))
    return bool(readable) and not os.read(pipe, 4096)


def report(**fields: Any) -> None:
    """Print one line of JSON for the runner, which may have ended."""
    with contextlib.suppress(OSError):
        say(json.dumps(fields))


def inject_later(twin: Twin, one: Injection, waiting: list[Injection]) -> None:
    """Inject the fault `one.after` seconds after the first motor turns, and remove it from `waiting`."""
    while twin.truth.pwm.max() == 0 or max(twin.truth.thrust) == 0:
        clock.sleep(0.01)
    clock.sleep(one.after)
    waiting.remove(one)
    twin.inject(one)


if __name__ == "__main__":
    sys.exit(main())

"""`python -m mjxball.fly.twin`: the twin as a process of its own. Prints its two URIs as one line of JSON.

It ends when its standard input closes, so that it never outlives the process that started it.
"""

from __future__ import annotations

import argparse
import json
import sys
import threading
from pathlib import Path

from mjxball.cli import make_parser, run_command
from mjxball.fly import clock
from mjxball.fly.app.host import compile_pair
from mjxball.fly.card import load_policy
from mjxball.fly.process import urgent
from mjxball.fly.twin.conditions import Injection, LinkFaults, add_twin_options, drone_kind, read_fault, surroundings
from mjxball.fly.twin.physics import make_pair
from mjxball.fly.twin.server import Twin


def main() -> int:
    """Command line of the twin; returns the exit code."""
    parser = make_parser("python -m mjxball.fly.twin", __doc__ or "")
    parser.add_argument("--ports", type=int, nargs=2, default=(0, 0), metavar=("LEADER", "FOLLOWER"))
    parser.add_argument("--policy", type=Path, default=None, metavar="POLICY.npz", help="its card names the rig")
    for name in ("loss", "delay", "jitter"):
        parser.add_argument(f"--{name}", type=float, default=0.0, metavar="X", help="of both links, once motors turn")
    parser.add_argument("--onboard", choices=("float32", "int8"), help="apps on the drones, with these weights")
    add_twin_options(parser)
    parser.add_argument("--fault", type=read_fault, action="append", default=[], metavar="KIND:DRONE@S")
    options = parser.parse_args()
    return run_command(lambda: serve(options))


def serve(options: argparse.Namespace) -> int:
    """Run the twin that `options` ask for until standard input ends."""
    policy = load_policy(options.policy) if options.policy else None
    card = policy.card if policy else None
    cores = compile_pair(policy, options.policy.stem, options.onboard == "int8") if policy and options.onboard else None
    kind = drone_kind(options.twin_drone or "2.1", options.twin_curve or "linear")
    with urgent(), Twin(make_pair(card, kind, surroundings(options)), tuple(options.ports), cores) as twin:
        worse = LinkFaults(options.loss, options.delay, options.jitter)
        links = [Injection(worse, drone, 0.0) for drone in range(2)] if worse != LinkFaults() else []
        for one in (*links, *options.fault):
            threading.Thread(target=inject_later, args=(twin, one), daemon=True).start()
        print(json.dumps({"uris": twin.uris}), flush=True)  # noqa: T201
        try:
            while sys.stdin.readline():
                pass
        except KeyboardInterrupt:
            pass
    return 0


def inject_later(twin: Twin, one: Injection) -> None:
    """Wait for the first motor to turn, then until the fault is due."""
    while twin.truth.pwm.max() == 0 or max(twin.truth.thrust) == 0:
        clock.sleep(0.01)
    clock.sleep(one.after)
    twin.inject(one)


if __name__ == "__main__":
    sys.exit(main())

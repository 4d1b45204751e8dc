"""The watchdog: a separate process that brings both drones down if the runner dies or hangs in the air.

The runner's main thread writes a frame with its time at every tick. A closed pipe means that the runner died, an old
frame in flight that it hangs; it is then killed, so that its radio is free. The watchdog opens both links and flies a
blind descent: level, a little below the last trim, then stop. It uses only cflib's drivers: no tables, no parameters,
no waiting. If the runner has real-time priority, the watchdog has a higher one.
"""

from __future__ import annotations

import contextlib
import gc
import math
import os
import select
import signal
import struct
import sys
import threading
from collections.abc import Sequence
from typing import Any

from mjxball.cli import make_parser
from mjxball.terminal import warn
from mjxfly import clock, packets
from mjxfly.packets import Packet, Setpoint
from mjxfly.process import Child, urgent
from mjxfly.setpoints import LastKnownState, blind_shares

FRAME = struct.Struct("<BdHHfff")  # IDLE, FLYING or GOODBYE; time [s]; `LastKnownState`
IDLE, FLYING, GOODBYE = 0, 1, 2
SILENCE = 0.3  # [s] without a frame while flying: the firmware levels at 0.5 s and stops at 2 s
PERIOD = 0.02  # [s] between two setpoints of the descent
STOPPING = 0.5  # [s] for which stops are repeated
ZEROS = 2.3  # [s] of zeros after that: firmware that counts as flying and hears nothing for 2 s locks itself
OPENING = 2.0  # [s] for which opening a link is tried: by then the firmware has stopped by itself
NOTHING = LastKnownState((0, 0), 0.0, 0.0, 0.0)


def packed(state: int, seen: LastKnownState) -> bytes:
    """One frame with the present time."""
    return FRAME.pack(state, clock.now(), *seen.trims, seen.height, seen.climb, seen.lift)


class Watchdog(Child):
    """The runner's side of the watchdog. A context manager; `beat` never blocks."""

    def __init__(self, uris: Sequence[str], start_limit: float = 15.0, rehearses: bool = False):
        """Start the process, with this one's clock. Raises InputError if it is not ready within `start_limit` [s].

        In a rehearsal its messages blame a slow computer for a flight program that hangs.
        """
        failure = f"the watchdog process was not ready within {start_limit:g} s"
        flags = [f"--slow={clock.factor()}", *(["--rehearses"] if rehearses else [])]
        late = clock.too_slow(failure) if rehearses else failure
        super().__init__(["mjxfly.watchdog", str(os.getpid()), *uris, *flags], failure, start_limit, late)
        assert self._process.stdin is not None
        self._pipe = self._process.stdin.fileno()
        os.set_blocking(self._pipe, False)

    def beat(self, flying: bool, seen: LastKnownState) -> bool:
        """Write a frame with the pair's state `seen`; false if the watchdog has ended or does not read."""
        return self._write(packed(FLYING if flying else IDLE, seen))

    def leave(self) -> None:
        """Close the pipe, so that the watchdog takes over as if this process had died."""
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()

    def _write(self, frame: bytes) -> bool:
        try:
            return os.write(self._pipe, frame) > 0
        except OSError:  # also if its pipe is full, which holds 64 KiB: a minute of frames
            return False

    def __exit__(self, *_: object) -> None:
        self._write(packed(GOODBYE, NOTHING))
        self.close()


def watch(pipe: int, runner: int) -> tuple[LastKnownState, float] | None:
    """Read frames from `pipe` until the runner ends; None if it ended normally or on the ground.

    Else the pair's last state and its age [s], from which the watchdog takes over. A runner that hangs is killed.
    """
    state, written, seen, waiting = IDLE, 0.0, NOTHING, b""
    while True:
        # Time since the frame was written, not read: a watchdog that woke late must not wait that long again.
        left = written + SILENCE - clock.now() if state == FLYING else math.inf
        readable, _, _ = select.select([pipe], [], [], None if math.isinf(left) else clock.real(max(left, 0.0)))
        if not readable:  # it hangs in the air: only its death frees the radio
            with contextlib.suppress(ProcessLookupError):
                os.kill(runner, signal.SIGKILL)
            return seen, clock.now() - written
        received = os.read(pipe, 4096)
        if not received:
            return (seen, clock.now() - written) if state == FLYING else None
        waiting += received
        while len(waiting) >= FRAME.size:
            state, written, leader, follower, *rest = FRAME.unpack(waiting[: FRAME.size])
            seen, waiting = LastKnownState((leader, follower), *rest), waiting[FRAME.size :]
            if state == GOODBYE:
                return None


def descent_packets(number: int, seen: LastKnownState, unheard: float) -> list[Packet]:
    """Packets for drone `number`, one per `PERIOD`: a level descent, then stops and zeros.

    Both drones' lists have the same length, so that they stay in step.
    """
    shares = blind_shares(seen, unheard, PERIOD)
    thrusts = [min(round(share * seen.trims[number]), packets.THRUST_CEILING) for share in shares]
    sinking = [packets.setpoint_packet(Setpoint(0.0, 0.0, 0.0, thrust)) for thrust in thrusts]
    ending = [packets.STOP, packets.setpoint_packet(packets.ZERO)] * round(STOPPING / PERIOD / 2)
    return [*sinking, *ending, *[packets.setpoint_packet(packets.ZERO)] * round(ZEROS / PERIOD)]


def bring_down(uri: str, plan: Sequence[Packet], start: float) -> None:
    """Open the link at `uri` and send `plan` at fixed times from `start` [s], so that both drones stay in step."""
    import cflib.crtp
    from cflib.crtp.crtpstack import CRTPPacket

    driver = _open(cflib.crtp, uri)
    if driver is None:
        return
    for number, packet in enumerate(plan):
        wait = start + number * PERIOD - clock.now()
        if wait < -PERIOD and number < len(plan) - 5:
            continue  # its time passed while the link was opened
        clock.sleep(max(wait, 0.0))
        wire = CRTPPacket()
        wire.set_header(packet.port, packet.channel)
        wire.data = packet.data
        with contextlib.suppress(Exception):
            driver.send_packet(wire)
    with contextlib.suppress(Exception):
        driver.close()


def _open(crtp: Any, uri: str) -> Any:
    """The driver for `uri`, retried until the dead runner's radio is free; None after `OPENING` seconds."""
    deadline = clock.now() + OPENING
    while clock.now() < deadline:
        with contextlib.suppress(Exception):
            return crtp.get_link_driver(uri, lambda statistics: None, lambda error: None)
        clock.sleep(0.05)
    return None


def main(arguments: Sequence[str]) -> int:
    """`python -m mjxfly.watchdog RUNNER_PID URI URI`: watch standard input; return the exit code."""
    parser = make_parser("python -m mjxfly.watchdog", "Watch over a flight; started by mjxfly, not by hand.")
    parser.add_argument("runner", type=int, metavar="RUNNER_PID")
    parser.add_argument("uris", nargs=2, metavar="URI")
    parser.add_argument("--slow", type=float, default=1.0, metavar="FACTOR", help="of the runner's clock")
    parser.add_argument("--rehearses", action="store_true", help="the drones are the twin's")
    options = parser.parse_args(arguments)
    clock.slow_down(options.slow)
    import cflib.crtp

    cflib.crtp.init_drivers()
    _warm_up()
    with urgent(above=1):
        with contextlib.suppress(BrokenPipeError):  # of a runner that was interrupted meanwhile
            os.write(sys.stdout.fileno(), b"ready\n")
        left = watch(sys.stdin.fileno(), options.runner)
        if left is not None:
            take_over(options.uris, left, options.rehearses)
    return 0


def _warm_up() -> None:
    """Run the code of a take-over once, so that nothing is loaded then."""
    import cflib.crtp.crtpstack
    import cflib.crtp.udpdriver  # noqa: F401

    for number in range(2):
        descent_packets(number, LastKnownState((40000, 40000), 0.1, 0.0, 0.0), SILENCE)
    gc.collect()
    gc.freeze()


def take_over(uris: Sequence[str], left: tuple[LastKnownState, float], rehearses: bool) -> None:
    """Bring both drones down from (state, age [s]) as returned by `watch`."""
    start = clock.now()
    threads = [
        threading.Thread(target=bring_down, args=(uri, descent_packets(number, *left), start), daemon=True)
        for number, uri in enumerate(uris)
    ]
    for thread in threads:
        thread.start()
    if left[1] >= SILENCE:
        warn(hang_message(left[1], rehearses))
    for thread in threads:
        thread.join(timeout=clock.real(OPENING + 5))


def hang_message(silent: float, rehearses: bool) -> str:
    """Message on a flight process that was `silent` for so long [s]."""
    if rehearses:
        return clock.too_slow(f"the flight process stood still for {silent:.2f} s")
    return f"the watchdog heard nothing of the flight for {silent:.2f} s and ended it; it brings both drones down"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

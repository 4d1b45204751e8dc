"""Opening a link with cflib: tables cached, silence noticed and tried again, progress told.

cflib asks for every entry of its tables once and waits for ever for a lost answer; a link that falls silent is
therefore closed and opened anew. What was listed by then is not lost if the tables were complete: they are cached by
their checksum.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mjxball.fly.parameters import LinkError


@dataclass(frozen=True)
class Deadlines:
    """How long the link may take [s]."""

    connect: float = 120.0  # in all: 600 table entries the first time, each a round trip
    silence: float = 2.0  # without a packet while connecting
    attempts: int = 3
    parameter: float = 2.0  # without an answer
    request: float = 2.0  # a packet of ours, before the flight
    first_state: float = 3.0
    version: float = 1.0
    close: float = 2.0


@dataclass(frozen=True)
class Identity:
    """What a drone says that it is; "?" where it does not."""

    protocol: int = 0
    version: str = "?"  # of the firmware, such as 2026.08
    device: str = "?"  # such as Crazyflie 2.1
    revision: str = "?"  # of the firmware's source


def bounded(action: Callable[[], Any], seconds: float) -> bool:
    """Run `action` in a thread; false if it has not returned after `seconds`, it is then left behind.

    cflib waits without limit in places, and some of its callbacks can lock each other out.
    """
    thread = threading.Thread(target=action, daemon=True)
    thread.start()
    thread.join(seconds)
    return not thread.is_alive()


def table_cache() -> str | None:
    """Directory for the tables of contents of firmwares, one file each; None if there can be none."""
    base = os.environ.get("XDG_CACHE_HOME")
    place = (Path(base) if base else Path.home() / ".cache") / "mjxball" / "crazyflie"
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return str(place)


def connect(
    uri: str,
    name: str,
    deadlines: Deadlines,
    progress: Callable[[str], None],
    lost: Callable[[str], None],
    console: Callable[[str], None],
) -> Any:
    """An open cflib `Crazyflie`; `lost` hears why it ends, `console` what it prints. Raises LinkError."""
    import cflib.crtp

    _start_drivers(cflib.crtp)
    started = time.monotonic()
    for attempt in range(1, deadlines.attempts + 1):
        crazyflie, reason, refused = _attempt(uri, name, deadlines, started, progress)
        if not reason:
            crazyflie.connection_lost.add_callback(lambda _, why: lost(why))
            crazyflie.console.receivedChar.add_callback(console)
            if crazyflie.link is None:  # it ended in between
                raise LinkError(f"{name} at {uri} cannot be reached: the link ended")
            # Its pings share a lock with every send, and their thread holds that lock for ever when a link dies.
            bounded(crazyflie.link_statistics.stop, deadlines.close)
            return crazyflie
        bounded(crazyflie.close_link, deadlines.close)
        if refused or time.monotonic() - started > deadlines.connect or attempt == deadlines.attempts:
            break
        progress(f"{name}: {reason}, trying again")
    raise LinkError(f"{name} at {uri} cannot be reached: {reason}")


def _attempt(
    uri: str, name: str, deadlines: Deadlines, started: float, progress: Callable[[str], None]
) -> tuple[Any, str, bool]:
    """Open a link once; returned beside it: what stood in the way, and whether that was more than silence."""
    from cflib.crazyflie import Crazyflie

    crazyflie, ready = Crazyflie(rw_cache=table_cache()), threading.Event()
    failed: list[str] = []
    heard = [time.monotonic()]

    def refused(_: str, why: str) -> None:
        failed.append((why.strip().splitlines() or ["link error"])[0])
        ready.set()

    def arrived(_: Any) -> None:
        heard[0] = time.monotonic()

    # The values of all parameters would take 240 round trips; those that matter are read by name.
    crazyflie.param.request_update_of_all_params = lambda: None
    crazyflie.connected.add_callback(lambda _: ready.set())
    crazyflie.connection_failed.add_callback(refused)
    crazyflie.connection_lost.add_callback(refused)
    crazyflie.packet_received.add_callback(arrived)
    threading.Thread(target=crazyflie.open_link, args=(uri,), daemon=True).start()
    while not ready.wait(0.5):
        now = time.monotonic()
        if now - heard[0] > deadlines.silence or now - started > deadlines.connect:
            return crazyflie, f"no answer within {now - heard[0]:.1f} s", False
        logs, params = _listed(crazyflie.log.toc), _listed(crazyflie.param.toc)
        progress(f"{name}: connecting, {logs} log variables and {params} parameters listed")
    crazyflie.packet_received.remove_callback(arrived)
    return crazyflie, failed[0] if failed else "", bool(failed)


def _listed(table: Any) -> int:
    """Entries of a table that is being read; cflib has none before it begins."""
    return sum(map(len, list(table.toc.values()))) if table is not None else 0


_drivers = threading.Lock()


def _start_drivers(crtp: Any) -> None:
    """Start cflib's drivers once, and keep its own messages off the terminal."""
    with _drivers:
        if not crtp.CLASSES:
            crtp.init_drivers()
        logger = logging.getLogger("cflib")
        if not logger.handlers:
            logger.addHandler(logging.NullHandler())
            logger.propagate = False

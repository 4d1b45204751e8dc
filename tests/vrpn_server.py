"""Support: a VRPN server on loopback, as much of it as sends trackers' poses to one client over TCP.

A connection begins with a cookie of 24 bytes each way. A message is a header of five 32-bit numbers (length, time,
sender, type), padded to 24 bytes, and a payload padded to a multiple of 8, all big-endian. Negative types describe
senders and types by name.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time
from collections.abc import Callable, Mapping, Sequence

COOKIE = b"vrpn: ver. 07.35  0\0\0\0\0\0"
SENDER, KIND = -1, -2
POSE = "vrpn_Tracker Pos_Quat"
Poses = Mapping[str, Sequence[float]]  # name -> x, y, z [m], qw, qx, qy, qz


def message(sender: int, kind: int, payload: bytes) -> bytes:
    now = time.time()
    head = struct.pack(">IIIii", 24 + len(payload), int(now), int(1e6 * (now % 1)), sender, kind) + bytes(4)
    return head + payload + bytes(-len(payload) % 8)


def named(number: int, kind: int, name: str) -> bytes:
    text = name.encode() + b"\0"
    return message(number, kind, struct.pack(">I", len(text)) + text)


class VrpnServer:
    """Sends `poses()` at `rate` [Hz] to whoever connects. A context manager; `host` is what a client is given."""

    def __init__(self, poses: Callable[[], Poses], rate: float = 100.0, mute: bool = False):
        self._poses, self._rate, self._mute = poses, rate, mute
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._stop = threading.Event()
        self.host = f"tcp://127.0.0.1:{self._listener.getsockname()[1]}"
        self._threads = [threading.Thread(target=self._accept, daemon=True)]

    def __enter__(self) -> VrpnServer:
        self._threads[0].start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._listener.close()
        for thread in self._threads:
            thread.join(timeout=5)

    def _accept(self) -> None:
        self._listener.settimeout(0.1)
        while not self._stop.is_set():
            try:
                client, _ = self._listener.accept()
            except TimeoutError:
                continue
            except OSError:
                return
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            thread = threading.Thread(target=self._serve, args=(client,), daemon=True)
            self._threads.append(thread)
            thread.start()

    def _serve(self, client: socket.socket) -> None:
        with client, contextlib.suppress(OSError):
            client.sendall(COOKIE)
            client.recv(24)
            senders: dict[str, int] = {}
            client.sendall(named(0, KIND, POSE))
            due = time.monotonic()
            while not self._stop.is_set():
                due += 1 / self._rate
                time.sleep(max(due - time.monotonic(), 0))
                if not self._mute:
                    client.sendall(self._frame(senders))

    def _frame(self, senders: dict[str, int]) -> bytes:
        sent = b""
        for name, (x, y, z, w, i, j, k) in self._poses().items():
            if name not in senders:
                senders[name] = len(senders)
                sent += named(senders[name], SENDER, name)
            sent += message(senders[name], 0, struct.pack(">ii7d", 0, 0, x, y, z, i, j, k, w))
        return sent

"""Live view: an HTTP server on the loopback whose page follows a flight log that is being written."""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import signal
import socketserver
import sys
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from mjxball.errors import InputError
from mjxball.view.page import packed, page_of
from mjxfly.view.foxglove import Foxglove
from mjxfly.view.live_log import LiveLog, columns

HOST = "127.0.0.1"
PERIOD = 0.1  # [s] between two reads of the log
SILENCE = 2.0  # [s] without new records before the page reports it
LINGER = 2.0  # [s] for an open page to fetch the last rows before the server ends
BATCH = 20_000  # rows in an answer
PATIENCE = 10.0  # [s] timeout of a request
# The page may run its inline script and connect to its server, and load nothing else.
POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:; connect-src 'self'"


def live_page(title: str, token: str) -> str:
    """Return the HTML page; `token` identifies the server that it polls for rows."""
    return page_of(title, {"token": token}, Path(__file__).with_name("live.js"))


class LiveView:
    """Content of the answers to the page: written by the main loop, read by the server's threads."""

    def __init__(self, log: LiveLog):
        self.page = live_page(f"{log.path.name}, live", token := secrets.token_hex(8)).encode()
        self.token = token
        self.lock = threading.Lock()
        self.last_request: float | None = None  # when a page last asked for rows [s]
        self.all_sent = False
        self._log, self._last_news = log, time.monotonic()

    def update(self) -> bool:
        """Read new records of the log; return whether there were any."""
        with self.lock:
            added = self._log.update()
        if added:
            self._last_news, self.all_sent = time.monotonic(), False
        return added

    def answer(self, after: int) -> dict[str, Any]:
        """Return at most `BATCH` rows from number `after` on, as packed arrays, and the flight's status."""
        now = time.monotonic()
        with self.lock:
            log = self._log
            total = len(log.rows) if len(log.rows) > 1 else 0  # a plot needs two
            rows = log.rows[after : min(total, after + BATCH)]
            text, level, ended, plant = log.status.text, log.status.level, log.status.ended, log.plant
            marks = [mark._asdict() for mark in log.marks]
            self.last_request, self.all_sent = now, ended and after + len(rows) >= total
        silent = now - self._last_news
        if plant and not ended and silent > SILENCE:
            text, level = f"nothing new for {silent:.0f} s; last: {text}", "bad"
        arrays = {name: packed(column) for name, column in columns(rows).items()}
        known = {"text": text, "level": level, "ended": ended, "plant": plant, "marks": marks}
        return {**known, "total": total, "rows": len(rows), "arrays": arrays}


class Server(ThreadingHTTPServer):
    """Serves the page of a `LiveView` and its rows on the loopback."""

    daemon_threads = True
    block_on_close = False

    def __init__(self, port: int, view: LiveView):
        """Listen on `port` of the loopback, 0 for a free one. Raises InputError if it cannot be opened."""
        self.view = view
        try:
            super().__init__((HOST, port), Handler)
        except OSError as error:
            raise InputError(f"port {port} cannot be had: {error.strerror or error}; choose another") from None

    def server_bind(self) -> None:
        """Bind without the reverse DNS lookup of the base class."""
        socketserver.TCPServer.server_bind(self)
        self.server_name, self.server_port = HOST, self.server_address[1]

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore connections that the browser drops."""

    @property
    def address(self) -> str:
        """The URL of the page."""
        return f"http://{HOST}:{self.server_port}/"


class Handler(BaseHTTPRequestHandler):
    """Handler of one request, for the page or for rows."""

    server: Server
    timeout = PATIENCE

    def do_GET(self) -> None:
        """Send the page or its rows, or an error."""
        port, view = self.server.server_port, self.server.view
        # DNS rebinding: a foreign name that resolves to the loopback appears as the host.
        if self.headers.get("Host") not in (f"{HOST}:{port}", f"localhost:{port}"):
            self._send(403, "text/plain", b"this page is for this machine alone\n")
            return
        url = urlsplit(self.path)
        if url.path == "/":
            self._send(200, "text/html; charset=utf-8", view.page)
        elif url.path == "/rows":
            self._rows(view, parse_qs(url.query))
        else:
            self._send(404, "text/plain", b"there is only the page\n")

    def _rows(self, view: LiveView, query: dict[str, list[str]]) -> None:
        after = query.get("after", [""])[0]
        if query.get("token") != [view.token]:
            self._send(409, "text/plain", b"that was another viewer\n")
        elif not (after.isascii() and after.isdigit() and len(after) < 10):
            self._send(400, "text/plain", b"after is no number of rows\n")
        else:
            self._send(200, "application/json", json.dumps(view.answer(int(after))).encode())

    def _send(self, code: int, kind: str, body: bytes) -> None:
        self.send_response(code)
        headers = {"Content-Type": kind, "Content-Length": str(len(body)), "Cache-Control": "no-store"}
        headers |= {"Content-Security-Policy": POLICY, "X-Content-Type-Options": "nosniff"}
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Log nothing: a page sends ten requests a second."""


def follow(path: Path, port: int = 0, attached: bool = False, foxglove: int | None = None) -> int:
    """Serve the flight log `path` until Ctrl-C, or, if `attached`, until standard input ends; return the exit code.

    `foxglove`: port of a server for Foxglove, None for none. Prints the address and, unless attached, the end of the
    flight. Raises InputError if `path` is no flight log.
    """
    if foxglove is None:
        return _follow(LiveLog(path), port, attached)
    with Foxglove(foxglove) as server:
        return _follow(LiveLog(path, server.take), port, attached, f"; Foxglove connects to {server.address}")


def _follow(log: LiveLog, port: int, attached: bool, also: str = "") -> int:
    with contextlib.suppress(OSError, AttributeError):
        os.nice(10)  # lower priority than the flight's process
    view, leave = LiveView(log), threading.Event()
    with contextlib.closing(log), _serving(Server(port, view)) as address, _until(leave, attached):
        begun = view.update()
        waits = "" if begun else f", and waits for {log.path}"
        print(f"the live view is at {address}{waits}{also}", flush=True)  # noqa: T201
        _watch(view, log, leave, attached)
        _linger(view)
    return 0


def _watch(view: LiveView, log: LiveLog, leave: threading.Event, attached: bool) -> None:
    """Read new records until `leave` is set."""
    announced = False
    while True:
        busy = view.update()
        if log.status.ended and not announced and not attached:
            announced = True
            print(f"{log.status.text}; Ctrl-C ends the view", flush=True)  # noqa: T201
        if leave.wait(0 if busy and not log.status.ended else PERIOD):
            return


def _linger(view: LiveView) -> None:
    """Wait at most `LINGER` until an open page has fetched all rows."""
    until = time.monotonic() + LINGER
    while time.monotonic() < until and view.update():
        pass
    while (
        view.last_request is not None
        and not view.all_sent
        and time.monotonic() < min(until, view.last_request + LINGER)
    ):
        time.sleep(0.02)
    time.sleep(0.1 if view.last_request is not None else 0.0)  # the last answer is still being sent


@contextlib.contextmanager
def _serving(server: Server) -> Iterator[str]:
    """Run the server in a thread; yields its address."""
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True)
    thread.start()
    try:
        yield server.address
    finally:
        server.shutdown()
        server.server_close()


@contextlib.contextmanager
def _until(leave: threading.Event, attached: bool) -> Iterator[None]:
    """Set `leave` on Ctrl-C, or, if `attached`, when standard input ends."""

    def watch() -> None:
        sys.stdin.read()
        leave.set()

    if attached:
        threading.Thread(target=watch, daemon=True).start()
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, lambda *_: leave.set())
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)

"""Live view for Foxglove: a WebSocket server on the loopback that sends new log records as ROS 2 messages.

The protocol is version 1 of Foxglove's SDK. Any web page open in a browser of this machine can connect to a loopback
WebSocket, so the server checks the request's origin. Foxglove's server does not, which is why it is not used.
"""

from __future__ import annotations

import collections
import contextlib
import http
import json
import logging
import socket
import struct
import threading
from typing import Any
from urllib.parse import urlsplit

from mjxball.errors import InputError
from mjxball.reading import parse_json
from mjxfly.log_schema import Record
from mjxfly.messages import Encoder
from mjxfly.process import bounded

HOST = "127.0.0.1"
PROTOCOL: Any = "foxglove.sdk.v1"
DATA = struct.Struct("<BIQ")  # header of a message: opcode 1, subscription, time [ns]
BACKLOG = 1024  # messages queued for one client; a slower client loses the oldest
LARGEST_REQUEST = 2**16  # [bytes]
CLOSE_TIMEOUT = 1.0  # [s] for the closing handshake of one client
LOOPBACK = (HOST, "localhost")
FOXGLOVE = "https://app.foxglove.dev"


class Foxglove:
    """Server of the messages of a flight log. A context manager."""

    def __init__(self, port: int):
        """Listen on `port` of the loopback, 0 for a free one. Raises InputError if it cannot be opened."""
        from websockets.sync.server import serve

        self._encoder = Encoder(self)
        self._lock = threading.Lock()
        self._schemas: list[dict[str, str]] = []
        self._channels: list[dict[str, Any]] = []
        self._clients: list[_Client] = []
        try:
            self._server = serve(
                self._serve_client,
                HOST,
                port,
                subprotocols=[PROTOCOL],
                process_request=_check,
                max_size=LARGEST_REQUEST,
                logger=logging.Logger("foxglove", logging.CRITICAL + 1),  # silent: refused clients are not logged
            )
        except OSError as error:
            why = error.strerror or error
            raise InputError(f"port {port} of --foxglove cannot be had: {why}; choose another") from None
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def __enter__(self) -> Foxglove:
        return self

    def __exit__(self, *_: object) -> None:
        with self._lock:
            left = list(self._clients)
        for client in left:
            client.close()
        self._server.shutdown()

    @property
    def address(self) -> str:
        """The URL for Foxglove's "Open connection"."""
        return f"ws://{HOST}:{self._server.socket.getsockname()[1]}"

    def take(self, record: Record) -> None:
        """Send one `record` as messages; the first record must be the header."""
        self._encoder.take(record)

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a message type; returns its number."""
        self._schemas.append({"schemaName": name, "schemaEncoding": encoding, "schema": data.decode()})
        return len(self._schemas)

    def register_channel(self, topic: str, message_encoding: str, schema_id: int) -> int:
        """Add a topic with messages of the type `schema_id` and advertise it; returns its number."""
        with self._lock:
            number = len(self._channels) + 1
            channel = {"id": number, "topic": topic, "encoding": message_encoding, **self._schemas[schema_id - 1]}
            self._channels.append(channel)
            for client in self._clients:
                client.enqueue(json.dumps({"op": "advertise", "channels": [channel]}))
        return number

    def add_message(self, channel_id: int, log_time: int, data: bytes, publish_time: int, sequence: int) -> None:
        """Queue a message of the topic `channel_id` for its subscribers; times in [ns]."""
        with self._lock:
            for client in self._clients:
                for subscription, channel in client.subscriptions.items():
                    if channel == channel_id:
                        client.enqueue(DATA.pack(1, subscription, log_time) + data)

    def _serve_client(self, connection: Any) -> None:
        """Serve one connection in its thread, until the client leaves or violates the protocol."""
        client = _Client(connection)
        with self._lock:
            client.enqueue(json.dumps({"op": "serverInfo", "name": "mjxball", "capabilities": [], "metadata": {}}))
            client.enqueue(json.dumps({"op": "advertise", "channels": self._channels}))
            self._clients.append(client)
        sending = threading.Thread(target=client.send, daemon=True)
        sending.start()
        try:
            for text in connection:
                subscriptions = _subscriptions(text, client.subscriptions)
                with self._lock:
                    client.subscriptions = subscriptions
        except (ValueError, TypeError, AttributeError, KeyError, RecursionError):
            connection.close(1002)
        finally:
            with self._lock:
                self._clients.remove(client)
            client.enqueue(None)


class _Client:
    """Message queue and subscriptions of one client."""

    def __init__(self, connection: Any):
        self.subscriptions: dict[int, int] = {}  # subscription number -> channel number
        self._connection = connection
        self._waiting: collections.deque[str | bytes | None] = collections.deque()
        self._news = threading.Condition()

    def enqueue(self, message: str | bytes | None) -> None:
        """Queue `message`; None ends the queue. A full queue drops its oldest binary message, never a text message."""
        with self._news:
            data = (place for place, one in enumerate(self._waiting) if isinstance(one, bytes))
            if len(self._waiting) >= BACKLOG and (oldest := next(data, None)) is not None:
                del self._waiting[oldest]
            self._waiting.append(message)
            self._news.notify()

    def close(self) -> None:
        """Close the connection; after a timeout, shut the socket of a client that does not answer."""
        if not bounded(self._connection.close, CLOSE_TIMEOUT):
            with contextlib.suppress(OSError):
                self._connection.socket.shutdown(socket.SHUT_RDWR)

    def send(self) -> None:
        """Send the queued messages until the final None."""
        from websockets.exceptions import ConnectionClosed

        with contextlib.suppress(ConnectionClosed):
            while (message := self._next()) is not None:
                self._connection.send(message)

    def _next(self) -> str | bytes | None:
        with self._news:
            self._news.wait_for(lambda: self._waiting)
            return self._waiting.popleft()


def _check(connection: Any, request: Any) -> Any:
    """Return None for a `request` of a local program, a page of this machine or Foxglove's, else a refusal."""
    hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
    # DNS rebinding: a foreign name that resolves to the loopback appears as the host.
    if len(hosts) != 1 or urlsplit(f"//{hosts[0]}").hostname not in LOOPBACK or not all(map(_is_allowed, origins)):
        return connection.respond(http.HTTPStatus.FORBIDDEN, "this server is for this machine alone\n")
    return None


def _is_allowed(origin: str) -> bool:
    """Whether pages of `origin` may connect: Foxglove's, those of this machine's servers, and local files."""
    url = urlsplit(origin)
    local = url.scheme in ("http", "https") and url.hostname in LOOPBACK
    return origin == FOXGLOVE or url.scheme == "file" or local


def _subscriptions(text: str | bytes, current: dict[int, int]) -> dict[int, int]:
    """Return the subscriptions `current` as changed by the client's message `text`. Raises ValueError."""
    request = parse_json(text) if isinstance(text, str) else {}
    if request.get("op") == "subscribe":
        added = {one["id"]: one["channelId"] for one in request["subscriptions"]}
        if not all(type(number) is int and 0 <= number < 2**32 for number in added):
            raise ValueError("a number of 32 bits")
        return current | added
    if request.get("op") == "unsubscribe":
        return {number: channel for number, channel in current.items() if number not in request["subscriptionIds"]}
    return current

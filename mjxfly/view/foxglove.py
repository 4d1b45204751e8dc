"""The live view for Foxglove: what is added to a flight log, as messages of ROS 2 on a WebSocket of this machine.

The protocol is version 1 of Foxglove's SDK. A WebSocket of this machine can be opened by every page that its browser
shows, wherever it is from, so that the origin decides who is answered; Foxglove's own server does not look at it.
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
DATA = struct.Struct("<BIQ")  # before a message's bytes: 1, subscription, time [ns]
BACKLOG = 1024  # messages that wait for one client; whoever is slower misses the oldest
LARGEST = 2**16  # bytes that a client may say at once
FAREWELL = 1.0  # [s] that a client has for closing the connection when the flight has ended
OWN = (HOST, "localhost")
FOXGLOVE = "https://app.foxglove.dev"


class Foxglove:
    """Serves the messages of a flight log. A context manager."""

    def __init__(self, port: int):
        """Listen on `port` of the loopback, 0 for a free one. Raises InputError if that cannot be had."""
        from websockets.sync.server import serve

        self._encoder = Encoder(self)
        self._lock = threading.Lock()
        self._schemas: list[dict[str, str]] = []
        self._channels: list[dict[str, Any]] = []
        self._clients: list[_Client] = []
        try:
            self._server = serve(
                self._attend,
                HOST,
                port,
                subprotocols=[PROTOCOL],
                process_request=_check,
                max_size=LARGEST,
                logger=logging.Logger("foxglove", logging.CRITICAL + 1),  # a client that is refused is no news
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
        """For Foxglove's Open connection."""
        return f"ws://{HOST}:{self._server.socket.getsockname()[1]}"

    def take(self, record: Record) -> None:
        """Send what one `record` says, the header first."""
        self._encoder.take(record)

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """A further type of messages; its number."""
        self._schemas.append({"schemaName": name, "schemaEncoding": encoding, "schema": data.decode()})
        return len(self._schemas)

    def register_channel(self, topic: str, message_encoding: str, schema_id: int) -> int:
        """A further topic with messages of the type `schema_id`; its number."""
        with self._lock:
            number = len(self._channels) + 1
            channel = {"id": number, "topic": topic, "encoding": message_encoding, **self._schemas[schema_id - 1]}
            self._channels.append(channel)
            for client in self._clients:
                client.tell(json.dumps({"op": "advertise", "channels": [channel]}))
        return number

    def add_message(self, channel_id: int, log_time: int, data: bytes, publish_time: int, sequence: int) -> None:
        """A message [ns] on the topic `channel_id`."""
        with self._lock:
            for client in self._clients:
                for subscription, channel in client.wanted.items():
                    if channel == channel_id:
                        client.tell(DATA.pack(1, subscription, log_time) + data)

    def _attend(self, plug: Any) -> None:
        """One client, in a thread of its own, until it leaves or says what is none of the protocol."""
        client = _Client(plug)
        with self._lock:
            client.tell(json.dumps({"op": "serverInfo", "name": "mjxball", "capabilities": [], "metadata": {}}))
            client.tell(json.dumps({"op": "advertise", "channels": self._channels}))
            self._clients.append(client)
        sending = threading.Thread(target=client.send, daemon=True)
        sending.start()
        try:
            for text in plug:
                wanted = _subscriptions(text, client.wanted)
                with self._lock:
                    client.wanted = wanted
        except (ValueError, TypeError, AttributeError, KeyError, RecursionError):
            plug.close(1002)
        finally:
            with self._lock:
                self._clients.remove(client)
            client.tell(None)


class _Client:
    """What waits for one client, and what it has subscribed to."""

    def __init__(self, plug: Any):
        self.wanted: dict[int, int] = {}  # channel by the number of its subscription
        self._plug = plug
        self._waiting: collections.deque[str | bytes | None] = collections.deque()
        self._news = threading.Condition()

    def tell(self, message: str | bytes | None) -> None:
        """Send `message`, later; None is the last. Of too many the oldest data are left out, and no text is."""
        with self._news:
            data = (place for place, one in enumerate(self._waiting) if isinstance(one, bytes))
            if len(self._waiting) >= BACKLOG and (oldest := next(data, None)) is not None:
                del self._waiting[oldest]
            self._waiting.append(message)
            self._news.notify()

    def close(self) -> None:
        """Part from the client; one that does not read would hold that up for ever, and is cut off."""
        if not bounded(self._plug.close, FAREWELL):
            with contextlib.suppress(OSError):
                self._plug.socket.shutdown(socket.SHUT_RDWR)

    def send(self) -> None:
        """Send what waits, to the last."""
        from websockets.exceptions import ConnectionClosed

        with contextlib.suppress(ConnectionClosed):
            while (message := self._next()) is not None:
                self._plug.send(message)

    def _next(self) -> str | bytes | None:
        with self._news:
            self._news.wait_for(lambda: self._waiting)
            return self._waiting.popleft()


def _check(plug: Any, request: Any) -> Any:
    """An answer that refuses `request`; None if it is of a program of this machine, its pages or Foxglove's."""
    hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
    # A page of elsewhere whose name was made to lead here carries that name.
    if len(hosts) != 1 or urlsplit(f"//{hosts[0]}").hostname not in OWN or not all(map(_is_allowed, origins)):
        return plug.respond(http.HTTPStatus.FORBIDDEN, "this server is for this machine alone\n")
    return None


def _is_allowed(origin: str) -> bool:
    """Whether a page of that `origin` may listen: Foxglove's and this machine's own, and what is no page of the web."""
    found = urlsplit(origin)
    return origin == FOXGLOVE or found.scheme == "file" or (found.scheme in ("http", "https") and found.hostname in OWN)


def _subscriptions(text: str | bytes, wanted: dict[int, int]) -> dict[int, int]:
    """`wanted` after the client said `text`, which changes nothing if it is about anything else. Raises ValueError."""
    told = parse_json(text) if isinstance(text, str) else {}
    if told.get("op") == "subscribe":
        added = {one["id"]: one["channelId"] for one in told["subscriptions"]}
        if not all(type(number) is int and 0 <= number < 2**32 for number in added):
            raise ValueError("a number of 32 bits")
        return wanted | added
    if told.get("op") == "unsubscribe":
        return {number: channel for number, channel in wanted.items() if number not in told["subscriptionIds"]}
    return wanted

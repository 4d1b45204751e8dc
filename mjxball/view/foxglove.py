"""The live view for Foxglove: what is added to a flight log, as messages of ROS 2 on a WebSocket of this machine."""

from __future__ import annotations

from typing import Any

from mjxball.errors import InputError
from mjxball.fly.log_schema import Record
from mjxball.fly.messages import Encoder

HOST = "127.0.0.1"


class Foxglove:
    """Serves the messages of a flight log. A context manager."""

    def __init__(self, port: int):
        """Listen on `port` of the loopback, 0 for a free one. Raises InputError if that cannot be had."""
        try:
            import foxglove
        except ModuleNotFoundError:
            raise InputError("--foxglove needs foxglove-sdk; pip install 'mjxball[foxglove]'") from None
        self._context = foxglove.Context()
        self._encoder = Encoder(self)
        self._schemas: list[Any] = []
        self._channels: list[Any] = []
        try:
            self._server = foxglove.start_server(name="mjxball", host=HOST, port=port, context=self._context)
        except (OSError, RuntimeError) as error:
            raise InputError(f"port {port} of --foxglove cannot be had: {error}; choose another") from None

    def __enter__(self) -> Foxglove:
        return self

    def __exit__(self, *_: object) -> None:
        self._server.stop()

    @property
    def address(self) -> str:
        """For Foxglove's Open connection."""
        return f"ws://{HOST}:{self._server.port}"

    def take(self, record: Record) -> None:
        """Send what one `record` says, the header first."""
        self._encoder.take(record)

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """A further type of messages; its number."""
        import foxglove

        self._schemas.append(foxglove.Schema(name=name, encoding=encoding, data=data))
        return len(self._schemas)

    def register_channel(self, topic: str, message_encoding: str, schema_id: int) -> int:
        """A further topic with messages of the type `schema_id`; its number."""
        import foxglove

        schema = self._schemas[schema_id - 1]
        channel = foxglove.Channel(topic, schema=schema, message_encoding=message_encoding, context=self._context)
        self._channels.append(channel)
        return len(self._channels)

    def add_message(self, channel_id: int, log_time: int, data: bytes, publish_time: int, sequence: int) -> None:
        """A message [ns] on the topic `channel_id`."""
        self._channels[channel_id - 1].log(data, log_time=log_time)

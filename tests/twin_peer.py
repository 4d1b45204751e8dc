"""Questions to a drone of the twin, packet by packet."""

from __future__ import annotations

from mjxfly.twin.protocol import Peer, header


def written(peer: Peer, name: str, value: float, now: float) -> float:
    """What a parameter reads 2 ms after `value` was written at `now`."""
    number = [parameter.name for parameter in peer.parameters].index(name)
    packed = peer.parameters[number].pack(value)
    echo = peer.receive(bytes([header(2, 2), *number.to_bytes(2, "little")]) + packed, now)
    assert echo[0][3:] == packed  # the echo is what was written
    [answer] = peer.receive(bytes([header(2, 1), *number.to_bytes(2, "little")]), now + 0.002)
    return peer.parameters[number].unpack(answer[4:])


def ask(peer: Peer, port: int, channel: int, data: bytes) -> list[bytes]:
    """What `peer` answers at once, without the header."""
    return [answer[1:] for answer in peer.receive(bytes([header(port, channel)]) + data, 0.0)]

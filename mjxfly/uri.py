"""Parsing and comparing the URIs of links: one drone can be named in several ways. Resolves host names, else pure.

The forms are those of cflib 0.1.34 (crtp/radiodriver.py, usbdriver.py, udpdriver.py), except for unknown data rates,
which cflib silently takes as 2M.
"""

from __future__ import annotations

import ipaddress
import re
import socket
from collections.abc import Sequence
from dataclasses import dataclass

from mjxball.errors import InputError

EXAMPLES = "radio://0/80/2M/E7E7E7E7E7 or udp://127.0.0.1:19850"
HERE = "127.0.0.1"
LAST_CHANNEL = 125  # of 1 MHz each, from 2400 MHz on: range of a Crazyradio and a drone
APART = 2  # channels that a link of 2 Mbit/s occupies
RATES = ("250K", "1M", "2M")
ADDRESS = "E7E7E7E7E7"  # default if a URI names none
RADIO = re.compile(
    r"radio://([0-9A-Za-z]+)/([0-9]{1,6})(?:/([^/?]+))?(?:/([0-9A-Fa-f]{1,10}))?/?(?:\?(\S*))?", re.ASCII
)
UDP = re.compile(r"udp://([\w.\-]+):([0-9]{1,5})")
USB = re.compile(r"usb://([0-9]{1,4})")
LIMITED = re.compile(r"(?:^|&)rate_limit=(?![1-9][0-9]*(?:&|$))")  # a value that is not a positive integer


@dataclass(frozen=True)
class Radio:
    """A drone behind a Crazyradio."""

    dongle: int | str  # number among those that are plugged in, or serial number
    channel: int
    rate: str  # of `RATES`
    address: int

    @property
    def drone(self) -> tuple[object, ...]:
        """Key that is equal for links to the same drone, which any dongle can reach."""
        return self.channel, self.rate, self.address


@dataclass(frozen=True)
class Udp:
    """A simulated drone on a UDP port."""

    host: str  # IPv4; any address of this machine's loopback is `HERE`
    port: int

    @property
    def drone(self) -> tuple[object, ...]:
        """See `Radio.drone`."""
        return self.host, self.port


@dataclass(frozen=True)
class Usb:
    """A drone on a USB cable."""

    number: int

    @property
    def drone(self) -> tuple[object, ...]:
        """See `Radio.drone`."""
        return (self.number,)


Uri = Radio | Udp | Usb


def parse_uri(text: str, where: str) -> Uri:
    """The link that `text` names. Raises InputError, which begins with `where`."""
    if radio := RADIO.fullmatch(text):
        return _radio(radio, f"{where} {text}")
    if (udp := UDP.fullmatch(text)) and int(udp[2]) in range(1, 65536):
        return Udp(_host(udp[1], f"{where} {text}"), int(udp[2]))
    if usb := USB.fullmatch(text):
        return Usb(int(usb[1]))
    raise InputError(f"{where} {text} is no URI such as {EXAMPLES}")


def _radio(found: re.Match[str], where: str) -> Radio:
    dongle, channel, rate, address, query = found.groups()
    if int(channel) > LAST_CHANNEL:
        raise InputError(f"{where}: channel {channel} is not one of 0 to {LAST_CHANNEL}")
    if rate not in (None, *RATES):
        raise InputError(f"{where}: data rate {rate} is none of {', '.join(RATES)}")
    if LIMITED.search(query or ""):
        raise InputError(f"{where}: rate_limit must be a whole number of packets a second")
    counted = dongle.isdigit() and len(dongle) < 10  # as cflib tells a number from a serial number
    named = int(dongle) if counted else dongle.upper()
    return Radio(named, int(channel), rate or RATES[-1], int(address or ADDRESS, 16))


def _host(name: str, where: str) -> str:
    try:
        found = socket.gethostbyname(name)
    except (OSError, UnicodeError):
        raise InputError(f"{where}: the host {name} is not known") from None
    address = ipaddress.ip_address(found)
    return HERE if address.is_loopback or address.is_unspecified else found


def share_dongle(links: Sequence[Uri]) -> bool:
    """Whether both links use the same radio dongle."""
    one, other = links
    return isinstance(one, Radio) and isinstance(other, Radio) and one.dongle == other.dongle


def check_pair(leader: Uri, follower: Uri, names: str = "--leader and --follower") -> None:
    """Raise InputError for links to the same drone or links that interfere; `names` name both in messages."""
    if type(leader) is type(follower) and leader.drone == follower.drone:
        raise InputError(f"{names} are the same drone; each needs a link of its own")
    if not isinstance(leader, Radio) or not isinstance(follower, Radio):
        return
    if isinstance(leader.dongle, str) is not isinstance(follower.dongle, str):
        named = f"radio {leader.dongle} and radio {follower.dongle}"
        raise InputError(f"{named} may be one: name both by number, or both by serial number")
    one, other = leader.channel, follower.channel
    if leader.dongle != follower.dongle:
        if abs(one - other) < APART:
            raise InputError(
                f"two radios on channels {one} and {other} disturb each other: leave {APART} MHz between them, or "
                "use one radio for both"
            )
    elif (one, leader.rate) != (other, follower.rate):
        raise InputError(
            f"radio {leader.dongle} would change between channel {one} at {leader.rate} and channel {other} at "
            f"{follower.rate} at every packet, which makes both late: set both drones to one channel and data rate "
            "with two addresses, or use a radio for each"
        )

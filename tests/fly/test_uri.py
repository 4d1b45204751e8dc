"""Which drone a link names, and which two links fly together."""

from __future__ import annotations

import pytest

from mjxball.errors import InputError
from mjxfly.uri import Radio, Udp, Usb, check_pair, parse_uri, share_dongle

NUMBERED = "radio://0/80/2M/E7E7E7E7E7"


def test_what_a_link_names() -> None:
    for text, link in (
        (NUMBERED, Radio(0, 80, "2M", 0xE7E7E7E7E7)),
        ("radio://0/80", Radio(0, 80, "2M", 0xE7E7E7E7E7)),
        ("radio://00/080/1M/e7?safelink=0&rate_limit=100", Radio(0, 80, "1M", 0xE7)),
        ("radio://e7e7e7e7ab/125/250K", Radio("E7E7E7E7AB", 125, "250K", 0xE7E7E7E7E7)),
        ("udp://localhost:19850", Udp("127.0.0.1", 19850)),
        ("udp://127.1:19850", Udp("127.0.0.1", 19850)),
        ("udp://127.0.0.2:1", Udp("127.0.0.1", 1)),
        ("udp://192.168.1.5:09850", Udp("192.168.1.5", 9850)),
        ("usb://01", Usb(1)),
    ):
        assert parse_uri(text, "--leader") == link, text


def test_what_no_link_is() -> None:
    for text in (
        *("radio://0", "radio://0/", "radio:///80", "radio://0/126", "radio://0/999999/2M", "radio://0/80/2m"),
        *(
            "radio://0/80/3M",
            "radio://0/80/2M/E7E7E7E7E7E7",
            "radio://0/80/2M/xyz",
            "radio://0/80/2M/E7/1",
            "radio://-1/8",
        ),
        *(
            "radio://0/80/2M?rate_limit=0",
            "radio://0/80?rate_limit=x",
            "RADIO://0/80",
            "radio://0/\u0668",
            "usb://",
            "usb://a",
        ),
        *(
            "udp://[::1]:19850",
            "udp://127.0.0.1:0",
            "udp://127.0.0.1:65536",
            "udp://127.0.0.1",
            "udp://a b:1",
            "udp://x.invalid:1",
        ),
        *("", "http://x", "tcp://127.0.0.1:1", NUMBERED + "\n"),
    ):
        with pytest.raises(InputError, match=r"^--leader"):
            parse_uri(text, "--leader")


def test_which_two_links_fly() -> None:
    """Links were compared as text, and channels only of two dongles."""
    for one, other, reason in (
        ("udp://localhost:5", "udp://127.0.0.1:5", "same drone"),
        (NUMBERED, "radio://0/80/2M/e7e7e7e7e7?safelink=0", "same drone"),
        (NUMBERED, "radio://0/80", "same drone"),
        (NUMBERED, "radio://1/80/2M", "same drone"),  # any dongle reaches it
        ("usb://0", "usb://00", "same drone"),
        (NUMBERED, "radio://0/90/2M/E7E7E7E7E8", "every packet"),
        (NUMBERED, "radio://0/80/1M/E7E7E7E7E8", "every packet"),
        (NUMBERED, "radio://1/81/2M/E7E7E7E7E8", "disturb"),
        (NUMBERED, "radio://E7E7E7E7AB/90/2M/E7E7E7E7E8", "may be one"),
        (NUMBERED, "radio://0/80/2M/E7E7E7E7E8", ""),
        (NUMBERED, "radio://1/90/2M/E7E7E7E7E8", ""),
        ("radio://e7e7e7e7ab/80", "radio://E7E7E7E7AB/80/2M/E7E7E7E7E8", ""),
        ("udp://127.0.0.1:5", "udp://127.0.0.1:6", ""),
        (NUMBERED, "usb://0", ""),
    ):
        links = parse_uri(one, "--leader"), parse_uri(other, "--follower")
        if not reason:
            check_pair(*links)
            continue
        with pytest.raises(InputError, match=reason):
            check_pair(*links)
    links = [parse_uri(text, "") for text in ("radio://e7e7e7e7ab/80", "radio://E7E7E7E7AB/80/2M/E7E7E7E7E8")]
    assert share_dongle(links)
    assert not share_dongle([links[0], parse_uri("udp://127.0.0.1:1", "")])

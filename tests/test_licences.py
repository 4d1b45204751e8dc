"""docs/licences.csv names the licence of every pinned package; the GPL stays out of what installs unasked."""

from __future__ import annotations

import csv
import importlib.util
from importlib import metadata
from types import ModuleType

import pytest
from command_line import REPOSITORY


@pytest.fixture(scope="module")
def licences() -> ModuleType:
    spec = importlib.util.spec_from_file_location("licences", REPOSITORY / "docs" / "licences.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def listed(licences: ModuleType) -> dict[str, tuple[str, str]]:
    """Package -> (licence, who installs it), as the list says."""
    with licences.LIST.open(encoding="utf-8", newline="") as file:
        return {name: (licence, asked) for name, licence, asked in list(csv.reader(file))[1:]}


def test_every_pinned_package_is_listed_and_no_other(licences: ModuleType, listed: dict[str, tuple[str, str]]) -> None:
    assert list(listed) == licences.pinned()


def test_the_list_says_what_the_installed_packages_say(
    licences: ModuleType, listed: dict[str, tuple[str, str]]
) -> None:
    """Of the same version: later ones may word it otherwise."""
    installed = {(licences.plain(found.metadata["Name"]), found.version) for found in metadata.distributions()}
    lines = (REPOSITORY / "constraints.txt").read_text().splitlines()
    pins = [line.partition(";")[0].strip().split("==") for line in lines if line]
    pinned = {(licences.plain(name), version) for name, version in pins}  # one by Python's version, where there are two
    compared = [name for name in listed if any(one[0] == licences.plain(name) for one in pinned & installed)]
    assert len(compared) > 20
    for name in compared:
        assert licences.licence(name) == listed[name][0], name


def test_copyleft_is_an_extra_that_must_be_asked_for(listed: dict[str, tuple[str, str]]) -> None:
    copyleft = {
        name: asked for name, (licence, asked) in listed.items() if "GPL" in licence or "General Public" in licence
    }
    # docutils: an Emacs mode that is not installed; pyte: a terminal for tests.
    assert copyleft == {"cflib": "fly", "docutils": "docs", "pyte": "dev"}


def test_every_licence_is_stated(listed: dict[str, tuple[str, str]]) -> None:
    assert all(licence and licence != "not stated" and asked for licence, asked in listed.values())

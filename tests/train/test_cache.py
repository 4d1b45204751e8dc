"""The compilation cache's place."""

from __future__ import annotations

from pathlib import Path

import pytest

from mjxball.cache import cache_directory


def test_cache_directory_can_be_chosen_or_switched_off(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("MJXBALL_CACHE", str(tmp_path / "here"))
    assert cache_directory() == tmp_path / "here"
    monkeypatch.setenv("MJXBALL_CACHE", "off")
    assert cache_directory() is None
    monkeypatch.delenv("MJXBALL_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_directory() == tmp_path / "mjxball" / "jax"

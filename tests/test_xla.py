"""XLA's flag for small loops on CPUs, and the place of what it compiled."""

from __future__ import annotations

import os
import pwd
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from mjxball import files, xla
from mjxfly import connection


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("", xla.SMALL_LOOPS),
        ("--xla_dump_to=here", f"--xla_dump_to=here {xla.SMALL_LOOPS}"),
        ("--xla_backend_extra_options=other=1", "--xla_backend_extra_options=other=1"),
    ],
)
def test_the_flag_is_added_once(before: str, after: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XLA_FLAGS", before)
    for _ in range(2):
        xla.compile_small_loops_whole()
        assert os.environ["XLA_FLAGS"] == after


def test_a_loop_becomes_one_function() -> None:
    """The tests run with the flag; without it XLA does so with loops of a kilobyte at most."""

    def loop(numbers: jax.Array) -> jax.Array:
        return jax.lax.fori_loop(0, 10, lambda _, kept: jnp.sin(jnp.roll(kept, 1)) + numbers, numbers)

    text = jax.jit(loop).lower(jnp.zeros(1000)).compile().as_text()
    assert "xla_cpu_small_call" in (text or "")


def test_cache_directory_can_be_chosen_or_switched_off(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("MJXBALL_CACHE", str(tmp_path / "here"))
    assert xla.cache_directory() == tmp_path / "here"
    monkeypatch.setenv("MJXBALL_CACHE", "off")
    assert xla.cache_directory() is None
    monkeypatch.delenv("MJXBALL_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert xla.cache_directory() == tmp_path / "mjxball" / "jax"


def test_who_has_no_home_directory_keeps_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a container that runs under a number without a name: neither $HOME nor an entry of passwd."""

    def nobody(number: int) -> None:
        raise KeyError(number)

    for name in ("HOME", "MJXBALL_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(pwd, "getpwuid", nobody)
    assert files.user_cache() is None
    assert xla.cache_directory() is None
    assert connection.table_cache() is None


def test_a_home_directory_that_cannot_be_written_keeps_no_tables(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "file" / "below"))
    (tmp_path / "file").touch()
    assert connection.table_cache() is None

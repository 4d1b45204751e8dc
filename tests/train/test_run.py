"""A training that is asked to stop."""

from __future__ import annotations

import signal
from types import SimpleNamespace

import pytest

from mjxball.train.run import graceful_interrupt


def test_a_second_sigterm_leaves_the_time_to_save() -> None:
    """SLURM sends it twice; a second Ctrl-C ends at once."""
    before, said = signal.getsignal(signal.SIGTERM), []
    with graceful_interrupt(SimpleNamespace(say=said.append, end_status=lambda: None)) as stop:
        stop.begun = True
        for _ in range(2):
            signal.raise_signal(signal.SIGTERM)
        assert stop.requested
        assert len(said) == 1
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGTERM) is before

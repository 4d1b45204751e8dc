"""`train.py` whose verdict is one second of flight: for tests of what comes before it. Run as a script or imported."""

from __future__ import annotations

import dataclasses
import sys

from mjxball.commands import compare, train
from mjxball.config import Config
from mjxball.evaluate.scenarios import standard_scenarios
from mjxball.running import quit_on_interrupt
from mjxball.sim.scenario import Scenario
from mjxball.train import processes


def one_second(settings: Config) -> tuple[Scenario, ...]:
    """The reference scenario, cut short."""
    return (dataclasses.replace(standard_scenarios(settings)[0], seconds=1.0),)


if __name__ == "__main__":
    quit_on_interrupt()  # as train.py does
    compare.standard_scenarios = one_second
    processes.HEARTBEAT = 10  # a process that is lost is missed sooner
    sys.exit(train.main())

"""Nothing is loaded, opened or compiled in a flight: what it does for the first time was done on the ground."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from command_line import run
from fly_virtual import VirtualTwin

import virtual_twin
from mjxfly.flight import Flight
from mjxfly.limits import FlightSettings, Times
from mjxfly.supervisor import FlightState
from mjxfly.warm_up import warm_up

# Prints in which states a flight does what only comes once: without and with a warm-up. A process of its own: in this
# one everything has been loaded.
BENCHMARKS = Path(virtual_twin.__file__).parent
FIRST = """
import json, sys
sys.path.append(sys.argv[2])
from mjxfly.controller import FlightController
from mjxfly.flight import Flight
from mjxfly.limits import FlightSettings
from mjxfly.telemetry import Rig
from mjxfly.twin.physics import SimplePair, SimplePlant
from virtual_twin import VirtualTwin
from mjxfly.warm_up import warm_up
from mjxball.policy import Policy, shipped_policy

found, ticking = [], False

def audit(event, arguments):
    if ticking and event in ("import", "open", "compile", "exec", "marshal.loads", "os.listdir", "os.scandir"):
        found.append([world.flight.supervisor.state.value, event])

policy = Policy.load(shipped_policy("flight"))
rig = Rig.from_metadata(policy.metadata)
physics = SimplePair(SimplePlant(mass=0.07, mounts=(rig.leader_mount, rig.follower_mount)))
world = VirtualTwin(policy, FlightSettings(seconds=1.0), physics=physics)
tick = world.flight.tick

def watched(*given):
    global ticking
    ticking = True
    try:
        if sys.argv[1] == "cold":
            import colorsys  # as something that nobody has loaded
        return tick(*given)
    finally:
        ticking = False

world.flight.tick = watched
if sys.argv[1] == "warm":
    pair = world.links, FlightController(policy), world.variants, ["linear"] * 2, world.rig, world.settings
    warm_up(Flight, *pair, world.now)
sys.addaudithook(audit)
assert world.run() == "done"
print(json.dumps(found))
"""


@pytest.mark.slow
def test_a_flight_does_nothing_for_the_first_time(tmp_path: Path) -> None:
    """A part of NumPy was loaded from 17 files in the first tick of "fly", which took 30 ms on an idle machine.

    Without a warm-up the flight imports a module, so that this test can fail.
    """
    found = {}
    for how in ("cold", "warm"):
        done = run(["-c", FIRST, how, BENCHMARKS], tmp_path)
        assert done.returncode == 0, done.stderr
        found[how] = json.loads(done.stdout)
    assert "import" in [event for _, event in found["cold"]]
    assert found["warm"] == []


def test_a_warm_up_goes_through_every_state_and_leaves_nothing_behind() -> None:
    seen: set[FlightState] = set()

    class Noted(Flight):
        def tick(self, now: float, late: float = 0.0, missed: int = 0, gap: float = 0.0) -> bool:
            seen.add(self.supervisor.state)
            return super().tick(now, late, missed, gap)

    world = VirtualTwin(FlightSettings(seconds=0.3, times=Times(arm=0.1, ramp=0.5, stop=0.2)))
    flight, before = world.flight, [len(link.packets) for link in world.links]
    pair = (world.links, flight.controller, world.variants, ["linear"] * 2, world.rig, world.settings)
    warm_up(Noted, *pair, world.now)
    assert seen == set(FlightState)
    assert [len(link.packets) for link in world.links] == before
    assert flight.controller.policy.memory is None
    assert not flight.controller.integral.any()
    assert world.run() == "done"
    assert flight.supervisor.cause is None

"""Classical followers that fly a pair of Crazyflies by name: LQGs, whose gains follow from the plant."""

from __future__ import annotations

from pathlib import Path

from mjxball.arrays import Array
from mjxball.cli import plant_setup
from mjxball.config import Config
from mjxball.errors import InputError
from mjxball.policy.export import flight_record

NAMES = ("lqg", "lqg-calm", "lqg-disturbed")
PLANT = "crazyflie"  # shipped plant that they fly unless another is named


class ClassicalFollower:
    """A classical follower with what `FlightController` reads of a `Policy`: metadata, control period, hidden state."""

    hidden = None  # no GRU

    def __init__(self, name: str, config: Config):
        """Raises InputError if SciPy is missing, or the follower does not fly the plant of `config`."""
        try:
            from mjxball.baselines import make_baseline
        except ModuleNotFoundError as missing:
            raise InputError(f"{name} needs {missing.name}; pip install 'mjxball[fly]'") from None
        self.name, self.metadata = name, flight_record(config)
        self.control_period = config.timing.control_period
        self._follower = make_baseline(name, config)

    def reset(self) -> None:
        """Begin a flight."""
        self._follower.reset()

    def __call__(self, observation: Array) -> Array:
        """Command (3,) = roll, pitch [rad], vertical acceleration [m/s2] for `observation` (18,)."""
        return self._follower(observation)


def is_classical(path: Path) -> bool:
    """Whether `path`, of the command line, names a classical follower and no file."""
    return str(path) in NAMES and not path.exists()


def classical(name: str, plant: Path | None) -> ClassicalFollower:
    """The follower `name` for a shipped plant or the file of one, `PLANT` by default. Raises InputError."""
    config = plant_setup(plant or Path(PLANT))
    if config.autopilot.kind != "crazyflie":
        raise InputError(f"--plant {plant} is no pair of Crazyflies, and {name} flies no other drones here")
    return ClassicalFollower(name, config)

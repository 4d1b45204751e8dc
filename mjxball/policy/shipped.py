"""Where the policies that come with mjxball are: in the installed package, or in the repository beside it."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from mjxball.errors import InputError

FOLDER = "policies"
STAND = "stand"  # policies in here were made for the paper's test stand and fly nowhere else


def shipped_policies() -> list[Path]:
    """Policy files for a pair that flies freely, by name; empty if there are none."""
    return _files(_folder())


def stand_policies() -> list[Path]:
    """Policy files that were made for the paper's test stand: they fly nowhere else."""
    return _files(_folder() / STAND)


def shipped_policy(name: str) -> Path:
    """The shipped policy file called `name`, such as `transport`; raise InputError if there is none."""
    known = {path.stem: path for path in (*shipped_policies(), *stand_policies())}
    if name not in known:
        raise InputError(f"no shipped policy is called {name!r}; there are {', '.join(known) or 'none'}")
    return known[name]


def _folder() -> Path:
    """A wheel carries them inside the package; a source tree and an editable install have them beside it."""
    packaged = Path(str(resources.files("mjxball"))) / FOLDER
    return packaged if packaged.is_dir() else Path(__file__).parents[2] / FOLDER


def _files(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.npz"))

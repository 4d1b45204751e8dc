"""Where the policies that come with mjxball are: in the installed package, or in the repository beside it."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from mjxball.errors import InputError

FOLDER = "policies"


def shipped_policies() -> list[Path]:
    """The policy files that come with mjxball, by name; empty if there are none."""
    return sorted(_folder().glob("*.npz"))


def shipped_policy(name: str) -> Path:
    """The shipped policy file called `name`, such as `transport`; raise InputError if there is none."""
    known = {path.stem: path for path in shipped_policies()}
    if name not in known:
        raise InputError(f"no shipped policy is called {name!r}; there are {', '.join(known) or 'none'}")
    return known[name]


def _folder() -> Path:
    """A wheel carries them inside the package; a source tree and an editable install have them beside it."""
    packaged = Path(str(resources.files("mjxball"))) / FOLDER
    return packaged if packaged.is_dir() else Path(__file__).parents[2] / FOLDER

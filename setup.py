"""The one build step that pyproject.toml cannot say: `policies/` becomes `mjxball/policies/` in a wheel."""

import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py


class BuildWithPolicies(build_py):
    """Copies the shipped policies into the package; an editable install finds them in the repository."""

    def run(self) -> None:
        """Build as ever, then copy."""
        super().run()
        source, target = Path("policies"), Path(self.build_lib) / "mjxball" / "policies"
        if self.editable_mode or not source.is_dir():
            return
        shutil.rmtree(target, ignore_errors=True)  # what an earlier build left
        shutil.copytree(
            source, target, ignore=lambda place, names: [n for n in names if Path(n).suffix not in ("", ".npz")]
        )


setup(cmdclass={"build_py": BuildWithPolicies})

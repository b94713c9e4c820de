"""Two policies go into the wheel, so that ``madviz explore`` has something to show anywhere.

They stay in checkpoints/, where all policies are; a wheel gets copies in ``madviz/bundled``.
Everything else is in pyproject.toml.
"""

from pathlib import Path
from shutil import copytree

from setuptools import setup
from setuptools.command.build_py import build_py

BUNDLED = ("metaworld-hammer-mad-light", "metaworld-hammer-merged-only-light")


class BuildWithPolicies(build_py):
    def run(self) -> None:
        super().run()
        if not self.editable_mode:
            for name in BUNDLED:
                target = Path(self.build_lib, "madviz", "bundled", name)
                copytree(Path("checkpoints", name), target, dirs_exist_ok=True)


setup(cmdclass={"build_py": BuildWithPolicies})

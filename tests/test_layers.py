"""The package's shape: which way imports go, where third parties may be, how long things get."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from fnmatch import fnmatch
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "madviz"
FILES = sorted(PACKAGE.rglob("*.py"))
MODULES = {".".join(p.relative_to(PACKAGE).with_suffix("").parts): p for p in FILES}

LAYERS = (
    "types subsets files factories statistics processes svg",
    "envs agent ablations streams moves",
    "manifest checkpoint store rollout evaluate live probes shapley projection saliency card",
    "recipes train",
    "session",
    "app bench doctor compare displacement report sweep recording replay",
    "teaching widgets examples",
    "cli main",
)
"""A module imports from its own line and those above. ``agent`` stands for all of its modules, and
``svg`` for ``svg_curves`` too."""
RANKS = {name: rank for rank, line in enumerate(LAYERS) for name in line.split()}
APART = (("envs", "agent"), ("agent", "envs"))
CONFINED = {
    "viser": "app.*",
    "mujoco": "envs.mujoco* envs.metaworld* examples.*",
    "metaworld": "envs.metaworld*",
    **dict.fromkeys(("mani_skill", "sapien"), "envs.maniskill*"),
    "fast_simplification": "envs.decimation",
    "playwright": "bench.live",
    "ray": "sweep.ray",
    "rerun": "recording.*",
    "ipywidgets": "widgets.*",
    "captum": "saliency",
    "tyro": "cli",
}


def group(module: str) -> str:
    """``envs.base`` -> ``envs``, ``svg_curves`` -> ``svg``, ``__main__`` -> ``main``."""
    return module.split(".")[0].strip("_").split("_")[0]


def imports(path: Path) -> Iterator[str]:
    """Full names of all modules that ``path`` imports, also inside functions."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names = (f"{node.module}.{alias.name}" for alias in node.names)
            yield from (names if node.module == "madviz" else (node.module or "",))


@pytest.mark.parametrize("module", [m for m in MODULES if m != "__init__"])
def test_imports_go_one_way(module: str) -> None:
    own = group(module)
    assert own in RANKS, f"say in LAYERS where {own} belongs"
    for name in imports(MODULES[module]):
        if name.startswith("madviz."):
            other = group(name.removeprefix("madviz."))
            assert RANKS[other] <= RANKS[own], f"{module} must not import {name}"
            assert (own, other) not in APART, f"{module} must not import {name}"


@pytest.mark.parametrize("module", MODULES)
def test_third_parties_stay_where_they_belong(module: str) -> None:
    for name in imports(MODULES[module]):
        places = CONFINED.get(name.split(".")[0], "*").split()
        assert any(fnmatch(module, place) for place in places), (
            f"{module} imports {name}, which belongs in {' and '.join(places)}"
        )


def test_every_third_party_is_declared() -> None:
    project = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"].values()
    lines = [*project["dependencies"], *(line for extra in extras for line in extra)]
    declared = {re.split(r"[^\w-]", line)[0].lower().replace("_", "-") for line in lines}
    outside = {name.split(".")[0] for path in FILES for name in imports(path)}
    providers = packages_distributions()
    for name in outside - set(sys.stdlib_module_names) - {"madviz"}:
        owners = {owner.lower().replace("_", "-") for owner in providers.get(name, [name])}
        assert owners & declared, f"pyproject.toml does not declare {owners}, which has {name}"


def test_the_readme_has_a_line_for_every_file() -> None:
    readme = (PACKAGE.parent / "README.md").read_text()
    lines = {line.split()[0] for line in readme.splitlines() if line.startswith("      ")}
    assert {path.name for path in FILES if path.name[0] != "_"} <= lines


@pytest.mark.parametrize("module", MODULES)
def test_files_and_functions_stay_short(module: str) -> None:
    text = MODULES[module].read_text()
    assert len(text.splitlines()) <= 400
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            length = (node.end_lineno or 0) - node.lineno + 1
            assert length <= 60, f"{module}.{node.name} has {length} lines"


def test_importing_madviz_loads_neither_torch_nor_viser() -> None:
    heavy = {"torch", "viser", "mujoco", "tyro", "sapien", "ray"}
    program = f"import madviz, sys; print(*{heavy} & set(sys.modules))"
    loaded = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=True,
        cwd=PACKAGE.parent,
    )
    assert loaded.stdout.split() == []

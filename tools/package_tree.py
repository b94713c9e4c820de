"""The packages and files of madviz, each with the first sentence of its docstring."""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = (ROOT / "madviz", ROOT / "benchmarks")


def packages() -> str:
    """The packages right under ``madviz/``, in the order of the layers in ``pyproject.toml``."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    layers = next(one["layers"] for one in contracts["contracts"] if one["type"] == "layers")
    lines = []
    for layer in layers:
        inits = [ROOT / "madviz" / name / "__init__.py" for name in layer.split(" | ")]
        mark = "─ "
        for init in filter(Path.is_file, inits):
            lines.append(f"{mark}{init.parent.name + '/':16} {summary(init)}")
            mark = "  "
    return "```text\n" + "\n".join(lines) + "\n```\n"


def files() -> str:
    """Every file, in its folder, as the built page on the architecture has them."""
    lines = []
    for package in PACKAGES:
        lines.append(f"{package.name}/")
        lines += [_line(file, 1) for file in modules(package)]
        for folder, depth in folders(package):
            name = "  " * depth + folder.name + "/"
            lines.append(f"{name:26} {summary(folder / '__init__.py')}")
            lines += [_line(file, depth + 1) for file in modules(folder)]
    return "```text\n" + "\n".join(lines) + "\n```\n"


def folders(package: Path) -> Iterator[tuple[Path, int]]:
    """The packages inside ``package`` with their depth, each before those inside it."""
    for init in sorted(package.rglob("__init__.py"), key=lambda file: file.parent.parts):
        if init.parent != package:
            yield init.parent, len(init.parent.relative_to(package).parts)


def modules(folder: Path) -> list[Path]:
    """The files of ``folder`` that are not private."""
    return [file for file in sorted(folder.glob("*.py")) if file.name[0] != "_"]


def summary(file: Path) -> str:
    """The first sentence of a file's docstring, without markup; only what is before its colon where
    it is long."""
    text = ast.get_docstring(ast.parse(file.read_text())) or ""
    first = " ".join(text.split("\n\n")[0].split()).replace("``", "").replace("*", "")
    sentence = re.split(r"(?<=[a-z0-9)])[.;] ", first)[0].rstrip(".:")
    return sentence if len(sentence) <= 90 else re.split(r"(?<=[a-z0-9)]): ", sentence)[0]


def _line(file: Path, depth: int) -> str:
    return f"{'  ' * depth + file.name:26} {summary(file)}"

"""Writes measured figures into README and docs, and checks that they are the ones in the files.

    python tools/fill_figures.py            fills every block
    python tools/fill_figures.py --check    says which block is out of date; changes nothing

A block stands between ``<!-- figures: NAME -->`` and ``<!-- end -->``. Each NAME is a function in
``BLOCKS``, which makes Markdown from the files in checkpoints/, results/ and madviz/ alone.
"""

from __future__ import annotations

import ast
import json
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
BLOCK = re.compile(r"(<!-- figures: ([a-z-]+) -->\n).*?(<!-- end -->)", re.DOTALL)
SINGLES = ("first", "third_a", "third_b")
LABELS = {"first": "First person", "third_a": "Third A", "third_b": "Third B"}
WEAK = 0.70
"""A single camera below this success rate is named as weak."""


def evaluation(policy: str) -> dict[str, Any]:
    """evaluation.json of a policy with weights or of a row of a table."""
    for folder in ("checkpoints", "results/tables"):
        file = ROOT / folder / policy / "evaluation.json"
        if file.is_file():
            return json.loads(file.read_text())
    raise FileNotFoundError(f"expected {policy}/evaluation.json in checkpoints/ or results/tables/")


def rate(policy: str, subset: str) -> str:
    """For example ``0.99 [0.95, 1.00]``."""
    row = evaluation(policy)["subsets"][subset]
    low, high = row["ci95"]
    return f"{row['success']:.2f} [{low:.2f}, {high:.2f}]"


def rates(policy: str, subsets: tuple[str, ...] = SINGLES) -> str:
    return ", ".join(rate(policy, subset) for subset in subsets)


def episodes(policy: str, subset: str = "all") -> int:
    return evaluation(policy)["subsets"][subset]["n"]


def shipped() -> Iterator[tuple[str, dict[str, Any]]]:
    """(task, subsets) of one MAD policy with the paper's cameras for each task."""
    files = [
        *ROOT.glob("checkpoints/*-mad-light/evaluation.json"),
        *ROOT.glob("results/tables/*-mad-light/evaluation.json"),
    ]
    for file in sorted(files):
        found = json.loads(file.read_text())
        subsets = {name: found["subsets"].get(name) for name in ("all", *SINGLES)}
        if all(subsets.values()):
            yield found["task"], subsets


def findings() -> str:
    hammer, merged = "metaworld-hammer-mad-light", "metaworld-hammer-merged-only-light"
    push, singular = "metaworld-push-mad-light-12x300", "metaworld-push-singular-only-light"
    alone = ", ".join(rate(f"metaworld-push-single-{one}-light", "all") for one in SINGLES)
    weak = [
        f"{task} {LABELS[name]} {row['success']:.2f} [{row['ci95'][0]:.2f}, {row['ci95'][1]:.2f}]"
        for task, subsets in shipped()
        for name, row in subsets.items()
        if name in SINGLES and row["success"] < WEAK
    ]
    names = "First person, Third A and Third B"
    return (
        f"1. **A policy trained on the sum alone fails on one camera.** Hammer, all cameras: MAD "
        f"{rate(hammer, 'all')}, Merged Only {rate(merged, 'all')}. On {names} alone: MAD "
        f"{rates(hammer)}; Merged Only {rates(merged)} (n = {episodes(hammer)}). *Limit:* Singular "
        f"Only does as well there, so hammer shows what training on single cameras gives, and not "
        f"what the sum adds.\n"
        f"2. **One policy for all cameras can beat one policy for each.** Push at a small budget: "
        f"on each camera alone MAD has {rates(push)}; three policies with one camera each have "
        f"{alone} (n = {episodes(push)}). Singular Only reaches {rate(singular, 'all')} on all "
        f"cameras, MAD {rate(push, 'all')}. *Limit:* one training each, and alpha was chosen on "
        f"these seeds.\n"
        f"3. **Not every camera is enough.** Below {WEAK:.2f} alone (n = 100): {'; '.join(weak)}. "
        f"*Limit:* a picture that does not show what decides and a training that is too weak look "
        f"the same in a rate.\n"
    )


def benchmarks() -> str:
    """What `madviz bench` measured, from results/bench: one row for each file."""
    files = sorted((ROOT / "results" / "bench").glob("*.json"))
    rows = [(file.stem, json.loads(file.read_text())) for file in files]
    lines = ["| benchmark | measured |", "|---|---|"]
    for name, found in rows:
        numbers = ", ".join(
            f"{key} {value:g}" for key, value in found.items() if isinstance(value, int | float)
        )
        lines.append(f"| {name} | {numbers} |")
    return "\n".join(lines) + "\n" if rows else "No measurement of this version is stored yet.\n"


def tree() -> str:
    """The folders, each with the first sentence of its docstring."""
    described = {
        "checkpoints/": "policies: configuration, weights, evaluation, curve, card",
        "results/": "results of all methods, their pictures, and the sweeps that make them",
        "notebooks/": "eight lessons",
        "docs/": "the documentation's pages",
        "tests/": "fast, slow and browser tests",
        "tools/": "installation, docs and figures",
        "typings/": "types of MuJoCo for the type checker",
        "madviz/": "the package",
    }
    lines = [f"{name:16} {text}" for name, text in described.items()]
    for folder, depth in folders(ROOT / "madviz"):
        name = "  " * depth + folder.name + "/"
        lines.append(f"{name:16} {summary(folder / '__init__.py')}")
    return "```text\n" + "\n".join(lines) + "\n```\n"


def files() -> str:
    """Every file of the package, in its folder, with the first sentence of its docstring."""
    lines = ["madviz/"]
    lines += [line(file, 1) for file in modules(ROOT / "madviz")]
    for folder, depth in folders(ROOT / "madviz"):
        name = "  " * depth + folder.name + "/"
        lines.append(f"{name:26} {summary(folder / '__init__.py')}")
        lines += [line(file, depth + 1) for file in modules(folder)]
    return "```tree\n" + "\n".join(lines) + "\n```\n"


def folders(package: Path) -> Iterator[tuple[Path, int]]:
    """The packages inside ``package`` with their depth, each before those inside it."""
    for init in sorted(package.rglob("__init__.py"), key=lambda file: file.parent.parts):
        if init.parent != package:
            yield init.parent, len(init.parent.relative_to(package).parts)


def modules(folder: Path) -> list[Path]:
    return [file for file in sorted(folder.glob("*.py")) if file.name[0] != "_"]


def line(file: Path, depth: int) -> str:
    return f"{'  ' * depth + file.name:26} {summary(file)}"


def summary(file: Path) -> str:
    """The first sentence of a file's docstring, without markup; only what is before its colon where
    it is long."""
    text = ast.get_docstring(ast.parse(file.read_text())) or ""
    first = " ".join(text.split("\n\n")[0].split()).replace("``", "").replace("*", "")
    sentence = re.split(r"(?<=[a-z0-9)])[.;] ", first)[0].rstrip(".:")
    return sentence if len(sentence) <= 90 else re.split(r"(?<=[a-z0-9)]): ", sentence)[0]


BLOCKS: dict[str, Callable[[], str]] = {
    "findings": findings,
    "tree": tree,
    "files": files,
    "benchmarks": benchmarks,
}


def filled(text: str) -> str:
    """``text`` with today's figures in its blocks. Raises KeyError for a block nobody makes."""
    return BLOCK.sub(lambda found: found[1] + BLOCKS[found[2]]() + found[3], text)


def main(words: list[str]) -> int:
    stale = []
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        text = page.read_text()
        if (new := filled(text)) != text:
            stale.append(page.relative_to(ROOT))
            if "--check" not in words:
                page.write_text(new)
    said = "out of date" if "--check" in words else "filled"
    print(*(f"{said}: {page}" for page in stale), sep="\n")
    return 1 if stale and "--check" in words else 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))

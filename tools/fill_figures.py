"""Writes measured figures into README and docs, and checks that they are the ones in the files.

    python tools/fill_figures.py            fills every block
    python tools/fill_figures.py --check    says which block is out of date; changes nothing

A block stands between ``<!-- figures: NAME -->`` and ``<!-- end -->``. Each NAME is a function in
``BLOCKS``, which makes Markdown from the files in checkpoints/, results/ and madviz/ alone.
"""

from __future__ import annotations

import ast
import json
import math
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
BLOCK = re.compile(r"(<!-- figures: ([a-z-]+) -->\n).*?(<!-- end -->)", re.DOTALL)
SINGLES = ("first", "third_a", "third_b")
LABELS = {"first": "First person", "third_a": "Third A", "third_b": "Third B"}
Evaluation = dict[str, Any]
"""An evaluation.json."""
CLASS_RUNS = ("quiet", "busy", "page", "training")
"""Of results/class; each file says in which conditions it was measured."""
WEAK = 0.70
"""A single camera below this success rate is named as weak."""


def measured(*policies: str) -> list[Evaluation]:
    """What was measured of each, all on reporting seeds or all on development seeds."""
    found = [evaluation(policy) for policy in policies]
    if len({seeds(one) for one in found}) == 1:
        return found
    return [evaluation(policy, development=True) for policy in policies]


def evaluation(policy: str, development: bool = False) -> Evaluation:
    """evaluation.json of a policy with weights or of a row of a table; or its figures on
    development seeds."""
    for folder in ("checkpoints", "results/tables"):
        file = ROOT / folder / policy / "evaluation.json"
        earlier = file.with_name("development.json")
        if file.is_file():
            return json.loads((earlier if development and earlier.is_file() else file).read_text())
    raise FileNotFoundError(f"expected {policy}/evaluation.json in checkpoints/ or results/tables/")


def seeds(found: Evaluation) -> str:
    """The rule of ``madviz.policies.seeds``, in short."""
    return "reporting seeds" if found["seed"] >= 10_000 else "development seeds"


def rate(found: Evaluation, subset: str = "all") -> str:
    """For example ``0.99 [0.95, 1.00]``."""
    row = found["subsets"][subset]
    low, high = row["ci95"]
    return f"{row['success']:.2f} [{low:.2f}, {high:.2f}]"


def rates(found: Evaluation) -> str:
    return ", ".join(rate(found, subset) for subset in SINGLES)


def count(found: Evaluation) -> str:
    return f"n = {found['subsets']['all']['n']}, {seeds(found)}"


def shipped() -> Iterator[Evaluation]:
    """Of one MAD policy with the paper's cameras for each task."""
    files = [
        *ROOT.glob("checkpoints/*-mad-light/evaluation.json"),
        *ROOT.glob("results/tables/*-mad-light/evaluation.json"),
    ]
    for file in sorted(files):
        found = json.loads(file.read_text())
        if {"all", *SINGLES} <= found["subsets"].keys():
            yield found


def weak() -> str:
    """Every single camera below ``WEAK``, with its rate."""
    named: dict[str, list[str]] = {}
    for found in shipped():
        for name in SINGLES:
            if found["subsets"][name]["success"] < WEAK:
                words = f"{found['task']} {LABELS[name]} {rate(found, name)}"
                named.setdefault(count(found), []).append(words)
    return ". ".join(
        f"Below {WEAK:.2f} alone ({each}): {'; '.join(words)}" for each, words in named.items()
    )


def findings() -> str:
    hammer, merged = measured("metaworld-hammer-mad-light", "metaworld-hammer-merged-only-light")
    push, singular, *alone = measured(
        "metaworld-push-mad-light-12x300",
        "metaworld-push-singular-only-light",
        *(f"metaworld-push-single-{one}-light" for one in SINGLES),
    )
    names = "First person, Third A and Third B"
    return (
        f"1. **A policy trained on the sum alone fails on one camera.** Hammer, all cameras: MAD "
        f"{rate(hammer)}, Merged Only {rate(merged)}. On {names} alone: MAD {rates(hammer)}; "
        f"Merged Only {rates(merged)} ({count(hammer)}). *Limit:* Singular Only does as well "
        f"there, so hammer shows what training on single cameras gives, and not what the sum "
        f"adds.\n"
        f"2. **One policy for all cameras can beat one policy for each.** Push at a small budget: "
        f"on each camera alone MAD has {rates(push)}; three policies with one camera each have "
        f"{', '.join(rate(one) for one in alone)} ({count(push)}). Singular Only reaches "
        f"{rate(singular)} on all cameras, MAD {rate(push)}. *Limit:* one training each, and "
        f"alpha was chosen on these seeds.\n"
        f"3. **Not every camera is enough.** {weak()}. *Limit:* a picture that does not show what "
        f"decides and a training that is too weak look the same in a rate.\n"
    )


def benchmarks() -> str:
    """What `madviz bench` measured, from results/bench: one row for each file."""
    files = sorted((ROOT / "results" / "bench").glob("*.json"))
    rows = [(file.stem, json.loads(file.read_text())) for file in files]
    for _, found in rows:
        found.pop("schema", None)
    lines = ["| benchmark | measured |", "|---|---|"]
    for name, found in rows:
        numbers = ", ".join(
            f"{key} {in_a_cell(value)}" for key, value in found.items() if in_a_cell(value)
        )
        lines.append(f"| {name} | {numbers} |")
    return "\n".join(lines) + "\n" if rows else "No measurement of this version is stored yet.\n"


def in_a_cell(value: object) -> str:
    """A number, or several of a row, as a table's cell says it; empty for anything else."""
    if isinstance(value, bool):
        return ""
    if isinstance(value, int | float):
        return f"{value:g}"
    if isinstance(value, list) and len(value) <= 8:
        return " / ".join(in_a_cell(one) for one in value)
    return ""


def tree() -> str:
    """The folders, each with the first sentence of its docstring."""
    described = {
        "checkpoints/": "policies: configuration, weights, evaluation, curve, card",
        "results/": "results of all methods, their pictures, and the sweeps that make them",
        "notebooks/": "ten lessons",
        "docs/": "the documentation's pages",
        "tests/": "fast, slow and browser tests",
        "integrations/": "LeRobot, vla-eval, openpi, Stable-Baselines3, each in an environment",
        "tools/ typings/": "installation, docs and figures; types of MuJoCo for the type checker",
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


def class_server() -> str:
    """What students took of a class server, from results/class, and what more would take."""
    folder = ROOT / "results" / "class"
    runs = {name: json.loads((folder / f"{name}.json").read_text()) for name in CLASS_RUNS}
    students, cores = runs["quiet"]["students"], runs["quiet"]["cores"]
    quiet = list(runs["quiet"]["each"].values())
    peaks = [one["memory_mb"] for run in runs.values() for one in run["each"].values()]

    def most(what: str) -> int:
        return max(found.get(what, 0) for found in peaks)

    active = sum(any(name[:2].isdigit() for name in one) for one in quiet)
    logins = [one["login_s"] for one in quiet]
    lines = [
        f"Measured with {students} students on {cores} cores, browsers on the same cores, torch "
        f"with its CUDA libraries. {active} of them ran the lessons of the timed run, the others "
        f"had only logged in. A login took {min(logins):.0f} to {max(logins):.0f} s. The slowest, "
        "and the largest of all runs:\n",
        "| lesson | kernel ready after (s) | all cells after (s) | kernel, whole student (MB) |",
        "|---|---|---|---|",
    ]
    for lesson in ("01", "02", "03", "04"):
        timed = [one[n] for one in quiet for n in one if n[:2] == lesson]
        times = [
            f"{max(found[key] for found in timed):.0f}" if timed else "not measured"
            for key in ("kernel_s", "cells_s")
        ]
        memory = f"{most(f'{lesson} kernel')}, {most(f'{lesson} all')}"
        lines.append(f"| {int(lesson)} | {' | '.join(times)} | {memory} |")
    whole = max(most(f"{lesson} all") for lesson in ("01", "02", "03", "04"))
    lines += [
        "\nMemory is proportional: what several processes share counts once. So, with as many "
        "students for each core, one kernel each, and 2 GB for the system:\n",
        "| students | cores | memory |",
        "|---|---|---|",
    ]
    for number in (4, 10, 20, 30):
        needed = math.ceil(2 + number * whole / 1024)
        lines.append(f"| {number} | {-(-number * cores // students)} | {needed} GB |")
    more = most("page page")
    lines.append(f"\nA live page that is open beside the kernel took {more} MB more (one page).")
    return "\n".join(lines) + "\n"


def kernel_memory() -> str:
    """Where the memory of a lesson's kernel goes, from results/class/kernel.json."""
    found = json.loads((ROOT / "results" / "class" / "kernel.json").read_text())
    lines = ["| after | MB (proportional) | of them, nobody can share |", "|---|---|---|"]
    lines += [f"| {one['after']} | {one['pss_mb']} | {one['own_mb']} |" for one in found["steps"]]
    return "\n".join([*lines, f"\ntorch {found['torch']}, one kernel alone."]) + "\n"


def imagine() -> str:
    """What `madviz bench imagine` measured, from results/imagine: one row for each camera that is
    hidden while all others are seen."""
    lines = [
        "| task | hidden | imagined | worst frame | mean | another episode | gain | passes |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for file in sorted((ROOT / "results" / "imagine").glob("*.json")):
        found = json.loads(file.read_text())
        most = max(row["from"].count("+") for row in found["rows"])
        for row in found["rows"]:
            if row["from"].count("+") == most:
                words = ("imagined", "worst", "mean_picture", "other_episode", "gain")
                numbers = " | ".join(f"{row[word]:.1f}" for word in words)
                passes = "yes" if row["gain"] >= 3 else "no"
                lines.append(
                    f"| {found['task']} | {LABELS[row['hidden']]} | {numbers} | {passes} |"
                )
    return "\n".join(lines) + "\n"


BLOCKS: dict[str, Callable[[], str]] = {
    "findings": findings,
    "tree": tree,
    "files": files,
    "benchmarks": benchmarks,
    "class-server": class_server,
    "kernel-memory": kernel_memory,
    "imagine": imagine,
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

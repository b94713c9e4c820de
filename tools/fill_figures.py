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
CLASS_RUNS = ("lessons", "pages", "alone")
"""Of results/class: files of ``python -m tests.e2e.class_server``."""
MEASURED = ("kernel", "all")
"""What the memory of a lesson is given for: its kernel, and all that the student runs."""
FASTER = "{ours_ms:.0f} ms; stock {stock_ms:.0f} ms; {ratio:.1f} times faster"
PAGE = (
    "{updates_per_s:.0f} updates per second; a switch is seen after {toggle_ms_p50:.0f} ms, 19 of "
    "20 times within {toggle_ms_p95:.0f} ms"
)
BENCHMARKS = (
    ("render", "", "render", FASTER),
    ("render-maniskill", "", "render --suite maniskill", FASTER),
    ("live", "", "live", f"one page: {PAGE}"),
    ("live", "with_workers", "live", f"beside an evaluation: {PAGE}"),
    ("live-training", "with_training", "live --training", f"beside a training: {PAGE}"),
    (
        "crowd",
        "",
        "crowd",
        "{visitors} visitors at once: {decisions_per_s} decisions per second each, of {speed:.0f} "
        "asked for; {cores} cores, {mb} MB",
    ),
    (
        "update",
        "",
        "update",
        "{ours_ms:.0f} ms; simple {naive_ms:.0f} ms; {ratio:.1f} times faster ({precision})",
    ),
    (
        "buffer",
        "",
        "buffer",
        "{times_smaller:.1f} times smaller; a batch takes {times_slower_to_sample:.1f} times as "
        "long",
    ),
    (
        "evaluate",
        "",
        "evaluate --workers 2",
        "{ours:.1f} episodes per minute; one process {serial:.1f} ({ratio_serial:.1f} times), with "
        "the simulator's own rendering {stock:.2f} ({ratio_stock:.0f} times)",
    ),
)
"""A file of results/bench, the part of it that is meant, its command, a sentence about it."""
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
    """What `madviz bench` measured, from results/bench: a row for each of ``BENCHMARKS``."""
    folder = ROOT / "results" / "bench"
    lines = ["| benchmark | measured |", "|---|---|"]
    for name, part, command, words in BENCHMARKS:
        found = json.loads((folder / f"{name}.json").read_text())
        said = words.format(**(found[part] if part else found))
        lines.append(f"| `madviz bench {command}` | {re.sub(r'[][]', '', said)} |")
    machine = json.loads((folder / "machine.json").read_text())["machine"]
    return "\n".join(lines) + f"\n\nOn {machine}.\n"


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
    lessons, pages, alone = (json.loads((folder / f"{run}.json").read_text()) for run in CLASS_RUNS)
    students, cores = lessons["students"], lessons["cores"]
    each = list(lessons["each"].values())
    logins = [one["login_s"] for one in each]
    lines = [
        f"Measured with {students} students at once on {cores} cores, their browsers on the same "
        f"cores, torch with its CUDA libraries. A login took {min(logins):.0f} to "
        f"{max(logins):.0f} s. Of each lesson the slowest, and the largest memory:\n",
        "| lesson | open (s) | new kernel (s) | all cells (s) | kernel (MB) | whole student (MB) |",
        "|---|---|---|---|---|---|",
    ]
    whole = 0
    for number in sorted({name[:2] for one in each for name in one if name[:2].isdigit()}):
        timed = [one[name] for one in each for name in one if name[:2] == number]
        times = (max(one[key] for one in timed) for key in ("opened_s", "kernel_s", "cells_s"))
        memory = [max(one["memory_mb"][f"{number} {what}"] for one in each) for what in MEASURED]
        whole = max(whole, memory[-1])
        words = (f"{int(number)}", *(f"{took:.0f}" for took in times), *map(str, memory))
        lines.append(f"| {' | '.join(words)} |")
    lines += [
        "\nMemory is proportional: what several processes share counts once. So, with as many "
        "students for each core, one kernel each, and 2 GB for the system:\n",
        "| students | cores | memory |",
        "|---|---|---|",
    ]
    for number in (4, 10, 20, 30):
        needed = math.ceil(2 + number * whole / 1024)
        lines.append(f"| {number} | {-(-number * cores // students)} | {needed} GB |")
    shown = [one["page"] for one in pages["each"].values()]
    more = max(one["memory_mb"]["page page"] for one in pages["each"].values())
    lines.append(
        f"\nWith {len(shown)} live pages at once, whose browsers hardly drew the 3D scene, "
        "each had its first numbers after "
        f"{max(one['shown_s'] for one in shown):.0f} s at most, then at least "
        f"{min(one['messages_a_second'] for one in shown):.0f} messages a second, and took "
        f"{more} MB more at most."
    )
    timed = [
        one for found in alone["each"].values() for name, one in found.items() if name[:2].isdigit()
    ]
    opened, kernels = ([one[key] for one in timed] for key in ("opened_s", "kernel_s"))
    lines.append(
        f"\nWith one student on the machine ({len(timed)} lessons), a lesson was open after "
        f"{min(opened):.0f} to {max(opened):.0f} s, and a new kernel answered after "
        f"{max(kernels):.1f} s at most."
    )
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


def site_success() -> str:
    """Success that `madviz bench site` counted in a browser, from results/site, beside Python's on
    the same seeds: one row for each policy and subset that was tried."""
    from madviz.evaluation.statistics import SuccessRate, pair

    lines = [
        "| policy | cameras | in the browser | in Python | only browser, only Python | p |",
        "|---|---|---|---|---|---|",
    ]
    for file in sorted((ROOT / "results" / "site").glob("*.json")):
        played: dict[tuple[str, str], dict[int, bool]] = {}
        for one in json.loads(file.read_text())["episodes"]:
            played.setdefault((one["policy"], one["subset"]), {})[one["seed"]] = one["success"]
        for (policy, subset), browser in played.items():
            rows = (evaluation(policy), evaluation(policy, development=True))
            of_seed = {
                row["seed"]: row["success"]
                for found in rows
                for row in found["episodes"]
                if row["subset"] == subset
            }
            python = {seed: of_seed[seed] for seed in browser}
            rates = [SuccessRate.of(sum(one.values()), len(one)) for one in (browser, python)]
            compared = pair(browser, python)
            lines.append(
                f"| {policy} | {LABELS.get(subset, subset)} | {rates[0]} | {rates[1]} | "
                f"{compared.first_only}, {compared.second_only} | {compared.mcnemar():.2g} |"
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
    "site-success": site_success,
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

"""Writes measured figures into README and docs, and checks that they are the ones in the files.

    python tools/fill_figures.py            fills every block
    python tools/fill_figures.py --check    says which block is out of date; changes nothing

A block stands between ``<!-- figures: NAME -->`` and ``<!-- end -->``. Each NAME is a function in
``BLOCKS``, which makes Markdown from the files in checkpoints/, results/ and madviz/ alone.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import measurements
import package_tree
from policy_files import LABELS, ROOT, SINGLES, Evaluation, evaluation, methods, rate, seeds

from madviz.report.claims import signed
from madviz.report.rows import Row, difference

START = "<!-- figures: "
BLOCK = re.compile(rf"({START}(\S+) -->\n)(?:(?!{START}).)*?(<!-- end -->)", re.DOTALL)
WEAK = 0.70
"""A single camera below this success rate is named as weak."""
LACKING = {("maniskill/poke-cube", "first"): " (it does not see the goal)"}
"""What ``python -m benchmarks places`` says of a weak camera, by task and camera."""


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
                words += LACKING.get((found["task"], name), "")
                named.setdefault(count(found), []).append(words)
    return ". ".join(
        f"Below {WEAK:.2f} alone (MAD, recipe `light`, {each}): {'; '.join(words)}"
        for each, words in named.items()
    )


def findings() -> str:
    push, cube = methods("metaworld/push"), methods("maniskill/push-cube")
    mad, merged, single, singular = (
        push[name] for name in ("mad", "merged-only", "single", "singular-only")
    )
    names = "First person, Third A and Third B"
    about = f"{mad.trainings} trainings, n = {len(mad.cells['all'])}, {mad.seeds} seeds"
    return (
        f"1. **A policy trained on the sum alone can fail on one camera.** Push ({about}), all "
        f"cameras: MAD {pooled(mad, 'all')}, Merged Only {pooled(merged, 'all')}. On {names} "
        f"alone: MAD {pooled(mad)}; Merged Only {pooled(merged)}. *Limit:* a small budget: "
        f"the included policy was trained longer, on more episodes and under a noise that fades, "
        f"and has {on_singles('metaworld-push-mad-light')} "
        f"there on reporting seeds; PushCube's First person alone is enough for Merged Only too, "
        f"and who acts in the training episodes counts as well as the loss "
        f"([alpha](docs/training.md#light)).\n"
        f"2. **One policy for all cameras can beat one policy for each.** On push's single "
        f"cameras, three policies with one camera each have {pooled(single)}. MAD minus these: "
        f"{gap(mad, single, SINGLES)}, but on First person alone {gap(mad, single, SINGLES[:1])}; "
        f"on PushCube {gap(cube['mad'], cube['single'], SINGLES)}. "
        f"MAD minus Singular Only, all cameras: {gap(mad, singular, ['all'])}; on PushCube "
        f"{gap(cube['mad'], cube['singular-only'], ['all'])}. *Limit:* two tasks; MAD's alpha was "
        f"chosen with push's first training, on these episodes.\n"
        f"3. **A camera alone has to see what decides.** {weak()}. "
        f"Peg-insert-side's First person had 0.33. Then its policy learned from a script that "
        f"carries the peg over the box first, where that camera sees the box, and it has "
        f"{rate(evaluation('metaworld-peg-insert-side-mad-light'), 'first')}. *Limit:* one "
        f"training each; other options differ too "
        f"([places](docs/benchmarks.md#places)).\n"
        f"4. **From rewards alone, MAD learns to act from one camera too.** {from_rewards()}; "
        f"these two do not differ measurably. *Limit:* one training each, at a "
        f"fifth of the paper's decisions.\n"
    )


def on_singles(name: str) -> str:
    """Rates of an included policy on each camera alone."""
    found = evaluation(name)
    return ", ".join(rate(found, subset) for subset in SINGLES)


def from_rewards() -> str:
    """MAD and Single Camera by reinforcement learning, on the seeds that both have."""
    mad, alone = (
        evaluation(f"maniskill-push-cube-{name}-paper-vectorised", development=True)
        for name in ("mad", "single-third_a")
    )
    rates = ", ".join(rate(mad, subset) for subset in ("all", *SINGLES))
    return (
        f"PushCube ({count(mad)}), all cameras, then {', '.join(LABELS.values())} alone: MAD "
        f"{rates}; Single Camera on Third A {rate(alone)}"
    )


def included(method: str) -> str:
    """Success of the included policies of one method with the paper's cameras."""
    lines = [
        "| policy | all cameras | First person | Third A | Third B | episodes |",
        "|---" * 6 + "|",
    ]
    for file in sorted(ROOT.glob("checkpoints/*/config.json")):
        config = json.loads(file.read_text())
        if (config["method"], config["setting"]) == (method, "three"):
            found = evaluation(file.parent.name)
            rates = " | ".join(rate(found, subset) for subset in ("all", *SINGLES))
            lines.append(f"| {found['policy']} | {rates} | {count(found)} |")
    return "\n".join(lines) + "\n"


def pooled(row: Row, *subsets: str) -> str:
    """Rates over all trainings; of every single camera if no subset is given."""
    words = []
    for subset in subsets or SINGLES:
        found = row.rate(subset)
        assert found, f"expected {row.label} to be measured on {subset}"
        low, high = found.interval
        words.append(f"{found.value:.2f} [{low:.2f}, {high:.2f}]")
    return ", ".join(words)


def gap(first: Row, second: Row, subsets: Sequence[str]) -> str:
    """For example ``+15 points [+2, +28]``, paired."""
    found = difference(first, second, subsets)
    assert found, "both have these subsets"
    low, high = found.interval
    return f"{signed(found.value)} points [{signed(low)}, {signed(high)}]"


BLOCKS: dict[str, Callable[[], str]] = {
    "findings": findings,
    "mv-mae": partial(included, "mv-mae"),
    "mv-mwm": partial(included, "mv-mwm"),
    "beside-imagining": measurements.beside_imagining,
    "packages": package_tree.packages,
    "benchmarks": measurements.benchmarks,
    "priorities": measurements.priorities,
    "class-server": measurements.class_server,
    "grading": measurements.grading,
    "kernel-memory": measurements.kernel_memory,
    "imagine": measurements.imagine,
    "view-masking": measurements.view_masking,
    "places": measurements.places,
    "soak": measurements.soak,
    "site-speed": measurements.site_speed,
    "site-success": measurements.site_success,
}


def filled(text: str) -> str:
    """``text`` with today's figures in its blocks. Raises KeyError for a block nobody makes, and
    ValueError for one without an end."""
    if text.count(START) != len(BLOCK.findall(text)):
        raise ValueError(
            "expected <!-- end --> after every <!-- figures: NAME -->, found one without"
        )
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

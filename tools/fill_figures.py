"""Writes measured figures into README and docs, and checks that they are the ones in the files.

    python tools/fill_figures.py            fills every block
    python tools/fill_figures.py --check    says which block is out of date; changes nothing

A block stands between ``<!-- figures: NAME -->`` and ``<!-- end -->``. Each NAME is a function in
``BLOCKS``, which makes Markdown from the files in checkpoints/, results/ and madviz/ alone.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Sequence
from functools import partial

import measurements
import package_tree
from measurements import table
from policy_files import LABELS, ROOT, SINGLES, methods, on_development, policies, rates, row

from madviz.report.layouts import THREE
from madviz.report.rows import Row, difference
from madviz.report.threshold import TWENTY, WEAK, judge

START = "<!-- figures: "
BLOCK = re.compile(rf"({START}(\S+) -->\n)(?:(?!{START}).)*?(<!-- end -->)", re.DOTALL)
LACKING = {("maniskill/poke-cube", "first"): " (it does not see the goal)"}
"""The finding of ``python -m benchmarks places`` about a weak camera, by task and camera."""


def count(measured: Row) -> str:
    """For example ``n = 100, reporting seeds``."""
    return f"n = {len(measured.cells['all'])}, {measured.seeds} seeds"


def joined(measured: Row, *subsets: str) -> str:
    """Rates in a line; those of every single camera if no subset is given."""
    return ", ".join(rates(measured, subsets or SINGLES))


def weak() -> str:
    """Every single camera below ``WEAK``, with its rate."""
    named: dict[str, list[str]] = {}
    for task in sorted(TWENTY):
        verdict = judge(task, list(policies().values()))
        for camera, success in verdict.weak.items():
            assert verdict.row, "a rate is one of a policy"
            label = f"{task} {LABELS[camera]} {success.without_count}"
            label += LACKING.get((task, camera), "")
            named.setdefault(count(verdict.row), []).append(label)
    return ". ".join(
        f"Below {WEAK:.2f} alone (MAD, recipe `light`, {measured}): {'; '.join(labels)}"
        for measured, labels in named.items()
    )


def findings() -> str:
    push, cube = methods("metaworld/push"), methods("maniskill/push-cube")
    mad, merged, single, singular = (
        push[name] for name in ("mad", "merged-only", "single", "singular-only")
    )
    included = row("metaworld-push-mad-light")
    names = "First person, Third A and Third B"
    about = f"{mad.trainings} trainings, n = {len(mad.cells['all'])}, {mad.seeds} seeds"
    return (
        f"1. **A policy trained on the sum alone can fail on one camera.** Push ({about}), all "
        f"cameras: MAD {joined(mad, 'all')}, Merged Only {joined(merged, 'all')}. On {names} "
        f"alone: MAD {joined(mad)}; Merged Only {joined(merged)}. *Limit:* a small budget: "
        f"the included policy was trained longer, on more episodes and under a noise that fades, "
        f"and has {joined(included)} there ({included.seeds} seeds); "
        f"PushCube's First person alone is enough for Merged Only too, "
        f"and who acts in the training episodes counts as well as the loss "
        f"([alpha](docs/training.md#light)).\n"
        f"2. **One policy for all cameras can beat one policy for each.** On push's single "
        f"cameras, three policies with one camera each have {joined(single)}. MAD minus these: "
        f"{gap(mad, single, SINGLES)}, but on First person alone {gap(mad, single, SINGLES[:1])}; "
        f"on PushCube {gap(cube['mad'], cube['single'], SINGLES)}. "
        f"MAD minus Singular Only, all cameras: {gap(mad, singular, ['all'])}; on PushCube "
        f"{gap(cube['mad'], cube['singular-only'], ['all'])}. *Limit:* two tasks; MAD's alpha was "
        f"chosen with push's first training, on these episodes.\n"
        f"3. **A camera alone has to see what decides.** {weak()}. "
        f"Peg-insert-side's First person had 0.33. Then its policy learned from a script that "
        f"carries the peg over the box first, where that camera sees the box, and it has "
        f"{joined(row('metaworld-peg-insert-side-mad-light'), 'first')}. *Limit:* one "
        f"training each; other options differ too "
        f"([places](docs/benchmarks.md#places)).\n"
        f"4. **From rewards alone, MAD learns to act from one camera too.** {from_rewards()}; "
        f"these two do not differ measurably. *Limit:* one training each, at a "
        f"fifth of the paper's decisions.\n"
    )


def from_rewards() -> str:
    """MAD and Single Camera by reinforcement learning, on the seeds that both have."""
    mad = on_development("maniskill-push-cube-mad-paper-vectorised")
    single = on_development("maniskill-push-cube-single-third_a-paper-vectorised", ("all",))
    return (
        f"PushCube ({count(mad)}), all cameras, then {', '.join(LABELS.values())} alone: MAD "
        f"{joined(mad, *THREE)}; Single Camera on Third A {joined(single, 'all')}"
    )


def included(method: str) -> str:
    """Success of the included policies of one method with the paper's cameras."""
    measured = [
        row(policy.folder)
        for policy in policies().values()
        if (policy.config.method, policy.config.setting) == (method, "three")
        and policy.path.parent == ROOT / "checkpoints"
    ]
    return table(
        ("policy", "all cameras", *LABELS.values(), "episodes"),
        [(policy.label, *rates(policy, THREE), count(policy)) for policy in measured],
    )


def gap(first: Row, second: Row, subsets: Sequence[str]) -> str:
    """For example ``+15 points [+2, +28]``, paired."""
    paired = difference(first, second, subsets)
    assert paired, "both have these subsets"
    return str(paired)


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
    return BLOCK.sub(lambda match: match[1] + BLOCKS[match[2]]() + match[3], text)


def main(arguments: list[str]) -> int:
    stale = []
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        text = page.read_text()
        if (new := filled(text)) != text:
            stale.append(page.relative_to(ROOT))
            if "--check" not in arguments:
                page.write_text(new)
    state = "out of date" if "--check" in arguments else "filled"
    print(*(f"{state}: {page}" for page in stale), sep="\n")
    return 1 if stale and "--check" in arguments else 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))

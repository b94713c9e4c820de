"""Writes measured figures into README and docs, and checks that they are the ones in the files.

    python tools/fill_figures.py            fills every block
    python tools/fill_figures.py --check    says which block is out of date; changes nothing

A block stands between ``<!-- figures: NAME -->`` and ``<!-- end -->``. Each NAME is a function in
``BLOCKS``, which makes Markdown from the files in checkpoints/, results/ and madviz/ alone. The
claims of results/RESULTS.md, which ``madviz report`` writes without them, get their block here.
"""

from __future__ import annotations

import json
import re
import sys
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections import Counter
from collections.abc import Callable
from functools import partial

import audits
import crossed_table
import fresh_seeds
import guard_table
import measurements
import package_tree
import recorded_table
import rewards_table
from findings import findings_table, headline_sentences, judged
from measurements import table
from policy_files import LABELS, ROOT, every_table, policies, rates, row

from madviz.policies import checkpoint
from madviz.report.layouts import THREE
from madviz.report.rows import Row
from madviz.report.threshold import TWENTY, WEAK, judge
from madviz.vocabulary.words import MEANINGS

START = "<!-- figures: "
BLOCK = re.compile(rf"({START}(\S+) -->\n)(?:(?!{START}).)*?(<!-- end -->)", re.DOTALL)
LACKING = {("maniskill/poke-cube", "first"): " (it does not see the goal)"}
"""The finding of ``python -m benchmarks places`` about a weak camera, by task and camera."""
CLAIMS_WORDS = (
    "Claims, from small budgets on two robot tasks and a toy. *Shown here*: the interval shows it, "
    "in three trainings by rewards or more, as in the paper. *Shown in part*: in others. "
    "With one training, intervals are over episodes only, and others scatter more. `make pictures` "
    "writes this table; `madviz report` does not."
)


def count(measured: Row) -> str:
    """For example ``n = 100, reporting seeds``."""
    return f"n = {len(measured.cells['all'])}, {measured.seeds} seeds"


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
        f"Rates below {WEAK:.2f} of MAD with one camera ({measured}): {'. And '.join(labels)}"
        for measured, labels in named.items()
    )


def claims() -> str:
    """The beginning of RESULTS.md."""
    return f"{CLAIMS_WORDS}\n\n{findings_table(every_table()).rstrip()}\n"


def findings() -> str:
    """The table of RESULTS.md, and two findings that are no difference of two rows."""
    return (
        f"{findings_table(every_table()).rstrip()}\n\n"
        f"- **Where a single camera is not enough.** {weak()}.\n"
        f"- **{holding_still()}\n"
    )


def headlines() -> str:
    """A sentence for each finding that is a headline, the counts of verdicts, and the guard."""
    found = judged(every_table())
    counts = Counter(one.verdict for one in found)
    said = ", ".join(f"{count} {verdict}" for verdict, count in counts.items())
    lines = [
        *headline_sentences(found),
        f"Of {len(found)} rows below: {said}.",
        guard_table.headline(),
    ]
    return "".join(f"- {one}\n" for one in lines)


def holding_still() -> str:
    """Success at the last step and at any step of the policy that learned from rewards."""
    file = ROOT / "checkpoints/maniskill-push-cube-mad-paper-vectorised" / checkpoint.DEVELOPMENT
    subsets = json.loads(file.read_text())["subsets"].values()
    last = [subset["success"] for subset in subsets]
    ever = [subset["success_any"] for subset in subsets]
    return (
        "Trained by rewards, MAD reaches the goal from every camera and does not hold still.** "
        "PushCube, one training, n = 100, development seeds, all cameras and each one only. At the "
        f"last step its success is {min(last):.2f} to {max(last):.2f}, at any step "
        f"{min(ever):.2f} to {max(ever):.2f}."
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


def glossary() -> str:
    """Every word of the vocabulary."""
    return table(
        ("word", "meaning"), ((word, MEANINGS[word]) for word in sorted(MEANINGS, key=str.lower))
    )


BLOCKS: dict[str, Callable[[], str]] = {
    "glossary": glossary,
    "wiring": measurements.wiring,
    "claims": claims,
    "findings": findings,
    "fresh-seeds": fresh_seeds.fresh_seeds,
    "headlines": headlines,
    "mv-mae": partial(included, "mv-mae"),
    "mv-mwm": partial(included, "mv-mwm"),
    "beside-imagining": measurements.beside_imagining,
    "packages": package_tree.packages,
    "crossed": crossed_table.crossed,
    "rewards": rewards_table.rewards,
    "recorded": recorded_table.recorded,
    "recorded-films": recorded_table.films,
    "guard-trial": guard_table.guard_trial,
    "guard-ways": guard_table.guard_ways,
    "guard-alarms": guard_table.guard_alarms,
    "benchmarks": measurements.benchmarks,
    "waits": measurements.waits,
    "priorities": measurements.priorities,
    "class-server": measurements.class_server,
    "grading": measurements.grading,
    "kernel-memory": measurements.kernel_memory,
    "imagine": measurements.imagine,
    "view-masking": measurements.view_masking,
    "places": measurements.places,
    "audits": audits.audits,
    "along": audits.along,
    "audit-hammer-mad": partial(audits.sentences, "metaworld-hammer-mad-light"),
    "audit-hammer-merged-only": partial(audits.sentences, "metaworld-hammer-merged-only-light"),
    "audit-push-cube": partial(audits.sentences, "maniskill-push-cube-mad-paper-vectorised"),
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


def with_claims(text: str) -> str:
    """RESULTS.md as ``madviz report`` writes it, with a block for the claims."""
    title = "# Results\n\n"
    return text.replace(f"{title}Generated", f"{title}{START}claims -->\n<!-- end -->\n\nGenerated")


def main(arguments: list[str]) -> int:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; 1 if out of date")
    check = parser.parse_args(arguments).check
    stale = []
    results = ROOT / "results" / "RESULTS.md"
    for page in (ROOT / "README.md", results, *sorted((ROOT / "docs").glob("*.md"))):
        text = page.read_text()
        if (new := filled(with_claims(text) if page == results else text)) != text:
            stale.append(page.relative_to(ROOT))
            if not check:
                page.write_text(new)
    state = "out of date" if check else "filled"
    print(*(f"{state}: {page}" for page in stale), sep="\n")
    return 1 if stale and check else 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))

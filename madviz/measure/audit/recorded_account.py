"""audit.html and audit.md of an audit on recordings, in blocks (``madviz.measure.blocks``)."""

from __future__ import annotations

import shlex

from madviz.measure.audit.recorded import (
    HARDLY,
    STEPS,
    VERDICTS,
    CameraStep,
    DistanceRow,
    RecordedAuditFile,
    RecordedRow,
)
from madviz.measure.audit.sentences import HOW_WORDS
from madviz.measure.blocks import Block, ending

FEW = 10
"""Episodes; intervals of fewer are coarse."""
SAME = 0.005
"""Spreads; two answers that are less apart are the same."""
HOW_TO_READ = (
    "Distances are in spreads: the root mean square, over the numbers of an action, of how far two "
    "actions are apart in standard deviations of the recorded ones.",
    "Brackets are 95 % intervals over episodes (Student's t).",
    "The episodes went on as they were recorded, whatever the policy answered. A small change at "
    "every step may add up, and a large one may be put right at the next step: only a robot or a "
    "simulator tells what comes of either.",
    "'Further off' is the distance from the recorded action, less the same with all cameras; below "
    "0 it is nearer.",
)


def recorded_words(found: RecordedAuditFile) -> list[str]:
    """One sentence for the policy, one for each camera, and what limits them."""
    judged = found["judged"]
    others = len(found["episodes"]) - len(judged)
    count = len(judged) or others
    lines = [
        f"{found['label'].capitalize()}. On {_episodes(count)} of {found['recording']}, "
        f"{found['policy']} is {_distance(found['apart'])} spreads from the recorded action with "
        "all cameras."
    ]
    if found["repeats"]["mean"] > SAME:
        lines.append(
            f"Asked the same twice, it answers {_distance(found['repeats'])} spreads apart: it "
            "samples. The changes below hold that, too; a verdict needs what goes beyond it."
        )
    for name, words in found["verdict"].items():
        how = found["decided_by"][name]
        row = _row(found, name, how)
        away = "" if how == "dropped" else f" ({HOW_WORDS[how]} in its place)"
        lines.append(
            f"{found['labels'][name]}: {words}{away}: {_distance(row['change'])} spreads"
            f"{_most(row)}; "
            f"{_distance(row['further'], signed=True)} further from the recorded action."
        )
    if not found["training_known"]:
        lines.append(
            "It is not known what the policy was trained on: verdicts rest on the episodes that "
            "madviz would hold out."
        )
    elif not judged:
        lines.append("The policy was trained on all of these episodes: no verdict rests on them.")
    if judged and others:
        trained = "was" if found["training_known"] else "may have been"
        lines.append(
            f"The policy {trained} trained on {_episodes(others)} more: no distance or verdict "
            "rests on them. They stand only under *Where each camera mattered most*."
        )
    if count == 1:
        lines.append("One episode says little, and has no interval: record more.")
    elif count < FEW:
        lines.append(f"{_episodes(count)} are few: intervals are wide.")
    lines += [f"Left out: {line}" for line in found["left_out"]]
    return lines


def recorded_account(found: RecordedAuditFile, command: str, source: list[str]) -> list[Block]:
    """All blocks; ``command`` makes the audit again, ``source`` are the words that name recordings
    and policy."""
    heads = ("cameras", "how", "change of the action", "most of all", "further off")
    moments = ("camera", "episode", "step", "change", "to see it; then go to the step in Go back")
    return [
        Block("h1", [f"Which cameras does {found['policy']} use? ({found['label']})"]),
        Block("words", recorded_words(found)),
        Block("h2", ["Verdicts"]),
        Block("list", [f"{name}: {meaning}." for name, meaning in VERDICTS.items()]),
        Block("h2", ["Where each camera mattered most"]),
        Block("table", moments, [_moment(found, one, source) for one in found["moments"]]),
        Block("h2", ["Every condition"]),
        Block("table", heads, [_condition(found, row) for row in _different(found)]),
        *ending(HOW_TO_READ, _facts(found), command),
    ]


def _row(found: RecordedAuditFile, camera: str, how: str) -> RecordedRow:
    return next(
        row
        for row in found["conditions"]
        if (row["camera"], row["what"], row["how"]) == (camera, "removed", how)
    )


def _different(found: RecordedAuditFile) -> list[RecordedRow]:
    """The rows of the table: where one of two cameras is removed, the other one is alone."""
    two = len(found["labels"]) == 2
    return [row for row in found["conditions"] if not (two and row["what"] == "alone")]


def _moment(found: RecordedAuditFile, one: CameraStep, source: list[str]) -> list[str]:
    words = ["madviz", "explore", *source, "--seed", str(one["place"])]
    known = "trained on" if found["training_known"] else "perhaps trained on"
    judged = one["episode"] in found["judged"]
    state = "off" if found["decided_by"][one["camera"]] == "dropped" else "mean"
    return [
        found["labels"][one["camera"]],
        f"{one['episode']}{'' if judged else f', {known}'}",
        str(one["step"]),
        f"{one['change']:.2f}",
        shlex.join([*words, "--condition", f"{one['camera']}={state}"]),
    ]


def _condition(found: RecordedAuditFile, row: RecordedRow) -> list[str]:
    camera = row["camera"]
    label = "no camera" if camera is None else f"{found['labels'][camera]} {row['what']}"
    others = [other for name, other in found["labels"].items() if name != camera]
    label += f", {others[0]} alone" if camera is not None and len(others) == 1 else ""
    further = _distance(row["further"], signed=True)
    most = f"{row['most']} {row['most_apart']:.2f}" if row["most"] else "none"
    return [label, HOW_WORDS[row["how"]], _distance(row["change"]), most, further]


def _facts(found: RecordedAuditFile) -> list[tuple[str, str]]:
    return [
        ("policy", found["policy"]),
        ("digest", found["digest"] or "none"),
        ("recordings", f"{found['recording']}, {found['fps']:g} steps a second"),
        ("episodes", ", ".join(map(str, found["episodes"]))),
        ("answers", f"{found['steps']} for each condition, at most {STEPS} of an episode"),
        ("hardly", f"less than {HARDLY} spreads"),
    ]


def _most(row: RecordedRow) -> str:
    """The clause on the number that changes most."""
    if not row["most"]:
        return ""
    return f", most of all {row['most']} ({row['most_apart']:.2f} of its own spread)"


def _episodes(count: int) -> str:
    return f"{count} episode{'' if count == 1 else 's'}"


def _distance(row: DistanceRow, signed: bool = False) -> str:
    ends = [row["mean"], *(row["ci95"] or ())]
    # No minus before a zero.
    mean, *interval = (f"{round(end, 2) + 0.0:{'+' if signed else ''}.2f}" for end in ends)
    return f"{mean} [{', '.join(interval)}]" if interval else mean

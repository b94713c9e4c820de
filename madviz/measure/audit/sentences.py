"""An audit in plain words: what a reader should know before any number."""

from __future__ import annotations

import math

from madviz.measure.audit.along import AlongFile
from madviz.measure.audit.document import AuditFile, ConditionRow, DifferenceRow
from madviz.measure.audit.guarded import GuardedRow, alarms_words, noticed_words
from madviz.measure.audit.verdict import LEVEL, MARGIN
from madviz.measure.episodes import clipped_words
from madviz.measure.statistics import SuccessRate
from madviz.policies.seeds import use_of

HOW_WORDS = {
    "dropped": "dropped",
    "black": "black",
    "mean": "the mean picture",
    "noise": "noise",
    "frozen": "frozen",
}
"""Names of the ways in which a camera is away."""
OCCLUDED = {
    "black": "black",
    "mean": "sending its mean picture",
    "noise": "sending noise",
    "frozen": "frozen from the start",
}
"""The words for a camera that is away in each of these ways, in a sentence."""
MEANING = {
    "needed": "success falls significantly without it, and is shown to fall by half or more",
    "used": "success falls significantly without it; a loss of half or more is not shown",
    "redundant": "no significant fall without it, but alone it is significantly better than no "
    "camera",
    "no use shown": "no significant fall without it, and alone not significantly better than no "
    "camera",
}
FAILS = 0.5
"""A policy below this with all cameras is no evidence about its cameras."""


def in_words(found: AuditFile) -> list[str]:
    """One sentence or two for the policy, for each camera, and for what is not the same as
    dropping."""
    lines = [_intact(found)]
    lines += filter(None, [clipped_words(found.get("outside", 0.0))])
    lines += [_camera(found, name) for name in found["verdict"]]
    lines += [*_occluded(found), *_guarded(found)]
    if any("mean" in how.values() for how in found["decided_by"].values()):
        lines.append(
            "This policy cannot leave out every camera. Where it cannot, the verdict comes from "
            "the mean picture: the camera sends what it sees on average."
        )
    return lines


def planned(found: AuditFile) -> str:
    """The plan, and how many episodes the audit took."""
    return plan_words(found["episodes"], found["detectable"], found["intact"]["n"])


def plan_words(episodes: int, smallest: float | None, played: int | None = None) -> str:
    """The plan in words; ``smallest`` is the change that is found 8 times in 10, ``played`` what an
    audit that is done has taken."""
    seen = (
        "no change of success can be shown with so few: plan more"
        if smallest is None or math.isnan(smallest)
        else f"a change of {points(smallest)} or more is found 8 times in 10"
    )
    stop = "" if played in (None, episodes) else f" It stopped after {played}: all was decided."
    return f"Planned: {episodes} episodes of each condition; {seen}.{stop}"


def measured(found: AuditFile | AlongFile) -> list[tuple[str, str]]:
    """The facts of an audit, for the table of its page."""
    seeds = range(found["seed"], found["seed"] + found["intact"]["n"])
    return [
        ("policy", found["policy"]),
        ("digest", found["digest"] or "none"),
        ("task", found["task"]),
        ("a success is", found["definition"]),
        ("seeds", f"{seeds[0]} to {seeds[-1]} ({use_of(seeds)})"),
    ]


def points(share: float, sign: bool = False) -> str:
    """0.83 as ``83 points``."""
    number = round(100 * share)
    text = f"{number:+d}" if sign and number else f"{number}"
    return f"{text} point{'' if abs(number) == 1 else 's'}"


def change(row: ConditionRow | DifferenceRow) -> str:
    """``-83 points [-90, -74]``."""
    low, high = (round(100 * end) for end in row["ci95"])
    return f"{points(row['difference'], sign=True)} [{low:+d}, {high:+d}]"


def rate_of(row: ConditionRow | GuardedRow) -> SuccessRate:
    """The row's success rate, with Wilson's interval."""
    n = row["n"]
    return SuccessRate.of(round(row["success"] * n), n)


def makes_no_difference(row: ConditionRow) -> bool:
    """True where the interval that holds for all cameras together lies within ``MARGIN`` of 0."""
    return "ci_all" in row and -MARGIN <= row["ci_all"][0] and row["ci_all"][1] <= MARGIN


def deciding(found: AuditFile, camera: str, what: str) -> ConditionRow:
    """The row that the verdict on ``camera`` rests on."""
    how = found["decided_by"][camera][what]
    return next(
        row
        for row in found["conditions"]
        if (row["camera"], row["what"], row["how"]) == (camera, what, how)
    )


def _intact(found: AuditFile) -> str:
    row = found["intact"]
    line = f"With all cameras, success is {SuccessRate.read(row)}."
    if row["success"] < FAILS:
        line += (
            " A policy that fails so often is no evidence about cameras: what follows says little."
        )
    return line


def _camera(found: AuditFile, name: str) -> str:
    label = found["labels"][name]
    verdict = found["verdict"][name]
    removed = deciding(found, name, "removed")
    alone = deciding(found, name, "alone")
    without = f"without it success changes by {change(removed)}"
    if makes_no_difference(removed) and removed["p_holm"] > LEVEL:
        without += ", so that makes no difference"
    if verdict in ("needed", "used"):
        return f"{label} is {verdict}: {without}."
    if verdict == "redundant":
        return f"{label} is redundant: {without}; alone it has {alone['success']:.2f}."
    above = alone.get("above_none")
    against = "" if above is None else f", {change(above)} against no camera at all"
    line = f"{label}: no use shown. W{without[1:]}; alone it has {alone['success']:.2f}{against}."
    if removed["p_holm"] <= LEVEL and removed["difference"] > 0:
        line += " The policy is better without it."
    return line


def _occluded(found: AuditFile) -> list[str]:
    """For each way to occlude, the camera at which it differs most from dropping, if it does."""
    lines = []
    for how in dict.fromkeys(row["how"] for row in found["occluded"]):
        rows = [row for row in found["occluded"] if row["how"] == how and row["p_holm"] <= LEVEL]
        if rows:
            worst = max(rows, key=lambda row: abs(row["difference"]))
            rates = {
                row["how"]: row["success"]
                for row in found["conditions"]
                if (row["camera"], row["what"]) == (worst["camera"], "removed")
            }
            subject = HOW_WORDS[how].capitalize()
            lines.append(
                f"{subject} is not dropped: with {found['labels'][worst['camera']]} "
                f"{OCCLUDED[how]}, success is {rates[how]:.2f}; with it dropped, "
                f"{rates['dropped']:.2f}."
            )
    return lines


def _guarded(found: AuditFile) -> list[str]:
    """The way of breaking a camera in which the guard wins most, or loses, and its false alarms."""
    guarded = found.get("guarded")
    if guarded is None:
        return []
    without = {(row["camera"], row["how"]): row for row in found["conditions"] if broken(row)}
    pairs = [
        (without[camera, how], row)
        for camera, rows in guarded["broken"].items()
        for how, row in rows.items()
    ]
    if not pairs:
        return [guarded["note"]]
    row, with_guard = max(pairs, key=lambda pair: abs(pair[1]["success"] - pair[0]["success"]))
    rates = [rate_of(one).without_count for one in (row, with_guard)]
    subject = f"{HOW_WORDS[row['how']].capitalize()}, {found['labels'][str(row['camera'])]}"
    noticed = noticed_words(with_guard["noticed"])
    alarms = alarms_words(guarded["intact"]["noticed"])
    return [
        f"{subject}: {rates[0]} without, {rates[1]} with the guard; {noticed}, {alarms}.",
        guarded["note"],
    ]


def broken(row: ConditionRow) -> bool:
    """True where one camera is broken and the others are intact."""
    return row["what"] == "removed" and row["how"] != "dropped"

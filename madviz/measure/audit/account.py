"""audit.html and audit.md: one account of an audit, in blocks (``madviz.measure.blocks``)."""

from __future__ import annotations

from collections.abc import Sequence

from madviz.measure.audit.document import AuditFile, ConditionRow
from madviz.measure.audit.guarded import noticed_words
from madviz.measure.audit.lost_cameras import HOWS
from madviz.measure.audit.sentences import (
    HOW_WORDS,
    MEANING,
    broken,
    change,
    deciding,
    in_words,
    measured,
    planned,
    rate_of,
)
from madviz.measure.blocks import Block, ending
from madviz.measure.episodes import clipped_words
from madviz.plots import figures

HOW_TO_READ = (
    "Success counts at the last step of an episode. All conditions met the same scenes, so that a "
    "difference comes from the cameras. Brackets are 95 % intervals: Wilson's for a rate, "
    "Newcombe's for a paired difference, Agresti and Min's for a Shapley value.",
    "p is McNemar's, exact, with Holm's correction for the other tests of its kind, and for the "
    "looks at which the audit could have stopped: 0.05 is the limit. The verdicts together claim a "
    "significant difference that is not there in at most 5 of 100 audits.",
    "'Needed' is said only where an interval shows a loss of half or more, and 'makes no "
    "difference' where one lies within 5 points either way. These intervals hold for all cameras "
    "and looks together, so they are wider than the ones in brackets. 'No use shown' does not mean "
    "no use: more episodes may show one.",
    "The Shapley value of a camera is the success that it adds, on average over all orders in "
    "which cameras can come. The values sum to the difference between all cameras and none.",
    "An audit is about one training of a policy, in simulation, on the scenes of these seeds.",
)


def account(found: AuditFile, command: str, pairs: Sequence[Block] = ()) -> list[Block]:
    """All blocks; ``command`` makes the audit again, ``pairs`` show episodes that turned."""
    clipped = clipped_words(found.get("outside", 0.0))
    heads = (*CONDITION_HEADS, "guarded", "noticed") if "guarded" in found else CONDITION_HEADS
    looks = ", ".join(map(str, found["looks"])) + " episodes"
    return [
        Block("h1", [f"Does {found['policy']} use its cameras?"]),
        Block("words", in_words(found)),
        Block("p", [planned(found)]),
        Block("h2", ["Verdicts"]),
        Block("table", VERDICT_HEADS, _verdict_rows(found)),
        *([Block("p", [clipped])] if clipped else []),
        Block("list", [f"{name}: {meaning}." for name, meaning in MEANING.items()]),
        *pairs,
        Block("h2", ["Success by condition"]),
        Block("svg", [rates_picture(found)]),
        *_shapley(found),
        Block("h2", ["Every condition"]),
        Block("table", heads, [_condition_row(found, r) for r in found["conditions"]]),
        *ending(HOW_TO_READ, [*measured(found), ("looks", looks)], command),
    ]


VERDICT_HEADS = ("camera", "verdict", "without it", "p", "alone", "alone against none", "p")
CONDITION_HEADS = ("cameras", "how", "success", "against all cameras", "p")


def _verdict_rows(found: AuditFile) -> list[list[str]]:
    rows = []
    for name, verdict in found["verdict"].items():
        removed = deciding(found, name, "removed")
        alone = deciding(found, name, "alone")
        above = alone.get("above_none")
        rows.append(
            [
                found["labels"][name],
                verdict,
                change(removed),
                f"{removed['p_holm']:.2g}",
                str(rate_of(alone)),
                change(above) if above else "",
                f"{above['p_holm']:.2g}" if above else "",
            ]
        )
    return rows


def _condition_row(found: AuditFile, row: ConditionRow) -> list[str]:
    label = condition_label(found, row)
    how = HOW_WORDS[row["how"]]
    cells = [label, how, str(rate_of(row)), change(row), f"{row['p_holm']:.2g}"]
    if "guarded" not in found:
        return cells
    guarded = found["guarded"]["broken"].get(str(row["camera"]), {}).get(row["how"])
    if guarded is None or not broken(row):
        return [*cells, "", ""]
    noticed = noticed_words(guarded["noticed"]).removeprefix("noticed ")
    return [*cells, str(rate_of(guarded)), noticed]


def condition_label(found: AuditFile, row: ConditionRow) -> str:
    """``First person removed``, ``no camera``."""
    if row["camera"] is None:
        return "no camera"
    return f"{found['labels'][row['camera']]} {row['what']}"


def _shapley(found: AuditFile) -> list[Block]:
    if not found["shapley"]:
        return []
    labels = [found["labels"][name] for name in found["shapley"]]
    bars = [
        figures.Bar(row["value"], row["ci95"][0], row["ci95"][1])
        for row in found["shapley"].values()
    ]
    away = "cameras are dropped" if found["shapley_how"] == "dropped" else "cameras send the mean"
    title = f"Shapley values: what a camera adds to success ({away})"
    return [Block("svg", [figures.dots(title, labels, {found["shapley_how"]: bars}, signed=True)])]


def rates_picture(found: AuditFile) -> str:
    """SVG: a line for every camera removed and alone and for none, a dot for every way."""
    labels = list(dict.fromkeys(condition_label(found, row) for row in found["conditions"]))
    series: dict[str, list[figures.Bar | None]] = {}
    for how in HOWS:
        rows = {condition_label(found, r): r for r in found["conditions"] if r["how"] == how}
        if rows:
            words = HOW_WORDS[how].removeprefix("the ")
            series[words] = [_bar(rows[label]) if label in rows else None for label in labels]
    intact = found["intact"]["success"]
    title = f"{found['policy']}: success; the dashed line is all cameras"
    return figures.dots(title, labels, series, marks=(intact,))


def _bar(row: ConditionRow) -> figures.Bar:
    rate = rate_of(row)
    return figures.Bar(rate.value, *rate.interval)

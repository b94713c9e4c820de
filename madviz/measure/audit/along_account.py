"""An audit along axes in words, as blocks of a page, and as a table."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence

from madviz.measure.audit.along import AlongFile, AxisRow, SideRow
from madviz.measure.audit.sentences import FAILS, measured
from madviz.measure.blocks import Block, ending
from madviz.measure.episodes import clipped_words
from madviz.measure.statistics import SuccessRate
from madviz.plots.figures import Line, lines

HOW_TO_READ = (
    "Success counts at the last step of an episode. Every scene was played with nothing changed "
    "first. Those that were solved were then played with the change, each once on a side of an "
    "axis, and all sides met them in the same order.",
    "A curve is the share of these scenes that is solved in spite of the change. It comes from a "
    "family of curves that only fall (Weibull's) and Bayes' rule. Its band, and the interval of a "
    "breaking point, held the truth at least 95 times in 100 in simulated audits.",
    "Most episodes are where success falls, few where it does not change. So the counts of single "
    "places differ, and say less than the curve.",
    "An audit is about one training of a policy, in simulation, on the scenes of these seeds.",
)

HEADS = ("axis", "way", "half is gone at", "kept at its end", "episodes")


def along_words(found: AlongFile) -> list[str]:
    """A sentence for the policy, and one for every side."""
    intact = found["intact"]
    first = f"With nothing changed, success is {SuccessRate.read(intact)}."
    if intact["success"] < FAILS:
        first += " A policy that fails so often is no evidence about what breaks it."
    sentences = [first, *filter(None, [clipped_words(found["outside"])])]
    for axis in found["axes"]:
        sentences += [_sentence(found, axis, side) for side in axis["sides"]]
    return sentences


def _sentence(found: AlongFile, axis: AxisRow, side: SideRow) -> str:
    who = found["labels"].get(axis["camera"] or "", "All cameras")
    low, _ = side["ci95"]
    start = f"{who}, {side['way']}: "
    end = at(axis["unit"], side["end"])
    if not side["n"]:
        return f"{start}nothing was played, because too few scenes are solved with nothing changed."
    if low is None:
        return f"{start}half of its success or more is kept up to {end}."
    if side["breaking"] is None:
        return (
            f"{start}no breaking point is shown up to {end}; half of its success or more is kept "
            f"up to {at(axis['unit'], low)}."
        )
    return f"{start}half of its success is gone at {breaking(axis, side)}."


def breaking(axis: AxisRow, side: SideRow) -> str:
    """``11° [9, 14]``, also of the way to the left: the words beside it say which way it is."""
    if side["ci95"][0] is None:
        return "beyond the end"
    low, high = ("beyond" if end is None else f"{abs(end):.3g}" for end in side["ci95"])
    if axis["what"] in ("zoom", "light") and side["end"] < 1:
        low, high = high, low
    broken = "beyond the end" if side["breaking"] is None else at(axis["unit"], side["breaking"])
    return f"{broken} [{low}, {high}]"


def at(unit: str, value: float) -> str:
    """``11°``, ``1.34 times``, ``a strength of 0.5``; the way says on which side."""
    number = f"{abs(value):.3g}"
    if unit == "strength":
        return f"a strength of {number}"
    return f"{number}{'' if unit == '°' else ' '}{unit}"


def along_account(found: AlongFile, command: str, pairs: Sequence[Block] = ()) -> list[Block]:
    """All blocks; ``command`` makes the audit again, ``pairs`` show episodes that turned."""
    return [
        Block("h1", [f"How much is too much for {found['policy']}?"]),
        Block("words", along_words(found)),
        *(Block("svg", [_picture(found, axis)]) for axis in found["axes"]),
        *pairs,
        Block("h2", ["Every side"]),
        Block("table", HEADS, _rows(found)),
        *ending(HOW_TO_READ, measured(found), command),
    ]


def _rows(found: AlongFile) -> list[list[str]]:
    rows = []
    for axis in found["axes"]:
        for side in axis["sides"]:
            last = side["places"][-1]
            kept = f"{last['kept']:.2f} [{last['ci95'][0]:.2f}, {last['ci95'][1]:.2f}]"
            rows.append([axis["axis"], side["way"], breaking(axis, side), kept, str(side["n"])])
    return rows


def _picture(found: AlongFile, axis: AxisRow) -> str:
    """SVG: a line for each side, over how far it went."""
    start = 1.0 if axis["what"] in ("zoom", "light") else 0.0
    drawn = {}
    for side in axis["sides"]:
        places = side["places"]
        drawn[side["way"]] = Line(
            [abs(start), *(abs(place["at"]) for place in places)],
            [1.0, *(place["kept"] for place in places)],
            *([1.0, *(place["ci95"][end] for place in places)] for end in (0, 1)),
        )
    title = f"{found['policy']}: scenes that are still solved"
    return lines(title, axis["unit"], {axis["axis"]: drawn})


def along_csv(found: AlongFile) -> str:
    """A row for each place, with all that sets it apart from rows of other files."""
    facts = {key: found[key] for key in ("policy", "digest", "task", "seed")}
    numbers = ("at", "successes", "n", "kept", "ci95_low", "ci95_high")
    file = io.StringIO()
    names = [*facts, "camera", "along", "unit", "way", *numbers]
    writer = csv.DictWriter(file, names, lineterminator="\n")
    writer.writeheader()
    for axis in found["axes"]:
        of = {"camera": axis["camera"] or "all", "along": axis["what"], "unit": axis["unit"]}
        for side in axis["sides"]:
            for place in side["places"]:
                low, high = place["ci95"]
                measured = {name: place[name] for name in numbers[:4]}
                ends = {"ci95_low": low, "ci95_high": high}
                writer.writerow({**facts, **of, "way": side["way"], **measured, **ends})
    return file.getvalue()

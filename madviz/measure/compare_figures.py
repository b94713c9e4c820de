"""The figures of ``madviz compare``: success by subset, and against environment steps."""

from __future__ import annotations

import re
from collections.abc import Sequence

from madviz.errors import UserError
from madviz.measure.evidence import Evidence, Outcomes
from madviz.measure.formulas import student
from madviz.measure.statistics import interval_over_trainings, mean_interval
from madviz.plots import figures
from madviz.system.files import read_rows


def bars(found: Sequence[Evidence], table: dict[str, list[Outcomes]]) -> str:
    """Success by method and subset as SVG: bars are means, dots are trainings. ``table`` has the
    outcomes of every policy by subset."""
    series: dict[str, list[figures.Bar | None]] = {}
    for label, places in _grouped(found).items():
        series[label] = []
        for rows in table.values():
            trainings = [[float(rows[i][seed]) for seed in sorted(rows[i])] for i in places]
            rates = [sum(each) / len(each) for each in trainings]
            shares = [sum(scene) / len(scene) for scene in zip(*trainings, strict=True)]
            ends = mean_interval(shares, len(trainings))
            if len(trainings) > 1:
                ends = interval_over_trainings([trainings], ends)
            dots = tuple(rates) if len(rates) > 1 else ()
            series[label].append(figures.Bar(sum(rates) / len(rates), *ends, dots))
    return figures.bars(f"{found[0].config.task}: success by subset", list(table), series)


def curves(found: Sequence[Evidence]) -> str:
    """The paper's figure as SVG: all, each single and their average against environment steps.

    Steps that one of a method's trainings did not measure are left out. Raises UserError for a
    policy whose curve.csv has no success by subset, and for trainings that share no step.
    """
    panels: dict[str, dict[str, figures.Line]] = {}
    for label, places in _grouped(found).items():
        tables = [_curve(found[index]) for index in places]
        common = sorted(set.intersection(*(set(table) for table in tables)))
        for name in _shared(label, tables, common):
            line = [[table[step][name] for table in tables] for step in common]
            means = [sum(rates) / len(rates) for rates in line]
            ends = [student([[[rate] for rate in rates]]) for rates in line]
            lows = [low for low, _ in ends]
            highs = [high for _, high in ends]
            panels.setdefault(name, {})[label] = figures.Line(common, means, lows, highs)
    return figures.lines(f"{found[0].config.task}: success while training", "steps", panels)


def _shared(label: str, tables: Sequence[dict], steps: Sequence[float]) -> list[str]:
    """The subsets that every training measured at each of the shared ``steps``, and their average
    where no training has others."""
    if not steps:
        raise UserError(
            f"expected trainings of {label} that were measured at the same steps, found none that "
            "they share; compare fewer of them, or leave --curves out"
        )
    rows = [table[step] for table in tables for step in steps]
    shared = [name for name in rows[0] if all(name in row for row in rows)]
    return [one for one in shared if one != "average" or all(len(shared) == len(r) for r in rows)]


def _label(evidence: Evidence) -> str:
    config = evidence.config
    facts = [config.setting, *([config.camera] if config.camera else []), config.recipe]
    facts += [] if evidence.alpha is None else [f"alpha {evidence.alpha:g}"]
    return f"{evidence.method} ({', '.join(facts)})"


def _grouped(found: Sequence[Evidence]) -> dict[str, list[int]]:
    """Places in ``found`` of every method's trainings. Those with other options of the recipe are
    no trainings of one method: where two would have one label, it says the options."""
    labels = [_label(evidence) for evidence in found]
    options = [_options(evidence) for evidence in found]
    groups: dict[str, list[int]] = {}
    for index, label in enumerate(labels):
        alike = {options[i] for i, other in enumerate(labels) if other == label}
        said = f": {options[index] or 'the usual options'}" if len(alike) > 1 else ""
        groups.setdefault(label + said, []).append(index)
    return groups


def _options(evidence: Evidence) -> str:
    """The options of the recipe in its command, but alpha, which the label has, and the number of
    processes, as in ``rounds 20, noise-decay 0.9``."""
    found = re.findall(r"--[\w-]+\.([\w.-]+)((?: (?!--)\S+)*)", evidence.command)
    return ", ".join(name + value for name, value in found if name not in ("alpha", "workers"))


def _curve(evidence: Evidence) -> dict[float, dict[str, float]]:
    """Success by subset, and on average, at every environment step that was measured."""
    file = evidence.path / "curve.csv"
    table = {}
    for row in read_rows(file):
        rates = {
            k.removeprefix("success_"): float(v) for k, v in row.items() if k.startswith("success_")
        }
        if "env_steps" in row and rates:
            table[float(row["env_steps"])] = {**rates, "average": sum(rates.values()) / len(rates)}
    if not table:
        raise UserError(
            f"{file}: expected success by subset against environment steps, found none; only the "
            "recipe `paper` measures it while it trains: leave --curves out"
        )
    return table

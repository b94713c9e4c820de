"""``curve.svg`` in a run's folder: success while training, drawn anew at every evaluation.

Every subset is a line over simulator steps; its band is the 95% interval of that evaluation's
episodes (Wilson). With the recipe's 20 episodes that is wide: 15 of 20 could be 0.53 or 0.89, so a
dip in one line says little. Above it stand how far the run is and the time that is left at its
rate so far. Several trainings in one picture, with intervals over their seeds, are
``madviz compare ... --curves FILE``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from madviz.measure.statistics import wilson
from madviz.plots import figures
from madviz.system.files import read_rows, write_bytes

PREFIX = "success_"


def draw_curve(folder: Path, name: str, steps: int) -> None:
    """Draws ``curve.csv`` of ``folder`` to ``curve.svg``; ``steps`` are the whole run's decisions.

    Nothing is drawn from a curve that has no success by subset.
    """
    rows = read_rows(folder / "curve.csv")
    lines = success_lines(rows)
    if not lines:
        return
    title = f"{name}: {progress(rows[-1], steps)}"
    figure = figures.lines(title, "simulator steps", {"success, 95% intervals": lines})
    write_bytes(folder / "curve.svg", figure.encode())


def success_lines(rows: Sequence[Mapping[str, str]]) -> dict[str, figures.Line]:
    """A line by subset from the rows of a curve; empty without success by subset."""
    lines: dict[str, figures.Line] = {}
    steps = [float(row["env_steps"]) for row in rows if "env_steps" in row]
    for column in [key for key in (rows[0] if steps else {}) if key.startswith(PREFIX)]:
        rates = [float(row[column]) for row in rows]
        counts = [int(row["episodes"]) for row in rows]
        ends = [wilson(round(r * n), n) for r, n in zip(rates, counts, strict=True)]
        lows = [low for low, _ in ends]
        highs = [high for _, high in ends]
        lines[column.removeprefix(PREFIX)] = figures.Line(steps, rates, lows, highs)
    return lines


def progress(row: Mapping[str, str], steps: int) -> str:
    """How far a run is at a row of its curve, and what is left (or was taken), in words."""
    done = int(row["step"])
    left = row.get("seconds_left")
    reached = f"{done:,} of {steps:,} decisions"
    if done >= steps:
        return f"{reached}, {duration(float(row['seconds']))}"
    return f"{reached}, {duration(float(left))} left" if left else reached


def duration(seconds: float) -> str:
    """``3 h 05 min``, ``12 min`` or ``40 s``."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes >= 60 else f"{minutes} min"

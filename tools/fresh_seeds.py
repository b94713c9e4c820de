"""The table of docs/evaluation.md: the same policies on development seeds and on reporting seeds.

A policy whose script or options were improved on the seeds from 5000 on may owe some of its rate to
just these scenes. The difference between the two columns says how much.
"""

from __future__ import annotations

import numpy as np
from measurements import table
from policy_files import LABELS, on_development, policies, row

from madviz.measure.formulas import t_interval
from madviz.policies.seeds import REPORTING
from madviz.report.layouts import THREE
from madviz.report.rows import Row
from madviz.report.threshold import TWENTY


def fresh_seeds() -> str:
    """A row for all cameras and each alone: the mean over tasks on both kinds of seeds, and their
    difference; and one sentence."""
    pairs = _pairs()
    lines = []
    lower = []
    for subset in THREE:
        before, now = (
            np.array([_rate(pair[side], subset) for pair in pairs]) for side in (0, 1)
        )  # (T,) each
        low, high = (100 * end for end in t_interval(now - before))
        points = f"{100 * np.mean(now - before):+.1f} [{low:+.1f}, {high:+.1f}]"
        label = LABELS.get(subset, "all cameras")
        lines.append((label, f"{before.mean():.3f}", f"{now.mean():.3f}", points))
        lower += [f"{label}, {points} points"] if high < 0 else []
    said = f"is lower with {'; '.join(lower)}" if lower else "is not shown to be lower"
    words = (
        f"Means over {len(pairs)} tasks, 100 episodes of each; Student's t intervals over tasks. "
        f"On scenes that nothing was chosen on, success {said}."
    )
    header = ("present", "development", "reporting", "difference, points")
    return f"{table(header, lines)}\n{words}\n"


def _pairs() -> list[tuple[Row, Row]]:
    """Returns the rows of each task's MAD on development and on reporting seeds, for those that
    were read."""
    names = [f"{task.replace('/', '-')}-mad-light" for task in TWENTY]
    known = [name for name in names if name in policies()]
    rows = [(on_development(name), row(name)) for name in known]
    return [(before, now) for before, now in rows if now.seeds == REPORTING]


def _rate(measured: Row, subset: str) -> float:
    rate = measured.rate(subset)
    assert rate is not None, "every included policy was measured from each camera"
    return rate.value

"""The texts below an explorer's picture: the state of the episode, and every subset of cameras."""

from __future__ import annotations

from html import escape

import numpy as np

from madviz.errors import parts_of
from madviz.session.camera_names import subset_label
from madviz.session.frame import Frame, words
from madviz.subsets import name_of
from madviz.types import Array

ROWS = 12
"""Rows of the table of subsets; with six streams there would be 64."""


def words_html(frame: Frame) -> str:
    """The state of the episode, and the effect of the last click."""
    world = frame.world
    if frame.ended:
        outcome = "success" if world.success else "failed"
    else:
        outcome = "goal met now" if world.success else "not yet"
    lines = [
        f"seed {world.seed}, decision {world.step} of {world.env.horizon}: <b>{outcome}</b>",
        escape(words(world.change, world.env)) if world.change else "",
        escape(parts_of(frame.pace.error)[0]),
    ]
    return "<br>".join(line for line in lines if line)


def table_html(frame: Frame) -> str:
    """The present subset, trained ones and others: action, its distance from the present one, Q."""
    probe = frame.world.probe
    streams = frame.world.policy.streams
    head = "".join(f"<th>{w}</th>" for w in ("cameras", "", "action", "apart", "Q"))
    rows = [
        _subset_row(frame, row, subset_label(frame, name_of(probe.masks[row], streams)))
        for row in shown_rows(frame)
    ]
    return f"<table><tr>{head}</tr>{''.join(rows)}</table>"


def shown_rows(frame: Frame) -> list[int]:
    """At most ROWS rows of the probe: the present subset, then the trained ones, then the rest."""
    here = frame.row
    trained = frame.trained_rows
    rows = range(len(frame.world.probe.masks))
    return sorted(rows, key=lambda row: (row != here, row not in trained, row))[:ROWS]


def _subset_row(frame: Frame, row: int, name: str) -> str:
    probe = frame.world.probe
    note = []
    if row == frame.row:
        note.append("now")
    if row not in frame.trained_rows:
        note.append("not trained on this subset")
    action: Array = probe.readout.action[row]
    if probe.waiting[row]:
        cells = ["not read", "", ""]
    elif not np.isfinite(action).all():
        cells = ["cannot act on this", "", ""]
    else:
        distance = float(np.linalg.norm(action - frame.action))
        numbers = (f"{distance:.2f}", f"{probe.readout.q[row]:.1f}")
        cells = [" ".join(f"{a:+.2f}" for a in action), *(n.replace("nan", "–") for n in numbers)]
    row_cells = "".join(f"<td>{escape(cell)}</td>" for cell in (name, ", ".join(note), *cells))
    return f"<tr>{row_cells}</tr>"

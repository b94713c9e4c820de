"""The Shapley value of every camera, in Q, in the action and in success, side by side.

Three games with the same players. Q and action are read from what every subset would do at this
very step; success is shared out from measured rates, so it waits until every set of cameras has
been measured, and then has an interval. Bars of one column share one scale.
"""

from __future__ import annotations

from functools import partial
from html import escape
from typing import NamedTuple

import numpy as np
import viser

from madviz.analysis.shapley import (
    ShapleyValues,
    action_shapley,
    q_shapley,
    set_names,
    success_interval,
    success_shapley,
)
from madviz.app.markup import band, dot, track
from madviz.app.success_rates import SuccessRates
from madviz.app.toolkit import HtmlPanel
from madviz.drawing.colours import FAINT, MUTED, NOTE, camera_colours
from madviz.observation.condition import Condition
from madviz.session.camera_names import subset_label
from madviz.session.frame import Frame
from madviz.subsets import camera_of, cameras_of, mask_of
from madviz.types import Array

IDEA = (
    "Several cameras show the same things, so dropping one says too little. Add them one after the "
    "other instead: <b>the Shapley value of a camera is what it adds</b>, on average over all "
    "orders. Together they add what is in the last row."
)
ARROWS = (
    "<b>Arrows at the gripper:</b> where it would go next with each subset. "
    f'<b style="color:{NOTE}">Yellow</b> is the present condition, <b>white</b> all cameras, a '
    "camera's own colour that camera alone; grey is any other subset, dashed is one it was "
    "not trained on. None at full speed."
)


class Column(NamedTuple):
    """One game, ready to be drawn."""

    title: str
    values: ShapleyValues | None
    digits: int
    total: str
    """The quantity that the cameras share."""
    words: str
    """The meaning of a number, or why there is none."""
    doubt: Array | None = None
    """(C,) half the width of the interval."""


class ShapleyPanel(HtmlPanel):
    """A table with a row per camera and a column per game; below it, what the numbers mean."""

    def __init__(self, gui: viser.GuiApi, frame: Frame, rates: SuccessRates) -> None:
        super().__init__(gui, frame, partial(shapley_html, rates=rates))


def shapley_html(frame: Frame, rates: SuccessRates) -> str:
    """A row per camera with a signed bar for each game, and what they share in the last row."""
    columns = [q_column(frame), action_column(frame)]
    simulated = frame.world.recorded is None
    columns += [success_column(frame, rates)] if simulated else []
    cameras = cameras_of(frame.world.policy.streams)
    heads = "".join(f'<td style="width:27%">{column.title}</td>' for column in columns)
    rows = "".join(_row(frame, camera, i, columns) for i, camera in enumerate(cameras))
    totals = "".join(f'<td class="num" style="text-align:center">{c.total}</td>' for c in columns)
    words = "".join(f"<div>{column.words}</div>" for column in columns)
    return (
        f'<div class="mv mv-shapley"><div>{IDEA}</div><table style="margin:5px 0">'
        f'<tr class="dim"><td></td>{heads}</tr>{rows}'
        f'<tr style="border-top:1px solid {FAINT}"><td class="dim">none → all present</td>{totals}'
        f'</tr></table>{words}<div style="margin-top:4px">{ARROWS if simulated else ""}</div></div>'
    )


def q_column(frame: Frame) -> Column:
    """Shares in the critic's forecast."""
    values = q_shapley(frame.world.probe, frame.world.policy.streams, frame.mask)
    words = (
        "<b>Q</b> is the policy's own forecast of the reward still to come; of sets it was "
        "not trained on, it may be far from the truth."
    )
    if not np.isfinite(frame.q):
        return Column("Q now", None, 1, "–", "<b>Q</b>: no forecast here, so nothing to share.")
    if not np.isfinite(values.cameras).all():
        return Column("Q now", None, 1, "–", f"<b>Q</b>: {_undefined(frame)}")
    return Column("Q now", values, 1, f"{values.empty:.1f} → {values.full:.1f}", words)


def action_column(frame: Frame) -> Column:
    """Shares in the way from the action without cameras to the present one."""
    values = action_shapley(frame.world.probe, frame.world.policy.streams, frame.mask)
    if not np.isfinite(values.cameras).all():
        return Column("action now", None, 2, "–", f"<b>Action</b>: {_undefined(frame)}")
    words = (
        "<b>Action</b>: how much nearer a camera brings the action to the one taken now; below 0, "
        "it pulls away from it."
    )
    total = f"{-values.empty:.2f} → 0.00 apart"
    return Column("action now", values, 2, total, words)


def success_column(frame: Frame, rates: SuccessRates) -> Column:
    """Shares in the success measured with each set of cameras, without occlusions."""
    streams = frame.world.policy.streams
    title = "success, measured"
    names = set_names(streams, frame.mask)
    found = {name: rates.best(frame.world.policy, Condition(name)) for name in dict.fromkeys(names)}
    means = {name: rate.value for name, rate in found.items()}
    values = success_shapley(means, streams, frame.mask)
    if values is None and _cannot(frame):
        return Column(title, None, 2, "–", f"<b>Success</b>: {_undefined(frame)}")
    if values is None:
        missing = [name for name in found if not found[name].n]
        return Column(title, None, 2, "–", _missing(frame, missing, rates.measures))
    bounded = {name: (rate.value, *rate.interval) for name, rate in found.items()}
    low, high = success_interval(bounded, streams, frame.mask)
    least = min(rate.n for rate in found.values())
    clean = " Measured with clean pictures." if frame.condition.key() else ""
    words = (
        "<b>Success</b>: the success rate that a camera adds, ± 95 % interval "
        f"({least} or more episodes for each set).{clean}"
    )
    total = f"{values.empty:.2f} → {values.full:.2f}"
    return Column(title, values, 2, total, words, (high - low) / 2)


def _undefined(frame: Frame) -> str:
    """Why a game cannot be played: which sets of cameras the policy cannot act on."""
    probe = frame.world.probe
    cannot = _cannot(frame)
    if not cannot and not probe.known.all():
        return "needs every subset: switch <b>Read every subset</b> on, under <b>What if?</b>."
    if not cannot:
        return "some of its numbers are broken (not finite), so there is nothing to share."
    said = ", ".join(escape(subset_label(frame, name)) for name in cannot[:3])
    more = f" and {len(cannot) - 3} more" if len(cannot) > 3 else ""
    return f"not defined. The idea needs every subset, and this policy cannot act on {said}{more}."


def _cannot(frame: Frame) -> list[str]:
    """The sets of the present cameras that the policy cannot act on."""
    streams = frame.world.policy.streams
    probe = frame.world.probe
    names = dict.fromkeys(set_names(streams, frame.mask))
    return [name for name in names if not probe.supported[probe.row(mask_of(name, streams))]]


def _missing(frame: Frame, names: list[str], measures: bool) -> str:
    said = "; ".join(escape(subset_label(frame, name)) for name in names[:4])
    more = f"; {len(names) - 4} more" if len(names) > 4 else ""
    how = " Switch the cameras so, with Measure on, and its episodes are played."
    return f"<b>Success</b>: not known yet. Not measured: {said}{more}.{how if measures else ''}"


def _row(frame: Frame, camera: str, index: int, columns: list[Column]) -> str:
    colour = camera_colours(frame.world.env.cameras)[camera]
    streams = [camera_of(stream) == camera for stream in frame.world.policy.streams]
    present = bool((frame.mask & np.array(streams)).any())
    label = escape(frame.world.env.camera(camera).label) + ("" if present else " · dropped")
    cells = "".join(f"<td>{_cell(column, index, colour)}</td>" for column in columns)
    style = "" if present else ' style="opacity:0.45"'
    return f"<tr{style}><td>{dot(colour)}{label}</td>{cells}</tr>"


def _cell(column: Column, index: int, colour: str) -> str:
    """A bar from the place of 0, to the right for what a camera adds; its number beside it."""
    if column.values is None:
        return '<div class="dim" style="text-align:center">–</div>'
    shares = column.values.cameras
    low = min(0.0, float(shares.min()))
    high = max(0.0, float(shares.max()))
    span = max(high - low, 1e-9)
    value = float(shares[index])
    number = round(value, column.digits) + 0.0  # No minus zero.
    zero = 100 * -low / span
    width = 100 * abs(value) / span
    left = zero if value >= 0 else zero - width
    bars = band(left, width, colour) + band(zero, 0, MUTED, "width:1px")
    doubt = ""
    if column.doubt is not None:
        doubt = f'<span class="dim" style="font-size:11px">±{column.doubt[index]:.2f}</span>'
    return (
        '<div style="display:flex;gap:5px;align-items:center">'
        f"{track(bars, 13)}"
        f'<span class="num" style="min-width:3.1em">{number:+.{column.digits}f}</span>{doubt}</div>'
    )

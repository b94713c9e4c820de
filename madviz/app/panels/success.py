"""Success rates with their intervals, the last live outcomes, and a line on what has changed."""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable
from html import escape

import numpy as np
import viser
from viser import uplot

from madviz.app.markup import band, dot, track
from madviz.app.panel import Assign
from madviz.app.panels.features import NO_POINTS, small_axes
from madviz.app.panels.subsets import is_trained, presence, subset_label
from madviz.app.rates import NOTHING, SuccessRates
from madviz.app.toolkit import WidgetPanel, on_value
from madviz.drawing.colours import BAD, FAINT, GOOD, MUTED, NOTE, camera_colours
from madviz.evaluation.statistics import SuccessRate
from madviz.session.frame import Condition, Frame, Outcome
from madviz.subsets import mask_of, name_of, single_streams
from madviz.types import PolicySpec

MEASURE_HINT = (
    "Worker processes play episodes under the present condition, for the bars. Their last frames "
    "count as here; switch this off to give the page the whole machine."
)
EDGE = "rgba(77, 182, 255, 0.5)"
"""The ends of the interval around the success curve."""
BELOW = -1.0
"""Where the success curve has what is not to be seen; its axis ends at 0."""
LABEL = 14
"""Letters that a row has room for; a longer label gives way to the subset's own name."""
HISTORY = 200
"""Points of the success curve."""


class SuccessPanel(WidgetPanel):
    """Bars (shipped above, measured here below), a curve that marks every change, a strip."""

    def __init__(
        self, gui: viser.GuiApi, frame: Frame, rates: SuccessRates, visitor: Hashable | None
    ) -> None:
        """``visitor`` has the present condition measured; None only watches."""
        self._rates, self._visitor = rates, visitor
        self._wanted: tuple[PolicySpec, Condition] | None = None
        self._known: tuple[Outcome, ...] = ()
        self._curve = Curve()
        self._bars = gui.add_html(bars_html(frame, rates))
        self._strip = gui.add_html(strip_html(frame))
        self._plot = gui.add_uplot(
            self._curve.data(),
            (
                uplot.Series(label="episode"),
                uplot.Series(label="low", stroke=EDGE, width=1, points=NO_POINTS),
                uplot.Series(label="high", stroke=EDGE, width=1, points=NO_POINTS),
                uplot.Series(label="success", stroke=GOOD, width=2, points=NO_POINTS),
                uplot.Series(label="change", stroke=NOTE, width=1, dash=(3, 3), points=NO_POINTS),
            ),
            scales={"x": uplot.Scale(time=False), "y": uplot.Scale(range=(0.0, 1.0))},
            axes=small_axes(30),
            legend=uplot.Legend(show=False),
            height=84,
            padding=(6, 10, 0, 0),
        )
        self.handles = [self._bars, self._strip, self._plot]
        self._switch: viser.GuiCheckboxHandle | None = None
        if visitor is not None and rates.measures:
            self._switch = gui.add_checkbox("Measure", True, hint=MEASURE_HINT)
            self.handles.append(self._switch)
            on_value(self._switch, lambda _, on: self._set_measuring(bool(on)))

    def update(self, frame: Frame) -> list[Assign]:
        if self._visitor is not None:
            self._keep(frame)
            self._want(frame)
        condition = frame.condition
        moved = self._curve.add(
            frame.world.policy, condition, self._rates.live(frame.world.policy, condition)
        )
        changes = [
            Assign(self._bars, "content", bars_html(frame, self._rates)),
            Assign(self._strip, "content", strip_html(frame)),
        ]
        if moved:
            changes.append(Assign(self._plot, "data", self._curve.data()))
        return changes

    def remove(self) -> None:
        self._rates.forget(self._visitor)
        super().remove()

    def _want(self, frame: Frame) -> None:
        """Has the condition of this moment measured, if it is not the one that already is."""
        wanted = (frame.world.policy, frame.condition)
        measuring = self._switch is not None and self._switch.value
        if measuring and wanted != self._wanted and frame.world.probe.supported[frame.row]:
            self._wanted = wanted
            self._rates.want(self._visitor, frame.world.policy, frame.mask, frame.world.ablation)

    def _set_measuring(self, on: bool) -> None:
        self._wanted = None
        if not on:
            self._rates.forget(self._visitor)

    def _keep(self, frame: Frame) -> None:
        """Episodes seen on this page that had one condition throughout are measurements, too."""
        fresh = [one for one in frame.world.outcomes if one not in self._known]
        self._known = frame.world.outcomes
        for outcome in fresh:
            if outcome.condition is not None and outcome.policy == frame.world.policy:
                self._rates.add(
                    frame.world.policy, outcome.condition, {outcome.seed: outcome.success}
                )


class Curve:
    """Success under the present condition, episode by episode; starts afresh at every change."""

    def __init__(self) -> None:
        self._points: deque[tuple[float, ...]] = deque(maxlen=HISTORY)
        self._key: tuple[PolicySpec, Condition] | None = None
        self._n, self._episodes = 0, 0

    def add(self, policy: PolicySpec, condition: Condition, rate: SuccessRate) -> bool:
        """Whether there is something new to draw."""
        key, before = (policy, condition), self._key
        if key != before:
            self._key, self._n = key, 0
            if before is not None:
                # A vertical line: up and down again at the same place. The chart knows no gaps, so
                # the others stay where they were, and the line waits below the visible range.
                x = self._episodes + 0.5
                held = self._points[-1][1:4] if self._points else rate_point(rate)
                self._points += [(x, *held, BELOW), (x, *held, 1.0), (x, *held, BELOW)]
        if rate.n == self._n:
            return key != before
        self._n, self._episodes = rate.n, self._episodes + 1
        self._points.append((self._episodes, *rate_point(rate), BELOW))
        return True

    def data(self) -> tuple[np.ndarray, ...]:
        """The columns: episode, low, high, success, change."""
        if not self._points:
            return (np.array([0.0, 10.0]), *(np.full(2, BELOW) for _ in range(4)))
        points = [*self._points] if len(self._points) > 1 else [*self._points] * 2
        return tuple(np.array(points).T)


def rate_point(rate: SuccessRate) -> tuple[float, float, float]:
    """Low, high and mean; out of sight where nothing was measured."""
    return (*rate.interval, rate.value) if rate.n else (BELOW, BELOW, BELOW)


def bar_rows(frame: Frame, rates: SuccessRates) -> list[Condition]:
    """The conditions that get a bar: all, the trained and the shipped ones, each stream alone, no
    camera; and the present one."""
    spec = frame.world.policy
    trained = [
        name_of(mask_of(subset, spec.streams), spec.streams) for subset in spec.trained_subsets
    ]
    singles = single_streams(spec.streams)
    names = ["all", *trained, *rates.shipped(spec), *singles, "none"]
    names.sort(key=lambda name: name == "none")
    rows = [Condition(name) for name in dict.fromkeys(names)]
    return rows if frame.condition in rows else [*rows, frame.condition]


def bars_html(frame: Frame, rates: SuccessRates) -> str:
    """One bar per condition: rate, interval and count, shipped above, measured here below."""
    spec = frame.world.policy
    rows = []
    conditions = bar_rows(frame, rates)
    for condition in conditions:
        shipped = rates.shipped(spec).get(condition.subset, NOTHING)
        shipped = NOTHING if condition.occlusions else shipped
        live = rates.live(spec, condition)
        rows.append(_bar_row(frame, condition, shipped, live, 20 if len(conditions) < 10 else 17))
    key = (
        f"{dot(MUTED, 'height:5px')}shipped{dot(GOOD, 'height:5px;margin-left:8px')}"
        f'here · † not trained on · <b style="color:{NOTE}">▸</b> now'
    )
    return (
        f'<div class="mv"><h4>Success at the last step</h4><div class="dim">{key}'
        f"</div>{''.join(rows)}{_trouble('not measured', rates.error(spec, frame.condition))}"
        f"{_trouble('not stored', rates.trouble)}</div>"
    )


def _bar_row(
    frame: Frame, condition: Condition, shipped: SuccessRate, live: SuccessRate, height: int
) -> str:
    mask = mask_of(condition.subset, frame.world.policy.streams)
    label = subset_label(frame, condition.subset)
    short = label if len(label) <= LABEL else condition.subset
    if condition.occlusions:
        words = " · " + ", ".join(p.split(",")[0] for p in condition.occlusions.split(";"))
        label, short = label + words, short + words
    dagger = "" if is_trained(frame, mask) else "† "
    joined = live if live.n >= shipped.n else shipped
    number = f"<b>{joined.value:.2f}</b> <span class=dim>n={joined.n}</span>" if joined.n else "–"
    here = condition == frame.condition
    now = f'<b style="color:{NOTE}">▸</b>' if here else ""
    title = escape(f"{label}: {_in_words(shipped, 'shipped')}; {_in_words(live, 'measured here')}")
    intervals = _interval(shipped, MUTED, 0) + _interval(live, GOOD, 6)
    return (
        f'<div title="{title}" class="rate{" now" if here else ""}" style="height:{height}px">'
        f"<span>{presence(frame, mask)}</span>"
        f'<span class="name">{now}{dagger}{escape(short)}</span>{track(intervals, 12)}'
        f'<span class="num" style="width:82px">{number}</span></div>'
    )


def _trouble(what: str, why: str) -> str:
    return f'<div style="color:{NOTE}">{what}: {escape(why)}</div>' if why else ""


def _in_words(rate: SuccessRate, source: str) -> str:
    if not rate.n:
        return f"nothing {source}"
    low, high = rate.interval
    return f"{source} {rate.value:.2f} [{low:.2f}, {high:.2f}], n={rate.n}"


def _interval(rate: SuccessRate, colour: str, top: int) -> str:
    """A band from low to high with a solid mark at the mean."""
    if not rate.n:
        return ""
    low, high = rate.interval
    place = f"top:{top}px;height:6px"
    return band(100 * low, 100 * (high - low), colour, f"{place};opacity:0.5") + band(
        97 * rate.value, 0, colour, f"{place};width:3px"
    )


def strip_html(frame: Frame) -> str:
    """The last live outcomes, newest on the right, with the cameras that were missing in each."""
    if not frame.world.outcomes:
        body = '<span class="dim">the first episode is still running</span>'
    else:
        body = "".join(_outcome(frame, outcome) for outcome in frame.world.outcomes)
    return (
        '<div class="mv"><h4>Last episodes <span class="plain">● dropped, ○ occluded</span></h4>'
        f'<div style="display:flex;gap:3px;min-height:38px">{body}</div>'
        "<h4>Success now, by episode</h4></div>"
    )


def _outcome(frame: Frame, outcome: Outcome) -> str:
    colours = camera_colours(frame.world.env.cameras)
    dots = ""
    for camera, wrong in outcome.cameras.items():
        fill = colours[camera] if wrong == "off" else "transparent"
        edge = colours[camera] if wrong else FAINT
        dots += f'<div style="background:{fill};border-color:{edge}"></div>'
    mark, colour = ("✔", GOOD) if outcome.success else ("✘", BAD)
    style = f"background:{colour};color:#15171a" if outcome.success else f"color:{colour}"
    failed = [f"{camera} {wrong}" for camera, wrong in outcome.cameras.items() if wrong]
    title = f"seed {outcome.seed}: {'success' if outcome.success else 'fail'}; " + (
        ", ".join(failed) or "all cameras worked"
    )
    return (
        f'<div title="{escape(title)}"><div class="outcome" style="border-color:{colour};{style}">'
        f'{mark}</div><div class="outcome-dots">{dots}</div></div>'
    )

"""Success rates with their intervals, the last live outcomes, and a line on what has changed."""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable, Sequence
from html import escape

import numpy as np
import viser
from viser import uplot

from madviz.agent.methods import label_of
from madviz.app.markup import band, dot, term, track
from madviz.app.panel import Assign
from madviz.app.panels.features import NO_POINTS, small_axes
from madviz.app.panels.subsets import presence
from madviz.app.success_rates import NOTHING, SuccessRates, side_b
from madviz.app.toolkit import WidgetPanel, on_use
from madviz.drawing.colours import BAD, FAINT, GOOD, MUTED, NOTE, camera_colours
from madviz.guard.policy import SUFFIX
from madviz.measure.statistics import SuccessRate, pair
from madviz.observation.condition import Condition
from madviz.policies.guarded import unguarded
from madviz.session.camera_names import subset_label
from madviz.session.ending import guard_words, needs_words
from madviz.session.frame import Frame, Outcome
from madviz.subsets import camera_of, cameras_of, mask_of, name_of, single_streams
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
    """Bars (measured above, counted here below), a curve that marks every change, a strip."""

    def __init__(
        self,
        gui: viser.GuiApi,
        frame: Frame,
        rates: SuccessRates,
        visitor: Hashable | None,
        measures: bool = True,
    ) -> None:
        """``visitor`` has the present condition measured, if the switch for it begins with
        ``measures``; None only watches."""
        self._frame = frame
        self._rates = rates
        self._visitor = visitor
        self._wanted: dict[Hashable, tuple[PolicySpec, Condition]] = {}
        """By side: what is measured for it."""
        self._known: dict[Hashable, tuple[Outcome, ...]] = {}
        self._specs: dict[tuple[str, bool], PolicySpec] = {}
        """The policies that acted here, by what they were loaded from, without a guard and with
        one."""
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
            height=64,
            padding=(6, 10, 0, 0),
        )
        self.handles = [self._bars, self._strip, self._plot]
        self._switch: viser.GuiCheckboxHandle | None = None
        if visitor is not None and rates.measures:
            self._switch = gui.add_checkbox("Measure", measures, hint=MEASURE_HINT)
            self.handles.append(self._switch)
            on_use(self._switch, lambda _, on: self._set_measuring(bool(on)))

    @property
    def measures(self) -> bool:
        """Whether the visitor has left the switch on."""
        return self._switch is None or bool(self._switch.value)

    def update(self, frame: Frame) -> list[Assign]:
        self._frame = frame
        if self._visitor is not None:
            self._keep(frame)
            self._want(frame)
        paired = frame.second is not None
        condition = frame.condition
        moved = self._curve.add(
            frame.world.policy, condition, self._rates.live(frame.world.policy, condition)
        )
        changes = [
            Assign(self._bars, "content", bars_html(frame, self._rates, self._guards(frame))),
            Assign(self._strip, "content", strip_html(frame)),
            Assign(self._plot, "visible", not paired),
        ]
        if moved:
            changes.append(Assign(self._plot, "data", self._curve.data()))
        return changes

    def remove(self) -> None:
        self._forget()
        super().remove()

    def _sides(self, frame: Frame) -> list[tuple[Hashable, Frame]]:
        """The keys under which A and, where there is one, B are measured; and their frames."""
        first = (self._visitor, frame)
        return [first] if frame.second is None else [first, (side_b(self._visitor), frame.second)]

    def _guards(self, frame: Frame) -> list[str]:
        """For each side whose cameras fail, the sentence on what a guard changes, as far as it was
        measured here with one and without."""
        sentences = []
        for _, side in self._sides(frame):
            spec = side.world.policy
            loaded = unguarded(side.world.reference)
            self._specs[loaded, spec.name.endswith(SUFFIX)] = spec
            both = [self._specs.get((loaded, guarded)) for guarded in (True, False)]
            known = [self._rates.outcomes(one, side.condition) if one else {} for one in both]
            words = guard_words(pair(*known)) if side.condition.key() else ""
            label = f"{label_of(spec)}: " if frame.second is not None and words else ""
            sentences.append(label + words)
        return sentences

    def _want(self, frame: Frame) -> None:
        """Has the conditions of this moment measured, if they are not those that already are."""
        if self._switch is None or not self.measures:
            return
        sides = self._sides(frame)
        for gone in self._wanted.keys() - {who for who, _ in sides}:
            self._rates.forget(gone)
            del self._wanted[gone]
        for who, side in sides:
            wanted = (side.world.policy, side.condition)
            if wanted != self._wanted.get(who) and side.world.probe.supported[side.row]:
                self._wanted[who] = wanted
                self._rates.want(who, *wanted)

    def _set_measuring(self, on: bool) -> None:
        if on:
            self._want(self._frame)  # No other frame may come while an episode is paused.
        else:
            self._forget()

    def _forget(self) -> None:
        self._rates.forget(self._visitor)
        self._wanted.clear()

    def _keep(self, frame: Frame) -> None:
        """Episodes seen on this page that had one condition throughout are measurements, too."""
        for who, side in self._sides(frame):
            known = self._known.get(who, ())
            fresh = [one for one in side.world.outcomes if one not in known]
            self._known[who] = side.world.outcomes
            for one in fresh:
                if one.condition is not None and one.policy == side.world.policy:
                    self._rates.add(one.policy, one.condition, {one.seed: one.success})


class Curve:
    """Success under the present condition, episode by episode; starts afresh at every change."""

    def __init__(self) -> None:
        self._points: deque[tuple[float, ...]] = deque(maxlen=HISTORY)
        self._key: tuple[PolicySpec, Condition] | None = None
        self._n = 0
        self._episodes = 0

    def add(self, policy: PolicySpec, condition: Condition, rate: SuccessRate) -> bool:
        """Whether there is something new to draw."""
        key = (policy, condition)
        before = self._key
        if key != before:
            self._key = key
            self._n = 0
            if before is not None:
                # A vertical line: up and down again at the same place. The chart knows no gaps, so
                # the others stay where they were, and the line waits below the visible range.
                x = self._episodes + 0.5
                held = self._points[-1][1:4] if self._points else rate_point(rate)
                self._points += [(x, *held, BELOW), (x, *held, 1.0), (x, *held, BELOW)]
        if rate.n == self._n:
            return key != before
        self._n = rate.n
        self._episodes = self._episodes + 1
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


def bars_html(frame: Frame, rates: SuccessRates, guards: Sequence[str] = ()) -> str:
    """One bar per condition: rate, interval and n, measured above, counted here below. Where
    there is a B, its bar stands under A's. ``guards``: sentences on what a guard changes."""
    sides = [frame] if frame.second is None else [frame, frame.second]
    own = [bar_rows(side, rates) for side in sides]
    # Where the two have other streams, a row of one may have no meaning for the other.
    alike = len({side.world.policy.streams for side in sides}) == 1
    apart = len({side.world.guard is None for side in sides}) == 2
    conditions = list(dict.fromkeys(row for rows in own for row in rows))
    conditions.sort(key=lambda row: row.subset == "none")
    height = 15 if len(sides) == 2 else 20 if len(conditions) < 9 else 17
    rows = [
        _bar_row(side, condition, rates, "" if len(sides) == 1 else "AB"[index], height, apart)
        for condition in conditions
        for index, side in enumerate(sides)
        if condition in own[index] or alike
    ]
    key = (
        f"{dot(MUTED, 'height:5px')}{term('measured')}"
        f"{dot(GOOD, 'height:5px;margin-left:8px')}{term('counted here')} · † "
        f'{term("not trained on")} · <b style="color:{NOTE}">▸</b> now'
    )
    troubles = {rates.error(side.world.policy, side.condition): None for side in sides}
    sentences = [*(needs_of(side, rates) for side in sides), *guards]
    shown = "".join(f"<div>{escape(each)}</div>" for each in sentences)
    return (
        f'<div class="mv"><h4>{term("success", "Success")} at the last step</h4>{shown}'
        f'<div class="dim">{key}</div>'
        f"{''.join(rows)}{''.join(_trouble('not measured', one) for one in troubles)}"
        f"{_trouble('not stored', rates.trouble)}</div>"
    )


def needs_of(frame: Frame, rates: SuccessRates) -> str:
    """The sentence on the cameras that the policy of ``frame`` needs; '' where that is open."""
    spec = frame.world.policy
    without = {}
    for name in cameras_of(spec.streams):
        others = np.array([camera_of(stream) != name for stream in spec.streams])  # (V,) bool
        subset = Condition(name_of(others, spec.streams))
        without[frame.world.env.camera(name).label] = rates.best(spec, subset)
    return needs_words(label_of(spec), rates.best(spec, Condition("all")), without)


def _bar_row(
    frame: Frame, condition: Condition, rates: SuccessRates, side: str, height: int, apart: bool
) -> str:
    """``side``: A or B, of which B leaves out what A's row above it says; '' where there is one.
    ``apart``: only one of the two has a guard."""
    spec = frame.world.policy
    known = {} if condition.key() else rates.shipped(spec)
    shipped = known.get(condition.subset, NOTHING)
    live = rates.live(spec, condition)
    mask = mask_of(condition.subset, frame.world.policy.streams)
    label = subset_label(frame, condition.subset)
    short = label if len(label) <= LABEL else subset_label(frame, condition.subset, short=True)
    if condition.key():
        words = " · " + ", ".join(p.split(",")[0] for p in condition.key().split(";"))
        label = label + words
        short = short + words
    guarded = frame.world.guard is not None and (live.n or condition == frame.condition)
    if guarded:
        label = f"with guard · {label}"
        short = f"with guard · {short}"
    dagger = "" if frame.world.probe.row(mask) in frame.trained_rows else "† "
    joined = rates.best(spec, condition)
    number = f"<b>{joined.value:.2f}</b> <span class=dim>n={joined.n}</span>" if joined.n else "–"
    here = condition == frame.condition
    now = f'<b style="color:{NOTE}">▸</b>' if here else ""
    title = escape(f"{label}: {_in_words(shipped, 'measured')}; {_in_words(live, 'counted here')}")
    intervals = _interval(shipped, MUTED, 0) + _interval(live, GOOD, 6)
    of_b = ("with guard" if guarded else "no guard") if apart else ""
    named = f"{now}{dagger}{escape(short)}" if side != "B" else of_b
    squares = f"<span{' class=hidden' if side == 'B' else ''}>{presence(frame, mask)}</span>"
    return (
        f'<div title="{title}" class="rate{" now" if here else ""}" style="height:{height}px">'
        f'{squares}<span class="name">{named}</span>{side and f"<b>{side}</b>"}'
        f"{track(intervals, 12)}"
        f'<span class="num" style="width:82px">{number}</span></div>'
    )


def _trouble(what: str, why: str) -> str:
    return f'<div style="color:{NOTE}">{what}: {escape(why)}</div>' if why else ""


def _in_words(rate: SuccessRate, source: str) -> str:
    if not rate.n:
        return f"nothing {source}"
    return f"{source} {rate.without_count}, n={rate.n}"


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
    """The last live outcomes of the policy, with a guard or without, newest on the right, with the
    cameras that were missing in each; of both sides where there is a B."""
    sides = [frame] if frame.second is None else [frame, frame.second]
    rows = []
    for index, side in enumerate(sides):
        name = side.world.policy.name.removesuffix(SUFFIX)
        ours = (one for one in side.world.outcomes if one.policy.name.removesuffix(SUFFIX) == name)
        body = "".join(_outcome(side, outcome) for outcome in ours)
        body = body or '<span class="dim">the first episode is still running</span>'
        letter = f"<b>{'AB'[index]}</b>" if len(sides) == 2 else ""
        rows.append(f'<div class="mv-outcomes">{letter}{body}</div>')
    curve = "" if len(sides) == 2 else "<h4>Success now, by episode</h4>"
    key = '<span class="plain">● dropped, ○ occluded, moved</span>'
    return f'<div class="mv"><h4>Last episodes {key}</h4>{"".join(rows)}{curve}</div>'


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

"""Does the policy use its cameras? An audit, started here and filled as episodes finish."""

from __future__ import annotations

from html import escape

import viser

from madviz.app.live_audit import AuditStatus, LiveAudit
from madviz.app.markup import dot, progress_bar
from madviz.app.panel import Assign, Newest
from madviz.app.toolkit import Cell, HtmlPanel, on_use, place
from madviz.drawing.colours import GOOD, NOTE, camera_colours
from madviz.measure.audit.lost_cameras import HOWS, INTACT, AuditRow
from madviz.measure.audit.sentences import in_words, plan_words
from madviz.measure.audit.verdict import VERDICTS
from madviz.observation.condition import Condition
from madviz.session.frame import Frame

EPISODES = ("20", "50", "100")
"""Episodes of each condition; as many as workers play at most."""
IDEA = (
    "<b>Does this policy use its cameras?</b> Workers play the same scenes with each camera "
    "removed, with each one alone, and with none; what they find is filled in here."
)
WORDS = {
    "running": "Measuring.",
    "stopped": "Stopped. Start goes on where it was.",
    "failed": "It failed:",
    "done": "Done.",
}
HINTS = {
    "episodes": "Of each condition, at most: it stops early when all is decided.",
    "start": "Audits the policy that acts now. The page's other measurements take turns with it.",
    "stop": "What was measured stays.",
}


class AuditPanel(HtmlPanel):
    """Controls, progress and a table. ``newest`` is what the page shows; None: read-only."""

    unsettled = True
    """An audit goes on while the episode stands still."""

    def __init__(
        self, gui: viser.GuiApi, newest: Newest | None, frame: Frame, audit: LiveAudit
    ) -> None:
        self._audit = audit
        self._newest = newest
        self._shown: AuditStatus | None = None
        if newest is not None and audit.measures:
            episodes = gui.add_dropdown(
                "Episodes", EPISODES, initial_value="50", hint=HINTS["episodes"]
            )
            start = gui.add_button("start audit", hint=HINTS["start"])
            stop = gui.add_button("stop audit", hint=HINTS["stop"])
            on_use(start, lambda *_: self._start(episodes.value))
            on_use(stop, lambda *_: audit.stop())
            cells = [Cell(episodes, 1, 4, "5em"), Cell(start, 5, 4), Cell(stop, 9, 4)]
            self.handles = place(gui, "audit", 12, cells)
        super().__init__(
            gui, frame, lambda frame: audit_html(frame, audit.status(), audit.measures)
        )

    def _start(self, episodes: str) -> None:
        frame = self._newest() if self._newest else None
        if isinstance(frame, Frame) and episodes in EPISODES:  # viser does not look.
            self._audit.start(frame, int(episodes))

    def update(self, frame: Frame) -> list[Assign]:
        status = self._audit.status()
        if status is self._shown:
            return []
        self._shown = status
        return super().update(frame)


def audit_html(frame: Frame, status: AuditStatus, measures: bool = True) -> str:
    """The question, the progress, the verdicts and the rates so far."""
    lines = [f"<div>{IDEA}</div>"]
    if not measures:
        lines.append(
            f'<div style="color:{NOTE}">No episodes are played here: --workers is 0.</div>'
        )
    if status.plan is not None and status.policy is not None:
        lines += [_state(status), _sentences(status), _table(frame, status)]
    return f'<div class="mv mv-audit" data-state="{status.state}">{"".join(lines)}</div>'


def _state(status: AuditStatus) -> str:
    assert status.plan is not None and status.policy is not None
    played = status.found["intact"]["n"] if status.found else None
    plan = plan_words(status.plan.episodes, status.plan.detectable, played)
    bar = progress_bar(status.share, GOOD) if status.state in ("running", "stopped") else ""
    return (
        f"<div><b>{escape(status.policy.name)}</b>: {WORDS.get(status.state, '')} "
        f'<span style="color:{NOTE}">{escape(status.why)}</span>'
        f'<span class="dim num">{100 * status.share:.0f} %</span>{bar}</div>'
        f'<div class="dim">{plan}</div>'
    )


def _sentences(status: AuditStatus) -> str:
    if status.found is None:
        return ""
    items = "".join(f"<li>{escape(line)}</li>" for line in in_words(status.found))
    return f'<ul style="margin:4px 0;padding-left:18px">{items}</ul>'


def _table(frame: Frame, status: AuditStatus) -> str:
    """A row for each camera removed and alone and for none, a column for each way."""
    assert status.plan is not None
    cameras = status.plan.cameras
    colours = camera_colours(frame.world.env.cameras)
    rows: dict[tuple[str | None, str], dict[str, AuditRow]] = {}
    for row in cameras.rows():
        rows.setdefault((row.camera, row.what), {})[row.how] = row
    order = [(name, what) for name in cameras.names for what in ("removed", "alone")]
    verdicts = _verdicts(status)
    lines = []
    for camera, what in [*order, (None, "none")]:
        by_how = rows.get((camera, what), {})
        rates = [_cell(status, by_how.get(how)) for how in HOWS]
        cells = "".join(f'<td class="num" style="text-align:center">{rate}</td>' for rate in rates)
        label = status.labels.get(camera or "", camera or "no camera")
        mark = dot(colours.get(camera, "transparent")) if camera else ""
        verdict = verdicts.get(camera or "", "") if what == "removed" else ""
        name = f"{mark}{escape(label)}" + (f" {what}" if camera else "")
        lines.append(f"<tr><td>{name}</td>{cells}<td><b>{verdict}</b></td></tr>")
    intact = _rate(status, INTACT)
    heads = "".join(f'<td style="text-align:center">{how}</td>' for how in HOWS)
    return (
        f'<table style="margin-top:4px;width:100%"><tr class="dim"><td>all cameras: '
        f"<b>{intact}</b></td>{heads}<td>verdict</td></tr>{''.join(lines)}</table>"
    )


def _verdicts(status: AuditStatus) -> dict[str, str]:
    """By camera; with a mark while more episodes are to come."""
    assert status.plan is not None
    if status.found is not None:
        return status.found["verdict"]
    now = status.plan.reached(status.outcomes)
    if now is None:
        return {}
    names = status.plan.cameras.names
    return {
        name: f"{VERDICTS[int(code)]} so far"
        for name, code in zip(names, now[1].verdict, strict=True)
    }


def _cell(status: AuditStatus, row: AuditRow | None) -> str:
    return "–" if row is None else _rate(status, row.condition)


def _rate(status: AuditStatus, condition: Condition) -> str:
    """Success on the seeds of the audit so far, and their number."""
    assert status.plan is not None
    seeds = status.plan.seeds(status.plan.episodes)
    seen = [ok for seed, ok in status.outcomes.get(condition, {}).items() if seed in seeds]
    if not seen:
        return '<span class="dim">·</span>'
    return f'{sum(seen) / len(seen):.2f} <span class="dim">{len(seen)}</span>'

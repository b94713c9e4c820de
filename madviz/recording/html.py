"""A report of an episode: one HTML file that needs nothing else, and loads nothing.

Pictures are JPEG files inside it, curves are SVG; it can be mailed, and opened without a network. A
content security policy in its head says so to the browser: no scripts, nothing from elsewhere.
"""

from __future__ import annotations

from html import escape
from pathlib import Path

import numpy as np

from madviz.drawing.colours import MERGED_ON_WHITE, colours_on_white
from madviz.drawing.jpeg import jpeg_url
from madviz.drawing.mosaic import mosaic
from madviz.measure.blocks import whole_page
from madviz.plots.figures import curves
from madviz.recording.facts import Facts, condition_words
from madviz.session.camera_names import stream_label
from madviz.session.frame import Frame
from madviz.subsets import camera_of
from madviz.system.files import write_bytes
from madviz.types import Array

PICTURES = 10
"""In the strip, besides those of steps at which the cameras changed."""
MOST_MARKED = 14
TILE = 168

_STYLE = """
body{font:15px/1.5 sans-serif;max-width:980px;margin:24px auto;padding:0 16px;color:#222;
background:#fff}h1{font-size:22px;margin:0 0 4px}h2{font-size:16px;margin:24px 0 6px}
table{border-collapse:collapse}td,th{padding:2px 14px 2px 0;text-align:left;vertical-align:top}
th{font-weight:600;color:#555;white-space:nowrap}code{background:#f1f1f1;padding:2px 5px;
overflow-wrap:anywhere}figure{margin:0 0 10px}figcaption{font-size:13px;color:#555}
.strip{display:grid;grid-template-columns:repeat(auto-fill,minmax(440px,1fr));gap:8px 14px}
.strip img{width:100%;display:block}.outcome{font-weight:700;padding:1px 10px;border-radius:3px;
color:#fff}.good{background:#0b6e99}.bad{background:#b4540a}.open{background:#666}
.marked figcaption{color:#8a6400;font-weight:600}
svg{max-width:100%;height:auto;display:block;margin-bottom:8px}
"""


class HtmlWriter:
    """See the module. Keeps of every step its numbers, and of all pictures the few it shows."""

    def __init__(self, path: Path, facts: Facts) -> None:
        self._path = path
        self._facts = facts
        self._last: Frame | None = None
        self._marks: dict[int, str] = {}
        self._pictures: dict[int, str] = {}
        self._numbers: dict[str, list[Array]] = {}

    def add(self, frame: Frame) -> None:
        world = frame.world
        if self._last is not None and _changed(self._last, frame):
            self._marks[world.step] = _change(self._last, frame)
        every = max(world.env.horizon // PICTURES, 1)
        marked = world.step in self._marks and len(self._marks) <= MOST_MARKED
        if marked or world.step % every == 0 or frame.ended:
            self._pictures[world.step] = jpeg_url(mosaic(frame, TILE))
        probe = world.probe
        row = frame.row
        self._note("norms", probe.norms)
        self._note("merged", np.array([probe.merged_norm(row)]))
        self._note("cosines", probe.cosines(row))
        self._note("action", frame.action)
        self._note("q", np.array([frame.q]))
        self._note("reward", np.array([world.reward]))
        self._last = frame

    def close(self) -> None:
        if self._last is not None:
            write_bytes(self._path, self._html(self._last).encode())

    def _note(self, name: str, numbers: Array) -> None:
        self._numbers.setdefault(name, []).append(np.asarray(numbers, float))

    def _html(self, last: Frame) -> str:
        title = f"{self._facts.policies or last.world.policy.name}, seed {last.world.seed}"
        body = [
            f"<h1>{escape(title)}</h1>",
            _outcome(last),
            f"<h2>What this is</h2>{_facts(last, self._facts)}",
            f"<h2>What the policy saw</h2>{self._strip()}",
            f"<h2>What it made of it</h2>{self._curves(last)}",
            f"<h2>To make it again</h2><p><code>{escape(self._facts.command)}</code></p>",
        ]
        return whole_page(title, _STYLE, "".join(body))

    def _strip(self) -> str:
        figures = []
        for step, picture in self._pictures.items():
            words = f"step {step}"
            if step in self._marks:
                words += f": {self._marks[step]}"
            style = ' class="marked"' if step in self._marks else ""
            figures.append(
                f'<figure{style}><img alt="all cameras at step {step}" '
                f'src="{picture}"><figcaption>{escape(words)}</figcaption>'
                "</figure>"
            )
        return f'<div class="strip">{"".join(figures)}</div>'

    def _curves(self, last: Frame) -> str:
        streams = last.world.policy.streams
        own = colours_on_white(last.world.env.cameras)
        labels = [stream_label(last, stream) for stream in streams]
        pairs = zip(labels, streams, strict=True)
        colours = {label: own[camera_of(stream)] for label, stream in pairs}
        colours |= {"merged": MERGED_ON_WHITE, "Q": "#0b6e99", "reward": "#5c8a3a"}
        hands = [f"a{index}" for index in range(last.world.env.action_dim)]
        colours |= {
            hand: ("#0b6e99", "#d9730d", "#5c8a3a", "#ad1a72", "#777")[i % 5]
            for i, hand in enumerate(hands)
        }
        end = last.world.step
        panels = [
            ("Q of the next action", self._series("q", ["Q"])),
            (
                "Norms of the features",
                self._series("norms", labels) | self._series("merged", ["merged"]),
            ),
            ("Cosine to the merged feature", self._series("cosines", labels)),
            ("Action", self._series("action", hands)),
            ("Reward", self._series("reward", ["reward"])),
        ]
        what = "cameras or policy" if self._facts.policies else "the cameras"
        note = f"<p>Dashed lines: {what} changed there.</p>" if self._marks else ""
        return note + "".join(curves(t, s, colours, self._marks, end) for t, s in panels)

    def _series(self, name: str, names: list[str]) -> dict[str, list[float]]:
        """Columns of what was noted; a policy that was swapped in may have other streams, and where
        their number differs there is a gap."""
        rows = self._numbers[name]
        return {
            label: [float(row[i]) if len(row) == len(names) else np.nan for row in rows]
            for i, label in enumerate(names)
        }


def _changed(before: Frame, now: Frame) -> bool:
    return (before.condition, before.world.policy.name) != (now.condition, now.world.policy.name)


def _change(before: Frame, now: Frame) -> str:
    """The change in words."""
    if before.world.policy.name != now.world.policy.name:
        return f"the policy becomes {now.world.policy.name}"
    return f"cameras become {condition_words(now)}"


def _outcome(last: Frame) -> str:
    word = ("SUCCESS" if last.world.success else "FAIL") if last.ended else "UNFINISHED"
    style = {"SUCCESS": "good", "FAIL": "bad"}.get(word, "open")
    ever = (
        "" if last.world.success else ", though it was met before" if last.world.success_any else ""
    )
    met = "met" if last.world.success else "not met"
    return (
        f'<p><span class="outcome {style}">{word}</span> '
        f"after {last.world.step} of {last.world.env.horizon} decisions: the goal is {met}{ever}. "
        f"Sum of rewards {last.world.total_reward:.2f}.</p>"
    )


def _facts(last: Frame, facts: Facts) -> str:
    spec = last.world.policy
    rows = {
        "policies": facts.policies,
        "policy": f"{spec.name} (method {spec.method}, setting {spec.setting}, recipe "
        f"{spec.recipe})",
        "digest": spec.digest or "none",
        "trained to work from": ", ".join(spec.trained_subsets) or "none of these",
        "task": f"{last.world.env.task}: {last.world.env.success}",
        "seed": str(last.world.seed),
        "cameras": ", ".join(camera.label for camera in last.world.env.cameras),
        "failures": ", ".join(facts.failures) or "none",
        "drawn with": f"the {spec.render_profile} render profile",
    }
    cells = (f"<tr><th>{escape(k)}</th><td>{escape(v)}</td></tr>" for k, v in rows.items() if v)
    return f"<table>{''.join(cells)}</table>"

"""Pieces of HTML that several panels are made of; ``browser/page.css`` has their styles."""

from __future__ import annotations

from html import escape

from madviz.errors import parts_of
from madviz.vocabulary.words import MEANINGS


def dot(colour: str, style: str = "") -> str:
    """A small square in a camera's colour."""
    return f'<span class="dot" style="background:{colour};{style}"></span>'


def term(word: str, label: str = "") -> str:
    """A word of the vocabulary, or ``label`` for it: its sentence is shown while the pointer rests
    on it, and while it has the focus."""
    says = escape(MEANINGS[word])
    shown = escape(label or word)
    return (
        f'<span class="term" tabindex="0" aria-description="{says}" data-says="{says}">{shown}'
        "</span>"
    )


def progress_bar(share: float, colour: str) -> str:
    """How much of something is done: ``share`` in [0, 1]."""
    return (
        f'<div class="progress"><div style="width:{100 * share:.0f}%;background:{colour}"></div>'
        "</div>"
    )


def track(content: str, height: int) -> str:
    """A strip of some pixels' height, on which ``band`` places what it shows."""
    return f'<div class="track" style="height:{height}px">{content}</div>'


def band(left: float, width: float, colour: str, style: str = "") -> str:
    """A part of a track: where it begins and how wide it is, in percent."""
    place = f"left:{left:.1f}%;width:{width:.1f}%;background:{colour};{style}"
    return f'<div class="band" style="{place}"></div>'


def error_html(before: str, error: str, after: str = "") -> str:
    """The message of an error, for a visitor; under it, closed, where in the code it was raised,
    for the author of the policy. ``error`` is a message, a traceback, or both in this order."""
    said, trace = parts_of(error)
    html = f"<b>{escape(before)}{escape(said)}</b><div>{escape(after)}</div>"
    if trace:
        shown = escape(trace.rstrip())
        html += f"<details><summary>Where in the code</summary><pre>{shown}</pre></details>"
    return html

"""Pieces of HTML that several panels are made of; ``browser/page.css`` has their styles."""

from __future__ import annotations


def dot(colour: str, style: str = "") -> str:
    """A small square in a camera's colour."""
    return f'<span class="dot" style="background:{colour};{style}"></span>'


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

"""Lesson 0: what the static site shows, and a link to it. The site's own page asks the same
(``madviz/site/web/lesson_checks.js``), for those who have nothing but a browser."""

from __future__ import annotations

import re
from typing import Any
from urllib.parse import parse_qsl

from madviz.teaching.checks.exercise import exercise, expect, number
from madviz.teaching.counted import shipped

MAD = "metaworld-hammer-mad-light"
MERGED_ONLY = "metaworld-hammer-merged-only-light"
WITHOUT_FIRST = "third_a+third_b"
ALONE = "first"
NO_EVENTS = ("policy", "vs", "seed", "guard")
"""Parts of a link that do nothing to a camera."""
BLACK = r"(?:(?:on|both|rgb):)?black(?::(?:0?\.\d{1,6}|[01](?:\.0{0,6})?))?"
"""A switch, the failure, its strength; the first and the last may be left out."""


@exercise(
    "00.rates",
    "set mad and merged_only to their success without First person",
    "Which two cameras are left when First person is off?",
    "In the table Success, look for the row that names these two, in the column measured.",
    "Both sides have such a table. A rate is a number from 0 to 1, with two digits.",
)
def rates(mad: Any, merged_only: Any) -> None:
    found = [number(mad, "a rate"), number(merged_only, "a rate")]
    expect(all(0 <= one <= 1 for one in found), "expected two numbers from 0 to 1")
    right = _rates(WITHOUT_FIRST)
    expect(not _near(found, right[::-1]), "the two have changed places")
    words = "these are the rates with First person alone, not without it"
    expect(not _near(found, _rates(ALONE)), words)
    expect(_near(found, right), "these are not the rates without First person")


def _rates(subset: str) -> list[float]:
    counted = [shipped(name)[subset] for name in (MAD, MERGED_ONLY)]
    return [successes / n for successes, n in counted]


def _near(found: list[float], right: list[float]) -> bool:
    return all(abs(one - other) < 0.005 for one, other in zip(found, right, strict=True))


@exercise(
    "00.link",
    "set link to one that shows Merged Only with Third A black from step 20 on",
    "Which part of the address names the policy, and which one a camera?",
    "A camera is written as camera=what@step, and parts are joined with &.",
    "The name of the camera is third_a, and what it does is one of off, black, noise, freeze.",
)
def link(link: Any) -> None:
    expect(isinstance(link, str), f"expected a link in quotes, found {link!r:.60}")
    parts = parse_qsl(link.strip().partition("#")[2] or link.strip(), keep_blank_values=True)
    policies = [value for key, value in parts if key == "policy"]
    expect(policies[-1:] == [MERGED_ONLY], "the policy of this link is not Merged Only")
    events = [(key, value) for key, value in parts if key not in NO_EVENTS]
    expect(events, "no camera is switched in this link")
    expect(len(events) == 1, "more than one thing happens in this link")
    ((camera, deed),) = events
    expect(not camera.startswith("b."), "this happens on side B, which is another policy")
    expect(camera.removeprefix("a.") == "third_a", "this is another camera than Third A")
    what, _, step = deed.partition("@")
    expect("off" not in what.split(":"), "off leaves the sum; black stays in it")
    expect(re.fullmatch(BLACK, what), "Third A sends something else than black")
    expect(step.isdecimal() and int(step) == 20, f"Third A turns black at step {step or 0}")
    seeds = [value for key, value in parts if key == "seed"]
    expect(all(seed.isdecimal() for seed in seeds), "the seed of this link is no number")

"""Pictures in files: what they show, and that they are the same every time."""

from __future__ import annotations

import re
import subprocess
import sys
import xml.etree.ElementTree as xml

import pytest

from madviz.plots import Bar, Line, bars, curves, lines

NAN = float("nan")


def corners(drawn: str, kind: str) -> list[list[tuple[float, float]]]:
    """The points of every path of a kind, in the picture's own units."""
    paths = re.findall(rf'<g class="{kind}">\s*<path d="([^"]*)"', drawn)
    return [
        [(float(x), float(y)) for x, y in re.findall(r"[ML] (\S+) (\S+)", path)] for path in paths
    ]


def height(points: list[tuple[float, float]]) -> float:
    return max(y for _, y in points) - min(y for _, y in points)


def test_bars_are_as_high_as_their_rates_and_words_are_escaped() -> None:
    series = {"mad": [Bar(0.5, 0.25, 1.0, (0.4,))], "$x$": [Bar(1.0, 0.9, 1.0)], "none": [None]}
    drawn = bars("a < b", ["all"], series)
    xml.fromstring(drawn)
    assert "a &lt; b" in drawn and ">$x$<" in drawn and drawn.count('class="dot"') == 1
    half, whole = corners(drawn, "bar")
    assert height(half) == pytest.approx(height(whole) / 2, abs=1e-3)


def test_lines_lie_in_their_bands() -> None:
    line = Line([0, 10], [0.0, 1.0], [0.0, 0.8], [0.2, 1.0])
    drawn = lines("t", "steps", {"all": {"mad": line}, "first": {}})
    xml.fromstring(drawn)
    assert all(f">{words}<" in drawn for words in ("all", "first", "mad", "steps", "10"))
    (curve,) = corners(drawn, "line")
    assert curve[0][0] < curve[1][0] and curve[0][1] > curve[1][1], "it rises to the right"
    assert drawn.count('class="band"') == 1


def test_curves_have_gaps_where_there_is_no_number() -> None:
    drawn = curves("Q", {"Q": [1.0, 2.0, NAN, 3.0, 4.0]}, {"Q": "#000000"}, {2: "<lost>"}, 4)
    assert re.findall(r'class="line">\s*<path d="([^"]*)"', drawn)[0].count("M") == 2
    assert "<title>step 2: &lt;lost&gt;</title>" in drawn and "nan" not in drawn
    assert not corners(curves("Q", {"Q": [NAN]}, {"Q": "#000000"}, {}, 0), "line")


def test_the_same_numbers_are_the_same_bytes_in_another_process() -> None:
    program = (
        "from madviz.plots import Bar, bars;"
        "print(bars('t', ['all', 'first'], {'mad': [Bar(0.5, 0.2, 0.8, (0.4,)), None]}), end='')"
    )
    one, other = (subprocess.check_output([sys.executable, "-c", program]) for _ in range(2))
    assert one == other and b"<metadata" not in one and b"<!--" not in one


def test_a_picture_refers_to_nothing_outside() -> None:
    drawn = curves("Q", {"Q": [1.0, 2.0]}, {"Q": "#000000"}, {1: "x"}, 4)
    assert drawn.startswith("<svg") and "url(" not in drawn
    assert all(link.startswith("#") for link in re.findall(r'href="([^"]*)"', drawn))

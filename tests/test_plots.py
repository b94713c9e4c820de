"""Pictures in files: what they show, and that they are the same every time."""

from __future__ import annotations

import re
import subprocess
import sys
import xml.etree.ElementTree as xml

import pytest

from madviz.agent.methods import METHODS
from madviz.drawing.colours import colours_on_white
from madviz.envs.registry import SETTINGS
from madviz.plots.figures import Bar, Line, bars, curves, dots, heat, lines
from madviz.plots.styles import STYLES, styles
from madviz.types import CameraSpec

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


def test_every_method_has_a_colour_and_a_marker_of_its_own() -> None:
    chosen = styles(METHODS).values()
    assert len({style.colour for style in chosen}) == len({s.marker for s in chosen}) == len(chosen)
    assert STYLES["mad"] == styles(["single", "MAD (light, alpha 0.5)"])["MAD (light, alpha 0.5)"]
    assert STYLES["merged-only"] == styles(["Merged Only"])["Merged Only"] == styles(["sum"])["sum"]


def test_no_two_series_of_a_figure_look_alike() -> None:
    labels = ["mad", "mad, alpha 0.8", "mad, one size", "alpha 0.2", "alpha 0.5", "single", "x"]
    chosen = styles(labels)
    assert len({(s.marker, s.hollow) for s in chosen.values()}) == len(labels)
    assert chosen["mad, alpha 0.8"].hollow and chosen["mad, alpha 0.8"].colour == "#0b5e86"


def test_a_camera_has_the_colour_that_it_has_on_the_page() -> None:
    cameras = tuple(CameraSpec(name, name, 60) for name in SETTINGS["three"].streams)
    for name, colour in colours_on_white(cameras).items():
        assert STYLES[name].colour.lower() == colour.lower()


def test_dots_lie_where_their_rates_are() -> None:
    series = {"mad": [Bar(0.0, 0.0, 0.1), Bar(1.0, 0.9, 1.0)], "single": [None, Bar(0.5, 0.4, 0.6)]}
    drawn = dots("t", ["hammer", "push"], series, (0.7,))
    xml.fromstring(drawn)
    places = [
        [float(x) for x in re.findall(r'<use [^>]*x="([\d.]+)"', group)]
        for group in re.findall(r'<g class="dot">(.*?)</g>\s*</g>', drawn, re.DOTALL)
    ]
    low, high, middle = (xs[0] for xs in places)
    assert middle == pytest.approx((low + high) / 2, abs=0.01)
    assert drawn.count('class="mark"') == 1 and ">push<" in drawn and ">single<" in drawn


def test_a_heat_map_has_a_number_in_every_cell_and_dashes() -> None:
    panels = {"hammer": {"mad": [1.0, 0.25]}, "push": {"mad": [None, 0.5], "vib": [0.0, 0.75]}}
    drawn = heat("t", ["mad", "vib"], ["all", "first"], panels)
    xml.fromstring(drawn)
    assert drawn.count('class="cell"') == 8 and drawn.count(">–<") == 3
    assert all(f">{number}<" in drawn for number in ("1.00", "0.25", "0.50", "0.00", "0.75"))


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
        "from madviz.plots.figures import Bar, bars;"
        "print(bars('t', ['all', 'first'], {'mad': [Bar(0.5, 0.2, 0.8, (0.4,)), None]}), end='')"
    )
    one, other = (subprocess.check_output([sys.executable, "-c", program]) for _ in range(2))
    assert one == other and b"<metadata" not in one and b"<!--" not in one


def test_a_picture_refers_to_nothing_outside() -> None:
    drawn = curves("Q", {"Q": [1.0, 2.0]}, {"Q": "#000000"}, {1: "x"}, 4)
    assert drawn.startswith("<svg") and "url(" not in drawn
    assert all(link.startswith("#") for link in re.findall(r'href="([^"]*)"', drawn))

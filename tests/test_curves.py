"""The picture of a run's curve: what it says, and when there is none."""

from __future__ import annotations

from pathlib import Path

import pytest

from madviz.measure.statistics import wilson
from madviz.runs.curve import draw_curve, duration, progress, success_lines

HEADER = (
    "step,env_steps,updates,seconds,seconds_left,episodes,success_all,success_first,critic_loss\n"
)
ROWS = "0,0,0,0.5,,20,0.0,0.0,nan\n25000,50000,11500,3600.0,68400,20,0.75,0.5,0.1\n"


def test_lines_carry_the_interval_of_their_episodes() -> None:
    row = {"env_steps": "50000", "episodes": "20", "success_all": "0.75", "success_first": "0.5"}
    lines = success_lines([row])
    assert list(lines) == ["all", "first"]
    assert lines["all"].x == [50000] and lines["all"].y == [0.75]
    assert (lines["all"].low[0], lines["all"].high[0]) == wilson(15, 20)
    assert lines["first"].high[0] == wilson(10, 20)[1]


def test_the_picture_says_how_far_the_run_is(tmp_path: Path) -> None:
    (tmp_path / "curve.csv").write_text(HEADER + ROWS)
    draw_curve(tmp_path, "metaworld-hammer-mad-paper", 500_000)
    text = (tmp_path / "curve.svg").read_text()
    assert "metaworld-hammer-mad-paper: 25,000 of 500,000 decisions, 19 h 00 min left" in text
    assert text.count('class="line"') == 2 and text.count('class="band"') == 2
    assert "95% intervals" in text and ">first<" in text
    draw_curve(tmp_path, "metaworld-hammer-mad-paper", 500_000)
    assert (tmp_path / "curve.svg").read_text() == text, "the same bytes from the same numbers"


@pytest.mark.parametrize("written", [None, "", "round,seconds,loss\n1,2.0,0.3\n"])
def test_a_curve_without_success_is_not_drawn(tmp_path: Path, written: str | None) -> None:
    if written is not None:
        (tmp_path / "curve.csv").write_text(written)
    draw_curve(tmp_path, "x", 10)
    assert not (tmp_path / "curve.svg").exists()


def test_progress_in_words() -> None:
    assert progress({"step": "0", "seconds": "3", "seconds_left": ""}, 100) == "0 of 100 decisions"
    assert progress({"step": "50", "seconds_left": "30"}, 100) == "50 of 100 decisions, 30 s left"
    assert progress({"step": "100", "seconds": "7200"}, 100) == "100 of 100 decisions, 2 h 00 min"
    words = {45.2: "45 s", 95: "2 min", 720: "12 min", 3660: "1 h 01 min", 11_100: "3 h 05 min"}
    assert {seconds: duration(seconds) for seconds in words} == words

"""Success against displacement: places, seeds, workers that put cameras back, the command."""

from __future__ import annotations

import csv
import json
import re
import xml.etree.ElementTree as ElementTree
from typing import Any

import numpy as np
import pytest

from madviz import cli
from madviz.envs.toy import ToyReach
from madviz.errors import UserError
from madviz.measure import displace as displace_module
from madviz.measure import table as table_module
from madviz.measure.displace import (
    DisplaceConfig,
    Point,
    displace,
    displacement_table,
    picture,
    places,
    run_displace,
)
from madviz.measure.episodes import Job, Runner
from madviz.measure.evaluate import evaluate
from madviz.measure.statistics import SuccessRate, wilson
from madviz.observation.condition import Condition
from madviz.observation.displacement import Displacement
from madviz.types import Encoded, Readout
from tests.fakes import AllOrNothing, FakePolicy


class Seeker(FakePolicy):
    """Finds hand and target by their colours in the map of third_b: perfect in its place, and
    misled by as much as the camera is moved."""

    def encode(self, views, state):
        picture = views[2, -3:].astype(int)
        size = picture.shape[-1]
        axis = ((np.arange(size) + 0.5) / size * 2 - 1) * 1.15
        red = (picture[0] > 200) & (picture[2] < 80)
        where = np.argwhere(red).mean(0) if red.any() else np.full(2, size / 2)
        goal = np.array(
            [np.interp(where[1], range(size), axis), -np.interp(where[0], range(size), axis)]
        )
        return Encoded(np.tile(np.r_[goal, state[4:6]], (3, 1)).astype(np.float32), state)

    def read(self, encoded: Encoded, masks) -> Readout:
        goal, hand = encoded.features[0, :2], encoded.features[0, 2:]
        action = np.clip((goal - hand) / 0.12, -1, 1)
        count = len(np.atleast_2d(masks))
        return Readout(np.zeros((count, 4)), np.tile(action, (count, 1)), np.zeros(count))


def test_places_go_from_none_to_the_last_by_equal_steps():
    assert list(places("right", 0.2, 5)) == [0.0, 0.05, 0.1, 0.15, 0.2]
    assert places("right", 0.2, 5)[0.0].is_none
    assert list(places("pan", -20, 3)) == [0.0, -10.0, -20.0]
    assert list(places("zoom", 2, 3)) == pytest.approx([1, 2**0.5, 2], abs=1e-6)


def test_both_ways_are_as_far_and_pass_through_none_once():
    assert list(places("right", 0.2, 3, both=True)) == [-0.2, -0.1, 0.0, 0.1, 0.2]
    assert list(places("right", -0.2, 3, both=True)) == [0.2, 0.1, 0.0, -0.1, -0.2]
    zooms = places("zoom", 2, 3, both=True)
    assert list(zooms) == pytest.approx([0.5, 0.5**0.5, 1, 2**0.5, 2], abs=1e-6)
    for moves in (places("tilt", 9, 2, both=True), zooms):
        assert [move.is_none for move in moves.values()].count(True) == 1
    with pytest.raises(UserError, match="2 to 50 places, found 51"):
        places("right", 0.2, 26, both=True)


@pytest.mark.parametrize(
    ("direction", "most", "steps", "said"),
    [
        ("right", 0.2, 1, "places"),
        ("right", 0.2, 1000, "places"),
        ("right", 0.0, 5, "lead away"),
        ("zoom", 1.0, 5, "lead away"),
        ("right", 3.0, 5, "expected right"),
        ("right", float("nan"), 5, "expected right"),
        ("sideways", 0.2, 5, "unknown direction"),
    ],
)
def test_places_that_are_none_are_refused(direction, most, steps, said):
    with pytest.raises(UserError, match=said):
        places(direction, most, steps)


def test_success_falls_with_distance_and_starts_at_what_eval_says():
    moves = places("right", 0.6, 3)
    points = displace(Seeker(), "third_b", moves, subset="third_b", episodes=6, seed=5000)
    assert [point.at for point in points] == [0.0, 0.3, 0.6]
    whole = evaluate(Seeker(), ["third_b"], episodes=6, seed=5000).rows["third_b"]
    assert points[0].success.value == whole["success"] == 1.0
    assert points[2].success.value < 0.5
    assert points[0].success == SuccessRate.of(6, 6)


def test_every_place_has_the_same_seeds(monkeypatch):
    seen = []

    class Watching(Runner):
        def run(self, job):
            seen.append((job.condition.moves, job.seed))
            return super().run(job)

    monkeypatch.setattr(table_module, "Runner", Watching)
    displace(Seeker(), "third_b", places("up", 0.1, 2), episodes=3, seed=5000)
    moves = {move for move, _ in seen}
    assert moves == {(), (("third_b", Displacement(up=0.1)),)}
    for move in moves:
        assert sorted(seed for m, seed in seen if m == move) == [5000, 5001, 5002]


def test_a_runner_puts_cameras_back_for_the_next_job():
    policy, runner = Seeker(), Runner()
    runner.adopt("", policy)
    there = Condition("all", (), (("third_b", Displacement(right=0.5)),))
    plain = Job("", policy.spec.digest, Condition("all"), 5000)
    moved = Job("", policy.spec.digest, there, 5000)
    first, away, again = (runner.run(job)[0] for job in (plain, moved, plain))
    assert first == again != away
    assert Condition("all").key() == ""
    assert there.key() == "third_b:moved,right=0.5"
    runner.close()


def test_a_camera_the_policy_does_not_see_cannot_be_moved():
    with pytest.raises(UserError, match="third_b"):
        displace(FakePolicy(), "third_b", places("right", 0.1, 2), subset="first")
    with pytest.raises(UserError, match="cannot act"):
        displace(AllOrNothing(), "first", places("right", 0.1, 2), subset="first")
    with pytest.raises(UserError, match="episodes"):
        displace(FakePolicy(), "first", places("right", 0.1, 2), episodes=0)


def make_seeker() -> Seeker:
    """For ``--policy tests.test_displacement:make_seeker``."""
    return Seeker()


def test_the_command_prints_a_table_writes_json_and_draws(tmp_path, capsys):
    words = ["--policy", "tests.test_displacement:make_seeker", "--camera", "third_b"]
    words += ["--along", "right", "--steps", "3", "--most", "0.6", "--episodes", "3"]
    out, drawn = tmp_path / "out.json", tmp_path / "out.svg"
    table = tmp_path / "out.csv"
    words += ["--workers", "0", "--json", str(out), "--svg", str(drawn), "--csv", str(table)]
    assert cli.main(["displace", *words]) == 0
    said, result = capsys.readouterr().out, json.loads(out.read_text())
    assert result["seed"] == 60_000 and [p["at"] for p in result["points"]] == [0.0, 0.3, 0.6]
    assert all(p["n"] == 3 and len(p["ci95"]) == 2 for p in result["points"])
    assert "0.3 m" in said and "n=3" in said and "third_b" in said
    assert ElementTree.fromstring(drawn.read_text()).tag.endswith("svg")
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert [float(row["at"]) for row in rows] == [0.0, 0.3, 0.6]
    for row, point in zip(rows, result["points"], strict=True):
        assert (row["camera"], row["along"], row["unit"], row["n"]) == (
            "third_b",
            "right",
            "m",
            "3",
        )
        assert int(row["successes"]) == point["successes"] == round(3 * point["success"])
        bounds = [float(row["ci95_low"]), float(row["ci95_high"])]
        assert bounds == point["ci95"] == list(wilson(point["successes"], 3))
    assert cli.main(["displace", *words[:2], "--camera", "nose", "--workers", "0"]) == 2
    nowhere = ["displace", *words[:4], "--csv", str(tmp_path / "none" / "x.csv")]
    assert cli.main(nowhere) == 2 and "folder that exists" in capsys.readouterr().err


@pytest.mark.parametrize(("way", "end"), [("up", 0.2), ("pan", 20.0), ("zoom", 1.5)])
def test_how_far_depends_on_what_it_is_unless_somebody_says(way, end, monkeypatch):
    asked = []

    def displaced(policy, camera, moves, **_):
        asked.extend(moves)
        return (Point(0.0, SuccessRate.of(1, 1)),)

    monkeypatch.setattr(displace_module, "displace", displaced)
    run_displace(DisplaceConfig("tests.test_displacement:make_seeker", "first", way))
    assert asked[-1] == end and len(asked) == 5


def test_table_and_picture_of_zoom():
    row = {"success": 0.5, "n": 4, "ci95": list(wilson(2, 4))}
    result: Any = {
        "policy": "p",
        "task": "t",
        "camera": "first",
        "along": "zoom",
        "unit": "times",
        "subset": "all",
        "points": [{"at": 1.0, **row}, {"at": 0.5, **row}],
    }
    assert "0.5 times" in displacement_table(result)
    assert "% more or less" in picture(result)
    assert "all, out" in picture(result) and "all, in" not in picture(result)


def test_a_curve_for_each_way():
    row = {"success": 0.5, "n": 4, "ci95": list(wilson(2, 4))}
    result: Any = {
        "policy": "p",
        "task": "t",
        "camera": "first",
        "along": "pan",
        "unit": "°",
        "subset": "rgb",
        "points": [{"at": at, **row} for at in (-20.0, -10.0, 0.0, 10.0, 20.0)],
    }
    drawn = picture(result)
    assert drawn.count('class="line"') == 2 and "rgb, right" in drawn and "rgb, left" in drawn
    assert ">20<" in drawn and ">°<" in drawn
    one, other = re.findall(r'class="line">\s*<path d="M (\S+) ', drawn)
    assert one == other  # Both begin where the camera stood in training.


def test_the_toy_world_is_where_its_spec_says_afterwards():
    env = ToyReach()
    env.reset(0)
    before = env.view("third_a").rgb
    env.move_camera("third_a", Displacement(zoom=1.5).placed(env.spec.camera("third_a")))
    assert not np.array_equal(env.view("third_a").rgb, before)
    env.move_camera("third_a", None)
    assert np.array_equal(env.view("third_a").rgb, before)

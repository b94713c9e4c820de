"""How much is too much: axes, the rule that chooses places, made-up policies that fail from a
known place on, and the command."""

from __future__ import annotations

import csv
import json
from functools import partial

import numpy as np
import pytest

from madviz import cli
from madviz.errors import UserError
from madviz.measure import table as table_module
from madviz.measure.audit.along import ENOUGH, EPISODES, along
from madviz.measure.audit.along_account import along_words
from madviz.measure.audit.axes import parse_axis
from madviz.measure.audit.curve import FallingCurve
from madviz.measure.audit.turned import along_pairs
from madviz.measure.episodes import Job
from madviz.measure.store import EpisodeResult, Store
from madviz.observation.ablation import Occlusion
from madviz.observation.displacement import Displacement
from tests.fakes import FakePolicy
from tests.test_displacement import Seeker

STREAMS = ("first", "third_a", "third_b")
PLACES = tuple((number + 1) / 40 for number in range(40))


# --- Axes ---


@pytest.mark.parametrize(
    ("word", "ends", "far"),
    [
        ("third_a.pan=-20:20", [20, -20], Displacement(pan=20)),
        ("third_a.right=0:0.2", [0.2], Displacement(right=0.2)),
        ("third_a.zoom=0.5:1", [0.5], Displacement(zoom=0.5)),
        ("third_a.blur=0:1", [1], Occlusion("blur")),
        ("third_a.patch=0:0.8", [0.8], Occlusion("patch", width=0.8, height=0.8)),
        ("third_a.loss=0:0.5", [0.5], Occlusion("dropout", 0.5)),
        ("third_a.delay=0:8", [8], Occlusion("delay", 0.8)),
        ("third_a.light=0.3:2", [2, 0.3], Occlusion("light", 1.0)),
    ],
)
def test_an_axis_has_a_side_for_each_end(word, ends, far):
    axis = parse_axis(word, STREAMS)
    assert [side.end for side in axis.sides] == ends
    condition = axis.sides[0].condition(1.0)
    assert condition.occlusions + condition.moves == (("third_a", far),)


def test_without_a_camera_all_of_them_change_and_places_fit_the_axis():
    (brighter, darker) = parse_axis("light=0.3:2", STREAMS).sides
    assert [name for name, _ in darker.condition(1.0).occlusions] == list(STREAMS)
    assert darker.value(0.5) == pytest.approx(0.3**0.5, abs=1e-4)
    assert brighter.way == "brighter"
    (late,) = parse_axis("first.delay=0:8", STREAMS).sides
    assert [late.value(share) for share in late.places] == [1, 2, 3, 4, 5, 6, 7, 8]


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("third_a", "expected an axis"),
        ("nose.pan=0:5", "unknown camera"),
        ("third_a.black=0:1", "unknown axis"),
        ("third_a.pan=5:20", "where nothing is changed"),
        ("third_a.pan=0:0", "where nothing is changed"),
        ("third_a.pan=0:1.2.3", "two numbers"),
        ("third_a.pan=0:200", "expected pan"),
        ("third_a.blur=-1:1", "expected blur of 0 or more"),
        ("third_a.blur=0:3", "strength"),
        ("light=0:2", "more than 0"),
        ("third_a.delay=0:2.5", "whole decisions"),
    ],
)
def test_what_is_no_axis_is_refused(word, said):
    with pytest.raises(UserError, match=said):
        parse_axis(word, STREAMS)


# --- The rule and its interval ---


def truth(rng):
    """A place, and a curve that falls through one half there: steep, slow, in one step, in a
    straight line, or to a rest that is kept for ever."""
    place, width, rest = rng.uniform(0.08, 0.95), rng.uniform(0.01, 0.08), rng.uniform(0, 0.3)
    steep = rng.uniform(2, 8)
    curves = (
        lambda u: np.where(u < place, 1.0, 0.0),
        lambda u: 1 / (1 + np.exp((u - place) / width)),
        lambda u: np.clip(0.5 - (u - place) / (4 * width), 0, 1),
        lambda u: np.clip(0.5 - (u - place) / (4 * width), rest, 1),
        lambda u: 2.0 ** -((u / place) ** steep),
    )
    return place, curves[rng.integers(len(curves))]


def simulated(rng, rate, most=EPISODES):
    curve, played = FallingCurve(PLACES), []
    while len(played) < most:
        for place in curve.next(4):
            curve.add(place, float(rng.random() < rate(PLACES[place])))
            played.append(place)
        _, low, high = curve.breaking()
        if len(played) >= 16 and (low > 1 or high - low <= ENOUGH):
            break
    return curve, played


def test_band_and_interval_cover_in_200_simulated_audits():
    inside, covered = [], []
    for number in range(200):
        rng = np.random.default_rng([7, number])
        place, rate = truth(rng)
        curve, _ = simulated(rng, rate)
        _, low, high = curve.breaking()
        inside.append(low <= place <= high)
        _, lows, highs = curve.band()
        rates = rate(np.array(PLACES))
        covered.append(np.mean((lows <= rates + 1e-9) & (rates <= highs + 1e-9)))
    assert np.mean(inside) >= 0.95
    assert np.mean(covered) >= 0.95


def test_episodes_are_where_success_falls():
    rng = np.random.default_rng(0)
    _, played = simulated(rng, lambda u: float(u < 0.3))
    near = [place for place in played if 0.2 <= PLACES[place] <= 0.4]
    assert len(near) >= 0.5 * len(played) and len(played) <= 32


def test_a_side_that_never_falls_is_played_at_its_end_and_soon_over():
    curve, played = simulated(np.random.default_rng(0), lambda u: 1.0)
    assert len(played) == 16 and min(PLACES[place] for place in played) >= 0.3
    assert curve.breaking()[1] > 1


# --- The whole audit, without a simulator ---


class Thresholds:
    """Plays no episode: a camera that is changed beyond its place loses the scene, with a place of
    its own in each scene."""

    def __init__(self, monkeypatch, word, place, spread=0.02, intact=1.0):
        self.sides = parse_axis(word, STREAMS).sides
        self.table = {side.condition(share): share for side in self.sides for share in side.places}
        self.place, self.spread, self.intact = place, spread, intact
        self.ran, self.stop_after = [], 10**9
        monkeypatch.setattr(table_module, "run_anywhere", self.play)

    def play(self, jobs, workers, here, progress):
        for job in jobs:
            if len(self.ran) == self.stop_after:
                raise KeyboardInterrupt
            self.ran.append(job)
            noise = np.random.default_rng([job.seed, 3])
            success = bool(noise.random() < self.intact)
            if job.condition in self.table:
                success &= self.table[job.condition] < self.place + noise.normal() * self.spread
            yield job, (EpisodeResult("all", job.seed, success, success, 0.0), "near")


@pytest.mark.parametrize("word", ["third_a.pan=0:20", "third_a.blur=0:1", "light=1:2"])
@pytest.mark.parametrize("place", [0.12, 0.4, 0.63, 0.9])
def test_a_known_threshold_is_found_within_5_percent_in_60_episodes(monkeypatch, word, place):
    world = Thresholds(monkeypatch, word, place)
    found = along(FakePolicy(), [word], seed=60_000)
    (side,) = found["axes"][0]["sides"]
    wanted = world.sides[0].value(place)
    length = abs(world.sides[0].end - world.sides[0].start)
    assert side["breaking"] is not None and abs(side["breaking"] - wanted) <= 0.05 * length
    assert side["n"] <= 60 and f"[{side['ci95'][0]:.3g}, " in along_words(found)[1]


def test_an_axis_that_is_written_twice_is_one(monkeypatch):
    Thresholds(monkeypatch, "third_a.blur=0:1", 0.4)
    words = ["third_a.blur=0:1", "third_a.blur=0:1.0"]
    found = along(FakePolicy(), words, seed=60_000)
    pairs = along_pairs(found, words, FakePolicy(), partial(Job, "p", ""), 3)
    assert len(found["axes"]) == 1 and len(pairs) == 3


def test_two_sides_share_the_episodes_and_meet_the_same_scenes(monkeypatch):
    world = Thresholds(monkeypatch, "third_a.pan=-20:20", 0.5, intact=0.8)
    found = along(FakePolicy(), ["third_a.pan=-20:20"], seed=60_000)
    right, left = found["axes"][0]["sides"]
    assert (right["way"], left["way"]) == ("turned right", "turned left")
    assert right["breaking"] == pytest.approx(10, abs=2)
    assert left["breaking"] == pytest.approx(-10, abs=2)
    assert right["n"] <= 30 and left["n"] <= 30
    solved = {job.seed for job in world.ran if job.condition not in world.table}
    changed = [
        [
            j.seed
            for j in world.ran
            if dict(j.condition.moves).get("third_a")
            and np.sign(j.condition.moves[0][1].pan) == sign
        ]
        for sign in (1, -1)
    ]
    assert changed[0][:20] == changed[1][:20] and set(changed[0]) < solved
    assert len(set(changed[0])) == len(changed[0])
    turned = {seed for _, seed in right["turned"]}
    assert turned <= set(changed[0]) and len(turned) == right["n"] - sum(
        place["successes"] for place in right["places"]
    )


def test_a_policy_that_seldom_succeeds_is_no_evidence(monkeypatch):
    Thresholds(monkeypatch, "third_a.blur=0:1", 0.5, intact=0.02)
    found = along(FakePolicy(), ["third_a.blur=0:1"], seed=60_000, episodes=20)
    words = " ".join(along_words(found))
    assert "no evidence" in words and found["intact"]["n"] == 40


@pytest.mark.parametrize(
    ("word", "episodes", "intact", "n"),
    [
        ("third_a.pan=-20:20", 60, 0.02, 60),
        ("third_a.pan=-20:20", 2, 1.0, 2),
        ("third_a.pan=-20:20", 1, 1.0, 2),
        ("third_a.blur=0:1", 4, 0.02, 8),
    ],
)
def test_few_episodes_and_few_successes_end_in_words(monkeypatch, word, episodes, intact, n):
    Thresholds(monkeypatch, word, 0.5, intact=intact)
    found = along(FakePolicy(), [word], seed=60_000, episodes=episodes)
    assert found["intact"]["n"] == n and along_words(found)


def test_an_audit_that_was_stopped_goes_on_and_ends_the_same(monkeypatch, tmp_path):
    word = "third_a.pan=-20:20"
    Thresholds(monkeypatch, word, 0.4)
    whole = along(FakePolicy(), [word], seed=60_000)
    world = Thresholds(monkeypatch, word, 0.4)
    world.stop_after = 30
    with pytest.raises(KeyboardInterrupt):
        along(FakePolicy(), [word], seed=60_000, store=Store(tmp_path / "episodes.sqlite"))
    world.stop_after = 10**9
    again = along(FakePolicy(), [word], seed=60_000, store=Store(tmp_path / "episodes.sqlite"))
    assert again == whole
    pairs = [(job.condition, job.seed) for job in world.ran]
    assert len(set(pairs)) == len(pairs)


# --- The command ---


def make_seeker() -> Seeker:
    """For ``--policy tests.test_along:make_seeker``."""
    return Seeker()


def test_the_command_writes_its_page_and_tables(tmp_path, capsys):
    words = ["audit", "--policy", "tests.test_along:make_seeker", "--out", str(tmp_path / "a")]
    words += ["--along", "third_b.right=0:0.6", "--episodes", "16", "--workers", "0"]
    assert cli.main(words) == 0
    said = capsys.readouterr().out
    assert "Third B, to the right: half of its success is gone at 0.1" in said
    document = json.loads((tmp_path / "a" / "along.json").read_text())
    page = (tmp_path / "a" / "along.html").read_text()
    assert document["seed"] == 60_000 and "<script" not in page and 'class="band"' in page
    rows = list(csv.DictReader((tmp_path / "a" / "along.csv").read_text().splitlines()))
    (side,) = document["axes"][0]["sides"]
    assert [float(row["at"]) for row in rows] == [place["at"] for place in side["places"]]
    assert sum(int(row["n"]) for row in rows) == side["n"] == 16
    assert (rows[0]["camera"], rows[0]["along"], rows[0]["unit"]) == ("third_b", "right", "m")
    before = [(tmp_path / "a" / name).read_bytes() for name in ("along.json", "along.html")]
    assert cli.main(words) == 0
    assert before == [(tmp_path / "a" / n).read_bytes() for n in ("along.json", "along.html")]
    assert cli.main([*words, "--how", "black"]) == 2
    assert cli.main(["displace", "--policy", "x"]) == 2
    assert "run madviz audit --along" in capsys.readouterr().err

"""Show me: the episodes behind a verdict, beside the ones they are compared with."""

from __future__ import annotations

import re
import tempfile
from base64 import b64decode
from dataclasses import replace
from functools import partial
from pathlib import Path

import av
import numpy as np
import pytest

from madviz import cli
from madviz.app.server import ExploreConfig, beginning
from madviz.envs.registry import SETTINGS
from madviz.errors import UserError
from madviz.measure.audit.audit import AuditConfig, run_audit
from madviz.measure.audit.audited_policy import repeats_itself
from madviz.measure.audit.lost_cameras import HOWS
from madviz.measure.episodes import Job, Runner
from madviz.measure.pairs import KEPT, EpisodePair, explore_command, pair_blocks, parting, show
from madviz.measure.watched import carry_out, kept, watched
from madviz.observation.ablation import CameraState, Occlusion
from madviz.observation.condition import Condition
from madviz.observation.displacement import Displacement, MoveCamera
from madviz.observation.grammar import condition_text, parse_condition
from madviz.observation.schedule import Event
from madviz.session.commands import SetCamera, SetSchedule
from tests.fakes import AllOrNothing, Chunked, Restless
from tests.test_audit import Looker

ALL, ALONE = Condition("all"), Condition("first")
LABELS = ("all cameras", "Third B dropped")


def runner_of(policy) -> Runner:
    runner = Runner()
    runner.adopt("p", policy)
    return runner


def job(condition: Condition, seed: int = 60_000) -> Job:
    return Job("p", "looker", condition, seed)


def test_actions_part_where_they_stay_apart_for_three_steps():
    assert parting(np.array([0, 0.2, 0, 0.2, 0.2, 0.05, 0.2, 0.3, 0.11])) == 6
    assert parting(np.array([0.2, 0.2])) is None and parting(np.zeros(9)) is None


def test_an_episode_is_played_again_with_the_pictures_that_the_policy_got():
    runner = runner_of(Looker())
    whole, broken = (watched(job(one), runner)[0] for one in (ALL, ALONE))
    assert whole.success and not broken.success
    assert whole.pictures[0].shape == (168, 2 * 168 + 4, 3)
    assert np.array_equal(whole.pictures[0][:, :168], broken.pictures[0][:, :168])
    dimmed, seen = (one.pictures[0][:, -168:].astype(float) for one in (broken, whole))
    assert np.abs(dimmed - 0.3 * seen).max() <= 2
    black, _ = watched(job(Condition("all", (("third_b", Occlusion("black")),))), runner)
    assert not black.pictures[0][:, -168:].any()
    again, _ = watched(job(ALL), runner)
    assert np.array_equal(again.actions, whole.actions)


def test_a_pair_says_when_the_actions_part_and_has_a_film_of_both(tmp_path):
    runner = runner_of(Looker())
    pair = EpisodePair(job(ALL), job(ALONE), LABELS, (True, False))
    (heading, block) = pair_blocks([pair], runner)
    text, html = block.lines
    assert heading.lines == ["Show me"]
    assert text.startswith(
        "Seed 60000: success with all cameras, no success with Third B dropped. Their actions part "
        "at step 0 of "
    )
    assert "madviz explore --policy p --seed 60000 --condition first<" in html
    assert "First person, Third B" in html and 'class="mark 0"' in html
    (encoded,) = re.findall(r"data:video/mp4;base64,([^\"]+)", html)
    film = b64decode(encoded)
    (tmp_path / "pair.mp4").write_bytes(film)
    with av.open(str(tmp_path / "pair.mp4")) as file:
        frames = [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
    (shown,) = show([pair], runner)
    assert len(frames) == max(len(shown.first.pictures), len(shown.second.pictures))
    assert frames[0].shape == (8 + 2 * 168 + 4, 2 * 168 + 4, 3) and len(film) < 150_000


def test_pairs_that_come_out_otherwise_are_left_out_and_counted():
    pair = EpisodePair(job(ALL), job(ALONE), LABELS, (True, True))
    blocks = pair_blocks([pair], runner_of(Looker()))
    assert "1 of 1 pairs are not shown" in blocks[-1].lines[0]


def test_an_audit_keeps_the_seeds_that_turned_and_its_page_shows_pairs(tmp_path):
    config = AuditConfig(
        "tests.test_audit:make_looker", tmp_path, episodes=2, how=("dropped",), workers=0, pairs=2
    )
    found = run_audit(config)
    assert "conditions" in found
    removed = next(
        r for r in found["conditions"] if (r["camera"], r["what"]) == ("third_b", "removed")
    )
    assert removed.get("lost") == [60_000, 60_001] and removed.get("won") == []
    page = (tmp_path / "audit.html").read_bytes()
    assert page.count(b"<video") == 2 and b"<script" not in page and len(page) < 1_000_000
    (tmp_path / "audit.html").unlink()
    run_audit(config)
    assert (tmp_path / "audit.html").read_bytes() == page
    assert "Their actions part at step" in (tmp_path / "audit.md").read_text()


class Dreamer(Looker):
    """Never gives the same answer twice."""

    def __init__(self):
        super().__init__("dreamer")
        self._rng = np.random.default_rng()
        self.answers: list[np.ndarray] = []

    def read(self, encoded, masks):
        found = super().read(encoded, masks)
        drawn = 0.2 * self._rng.standard_normal(found.action.shape).astype(np.float32)
        self.answers += [np.clip(found.action + drawn, -1, 1)]
        return replace(found, action=self.answers[-1])


def make_dreamer():
    return Dreamer()


def test_episodes_are_kept_of_a_policy_that_does_not_repeat_itself(tmp_path):
    config = AuditConfig(
        "tests.test_pairs:make_dreamer", tmp_path, episodes=2, how=("dropped",), workers=0, pairs=2
    )
    run_audit(config)
    page = (tmp_path / "audit.html").read_bytes()
    assert page.count(b"<video") == 2 and KEPT.encode() in page and b"pairs are not" not in page
    assert b"Where dreamer looks" not in page, "a map of random answers says nothing"
    run_audit(config)
    assert (tmp_path / "audit.html").read_bytes() == page, "none was played again"
    for file in (tmp_path / "kept").iterdir():
        file.write_bytes(file.read_bytes()[:99])
    run_audit(config)
    assert "2 of 2 pairs are not shown" in (tmp_path / "audit.html").read_text()


def test_worker_processes_keep_them_too_and_what_cannot_be_written_counts(tmp_path):
    config = AuditConfig(
        "tests.test_pairs:make_dreamer", tmp_path, episodes=1, how=("dropped",), workers=1, pairs=1
    )
    run_audit(config)
    assert (tmp_path / "audit.html").read_text().count("<video") == 1
    (tmp_path / "in the way").mkdir()
    (tmp_path / "in the way" / "kept").write_text("a file")
    found = run_audit(replace(config, out=tmp_path / "in the way", workers=0))
    assert "shapley" in found and found["intact"]["n"] == 1
    assert "1 of 1 pairs are not shown" in (tmp_path / "in the way" / "audit.html").read_text()


class Dozer(Dreamer):
    """Draws only where it sees something."""

    def read(self, encoded, masks):
        return super().read(encoded, masks) if np.any(masks) else Looker.read(self, encoded, masks)


@pytest.mark.parametrize(
    ("make", "repeats"),
    [
        (Looker, True),
        (Dozer, False),
        (Dreamer, False),
        (Restless, False),
        (Chunked, True),
        (AllOrNothing, True),
    ],
)
def test_a_policy_is_asked_whether_it_repeats_itself(make, repeats):
    assert repeats_itself("module:factory", make()) == repeats


def test_a_kept_episode_is_the_one_that_was_played(tmp_path):
    runner = Runner()
    policy = Dreamer()
    runner.adopt("p", policy)
    asked = replace(job(ALL), digest="dreamer", kept=str(tmp_path))
    result, _ = carry_out(asked, runner)
    found = kept(asked)
    assert found and found.success == result.success and found.looks == []
    assert np.array_equal(found.actions, np.concatenate(policy.answers))
    again, _ = watched(asked, runner)
    assert not np.array_equal(found.actions[0], again.actions[0])
    assert len(found.pictures) == len(found.actions) and found.pictures[0].shape == (168, 340, 3)
    assert np.abs(found.pictures[0].astype(int) - again.pictures[0]).mean() < 3, "one start"
    assert kept(replace(asked, seed=1)) is None, "another episode was not kept"


def test_compare_keeps_the_episodes_of_such_a_policy(tmp_path, monkeypatch):
    page = tmp_path / "pairs.html"
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    words = ["compare", "tests.test_pairs:make_dreamer", "--conditions", "all", "third_b=black"]
    words += ["--episodes", "1", "--workers", "0", "--page", str(page), "--json", "-"]
    assert cli.main(words) == 0
    text = page.read_text()
    assert text.count("<video") == 1 and KEPT in text
    assert [one.name for one in tmp_path.iterdir()] == ["pairs.html"]


def test_compare_shows_the_same_page(tmp_path):
    page = tmp_path / "pairs.html"
    words = ["compare", "tests.test_audit:make_looker", "--conditions", "all", "third_b=black"]
    words += ["--episodes", "1", "--workers", "0", "--page", str(page), "--json", "-"]
    assert cli.main(words) == 0
    text = page.read_text()
    assert text.count("<video") == 1 and "no success with third_b=black" in text


# --- Open in the explorer ---


@pytest.mark.parametrize(
    "word",
    [
        "all",
        "first+third_b",
        "third_a=noise:0.3",
        "first,first=patch:1:0.5:0.5:0.3:0.2",
        "third_a.pan=-11",
        "first=blur:0.5,third_a.right=0.1,third_a.zoom=1.5",
        "third_a=noise:0.3@20",
        "third_a=off@7",
        "first=off,third_b=off,third_a=black@7",
        "first=off,third_a=off,third_b=off@7",
    ],
)
def test_a_condition_can_be_written_and_read_again(word):
    streams = SETTINGS["three"].streams
    condition = parse_condition(word, streams).noticed(streams)
    assert condition_text(condition, streams) == word
    assert explore_command(Job("p", "", condition, 7), streams).split()[-1] == word


def test_colour_of_one_camera_and_depth_of_another_are_dropped_one_by_one():
    streams = ("first", "third_a.depth")
    for camera, left in (("first", "depth"), ("third_a", "rgb")):
        condition = parse_condition(f"{camera}=off@20", ("first", "third_a")).noticed(streams)
        assert (condition.subset, condition.begin) == (left, 20)
        word = condition_text(condition, streams)
        assert parse_condition(word, ("first", "third_a")).noticed(streams) == condition


def test_the_page_begins_with_the_switches_of_an_episode():
    spec = replace(Looker().spec, streams=SETTINGS["three"].streams)
    start = partial(ExploreConfig, seed=60_003)
    assert beginning(start(), spec) == ()
    assert beginning(start(condition="third_a=black,first.pan=5"), spec) == (
        SetCamera("third_a", CameraState("rgb", Occlusion("black"))),
        MoveCamera("first", Displacement(pan=5)),
    )
    dropped = CameraState("off")
    assert beginning(start(condition="first"), spec) == (
        SetCamera("third_a", dropped),
        SetCamera("third_b", dropped),
    )
    assert beginning(start(condition="first=off,third_a=black@20"), spec) == (
        SetSchedule((Event(20, "first", True), Event(20, "third_a", False, Occlusion("black")))),
    )
    with pytest.raises(UserError, match="before step 25, where toy/reach ends, found one at step"):
        beginning(start(condition="first=freeze@500"), spec)
    with pytest.raises(UserError, match="beside --replay"):
        beginning(start(replay=Path("x.json")), spec)
    with pytest.raises(UserError, match="unknown camera"):
        beginning(start(condition="nose.pan=5"), spec)


@pytest.mark.slow
def test_the_whole_chain_on_hammer(tmp_path):
    """An audit of a policy that uses First person, its page with films and maps, and one axis."""
    config = AuditConfig(
        "metaworld-hammer-merged-only-light", tmp_path, episodes=2, how=("dropped",), pairs=2
    )
    found = run_audit(config)
    page = (tmp_path / "audit.html").read_text()
    assert page.count("<video") == 2 and page.count("data:image/jpeg") == 2
    assert "Under it, the gradient of the network. First person: up to 0." in page
    assert len(page) < 5_000_000 * 2 / 12
    assert "conditions" in found
    rows = {(row["camera"], row["what"]): row for row in found["conditions"]}
    assert rows["first", "removed"].get("lost") == [60_000, 60_001]
    along = run_audit(replace(config, how=HOWS, along=("first.pan=0:40",), episodes=16, pairs=1))
    assert "axes" in along
    (side,) = along["axes"][0]["sides"]
    assert side["breaking"] is not None and 0 < side["breaking"] < 40
    assert (tmp_path / "along.html").read_text().count("<video") == 1

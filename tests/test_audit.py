"""The audit: made-up policies whose use of cameras is known, and made-up outcomes."""

import json
import re
import signal
from dataclasses import replace

import numpy as np
import pytest

from madviz.analysis.shapley import shapley
from madviz.envs.registry import SETTINGS
from madviz.envs.toy import STEP
from madviz.errors import Interrupted, UserError
from madviz.measure import table as table_module
from madviz.measure.audit.account import account
from madviz.measure.audit.audit import AuditConfig, audit, audit_words, command, run_audit
from madviz.measure.audit.lost_cameras import HOWS, INTACT, Cameras
from madviz.measure.audit.schedule import AuditPlan
from madviz.measure.audit.sentences import deciding, in_words, makes_no_difference
from madviz.measure.audit.verdict import LEVEL
from madviz.measure.blocks import html, markdown
from madviz.measure.statistics import pair
from madviz.measure.store import MEMORY, EpisodeResult, Store
from madviz.measure.table import Table
from madviz.subsets import every_mask
from madviz.types import Encoded, PolicySpec, Readout

THREE = SETTINGS["three"].streams


# --- Made-up policies on the toy task ---


class Looker:
    """Goes to the orange pixels of Third B's picture, and never looks at First person's."""

    def __init__(self, name="looker", streams=("first", "third_b"), drops=True):
        self.spec = PolicySpec(
            name, "toy/reach", "none", "three", "by hand", streams, ("all",), digest=name
        )
        self._drops = drops

    def encode(self, views, state):
        seen = np.zeros((len(views), 3), np.float32)
        picture = views[self.spec.streams.index("third_b")][-3:, ::2, ::2].astype(int)
        rows, columns = np.nonzero(
            np.abs(picture - np.array([[[230]], [[90]], [[40]]])).max(0) < 40
        )
        x, y = 1.15 * ((columns + 0.5) / 21 - 1), -1.15 * ((rows + 0.5) / 21 - 1)
        seen[self.spec.streams.index("third_b")] = x.sum(), y.sum(), len(rows)
        return Encoded(seen, state)

    def read(self, encoded, masks):
        merged = masks.astype(np.float32) @ encoded.features
        hand, count = encoded.state[-2:], merged[:, 2:]
        target = np.where(count > 0, merged[:, :2] / np.maximum(count, 1), hand)
        action = np.clip((target - hand) / STEP, -1, 1).astype(np.float32)
        return Readout(merged, action, np.full(len(masks), np.nan, np.float32))

    def supports(self, mask):
        return self._drops or bool(np.all(mask))


def make_looker():
    return Looker()


def test_it_finds_the_camera_that_is_used_and_the_one_that_is_not(tmp_path):
    config = AuditConfig("tests.test_audit:make_looker", tmp_path, episodes=16, workers=0)
    found = run_audit(config)
    assert "shapley" in found
    assert found["verdict"] == {"first": "no use shown", "third_b": "needed"}
    rows = {(row["camera"], row["what"], row["how"]): row for row in found["conditions"]}
    assert len(rows) == 5 * 5
    for how in HOWS:  # Not looked at: to the bit the same, whatever is done to it.
        assert rows["first", "removed", how]["difference"] == 0
        assert rows["first", "removed", how]["p_holm"] == 1
        assert rows["third_b", "alone", how]["success"] == found["intact"]["success"]
    assert rows["third_b", "removed", "dropped"]["difference"] < -0.7
    assert found["shapley"]["first"]["value"] == 0
    total = found["intact"]["success"] - rows[None, "none", "dropped"]["success"]
    assert found["shapley"]["third_b"]["value"] == pytest.approx(total)
    words = audit_words(found)
    assert "Third B is needed: without it success changes by -" in words
    assert "First person: no use shown. Without it success changes by 0 points [-" in words
    for name in ("audit.html", "audit.json", "audit.md", "episodes.sqlite"):
        assert (tmp_path / name).stat().st_size > 1000
    assert json.loads((tmp_path / "audit.json").read_text()) == found


# --- Made-up outcomes: the whole command, without a simulator ---


class World:
    """Plays no episode: success of every condition at a rate, with the same luck in each scene."""

    def __init__(self, rate, monkeypatch):
        self.rate, self.ran, self.stop_after = rate, 0, 10**9
        monkeypatch.setattr(table_module, "run_anywhere", self.play)

    def play(self, jobs, workers, here, progress):
        for job in jobs:
            if self.ran == self.stop_after:
                raise KeyboardInterrupt
            self.ran += 1
            luck = np.random.default_rng([job.seed, 1]).random()
            success = bool(luck < self.rate(job.condition))
            yield (
                job,
                (EpisodeResult(job.condition.subset, job.seed, success, success, 0.0), "near"),
            )


def lost(played):
    """The cameras that a condition takes from a policy with three."""
    if played.occlusions:
        return {name for name, _ in played.occlusions}
    present = played.subset.split("+")
    return set() if played.subset == "all" else {name for name in THREE if name not in present}


def one_needed(played):
    """First person is needed; each of the other two is as good as both."""
    away = lost(played)
    return 0.9 - 0.8 * ("first" in away) - 0.05 * (away >= {"third_a", "third_b"})


def test_the_document_has_the_schema(monkeypatch):
    World(one_needed, monkeypatch)
    found = audit(Looker(streams=THREE), episodes=100)
    keys = {"schema", "policy", "task", "intact", "conditions", "shapley", "verdict"}
    assert keys < set(found) and found["schema"] == 1
    assert set(found["intact"]) == {"success", "n", "ci95"}
    assert set(found["shapley"]) == set(found["verdict"]) == set(THREE)
    asked = {"camera", "what", "how", "success", "n", "difference", "ci95", "p_holm"}
    for row in found["conditions"]:
        assert asked <= set(row) <= asked | {"above_none", "ci_all", "lost", "won"}
        assert row["n"] == found["intact"]["n"]
        assert row["ci95"][0] <= row["difference"] <= row["ci95"][1]
        assert row["difference"] == pytest.approx(row["success"] - found["intact"]["success"])
    named = [(row["camera"], row["what"], row["how"]) for row in found["conditions"]]
    expected = [(None, "none"), *((name, what) for name in THREE for what in ("removed", "alone"))]
    assert sorted(map(str, named)) == sorted(str((*e, how)) for e in expected for how in HOWS)
    assert json.loads(json.dumps(found)) == found


def test_rows_and_shapley_values_are_those_of_independent_formulas(monkeypatch):
    World(one_needed, monkeypatch)
    cameras = Cameras(THREE, lambda mask: True)
    plan, store = AuditPlan(cameras, 40, 60_000), Store(MEMORY)
    found = audit(Looker("x", THREE), episodes=40, store=store)

    def outcomes(played):
        known = Table("", Looker("x", THREE).spec, store, own=True).results(played)
        return {s: known[s].success for s in plan.seeds(found["intact"]["n"])}

    for row, one in zip(found["conditions"], cameras.rows(), strict=True):
        paired = pair(outcomes(one.condition), outcomes(INTACT))
        assert row["difference"] == pytest.approx(paired.difference)
        assert row["ci95"] == pytest.approx(list(paired.interval()))
    rates = [np.mean(list(outcomes(played).values())) for played in cameras.sets()]
    assert len(rates) == len(every_mask(3))
    expected = shapley(np.array(rates))
    assert [row["value"] for row in found["shapley"].values()] == pytest.approx(list(expected))
    for row in found["shapley"].values():
        assert row["ci95"][0] < row["value"] < row["ci95"][1]


def test_it_stops_when_all_is_decided_and_plays_the_rest_on_the_same_scenes(monkeypatch):
    world = World(lambda played: 0.0 if lost(played) else 1.0, monkeypatch)
    found = audit(Looker(streams=THREE), episodes=100)
    assert set(found["verdict"].values()) == {"needed"}
    assert found["intact"]["n"] == 25 and world.ran == 25 * 36
    assert "It stopped after 25: all was decided." in audit_words(found)
    world.ran = 0
    assert audit(Looker(streams=THREE), episodes=100, how=("dropped",))["looks"][0] == 25
    assert world.ran == 25 * 8


def test_it_goes_on_where_it_was_stopped(monkeypatch, tmp_path):
    world = World(one_needed, monkeypatch)
    config = AuditConfig("tests.test_audit:make_looker", tmp_path / "b", episodes=30)
    straight = run_audit(replace(config, out=tmp_path / "a"))
    whole, world.ran, world.stop_after = world.ran, 0, 77
    with pytest.raises(
        Interrupted, match="madviz audit --policy tests.test_audit:make_looker"
    ) as e:
        run_audit(config)
    assert e.value.exit_code == 128 + signal.SIGINT
    again = command(replace(config, trust=True, workers=2, json="-"), given_away=False)
    assert "--workers 2 --json - --trust" in again
    world.stop_after = 10**9
    assert run_audit(config) == straight
    assert world.ran == whole
    world.ran = 0
    assert run_audit(config) == straight and world.ran == 0


def test_a_policy_that_cannot_drop_is_judged_by_the_mean_picture(monkeypatch):
    World(one_needed, monkeypatch)
    found = audit(Looker("stacked", THREE, drops=False), episodes=100)
    assert found["verdict"]["first"] == "needed"
    assert {row["how"] for row in found["conditions"]} == {"black", "mean", "noise", "frozen"}
    assert found["decided_by"]["first"] == {"removed": "mean", "alone": "mean"}
    assert found["shapley_how"] == "mean" and found["occluded"] == []
    assert "the verdict comes from the mean picture" in audit_words(found)


def test_black_is_not_dropped(monkeypatch):
    def rate(played):
        blacks = [name for name, occlusion in played.occlusions if occlusion.kind == "black"]
        return 0.3 if blacks else 0.95

    World(rate, monkeypatch)
    found = audit(Looker(streams=THREE), episodes=80)
    (line,) = [line for line in in_words(found) if "is not dropped" in line]
    assert line.startswith("Black is not dropped: with ") and "with it dropped, 0.9" in line


def test_a_policy_that_fails_is_no_evidence(monkeypatch):
    World(lambda played: 0.2, monkeypatch)
    assert "no evidence about cameras" in audit_words(audit(Looker(streams=THREE), episodes=40))


def test_no_difference_is_said_only_where_the_interval_is_narrow(monkeypatch):
    World(lambda played: 1.0 - (played.subset == "none"), monkeypatch)
    few = audit_words(audit(Looker(streams=THREE), episodes=40, how=("dropped",)))
    assert "makes no difference" not in few and "without it success changes by 0 points" in few
    many = audit_words(audit(Looker(streams=THREE), episodes=100, how=("dropped",)))
    assert many.count("so that makes no difference") == 3
    assert many.count(" is redundant: ") == 3 and "alone it has 1.00" in many


def test_a_small_loss_that_is_shown_is_not_said_to_make_no_difference(monkeypatch):
    World(lambda played: 1.0 - (played.subset == "none"), monkeypatch)
    found = audit(Looker(streams=THREE), episodes=100, how=("dropped",))
    removed = deciding(found, "first", "removed")
    assert makes_no_difference(removed)
    removed["difference"] = -0.03
    removed["ci_all"] = [-0.049, -0.007]
    removed["p_holm"] = 0.008
    assert makes_no_difference(removed) and removed["p_holm"] <= LEVEL
    (line,) = [line for line in in_words(found) if line.startswith("First person")]
    assert "-3 points" in line and "makes no difference" not in line


def test_page_and_text_say_the_same_and_load_nothing(monkeypatch):
    World(one_needed, monkeypatch)
    found = audit(Looker(streams=THREE), episodes=60)
    found["policy"] = "<b>bad</b> | name"
    blocks = account(found, "madviz audit --out <x>")
    page, text = html(blocks), markdown(blocks)
    for line in in_words(found):
        assert line in text
    assert "<b>bad</b>" not in page and "--out &lt;x&gt;" in page
    assert "Content-Security-Policy" in page and page.count("<svg") == 2
    assert not re.findall(r"(?:src|href)=\"(?!#)", page.replace("http://www.w3.org", ""))
    assert page == html(account(found, "madviz audit --out <x>"))
    tables = [line for line in text.splitlines() if line.startswith("|")]
    assert len(tables) > 45 and text.count("## ") == 6


def test_a_wrong_folder_or_task_is_refused(monkeypatch, tmp_path):
    World(one_needed, monkeypatch)
    config = AuditConfig("tests.test_audit:make_looker", tmp_path, episodes=10)
    with pytest.raises(UserError, match="expected a policy for metaworld/hammer, found 'looker'"):
        run_audit(replace(config, task="metaworld/hammer"))
    (tmp_path / "audit.json").write_text('{"policy": "another"}')
    with pytest.raises(UserError, match="found one of 'another'; choose another"):
        run_audit(config)
    with pytest.raises(UserError, match="no folder"):
        run_audit(replace(config, out=tmp_path / "not" / "here"))

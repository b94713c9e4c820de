"""The audit: made-up policies whose use of cameras is known, and thousands of made-up outcomes."""

import json
import re
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from madviz.analysis.shapley import shapley
from madviz.auditing import audit as command
from madviz.auditing.audit import AuditConfig, audit, audit_words, run_audit
from madviz.auditing.conditions import HOWS, INTACT, Cameras, Played
from madviz.auditing.page import html, markdown
from madviz.auditing.plan import AuditPlan
from madviz.auditing.rule import (
    LEVEL,
    VERDICTS,
    Look,
    PairedOutcomes,
    judged,
    looks,
    table,
    within,
)
from madviz.auditing.words import in_words, plan_words
from madviz.envs.registry import SETTINGS
from madviz.envs.toy import STEP
from madviz.errors import Interrupted, UserError
from madviz.evaluation.statistics import pair
from madviz.evaluation.store import MEMORY, EpisodeResult, Store
from madviz.subsets import every_mask
from madviz.types import Encoded, PolicySpec, Readout

THREE = SETTINGS["three"].streams
CODES = {name: code for code, name in enumerate(VERDICTS)}


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
    """Plays no episode: success of every ``Played`` at a rate, with the same luck in each scene."""

    def __init__(self, rate, monkeypatch):
        self.rate, self.ran, self.stop_after = rate, 0, 10**9
        monkeypatch.setattr(command, "run_anywhere", self.play)

    def play(self, jobs, workers, here, progress):
        for job in jobs:
            if self.ran == self.stop_after:
                raise KeyboardInterrupt
            self.ran += 1
            luck = np.random.default_rng([job.seed, 1]).random()
            success = bool(luck < self.rate(Played(job.subset, job.occlusions)))
            yield job, (EpisodeResult(job.subset, job.seed, success, success, 0.0), "near")


def lost(played):
    """The cameras that a ``Played`` takes from a policy with three."""
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
        assert asked <= set(row) <= asked | {"above_none"}
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
    plan, store = AuditPlan(cameras, 40, 5000), Store(MEMORY)
    found = audit(Looker("x", THREE), episodes=40, store=store)

    def outcomes(played):
        spec = replace(Looker("x", THREE).spec)
        key = command.Job("", "x", played.subset, played.occlusions, 0).key(spec, "")
        known = store.results(key)
        return {s: known[s].success for s in plan.seeds(found["intact"]["n"])}

    for row, one in zip(found["conditions"], cameras.every(), strict=True):
        paired = pair(outcomes(one.played), outcomes(INTACT))
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


def test_page_and_text_say_the_same_and_load_nothing(monkeypatch):
    World(one_needed, monkeypatch)
    found = audit(Looker(streams=THREE), episodes=60)
    found["policy"] = "<b>bad</b> | name"
    page, text = html(found, "madviz audit --out <x>"), markdown(found, "madviz audit --out <x>")
    for line in in_words(found):
        assert line in text
    assert "<b>bad</b>" not in page and "--out &lt;x&gt;" in page
    assert "Content-Security-Policy" in page and page.count("<svg") == 2
    assert not re.findall(r"(?:src|href)=\"(?!#)", page.replace("http://www.w3.org", ""))
    assert page == html(found, "madviz audit --out <x>")
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


# --- The rule, on thousands of audits at once ---


def simulated(rng, audits, episodes, rates, hard=0.0):
    """Outcomes of ``audits`` at once; ``rates`` of (intact, removed (C,), alone (C,), none).
    ``hard``: how much scenes differ in difficulty, from 0 to 1. Every condition has its luck."""
    intact, removed, alone, none = rates
    scene = rng.beta(0.5, 0.5, (audits, episodes)) - 0.5

    def play(rate):
        spread = hard * 2 * min(rate, 1 - rate)
        return rng.random((audits, episodes)) < rate + spread * scene

    floor = play(none)
    return PairedOutcomes(
        intact=play(intact),
        removed=np.stack([play(rate) for rate in removed], 1),
        alone=np.stack([play(rate) for rate in alone], 1),
        floor=np.stack([floor] * len(removed), 1),
    )


def ended(outcomes, plan):
    """The judgement of every audit at the look where it stops: codes (audits, C), episodes."""
    codes = np.zeros(outcomes.removed.shape[:2], int)
    stopped = np.zeros(len(codes), int)
    for look in plan:
        now, going = judged(outcomes, look), stopped == 0
        codes = np.where(going[:, None], now.verdict, codes)
        done = now.settled.all(-1) | (look == plan[-1])
        stopped = np.where(going & done, look.episodes, stopped)
    return codes, stopped


AUDITS = 1000
NOISE = LEVEL + 2.33 * np.sqrt(LEVEL * (1 - LEVEL) / AUDITS)
"""What 1,000 audits at the promised error rate stay below 99 times in 100."""


@pytest.mark.parametrize("hard", [0.0, 0.9])
@pytest.mark.parametrize("rate", [0.5, 0.8])
@pytest.mark.parametrize("episodes", [40, 100])
def test_an_audit_where_no_camera_matters_claims_something_at_most_5_times_in_100(
    hard, rate, episodes
):
    rng = np.random.default_rng(int(10 * rate) + episodes)
    world = simulated(rng, AUDITS, episodes, (rate, [rate] * 3, [rate] * 3, rate), hard)
    wrong = np.zeros(AUDITS, bool)
    for look in looks(episodes, 3):  # Even if it could stop wherever it suits.
        wrong |= (judged(world, look).verdict != CODES["no use shown"]).any(1)
    assert wrong.mean() <= NOISE


def test_where_one_camera_is_needed_the_others_are_judged_as_rarely_wrongly():
    rng = np.random.default_rng(5)
    world = simulated(rng, AUDITS, 100, (0.9, [0.1, 0.9, 0.9], [0.9, 0.1, 0.1], 0.1))
    codes, _ = ended(world, looks(100, 3))
    assert (codes[:, 0] == CODES["needed"]).mean() > 0.99
    assert (codes[:, 1:] != CODES["no use shown"]).any(1).mean() <= NOISE


def test_looking_often_without_shares_would_break_the_promise():
    """The simulation can tell: every look at the full level is wrong more often."""
    rng = np.random.default_rng(7)
    world = simulated(rng, 4 * AUDITS, 200, (0.5, [0.5] * 3, [0.5] * 3, 0.5))
    greedy = [Look(episodes, LEVEL) for episodes in range(10, 201, 10)]
    wrong = np.zeros(4 * AUDITS, bool)
    for look in greedy:
        wrong |= (judged(world, look).verdict != CODES["no use shown"]).any(1)
    assert wrong.mean() > NOISE


def test_no_difference_is_claimed_of_a_camera_that_costs_5_points_at_most_5_times_in_100():
    rng, plan = np.random.default_rng(9), looks(400, 1)
    world = simulated(rng, AUDITS, 400, (0.95, [0.90], [0.95], 0.05))
    claims = np.zeros(AUDITS, bool)
    _, stopped = ended(world, plan)
    for look in plan:
        seen = world.first(look.episodes)
        claims |= (stopped == look.episodes) & within(table(seen.intact, seen.removed[:, 0]))
    assert claims.mean() <= NOISE


def test_a_clear_case_is_found_and_stops_early():
    rng = np.random.default_rng(11)
    world = simulated(rng, AUDITS, 100, (0.97, [0.02] * 3, [0.05] * 3, 0.05))
    codes, stopped = ended(world, looks(100, 3))
    assert (codes == CODES["needed"]).all() and (stopped == 25).mean() > 0.95


def test_the_four_verdicts():
    def outcomes(*rates):
        return np.array([[i < rate for i in range(100)] for rate in rates])

    world = PairedOutcomes(
        intact=outcomes(90)[0],
        removed=outcomes(40, 60, 90, 89),
        alone=outcomes(10, 10, 80, 12),
        floor=outcomes(10, 10, 10, 10),
    )
    found = judged(world, Look(100, LEVEL))
    assert [VERDICTS[code] for code in found.verdict] == [
        "needed",
        "used",
        "redundant",
        "no use shown",
    ]


def test_a_p_value_counts_the_other_tests_and_the_share_of_its_look():
    rng = np.random.default_rng(13)
    world = simulated(rng, 50, 60, (0.8, [0.6, 0.7, 0.8], [0.5, 0.3, 0.2], 0.2))
    early = judged(world, Look(60, LEVEL / 10))
    for audit_ in range(50):
        tests = []
        for camera in range(3):
            for first, second in (
                (world.intact[audit_], world.removed[audit_, camera]),
                (world.alone[audit_, camera], world.floor[audit_, camera]),
            ):
                tests.append(pair(dict(enumerate(first)), dict(enumerate(second))).mcnemar())
        expected, worst = [0.0] * 6, 0.0
        for rank, place in enumerate(np.argsort(tests)):
            worst = max(worst, (6 - rank) * tests[place])
            expected[place] = min(10 * worst, 1.0)
        found = np.stack([early.p_removed[audit_], early.p_alone[audit_]], 1).ravel()
        assert found == pytest.approx(expected)


def test_the_shares_of_looks_add_up():
    for episodes in (1, 5, 20, 40, 100, 999):
        plan = looks(episodes, 3)
        assert sum(look.share for look in plan) == pytest.approx(LEVEL)
        assert [look.episodes for look in plan] == sorted({look.episodes for look in plan})
        assert plan[-1].episodes == episodes
    assert [look.episodes for look in looks(100, 3)] == [25, 50, 75, 100]
    assert [look.episodes for look in looks(20, 3)] == [15, 20]


def test_the_plan_in_words():
    words = plan_words(100, 0.174)
    assert words.endswith("; a change of 17 points or more is found 8 times in 10.")
    assert "no change of success can be shown" in plan_words(3, float("nan"))


def test_the_docs_say_which_change_is_found():
    text = (Path(__file__).parent.parent / "docs" / "audit.md").read_text()
    episodes, points_ = re.findall(r"^\| (?:episodes of each|change that is).*", text, re.MULTILINE)
    cameras = Cameras(THREE, lambda mask: True)
    for count, found in zip(re.findall(r"\d+", episodes), re.findall(r"\d+", points_), strict=True):
        assert round(100 * AuditPlan(cameras, int(count), 0).detectable) == int(found)


def test_conditions_that_are_the_same_are_played_once():
    two, one = (Cameras(s, lambda mask: True) for s in (("first", "third_b"), ("third_a",)))
    assert len(AuditPlan(two, 10, 0).every) == 16
    assert len(AuditPlan(one, 10, 0).every) == 6
    rgbd = Cameras(SETTINGS["three-rgbd"].streams, lambda mask: True)
    assert len(AuditPlan(rgbd, 10, 0).every) == 36
    assert rgbd.condition("removed", "first", "dropped").played.subset == "third_a+third_b"
    five = Cameras(SETTINGS["five"].streams, lambda mask: True)
    assert len(five.sets()) == 32 and len(AuditPlan(five, 10, 0).every) == 1 + 11 * 5 + 20

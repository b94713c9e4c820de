"""The rule of the audit, on thousands of made-up audits at once: how often it errs, and finds."""

import re
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from madviz.envs.registry import SETTINGS
from madviz.measure.audit.lost_cameras import INTACT, Cameras
from madviz.measure.audit.schedule import AuditPlan
from madviz.measure.audit.sentences import plan_words
from madviz.measure.audit.verdict import (
    LEVEL,
    VERDICTS,
    Look,
    PairedOutcomes,
    judged,
    looks,
    within,
)
from madviz.measure.statistics import pair

THREE = SETTINGS["three"].streams
CODES = {name: code for code, name in enumerate(VERDICTS)}


def simulated(rng, audits, episodes, rates, hard=0.0):
    """Outcomes of ``audits`` at once; ``rates`` of (intact, removed (C,), alone (C,), none).
    ``hard``: how much scenes differ in difficulty, from 0 to 1. Given a scene, the outcomes
    of conditions are independent."""
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


def judged_at(outcomes, look):
    """The judgement at ``look`` of audits that may be longer."""
    seen = {field.name: getattr(outcomes, field.name) for field in fields(outcomes)}
    return judged(PairedOutcomes(**{k: v[..., : look.episodes] for k, v in seen.items()}), look)


def ended(outcomes, plan):
    """The judgement of every audit at the look where it stops: codes (audits, C), episodes."""
    codes = np.zeros(outcomes.removed.shape[:2], int)
    stopped = np.zeros(len(codes), int)
    for look in plan:
        now, going = judged_at(outcomes, look), stopped == 0
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
        wrong |= (judged_at(world, look).verdict != CODES["no use shown"]).any(1)
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
        wrong |= (judged_at(world, look).verdict != CODES["no use shown"]).any(1)
    assert wrong.mean() > NOISE


@pytest.mark.parametrize("cameras", [1, 3, 5])
def test_no_difference_is_claimed_of_cameras_that_cost_5_points_at_most_5_times_in_100(cameras):
    """The claims of one audit together: any of them is an error."""
    rng = np.random.default_rng(9)
    plan = looks(400, cameras)
    world = simulated(rng, AUDITS, 400, (0.95, [0.90] * cameras, [0.95] * cameras, 0.05))
    claims = np.zeros(AUDITS, bool)
    _, stopped = ended(world, plan)
    for look in plan:
        claims |= (stopped == look.episodes) & within(judged_at(world, look).change).any(-1)
    assert claims.mean() <= NOISE


@pytest.mark.parametrize("cameras", [1, 3, 5])
@pytest.mark.parametrize("rate", [0.6, 0.98])
@pytest.mark.parametrize("hard", [0.0, 0.9])
def test_cameras_that_cost_49_percent_are_called_needed_at_most_5_times_in_100(rate, cameras, hard):
    rng = np.random.default_rng(cameras)
    world = simulated(
        rng, AUDITS, 100, (rate, [0.51 * rate] * cameras, [rate] * cameras, 0.05), hard
    )
    codes, _ = ended(world, looks(100, cameras))
    assert (codes == CODES["needed"]).any(-1).mean() <= NOISE
    assert (codes >= CODES["used"]).mean() > 0.9


def test_a_loss_well_beyond_half_is_called_needed():
    rng = np.random.default_rng(17)
    world = simulated(rng, AUDITS, 100, (0.95, [0.25, 0.95, 0.95], [0.9] * 3, 0.05))
    codes, _ = ended(world, looks(100, 3))
    assert (codes[:, 0] == CODES["needed"]).mean() > 0.95


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
        removed=outcomes(20, 44, 90, 89),
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


def test_a_camera_is_settled_by_both_of_its_tests():
    """Without a fall it takes the change within 5 points, and an answer about the camera alone."""
    same = np.ones((1, 400), bool)
    unclear = np.arange(400)[None] % 20 < 1  # Alone 5 % succeed, with no camera 0 %: no 5 points.
    few = np.arange(400)[None] < 8  # 2 %: within 5 points, and not significant.
    some = np.arange(400)[None] < 22  # 5.5 %: significant.
    none = np.zeros((1, 400), bool)
    for alone, floor, settled in (
        (few, none, True),
        (some, none, True),
        (unclear, np.roll(unclear, 1, -1) & (np.arange(400) < 200), False),
    ):
        world = PairedOutcomes(same[0], same, alone, floor)
        assert judged(world, Look(400, LEVEL)).settled[0] == settled
    lost = PairedOutcomes(same[0], np.arange(400)[None] % 2 < 1, none, none)  # Exactly half.
    assert not judged(lost, Look(400, LEVEL)).settled[0]


def test_an_audit_ends_at_the_look_that_settles_all():
    plan = AuditPlan(Cameras(THREE, lambda mask: True), 100, 5000)
    outcomes = {c: dict.fromkeys(range(5000, 5100), c == INTACT) for c in plan.deciding}
    end = plan.stopped(outcomes)
    assert end is not None
    look, judgement = end
    assert judgement.settled.all() and look.episodes == plan.looks[0].episodes < 100
    reached = plan.reached(outcomes)
    assert reached and reached[0] == look, "what was played later does not count"
    assert {seed for _, seed in plan.wanted(outcomes)} == set(range(5000, 5000 + look.episodes))


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
    assert rgbd.row("removed", "first", "dropped").condition.subset == "third_a+third_b"
    five = Cameras(SETTINGS["five"].streams, lambda mask: True)
    assert len(five.sets()) == 32 and len(AuditPlan(five, 10, 0).every) == 1 + 11 * 5 + 20

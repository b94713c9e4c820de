"""``madviz compare P --conditions``: conditions of one policy, on the same seeds."""

import json
from typing import cast

import pytest

from madviz import cli
from madviz.errors import UserError
from madviz.measure.compare import CompareConfig, comparison_table, run_compare
from madviz.measure.compare_conditions import ConditionsFile
from madviz.measure.evaluate import evaluate
from madviz.measure.statistics import pair
from madviz.observation.ablation import Occlusion
from madviz.observation.grammar import parse_condition, parse_what
from tests.fakes import AllOrNothing, FakePolicy

CAMERAS = ("first", "third_a", "third_b")
BLACK, LATE = Occlusion("black"), Occlusion("delay")


def make_picky():
    return AllOrNothing("picky")


@pytest.mark.parametrize(
    ("word", "subset", "occlusions"),
    [
        ("all", "all", {}),
        ("first+third_b", "first+third_b", {}),
        ("none", "none", {}),
        ("black:third_a", "all", {"third_a": BLACK}),
        ("third_a=black", "all", {"third_a": BLACK}),
        ("late:first", "all", {"first": LATE}),
        ("noise:third_b:0.5", "all", {"third_b": Occlusion("noise", 0.5)}),
        ("mean:all", "all", dict.fromkeys(CAMERAS, Occlusion("mean"))),
        ("off:first,black:third_a", "third_a+third_b", {"third_a": BLACK}),
        ("dropped:all", "none", {}),
        ("first+third_a,frozen:first", "first+third_a", {"first": Occlusion("freeze")}),
        ("first,black:all", "first", dict.fromkeys(CAMERAS, BLACK)),
        ("rgb,third_a=black", "rgb", {"third_a": BLACK}),
        ("third_a.rgb+first,third_a=black", "third_a.rgb+first", {"third_a": BLACK}),
    ],
)
def test_conditions_are_read(word, subset, occlusions):
    found = parse_condition(word, CAMERAS)
    assert (found.subset, dict(found.occlusions)) == (subset, occlusions)


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("black:fourth", "unknown camera in the condition 'black:fourth'"),
        ("blak:first", "unknown failure 'blak'"),
        ("black:first,late:first", "expected 'first' once"),
        ("first,off:third_a", "expected one subset of cameras"),
        ("noise:first:2", "expected a number from 0 to 1"),
        ("third_a,third_b=black", "'third_a,third_b=black'.*'third_b', which 'third_a' leaves out"),
        ("third_b=black,first+third_a", "'third_b', which 'first.third_a' leaves out"),
        ("none,black:all", "found 'all', which 'none' leaves out"),
        (
            "first=black@20,third_a=off@20",
            "expected one step, at its end.*found '@20,third_a=off@20",
        ),
        ("first=black@", "expected one step, at its end.*found '@'"),
        ("first=black:0.05", "expected 'black' alone, for it has no strength"),
        ("first=frozen:1", "expected 'freeze' alone"),
        ("first,third_b.pan=45", "to fail or to move, found 'third_b', which 'first' leaves out"),
        ("third_b=off,third_b.pan=45", "found 'third_b', which 'first.third_a' leaves out"),
        ("first.pan=10,first.pan=-10", "expected first.pan once in a condition"),
        ("third_b@20", "as in first=off,third_a=black@20, found the subset 'third_b'; write so"),
        ("all,first=black@20", "dropped or fail at step 20, .*found the subset 'all'"),
        ("first=black,third_a.pan=5@20", "dropped or fail at step 20, .*found one that is moved"),
    ],
)
def test_what_is_no_condition_is_refused(word, said):
    with pytest.raises(UserError, match=said):
        parse_condition(word, CAMERAS)


def test_a_failure_that_would_be_ignored_is_refused_before_anything_is_played(monkeypatch):
    monkeypatch.setattr("madviz.measure.table.run_anywhere", None)
    with pytest.raises(UserError, match="condition 'third_a,third_b=black': .*'third_b'"):
        run_compare(config("all", "third_a,third_b=black"))
    with pytest.raises(UserError, match="a subset with 'third_b', which is occluded, found only"):
        evaluate(FakePolicy(), ["first", "third_a"], occlusions={"third_b": BLACK})


def test_the_words_of_the_page_are_understood():
    assert parse_what("late:0.5") == Occlusion("delay", 0.5)
    assert parse_what("lossy") == Occlusion("dropout")
    assert parse_what("dropped") is None


def config(*conditions, policy="tests.fakes:FakePolicy", **more):
    return CompareConfig((policy,), conditions=conditions, episodes=6, seed=7, workers=0, **more)


def test_conditions_are_compared_on_the_same_seeds():
    result = cast(ConditionsFile, run_compare(config("all", "black:third_a", "first")))
    assert [row["second"] for row in result["comparisons"]] == ["black:third_a", "first"]
    intact = evaluate(FakePolicy(), ("all", "first"), episodes=6, seed=7)
    black = evaluate(
        FakePolicy(), ("all",), episodes=6, seed=7, occlusions={"third_a": Occlusion("black")}
    )
    for row, other in zip(
        result["comparisons"], (black.outcomes("all"), intact.outcomes("first")), strict=True
    ):
        paired = pair(intact.outcomes("all"), other)
        assert (row["difference"], row["n"]) == (paired.difference, 6)
        assert row["ci95"] == list(paired.interval()) and row["p"] == paired.mcnemar()
    assert json.loads(json.dumps(result)) == result
    words = comparison_table(result)
    assert "all minus black:third_a, paired by seed" in words and "exact p = " in words


def test_what_cannot_be_compared_is_refused_before_anything_is_played(monkeypatch):
    monkeypatch.setattr("madviz.measure.table.run_anywhere", None)
    with pytest.raises(UserError, match="picky cannot act on 'first'"):
        run_compare(config("all", "first", policy="tests.test_conditions:make_picky"))
    with pytest.raises(
        UserError, match="before step 25, where toy/reach ends, found one at step 25"
    ):
        run_compare(config("all", "first=black@25"))
    with pytest.raises(UserError, match="expected two or more conditions"):
        run_compare(config("all"))
    with pytest.raises(UserError, match="expected one policy with --conditions, found 2"):
        run_compare(CompareConfig(("a", "b"), conditions=("all", "none")))
    with pytest.raises(UserError, match="--subset is about policies"):
        run_compare(config("all", "none", subset=("all",)))


def test_the_command_line(capsys):
    words = "compare tests.fakes:FakePolicy --conditions all black:third_a late:first"
    assert cli.main([*words.split(), "--episodes", "2", "--workers", "0"]) == 0
    assert capsys.readouterr().out.count("paired by seed") == 2

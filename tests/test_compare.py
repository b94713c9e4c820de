"""``compare``: paired by seed, refused where it cannot be."""

from __future__ import annotations

import json
import xml.etree.ElementTree as xml
from pathlib import Path
from typing import Any

import pytest

from madviz import cli
from madviz.errors import UserError
from madviz.measure.compare import CompareConfig, compare_policies, comparison_table
from madviz.measure.evidence import read_evidence
from madviz.measure.statistics import pair
from madviz.measure.store import EpisodeResult, ResultKey, Store
from madviz.plots import figures
from madviz.policies.checkpoint import save_policy
from tests.checkpoints import make_agent, make_config
from tests.evidence import rates, write_policy

GOOD, BAD = rates(0.95, 0.9, 0.85, 0.8), rates(0.9, 0.2, 0.1, 0.0)


@pytest.fixture
def two(tmp_path: Path) -> tuple[str, str]:
    return (
        str(write_policy(tmp_path, GOOD)),
        str(write_policy(tmp_path, BAD, method="merged-only")),
    )


def test_differences_are_those_of_the_paired_episodes(two: tuple[str, str]) -> None:
    result = compare_policies(CompareConfig(two))
    assert [p["method"] for p in result["policies"]] == ["mad", "merged-only"]
    rows = result["comparisons"][0]["subsets"]
    assert list(rows) == ["all", "first", "third_a", "third_b"]
    first, second = read_evidence(two[0]), read_evidence(two[1])
    paired = pair(first.outcomes["all"], second.outcomes["all"])
    row = rows["all"]
    assert (row["first"], row["second"], row["n"]) == (0.95, 0.9, 100)
    assert row["difference"] == pytest.approx(0.05)
    assert (tuple(row["ci95"]), row["p"]) == (paired.interval(), paired.mcnemar())
    assert rows["third_b"]["p"] < 1e-20 and rows["third_b"]["ci95"][0] > 0.6
    words = comparison_table(result)
    assert "0.95 - 0.90 = +0.05 [" in words and "n=100   exact p = " in words
    assert (row["seeds"], row["use"]) == ((5000, 5099), "development")
    assert words.count("seeds 5000-5099, development") == 4


def test_only_the_subsets_asked_for(two: tuple[str, str]) -> None:
    result = compare_policies(CompareConfig(two, ("first",)))
    assert list(result["comparisons"][0]["subsets"]) == ["first"]
    with pytest.raises(UserError, match="expected episodes on 'none' of every policy"):
        compare_policies(CompareConfig(two, ("none",)))


@pytest.mark.parametrize("change", [{"episodes": 50}, {"first_seed": 6000}])
def test_policies_that_met_other_seeds_are_refused(change: dict[str, Any], tmp_path: Path) -> None:
    first = str(write_policy(tmp_path, GOOD))
    second = str(write_policy(tmp_path, BAD, method="merged-only", **change))
    with pytest.raises(UserError, match=r"same seeds for all, found 5000-5099 \(100\) of .*eval"):
        compare_policies(CompareConfig((first, second)))


@pytest.mark.parametrize(
    ("key", "value", "fact"),
    [
        ("task", "metaworld/push", "task"),
        ("definition", "at any step: it is done", "definition"),
        ("render_profile", "full", "render profile"),
    ],
)
def test_policies_that_were_measured_otherwise_are_refused(
    key: str, value: str, fact: str, two: tuple[str, str]
) -> None:
    file = Path(two[1]) / "config.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), key: value}))
    with pytest.raises(UserError, match=f"expected policies measured alike, found {fact}"):
        compare_policies(CompareConfig(two))


def test_one_policy_is_nothing_to_compare(two: tuple[str, str]) -> None:
    with pytest.raises(UserError, match="expected two or more policies, found 1"):
        compare_policies(CompareConfig(two[:1]))
    with pytest.raises(UserError, match="unknown policy 'no-such-policy'"):
        compare_policies(CompareConfig((two[0], "no-such-policy")))


def test_a_policy_that_was_not_evaluated_is_named_with_the_command(tmp_path: Path) -> None:
    evaluated = write_policy(tmp_path, GOOD)
    fresh = save_policy(tmp_path / "fresh", make_agent(), make_config())
    with pytest.raises(UserError, match=f"run `madviz eval --policy {fresh} --card`"):
        compare_policies(CompareConfig((str(evaluated), str(fresh))))


@pytest.mark.parametrize(
    ("stored", "asked"), [("none", "none"), ("first+third_a", "third_a+first")]
)
def test_episodes_may_come_from_a_store(
    two: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stored: str, asked: str
) -> None:
    from madviz.policies import checkpoint

    class Described:
        def __init__(self, path: str | Path) -> None:
            self.spec = self
            self.digest = Path(path).name

    monkeypatch.setattr(checkpoint, "describe", Described)
    store, facts = Store(tmp_path / "store.sqlite"), ("fast", "", stored)
    for policy, successes in zip(two, (3, 1), strict=True):
        evidence = read_evidence(policy)
        key = ResultKey(Path(policy).name, evidence.config.task, evidence.config.definition, *facts)
        for seed in range(4):
            store.put(key, EpisodeResult(stored, seed, seed < successes, True, 0.0, seed / 12))
    store.close()
    result = compare_policies(CompareConfig(two, (asked,), store=str(tmp_path / "store.sqlite")))
    assert [policy.get("outside") for policy in result["policies"]] == [0.125, 0.125]
    assert result["comparisons"][0]["subsets"][asked]["difference"] == 0.5
    with pytest.raises(UserError, match="expected episodes on 'fourth' of every policy"):
        compare_policies(CompareConfig(two, ("fourth",), store=str(tmp_path / "store.sqlite")))
    with pytest.raises(UserError, match="expected a store of results"):
        compare_policies(CompareConfig(two, store=str(tmp_path / "none.sqlite")))
    other = Path(two[0]) / "evaluation.json"
    before = other.read_bytes()
    with pytest.raises(UserError, match="expected a store of results, found another file"):
        compare_policies(CompareConfig(two, store=str(other)))
    assert other.read_bytes() == before, "what is only read is not changed"


def test_trainings_that_agree_have_an_interval(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three that always succeed are no proof that the fourth does."""
    drawn: dict[str, list[figures.Bar]] = {}
    monkeypatch.setattr(figures, "bars", lambda title, groups, series: drawn.update(series) or "")
    policies = [
        str(write_policy(tmp_path, {"all": 1.0}, seed=seed, folder=f"mad{seed}"))
        for seed in (1, 2, 3)
    ]
    compare_policies(CompareConfig(tuple(policies), figure=tmp_path / "figure.svg"))
    ((bar,),) = drawn.values()
    assert (bar.value, bar.high) == (1.0, 1.0) and 0.95 < bar.low < 0.99


def test_the_figure_has_a_bar_for_a_method_and_a_dot_for_a_training(tmp_path: Path) -> None:
    policies = [
        str(write_policy(tmp_path, {"all": 0.5 + seed / 10}, seed=seed, folder=f"mad{seed}"))
        for seed in (1, 2, 3)
    ]
    policies.append(str(write_policy(tmp_path, {"all": 0.4}, method="merged-only")))
    figure = tmp_path / "figure.svg"
    result = compare_policies(CompareConfig(tuple(policies), figure=figure))
    assert len(result["comparisons"]) == 3
    drawn = figure.read_text()
    xml.fromstring(drawn)
    assert drawn.count('class="dot"') == 3 and "merged-only (three, light)" in drawn
    compare_policies(CompareConfig(tuple(policies), figure=figure))
    assert figure.read_text() == drawn


def test_policies_of_other_cameras_or_merges_are_no_trainings_of_one_method(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: dict[str, list[figures.Bar]] = {}
    monkeypatch.setattr(figures, "bars", lambda title, groups, series: drawn.update(series) or "")
    for number, changed in enumerate(({"camera": "first"}, {"camera": "third_a"}, {})):
        folder = write_policy(tmp_path, {"all": 0.5}, method="single", folder=f"one{number}")
        config = json.loads((folder / "config.json").read_text())
        (folder / "config.json").write_text(json.dumps({**config, **changed}))
    folders = tuple(str(tmp_path / f"one{number}") for number in range(3))
    compare_policies(CompareConfig(folders, figure=tmp_path / "figure.svg"))
    assert list(drawn) == [
        f"single (three, {camera}light)" for camera in ("first, ", "third_a, ", "")
    ]


def test_trainings_with_other_options_are_not_drawn_as_one_method(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: dict[str, list[figures.Bar]] = {}
    monkeypatch.setattr(figures, "bars", lambda title, groups, series: drawn.update(series) or "")
    said = ("", "--light.workers 2", "--light.rounds 20 --light.alpha 0.25", "--light.rounds 20")
    for number, words in enumerate(said):
        folder = write_policy(tmp_path, {"all": 0.5}, folder=f"run{number}")
        config = json.loads((folder / "config.json").read_text())
        config["training"] |= {"alpha": 0.25, "command": f"madviz train {words} --seed {number}"}
        (folder / "config.json").write_text(json.dumps(config))
    folders = tuple(str(tmp_path / f"run{number}") for number in range(4))
    compare_policies(CompareConfig(folders, figure=tmp_path / "figure.svg"))
    label = "mad (three, light, alpha 0.25)"
    assert {name: len(bars[0].dots) for name, bars in drawn.items()} == {
        f"{label}: the usual options": 2,
        f"{label}: rounds 20": 2,
    }


def test_curves_need_success_by_subset(two: tuple[str, str], tmp_path: Path) -> None:
    figure = tmp_path / "curves.svg"
    (Path(two[0]) / "curve.csv").write_text("round,student_success\n1,0.5\n")
    with pytest.raises(UserError, match="only the recipe `paper` measures it"):
        compare_policies(CompareConfig(two, curves=figure))
    for policy in two:
        (Path(policy) / "curve.csv").write_text(
            "env_steps,success_all,success_first,return_all\n0,0.0,0.0,1\n100,1.0,0.5,9\n"
        )
    compare_policies(CompareConfig(two, curves=figure))
    drawn = figure.read_text()
    assert drawn.count('class="line"') == 6  # Two methods; all, first and their average.
    assert ">average<" in drawn and ">100<" in drawn


def test_curves_have_what_all_trainings_measured(tmp_path: Path) -> None:
    runs = [write_policy(tmp_path, {"all": 0.5}, folder=f"run{n}") for n in range(2)]
    (runs[0] / "curve.csv").write_text("env_steps,success_all,success_first\n100,0.5,0.5\n")
    (runs[1] / "curve.csv").write_text("env_steps,success_all\n100,0.5\n")
    figure = tmp_path / "curves.svg"
    asked = CompareConfig(tuple(map(str, runs)), curves=figure)
    compare_policies(asked)
    drawn = figure.read_text()
    assert ">all<" in drawn and ">first<" not in drawn and ">average<" not in drawn
    (runs[1] / "curve.csv").write_text("env_steps,success_all\n200,0.5\n")
    with pytest.raises(UserError, match="measured at the same steps, found none"):
        compare_policies(asked)


def test_the_command(two: tuple[str, str], capsys: Any) -> None:
    assert cli.main(["compare", *two, "--subset", "all", "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["schema"] == 1
    assert cli.main(["compare", *two]) == 0
    assert "paired by seed" in capsys.readouterr().out

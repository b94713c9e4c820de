"""Development seeds and reporting seeds: which is which, and that they are never mixed."""

from __future__ import annotations

import importlib
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks.guard_trial import note_trial
from benchmarks.imagine import ImagineConfig, bench_imagine
from madviz import cli
from madviz.agent.agent import Agent
from madviz.agent.networks import NetworkConfig
from madviz.envs.registry import SETTINGS
from madviz.envs.toy import ToyReach
from madviz.errors import UserError
from madviz.measure.compare import CompareConfig, run_compare
from madviz.measure.episodes import Runner
from madviz.measure.evaluate import EvalConfig, run_eval
from madviz.measure.evidence import find_evidence, read_evidence
from madviz.measure.readings import LEDGER, note_reading, readings
from madviz.policies import checkpoint
from madviz.policies.config import TrainingRecord, policy_config
from madviz.policies.seeds import seeds_from, training_seed, use_of
from madviz.report.results import ReportConfig, run_report
from madviz.report.rows import difference
from madviz.report.threshold import judge
from madviz.types import PolicySpec
from tests.evidence import rates, write_policy
from tests.reports import GOOD, report, table

STREAMS = SETTINGS["three"].streams
ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def toy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A policy that nobody trained, measured on two development seeds; the folder is current."""
    monkeypatch.chdir(tmp_path)
    torch.manual_seed(0)
    networks = NetworkConfig(state_dim=6, action_dim=2, hidden_dim=8)
    spec = PolicySpec("toy", "toy/reach", "mad", "three", "light", STREAMS, ("all", *STREAMS))
    config = policy_config(spec, ToyReach().spec, networks, TrainingRecord(command="madviz train"))
    folder = checkpoint.save_policy(tmp_path / "policies" / "toy", Agent(networks), config)
    run_eval(EvalConfig(str(folder), ("all", "first"), 2, 5000, workers=0, card=True))
    return folder


def move_to_reporting(path: Path, measured: dict[str, float]) -> None:
    """As ``report --evaluate`` leaves a folder, with any rates one likes."""
    fresh = write_policy(path.parent / "fresh", measured, first_seed=40_000)
    (path / "evaluation.json").rename(path / "development.json")
    shutil.copy(fresh / "evaluation.json", path / "evaluation.json")
    shutil.rmtree(path.parent / "fresh")


def test_no_more_seeds_are_asked_for_than_a_use_has() -> None:
    assert seeds_from(1000, 1000) == range(1000, 2000)
    assert seeds_from(1_000_000, 5_000_000).stop == 6_000_000
    with pytest.raises(UserError, match="1000 episodes or fewer, .* 0 to 999 .training., found 1"):
        bench_imagine(ImagineConfig(episodes=1001))


def test_every_seed_has_one_use() -> None:
    ends = "0 999 1000 2000 4999 5000 9999 10000 39999 40000 49999 50000 60000 999999 1000000"
    seeds = map(int, ends.split())
    assert [use_of([seed]) for seed in seeds] == [
        "training",
        "training",
        "selection",
        "live page",
        "live page",
        "development",
        "development",
        "development (read)",
        "development (read)",
        "reporting",
        "reporting",
        "unused",
        "try",
        "try",
        "reinforcement learning",
    ]
    assert use_of([40_000, 5000]) == "development and reporting" and use_of([]) == ""


def test_episodes_of_an_expert_have_training_seeds() -> None:
    assert [training_seed(3, number) for number in (0, 5, 588, 589)] == [411, 416, 999, 0]
    for seed in (0, 1, 2**31 - 1):
        seeds = [training_seed(seed, number) for number in range(1000)]
        assert len(set(seeds)) == 1000 and use_of(seeds) == "training"


@pytest.mark.parametrize("first", [900, 4999, 9990, 39_990, 50_000])
def test_a_report_refuses_seeds_that_serve_something_else(tmp_path: Path, first: int) -> None:
    write_policy(tmp_path, GOOD, first_seed=first)
    with pytest.raises(UserError, match="expected seeds of one use that rates may have"):
        run_report(ReportConfig(tmp_path))


def test_development_json_holds_development_seeds_alone(tmp_path: Path) -> None:
    path = write_policy(tmp_path, GOOD, first_seed=40_000)
    shutil.copy(path / "evaluation.json", path / "development.json")
    with pytest.raises(UserError, match="found seeds for reporting and for reporting"):
        run_report(ReportConfig(tmp_path))


def test_a_row_without_fresh_seeds_is_compared_on_development_seeds(tmp_path: Path) -> None:
    path = write_policy(tmp_path, rates(0.5, 0.5, 0.5, 0.5))
    write_policy(tmp_path, GOOD, method="merged-only")
    move_to_reporting(path, rates(1, 1, 1, 1))
    overall = table(tmp_path, "overall")
    found = overall.averages[0].rate("all")
    assert found is not None and found.value == 0.5
    assert {row.seeds for row in overall.averages} == {"development"}
    _, text = report(tmp_path)
    (twenty,) = (line for line in text.splitlines() if line.startswith("| metaworld/hammer | 1.00"))
    assert "| reporting | met |" in twenty
    assert "*Development seeds*" in text and "*Reporting seeds*" in text
    run_compare(CompareConfig((str(path), str(tmp_path / "metaworld-hammer-merged-only-light"))))


def test_no_policy_is_chosen_on_reporting_seeds(tmp_path: Path) -> None:
    """Of two that a task has, the one that is better on development seeds stands for it."""
    for name, before, fresh in (("one", 0.9, 0.5), ("other", 0.8, 1.0)):
        path = write_policy(tmp_path, rates(before, before, before, before), folder=name)
        move_to_reporting(path, rates(fresh, fresh, fresh, fresh))
    row = judge("metaworld/hammer", find_evidence(tmp_path)[0]).row
    assert row is not None and row.evidence[0].folder == "one" and row.seeds == "reporting"


def test_rows_that_all_have_fresh_seeds_are_compared_on_them(tmp_path: Path) -> None:
    for method in ("mad", "merged-only"):
        path = write_policy(tmp_path, GOOD, method=method)
        move_to_reporting(path, rates(1, 1, 1, 1))
    assert {row.seeds for row in table(tmp_path, "overall").averages} == {"reporting"}
    assert "*Development seeds*" not in report(tmp_path)[1]


def test_an_average_is_of_one_kind_of_seeds(tmp_path: Path) -> None:
    for task in ("hammer", "push", "soccer"):
        path = write_policy(tmp_path, GOOD, task=f"metaworld/{task}")
        if task != "soccer":
            move_to_reporting(path, rates(1, 1, 1, 1))
            document = json.loads((path / "config.json").read_text())
            assert document["task"] == f"metaworld/{task}"
    _, text = report(tmp_path)
    (average,) = (line for line in text.splitlines() if "average of" in line)
    assert average.startswith("| average of 2 in metaworld | 1.00") and "| reporting |" in average


def test_report_evaluates_on_fresh_seeds_and_moves_the_old_figures(toy: Path) -> None:
    before = (toy / "evaluation.json").read_bytes()
    words = ["report", "--folder", str(toy.parent), "--evaluate", "--episodes", "2"]
    assert cli.main([*words, "--workers", "0"]) == 0
    assert (toy / "development.json").read_bytes() == before
    evidence = read_evidence(toy)
    assert evidence.seeds == "reporting" and evidence.first_seed == 40_000
    assert {subset: len(found) for subset, found in evidence.outcomes.items()} == {
        "all": 2,
        "first": 2,
    }
    assert "Reporting seeds 40000 to 40001" in (toy / "card.md").read_text()


def test_an_evaluation_that_was_stopped_goes_on(toy: Path, monkeypatch: Any) -> None:
    run, seeds = Runner.run, []

    def stopped(runner: Any, job: Any) -> Any:
        if len(seeds) == 3:
            raise KeyboardInterrupt
        seeds.append((job.condition.subset, job.seed))
        return run(runner, job)

    monkeypatch.setattr(Runner, "run", stopped)
    config = ReportConfig(toy.parent, evaluate=True, episodes=2, workers=0)
    with pytest.raises(KeyboardInterrupt):
        run_report(config)
    assert read_evidence(toy).seeds == "development", "files change when all is there"
    seeds.clear()
    run_report(config)
    assert len(seeds) == 1, "three of four episodes were there"
    run_report(config)
    assert len(seeds) == 1, "a policy that is done is passed over"


def test_a_later_look_at_development_seeds_leaves_the_reported_figures(toy: Path) -> None:
    run_report(ReportConfig(toy.parent, evaluate=True, episodes=2, workers=0))
    reported = (toy / "evaluation.json").read_bytes()
    run_eval(EvalConfig(str(toy), ("none",), 2, 5000, workers=0, card=True))
    assert (toy / "evaluation.json").read_bytes() == reported
    assert list(read_evidence(toy).development) == ["all", "first", "none"]


def test_figures_in_readme_pool_trainings_on_alike_seeds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first training was counted on reporting seeds later; the others have no weights."""
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    tool, files = map(importlib.import_module, ("fill_figures", "policy_files"))
    monkeypatch.setattr(files, "ROOT", tmp_path)
    shown = write_policy(tmp_path / "checkpoints", rates(0.5, 0.5, 0.5, 0.5), folder="shown")
    move_to_reporting(shown, rates(1, 1, 1, 1))
    for seed, rate in ((2, 0.6), (3, 0.7)):
        tried = rates(rate, rate, rate, rate)
        write_policy(tmp_path / "results/tables", tried, seed=seed, folder=f"row-{seed}")
    write_policy(
        tmp_path / "results/tables", GOOD, method="vib", merge="vib", folder="metaworld-hammer-vib"
    )
    files.policies.cache_clear()
    rows = files.methods("metaworld/hammer")
    count = tool.count(files.row("shown"))
    files.policies.cache_clear()
    assert rows["mad"].trainings == 3 and rows["mad"].seeds == "development"
    assert files.rates(rows["mad"], ["all"])[0].startswith("0.60 [")
    gap = difference(rows["vib"], rows["mad"], ["all"])
    assert str(gap).startswith("+45 points"), "of one training"
    assert count == "n = 100, reporting seeds"


@pytest.fixture
def ledger(toy: Path) -> Path:
    """A ledger beside the policy, which the repository then shows."""
    toy.parent.rename(toy.parent.parent / "checkpoints")
    file = toy.parent.parent / LEDGER
    file.parent.mkdir()
    file.write_text("date,policy,task,digest,first,last\n")
    return file


def test_a_reading_of_reporting_seeds_is_written_down_and_told(ledger: Path) -> None:
    shown = ledger.parent.parent / "checkpoints"
    run_eval(EvalConfig(str(shown / "toy"), ("all",), 2, 60_000, workers=0, card=True))
    assert readings(shown / "toy") == [], "other seeds are nobody's business"
    config = ReportConfig(shown, evaluate=True, episodes=2, workers=0)
    run_report(config)
    (row,) = readings(shown / "toy")
    digest = checkpoint.describe(shown / "toy").spec.digest
    assert row[1:] == ("toy", "toy/reach", digest, 40_000, 40_001)
    run_report(config)
    assert len(readings(shown / "toy")) == 1, "a policy that is done is passed over"


def test_a_trial_of_the_guard_is_one_reading_however_often_it_goes_on(ledger: Path) -> None:
    folder = ledger.parent.parent / "checkpoints" / "toy"
    for seeds in (range(5_000, 5_005), range(45_000, 45_005), range(45_000, 45_005)):
        note_trial(str(folder), seeds)
    assert [row[-2:] for row in readings(folder)] == [(45_000, 45_004)]


def test_a_reading_that_lies_in_the_reporting_seeds_in_part_counts(ledger: Path) -> None:
    folder = ledger.parent.parent / "checkpoints" / "toy"
    note_reading(folder, "toy", "toy/reach", "d", range(39_998, 40_002))
    assert [row[-2:] for row in readings(folder)] == [(40_000, 40_001)]


def test_only_policies_that_the_repository_shows_are_in_its_ledger(ledger: Path) -> None:
    elsewhere = ledger.parent.parent / "runs" / "toy"
    shutil.copytree(ledger.parent.parent / "checkpoints" / "toy", elsewhere)
    run_eval(EvalConfig(str(elsewhere), ("all",), 1, 40_000, workers=0, card=True))
    assert readings(elsewhere) == [] and ledger.read_text().count("\n") == 1


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([], "No ledger says how often"),
        ([("a", 40_000, 40_099)], "read once (readings.csv): the seeds were untouched"),
        ([("a", 40_000, 40_099), ("a", 40_050, 40_059)], "(read 2 times)"),
        ([("b", 40_000, 40_099), ("a", 40_000, 40_099)], "not untouched: other weights were read"),
        ([("b", 10_000, 10_099), ("a", 40_000, 40_099)], "the seeds were untouched"),
        ([("a", 45_000, 45_004), ("a", 40_000, 40_099)], "the seeds were untouched"),
        ([("b", 45_000, 45_004), ("a", 40_000, 40_099)], "not untouched: other weights were read"),
    ],
)
def test_a_range_that_was_read_before_is_not_called_untouched(
    tmp_path: Path, rows: list[tuple[str, int, int]], words: str
) -> None:
    path = write_policy(tmp_path / "checkpoints", GOOD, first_seed=40_000)
    file = tmp_path / LEDGER
    file.parent.mkdir()
    name = json.loads((path / "config.json").read_text())["name"]
    lines = [f"2026-12-01,{name},metaworld/hammer,{digest},{a},{b}" for digest, a, b in rows]
    file.write_text("\n".join(["date,policy,task,digest,first,last", *lines, ""]))
    _, text = report(tmp_path / "checkpoints")
    assert words in text
    assert ("seeds were untouched" in text) == ("seeds were untouched" in words)


def test_policies_are_compared_on_seeds_that_all_have(tmp_path: Path) -> None:
    for method in ("mad", "merged-only"):
        write_policy(tmp_path, GOOD, method=method, first_seed=60_000)
    path = tmp_path / "metaworld-hammer-mad-light"
    move_to_reporting(path, GOOD)
    assert {row.seeds for row in table(tmp_path, "overall").averages} == {"try"}


def test_what_ships_keeps_the_rule() -> None:
    found, _ = find_evidence(ROOT / "checkpoints", ROOT / "results")
    assert {each.seeds for each in found} <= {"development", "development (read)", "reporting"}
    bare = [each for each in found if not (each.path / checkpoint.WEIGHTS).is_file()]
    assert {each.seeds for each in bare} == {"development"}

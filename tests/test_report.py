"""``report``: what is read, and tables that say what the files say."""

from __future__ import annotations

import csv
import json
import re
import xml.etree.ElementTree as xml
from pathlib import Path
from typing import Any

import pytest

from madviz import cli
from madviz.errors import UserError
from madviz.measure.evidence import find_evidence, read_evidence
from madviz.measure.statistics import SuccessRate, difference_interval
from madviz.report.layouts import THREE
from madviz.report.results import ReportConfig, run_report
from madviz.report.rows import Row, difference
from madviz.report.sweeps import FIRST_LINE
from madviz.report.tables import usual_alphas
from tests.evidence import rates, write_policy
from tests.reports import GOOD, average, every_table, report, table

# --- What is read ---


def test_a_rate_that_is_not_that_of_its_episodes_is_refused(tmp_path: Path) -> None:
    path = write_policy(tmp_path, GOOD)
    file = path / "evaluation.json"
    document = json.loads(file.read_text())
    document["subsets"]["all"]["success"] = 0.99
    file.write_text(json.dumps(document))
    with pytest.raises(UserError, match="rate of all to be that of its episodes, found 0.99"):
        read_evidence(path)
    del document["episodes"]
    file.write_text(json.dumps(document))
    with pytest.raises(UserError, match="expected 'episodes', found none"):
        read_evidence(path)


def test_an_evaluation_of_other_weights_is_refused(tmp_path: Path) -> None:
    path = write_policy(tmp_path, GOOD)
    (path / "weights.safetensors").write_bytes(b"other")
    with pytest.raises(UserError, match="expected an evaluation of these weights"):
        run_report(ReportConfig(tmp_path))


def test_one_camera_goes_by_two_names(tmp_path: Path) -> None:
    path = write_policy(tmp_path, {"all": 0.5}, method="single", streams=("third_a",))
    evidence = read_evidence(path)
    assert evidence.of("third_a") == evidence.of("all") and evidence.of("first") is None
    assert (evidence.first_seed, evidence.episodes, evidence.seed) == (5000, 100, 1)


def test_a_folder_without_policies_is_a_mistake(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="expected policy folders with evaluation.json"):
        run_report(ReportConfig(tmp_path))


# --- Tables ---


def test_the_report_comes_out_the_same_to_the_byte(tmp_path: Path) -> None:
    for method, measured in (("mad", GOOD), ("merged-only", rates(0.95, 0.1, 0.0, 0.0))):
        write_policy(tmp_path, measured, method=method)
    (tmp_path / "pictures").mkdir()
    (tmp_path / "sweeps").mkdir()
    own = (tmp_path / "pictures" / "mine.svg", tmp_path / "sweeps" / "mine.toml")
    for file in own:
        file.write_text("of somebody else")
    result, text = report(tmp_path)
    written = {path: path.read_bytes() for path in tmp_path.rglob("*.[sct][vos][gvm]*")}
    assert result["tables"] == ["overall-metaworld"]
    (tmp_path / "pictures" / "five-maniskill.svg").write_text("of a table that is gone")
    (tmp_path / "sweeps" / "five.toml").write_text(f"{FIRST_LINE}\n")
    again, same_text = report(tmp_path)
    assert (again, same_text) == (result, text)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.[sct][vos][gvm]*")} == written
    assert [Path(name).name for name in result["pictures"]] == [
        "twenty.svg",
        "overall-metaworld.svg",
    ]
    for name in result["pictures"]:
        xml.fromstring(Path(name).read_text())
        assert f"](pictures/{Path(name).name})" in text
    assert not (tmp_path / "sweeps" / "five.toml").exists()
    assert all(file.read_text() == "of somebody else" for file in own)


def test_pictures_come_before_tables_and_a_table_has_one_command(tmp_path: Path) -> None:
    for method in ("mad", "merged-only"):
        write_policy(tmp_path, GOOD, method=method)
    _, text = report(tmp_path)
    assert text.index("](pictures/twenty.svg)") < text.index("## How to read") < text.index("\n|")
    for section in text.split("\n## ")[2:]:
        assert section.count("madviz sweep ") == 1 and "madviz train" not in section


def test_every_rate_is_a_line_of_the_csv(tmp_path: Path) -> None:
    for method in ("mad", "merged-only"):
        for task in ("metaworld/hammer", "metaworld/push"):
            write_policy(tmp_path, GOOD, task=task, method=method)
    report(tmp_path)
    lines = list(csv.DictReader((tmp_path / "rates.csv").read_text().splitlines()))
    assert len(lines) == 4 * (2 + 4 + 2)  # Two of the twenty; four rows; two averages.
    average = next(line for line in lines if line["task"] == "average of 2")
    assert (average["subset"], average["success"], average["n"]) == ("all", "0.9500", "200")
    assert (average["seeds"], average["weights"]) == ("development", "no")


def test_the_shipped_report_joins_policies_with_weights_and_without(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_policy(tmp_path / "checkpoints", GOOD)
    write_policy(tmp_path / "results" / "tables", GOOD, method="merged-only")
    result = run_report(ReportConfig())
    assert (result["path"], result["policies"]) == ("results/RESULTS.md", 2)
    assert "Generated by `madviz report` from" in Path(result["path"]).read_text()


def test_tables_without_files_are_left_out(tmp_path: Path) -> None:
    write_policy(tmp_path, GOOD)
    assert report(tmp_path)[0]["tables"] == []
    write_policy(tmp_path, {"all": 0.9, "rgb": 0.9, "depth": 0.8}, setting="three-rgbd", folder="x")
    result, text = report(tmp_path)
    assert result["tables"] == ["modality-metaworld"]
    assert "| metaworld/hammer | mad, three-rgbd | 1 | 0.90 [0.83, 0.94] n=100 |" in text
    assert "modality-metaworld.svg" in text


def test_trainings_of_several_seeds_pool_and_tasks_weigh_alike(tmp_path: Path) -> None:
    for seed, rate in ((1, 1.0), (2, 0.5)):
        write_policy(tmp_path, {"all": rate}, seed=seed, folder=f"hammer{seed}")
    write_policy(tmp_path, {"all": 0.3}, task="metaworld/push")
    for task in ("metaworld/hammer", "metaworld/push"):
        write_policy(tmp_path, {"all": 0.1}, task=task, method="naive-both")
    overall = table(tmp_path, "overall")
    hammer = overall.rows[0][1]
    found = hammer.rate("all")
    assert found is not None and (hammer.trainings, found.value, found.n) == (2, 0.75, 200)
    # Over trainings too: one had 0.5 and one 1.0, so the next may have either.
    assert found.interval[0] < 0.5 and found.interval[1] > 0.99
    whole = overall.averages[0]
    assert whole.tasks == ("metaworld/hammer", "metaworld/push")
    # One training of each task: (1.0 + 0.3) / 2.
    assert (
        "| average of 2 in metaworld | mad | 1 | 0.65 [0.58, 0.71] n=200 |" in report(tmp_path)[1]
    )


def test_an_average_takes_the_episodes_that_a_tasks_rows_share(tmp_path: Path) -> None:
    write_policy(tmp_path, rates(1, 1, 1, 1), episodes=200)
    write_policy(tmp_path, rates(1, 1, 1, 1), method="naive-both", episodes=50)
    for method in ("mad", "naive-both"):
        write_policy(tmp_path, rates(0, 0, 0, 0), task="metaworld/push", method=method, episodes=50)
    for row in table(tmp_path, "overall").averages:
        found = row.rate("all")
        assert found is not None and (found.value, found.n) == (0.5, 100)


def test_a_task_with_more_episodes_weighs_no_more_in_an_average(tmp_path: Path) -> None:
    for method in ("mad", "naive-both"):
        write_policy(tmp_path, rates(1, 1, 1, 1), method=method, episodes=200)
        write_policy(tmp_path, rates(0, 0, 0, 0), task="metaworld/push", method=method, episodes=50)
    for row in table(tmp_path, "overall").averages:
        found = row.rate("all")
        assert found is not None and (found.value, found.n) == (0.5, 100)


def test_trainings_that_meet_the_same_scenes_are_no_independent_episodes() -> None:
    """Three that agree in every scene say as much as one."""
    units = [("push", training, seed) for training in (1, 2, 3) for seed in range(50)]
    row = Row("a", {name: {unit: unit[2] < 48 for unit in units} for name in ("all", "first")})
    other = Row("b", {name: {unit: unit[2] < 40 for unit in units} for name in ("all", "first")})
    rate, mean = row.rate("all"), row.mean(["all", "first"])
    found = difference(row, other, ["all", "first"])
    assert rate and mean and found
    one = SuccessRate.of(48, 50).interval
    assert rate.interval == pytest.approx(one) and mean.interval == pytest.approx(one)
    gaps = [float(40 <= seed < 48) for seed in range(50)]
    assert found.interval == pytest.approx(difference_interval(gaps))


def test_a_policy_with_cameras_of_the_users_is_in_no_table_of_the_suites(tmp_path: Path) -> None:
    write_policy(tmp_path, GOOD, seed=1)
    write_policy(tmp_path, GOOD, method="naive-both")
    path = write_policy(tmp_path, GOOD, seed=2, folder="mine")
    config = json.loads((path / "config.json").read_text())
    config["training"]["command"] = "madviz train --task metaworld/hammer --cameras mine.toml"
    (path / "config.json").write_text(json.dumps(config))
    assert table(tmp_path, "overall").rows[0][1].trainings == 1


def test_only_trainings_of_one_budget_are_compared(tmp_path: Path) -> None:
    push: dict[str, Any] = {"task": "metaworld/push"}
    write_policy(tmp_path, rates(1, 1, 1, 1), **push, updates=15000, folder="long")
    assert report(tmp_path)[0]["tables"] == []  # A task with one row compares nothing.
    write_policy(tmp_path, GOOD, **push, updates=3600, folder="short")
    write_policy(tmp_path, GOOD, **push, updates=3900, method="naive-both")  # A tenth is alike.
    write_policy(tmp_path, rates(0, 0, 0, 0), method="vib", merge="vib")  # Alone on hammer.
    overall = table(tmp_path, "overall")
    assert [(task, row.label) for task, row in overall.rows] == [
        ("metaworld/push", "mad"),
        ("metaworld/push", "naive-both"),
    ]
    assert [e.path.name for e in overall.rows[0][1].evidence] == ["short"]
    _, text = report(tmp_path)
    assert "| metaworld/push | 1.00 [0.96, 1.00] n=100 |" in text, "the best one is accepted"


def test_the_twenty_tasks_have_an_average_of_each_suite(tmp_path: Path) -> None:
    write_policy(tmp_path, rates(1, 1, 1, 1))
    write_policy(tmp_path, rates(0.5, 0.5, 0.5, 0), task="metaworld/push")
    write_policy(tmp_path, GOOD, task="maniskill/push-cube")
    _, text = report(tmp_path)
    (average,) = (line for line in text.splitlines() if "average of" in line)
    assert average.startswith("| average of 2 in metaworld | 0.75 [0.69, 0.80] n=200 |")


def test_an_average_of_means_leaves_out_what_they_leave_out(tmp_path: Path) -> None:
    """PokeCube's mean is without First person."""
    write_policy(tmp_path, rates(0.9, 0, 0.9, 0.9), task="maniskill/poke-cube")
    write_policy(tmp_path, rates(0.5, 0.5, 0.5, 0.5), task="maniskill/push-cube")
    (average,) = (line for line in report(tmp_path)[1].splitlines() if "average of" in line)
    assert "| 0.25 [" in average and average.count("| 0.70 [") == 4


def test_single_camera_is_three_trainings_in_one_row(tmp_path: Path) -> None:
    write_policy(tmp_path, GOOD)
    for camera, rate in (("first", 0.9), ("third_a", 0.4), ("third_b", 0.2)):
        write_policy(
            tmp_path, {"all": rate}, method="single", streams=(camera,), folder=f"single-{camera}"
        )
    overall = table(tmp_path, "overall")
    single = average(overall, "single")
    assert single.rate("all") is None
    found = single.mean(THREE)
    assert found is not None and found.value == pytest.approx(0.5)
    assert "0.50 [" in report(tmp_path)[1] and "(first, third_a, third_b) |" in report(tmp_path)[1]
    gap = difference(overall.averages[0], single, THREE)
    assert gap is not None and gap.columns == ("first", "third_a", "third_b")
    assert gap.value == pytest.approx(0.85 - 0.5)


def test_one_task_has_no_average(tmp_path: Path) -> None:
    for task in ("metaworld/hammer", "metaworld/push"):
        for method in ("mad", "merged-only"):
            write_policy(tmp_path, GOOD, task=task, method=method)
    for method in ("mad", "merged-only"):
        write_policy(tmp_path, GOOD, method=method, recipe="paper")
    _, text = report(tmp_path)
    assert "| average of 2 in metaworld | mad |" in text and "average of 1 " not in text


def test_what_adds_nothing_to_a_row_is_not_trained_again_for_it(tmp_path: Path) -> None:
    """Single Camera with Third A is the same in every setting that has it as it is."""
    write_policy(tmp_path, GOOD)
    for setting in ("three", "one-rgb"):
        write_policy(
            tmp_path, {"all": 0.4}, method="single", streams=("third_a",), setting=setting,
            folder=f"single-{setting}",
        )  # fmt: skip
    single = average(table(tmp_path, "overall"), "single")
    assert len(single.evidence) == 1
    found = single.rate("third_a")
    assert found is not None and found.n == 100


def test_an_alpha_ablation_stays_out_of_the_other_tables(tmp_path: Path) -> None:
    write_policy(tmp_path, GOOD)
    for alpha in (0.2, 0.8):
        write_policy(tmp_path, rates(1, 1, 1, 1), alpha=alpha, folder=f"alpha{alpha}")
    evidence, _ = find_evidence(tmp_path)
    assert [each.config.training.alpha for each in usual_alphas(evidence)] == [0.5]
    assert [row.label for row in table(tmp_path, "alpha").averages] == [
        "alpha 0.2",
        "alpha 0.5",
        "alpha 0.8",
    ]
    write_policy(tmp_path, GOOD, method="naive-both")
    found = table(tmp_path, "overall").averages[0].rate("all")
    assert found is not None and found.value == 0.95


def test_an_older_alpha_without_effect_parts_no_trainings(tmp_path: Path) -> None:
    write_policy(tmp_path, GOOD, method="vib", merge="vib")
    write_policy(tmp_path, GOOD, method="vib", merge="vib", alpha=None, seed=2, folder="later")
    evidence, _ = find_evidence(tmp_path)
    assert len(usual_alphas(evidence)) == 2


def test_imitation_and_reinforcement_learning_never_share_a_table(tmp_path: Path) -> None:
    write_policy(tmp_path, GOOD)
    write_policy(tmp_path, rates(0.1, 0.1, 0.1, 0.1), recipe="paper", alpha=0.8)
    assert report(tmp_path)[0]["tables"] == ["scratch-metaworld"]
    assert [row.label for row in table(tmp_path, "scratch").averages] == ["mad, paper"]
    for recipe in ("light", "paper"):
        write_policy(tmp_path, GOOD, method="naive-both", recipe=recipe)
        write_policy(tmp_path, GOOD, alpha=0.2, recipe=recipe, folder=f"alpha-{recipe}")
    both = table(tmp_path, "overall"), table(tmp_path, "scratch")
    assert [[row.label for row in each.averages] for each in both] == [
        ["mad", "naive-both"],
        ["mad, paper", "naive-both, paper"],
    ]
    alphas = [each for each in every_table(tmp_path) if each.layout.key == "alpha"]
    assert [each.name for each in alphas] == ["alpha-metaworld-reinforcement", "alpha-metaworld"]
    assert [row.label for row in alphas[0].averages] == ["alpha 0.2, paper", "alpha 0.8, paper"]


def test_one_rate_is_no_mean(tmp_path: Path) -> None:
    write_policy(tmp_path, GOOD)
    write_policy(tmp_path, {"all": 0.9}, method="unknown")
    whole, alone = table(tmp_path, "overall").averages
    assert whole.mean(THREE) is not None and alone.mean(THREE) is None
    assert "| unknown | 1 | 0.90 [0.83, 0.94] n=100 | – | – | – | – |" in report(tmp_path)[1]


# --- Pictures and the command ---


def test_the_command_writes_beside_the_folder_and_prints_json(tmp_path: Path, capsys: Any) -> None:
    write_policy(tmp_path, GOOD)
    assert cli.main(["report", "--folder", str(tmp_path)]) == 0
    assert "1 of 20 tasks meet the acceptance threshold" in capsys.readouterr().out
    assert cli.main(["report", "--folder", str(tmp_path / "nothing")]) == 2


def test_runs_of_a_sweep_have_their_own_names(tmp_path: Path) -> None:
    for method in ("mad", "merged-only"):
        write_policy(tmp_path, rates(0.9, 0.5, 0.5, 0.5), method=method, folder=f"{method}/policy")
    report(tmp_path)
    lines = csv.DictReader((tmp_path / "rates.csv").read_text().splitlines())
    assert {line["policies"] for line in lines} == {"mad", "merged-only"}


def test_where_most_methods_were_trained_there_is_a_heat_map(tmp_path: Path) -> None:
    for method in ("mad", "merged-only", "q-mean"):
        write_policy(tmp_path, GOOD, method=method, merge="q-mean" if "q" in method else "sum")
    write_policy(tmp_path, GOOD, method="vib", merge="vib")
    assert "methods.svg" not in report(tmp_path)[1]
    write_policy(tmp_path, {"all": 0.5}, method="concat", merge="concat")
    _, text = report(tmp_path)
    assert "](pictures/methods.svg)" in text
    drawn = (tmp_path / "pictures" / "methods.svg").read_text()
    rows = re.findall(r">(mad|vib|merged-only|concat|q-mean)<", drawn)
    assert rows == ["mad", "vib", "merged-only", "concat", "q-mean"]
    assert drawn.count('class="cell"') == 20 and drawn.count(">–<") == 3
    table_of = {line.split(",")[0] for line in (tmp_path / "rates.csv").read_text().splitlines()}
    assert "methods-metaworld" in table_of


def test_success_while_training_is_drawn_for_reinforcement_learning_only(tmp_path: Path) -> None:
    curve = "env_steps,episodes,success_all,success_first\n0,6,0.0,0.0\n100,6,0.5,1.0\n"
    for recipe in ("light", "paper"):
        path = write_policy(tmp_path, GOOD, recipe=recipe)
        (path / "curve.csv").write_text(curve)
    other = write_policy(tmp_path, GOOD, recipe="paper", task="toy/reach")
    (other / "curve.csv").write_text(curve)
    result, text = report(tmp_path)
    assert {Path(one).name for one in result["pictures"] if "reinforcement" in one} == {
        "reinforcement-metaworld-hammer.svg", "reinforcement-toy-reach.svg"
    }  # fmt: skip
    drawn = (tmp_path / "pictures" / "reinforcement-metaworld-hammer.svg").read_text()
    assert drawn.count('class="line"') == 2 and ">mad<" in drawn
    assert "](pictures/reinforcement-toy-reach.svg)" in text and "scratch on toy/reach." in text


def test_a_row_that_is_being_written_stops_no_picture(tmp_path: Path) -> None:
    path = write_policy(tmp_path, GOOD, recipe="paper")
    curve = "env_steps,episodes,success_all,success_first\n0,6,0.0,0.0\n100,6,0.5,1.0\n200,6,0."
    (path / "curve.csv").write_text(curve)
    result, _ = report(tmp_path)
    assert any("reinforcement" in one for one in result["pictures"])


@pytest.mark.parametrize("others", [("merged-only",), ("merged-only", "singular-only")])
def test_a_policy_on_other_seeds_is_named_and_left_out(
    others: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    left = write_policy(tmp_path, GOOD, first_seed=60_000)
    for method in others:
        write_policy(tmp_path, GOOD, method=method, first_seed=10_000)
    report(tmp_path)
    assert f"left out, because measured on others: {left}\n" in capsys.readouterr().err


def test_no_curve_takes_the_place_of_another(tmp_path: Path) -> None:
    changes: list[dict[str, Any]] = [
        {"recipe": "paper"},
        {"recipe": "paper", "alpha": 0.8, "folder": "often"},
        {"recipe": "paper", "alpha": 0.8, "folder": "again"},
        {"recipe": "paper-vectorised"},
        {"recipe": "paper", "seed": 2, "folder": "second"},
        {"recipe": "paper", "method": "vib"},
    ]
    for change in changes:
        path = write_policy(tmp_path, GOOD, **change)
        (path / "curve.csv").write_text("env_steps,episodes,success_all\n0,6,0.0\n100,6,0.5\n")
    report(tmp_path)
    drawn = (tmp_path / "pictures" / "reinforcement-metaworld-hammer.svg").read_text()
    assert drawn.count('class="line"') == len(changes)
    for label in (
        "mad, paper, alpha 0.5",
        "mad, paper, alpha 0.8, often",
        "mad, paper, alpha 0.8, again",
        "mad, paper-vectorised",
        "mad, seed 2",
        "vib",
    ):
        assert f">{label}<" in drawn

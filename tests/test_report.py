"""``report``: what is read, and tables that say what the files say."""

from __future__ import annotations

import json
import xml.etree.ElementTree as xml
from pathlib import Path
from typing import Any

import pytest

from madviz import cli, svg
from madviz.errors import UserError
from madviz.evaluation.evidence import find_evidence, read_evidence
from madviz.report.layouts import THREE
from madviz.report.results import ReportConfig, run_report
from madviz.report.rows import difference
from madviz.report.tables import usual_alphas
from tests.evidence import rates, write_policy
from tests.reports import GOOD, report, table

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
    with pytest.raises(UserError, match="expected what `madviz eval` writes"):
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
    result, text = report(tmp_path)
    pictures = [Path(name).read_bytes() for name in result["pictures"]]
    assert result["tables"] == ["overall-metaworld", "components-metaworld"]
    (tmp_path / "results" / "five-maniskill.svg").write_text("of a table that is gone")
    again, same_text = report(tmp_path)
    assert (again, same_text) == (result, text)
    assert [Path(name).read_bytes() for name in again["pictures"]] == pictures
    assert len(list((tmp_path / "results").iterdir())) == len(pictures) == 2
    for picture in pictures:
        xml.fromstring(picture.decode())
    for name in result["pictures"]:
        assert f"](results/{Path(name).name})" in text
    words = "madviz train --task metaworld/hammer --method merged-only --seed 1"
    assert f"{words} --out runs/metaworld-hammer-merged-only-light\n" in text
    assert "--subsets all first third_a third_b --episodes 100 --seed 5000 --card" in text


def test_tables_without_files_are_left_out(tmp_path: Path) -> None:
    write_policy(tmp_path, GOOD)
    assert report(tmp_path)[0]["tables"] == []
    write_policy(tmp_path, {"all": 0.9, "rgb": 0.9, "depth": 0.8}, setting="three-rgbd", folder="x")
    result, text = report(tmp_path)
    assert result["tables"] == ["modality-metaworld"]
    assert "| metaworld/hammer | mad, three-rgbd | 1 | 0.90 [0.83, 0.94] n=100 |" in text


def test_trainings_of_several_seeds_pool_and_tasks_average(tmp_path: Path) -> None:
    for seed, rate in ((1, 1.0), (2, 0.5)):
        write_policy(tmp_path, {"all": rate}, seed=seed, folder=f"hammer{seed}")
    write_policy(tmp_path, {"all": 0.3}, task="metaworld/push")
    for task in ("metaworld/hammer", "metaworld/push"):
        write_policy(tmp_path, {"all": 0.1}, task=task, method="naive-both")
    overall = table(tmp_path, "overall")
    hammer = overall.rows[0][1]
    found = hammer.rate("all")
    assert found is not None and (hammer.trainings, found.value, found.n) == (2, 0.75, 200)
    whole = overall.averages[0]
    assert whole.tasks == ("metaworld/hammer", "metaworld/push")
    assert "| average of 2 | mad | 2 | 0.60 [0.54, 0.65] n=300 |" in report(tmp_path)[1]


def test_an_average_takes_the_episodes_that_a_tasks_rows_share(tmp_path: Path) -> None:
    write_policy(tmp_path, rates(1, 1, 1, 1), episodes=200)
    write_policy(tmp_path, rates(1, 1, 1, 1), method="naive-both", episodes=50)
    for method in ("mad", "naive-both"):
        write_policy(tmp_path, rates(0, 0, 0, 0), task="metaworld/push", method=method, episodes=50)
    for row in table(tmp_path, "overall").averages:
        found = row.rate("all")
        assert found is not None and (found.value, found.n) == (0.5, 100)


def test_what_was_trained_for_longer_is_no_rival(tmp_path: Path) -> None:
    push: dict[str, Any] = {"task": "metaworld/push"}
    write_policy(tmp_path, rates(1, 1, 1, 1), **push, updates=15000, folder="long")
    assert report(tmp_path)[0]["tables"] == []  # A task with one row compares nothing.
    write_policy(tmp_path, GOOD, **push, updates=3600, folder="short")
    write_policy(tmp_path, GOOD, **push, updates=3600, method="naive-both")
    write_policy(tmp_path, rates(0, 0, 0, 0), method="vib", merge="vib")  # Alone on hammer.
    overall = table(tmp_path, "overall")
    assert [(task, row.label) for task, row in overall.rows] == [
        *(("metaworld/push", "mad"), ("metaworld/push", "naive-both")),
    ]
    assert [e.path.name for e in overall.rows[0][1].evidence] == ["short"]
    _, text = report(tmp_path)
    assert "| metaworld/push | `long` | 1.00 [0.96, 1.00] n=100 |" in text


def test_the_bar_has_an_average_of_each_suite(tmp_path: Path) -> None:
    write_policy(tmp_path, rates(1, 1, 1, 1))
    write_policy(tmp_path, rates(0.5, 0.5, 0.5, 0), task="metaworld/push")
    write_policy(tmp_path, GOOD, task="maniskill/push-cube")
    _, text = report(tmp_path)
    (average,) = (line for line in text.splitlines() if "average of" in line)
    assert average.startswith("| average of 2 in metaworld |  | 0.75 [0.69, 0.80] n=200 |")


def test_single_camera_is_three_trainings_in_one_row(tmp_path: Path) -> None:
    write_policy(tmp_path, GOOD)
    for camera, rate in (("first", 0.9), ("third_a", 0.4), ("third_b", 0.2)):
        write_policy(
            tmp_path, {"all": rate}, method="single", streams=(camera,), folder=f"single-{camera}"
        )
    overall = table(tmp_path, "overall")
    single = overall.average("single")
    assert single is not None and single.rate("all") is None
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
    assert "| average of 2 | mad |" in text and "average of 1 " not in text


def test_what_adds_nothing_to_a_row_is_not_trained_again_for_it(tmp_path: Path) -> None:
    """Single Camera with Third A is the same in every setting that has it as it is."""
    write_policy(tmp_path, GOOD)
    for setting in ("three", "one-rgb"):
        write_policy(
            tmp_path, {"all": 0.4}, method="single", streams=("third_a",), setting=setting,
            folder=f"single-{setting}",
        )  # fmt: skip
    single = table(tmp_path, "overall").average("single")
    assert single is not None and len(single.evidence) == 1
    found = single.rate("third_a")
    assert found is not None and found.n == 100


def test_an_alpha_ablation_stays_out_of_the_other_tables(tmp_path: Path) -> None:
    write_policy(tmp_path, GOOD)
    for alpha in (0.2, 0.8):
        write_policy(tmp_path, rates(1, 1, 1, 1), alpha=alpha, folder=f"alpha{alpha}")
    evidence = find_evidence(tmp_path)
    assert [each.alpha for each in usual_alphas(evidence)] == [0.5]
    assert [row.label for row in table(tmp_path, "alpha").averages] == [
        *("alpha 0.2", "alpha 0.5", "alpha 0.8"),
    ]
    write_policy(tmp_path, GOOD, method="naive-both")
    found = table(tmp_path, "overall").averages[0].rate("all")
    assert found is not None and found.value == 0.95


def test_recipes_are_never_pooled(tmp_path: Path) -> None:
    write_policy(tmp_path, GOOD)
    write_policy(tmp_path, rates(0.1, 0.1, 0.1, 0.1), recipe="paper", alpha=0.8)
    assert report(tmp_path)[0]["tables"] == ["scratch-metaworld"]  # Another recipe is no rival.
    assert [row.label for row in table(tmp_path, "scratch").averages] == ["mad, paper"]
    for recipe in ("light", "paper"):
        write_policy(tmp_path, GOOD, method="naive-both", recipe=recipe)
    assert [row.label for row in table(tmp_path, "overall").averages] == [
        *("mad", "mad, paper", "naive-both", "naive-both, paper"),
    ]


# --- Pictures and the command ---


def test_pictures_show_values_intervals_and_escape_words() -> None:
    drawn = svg.bars("a < b", ["all"], {"mad": [svg.Bar(0.5, 0.25, 1.0, (0.4,))], "none": [None]})
    root = xml.fromstring(drawn)
    assert "a &lt; b" in drawn and drawn.count("<circle") == 1
    heights = [r.get("height") for r in root.iter("{http://www.w3.org/2000/svg}rect")]
    assert "85.0" in heights  # Half of the plot.
    curve = svg.Line([0, 10], [0.0, 1.0], [0.0, 0.8], [0.2, 1.0])
    assert xml.fromstring(svg.lines("t", "steps", {"all": {"mad": curve}})) is not None


def test_the_command_writes_beside_the_folder_and_prints_json(tmp_path: Path, capsys: Any) -> None:
    write_policy(tmp_path, GOOD)
    assert cli.main(["report", "--folder", str(tmp_path)]) == 0
    assert "1 of 20 tasks meet the bar" in capsys.readouterr().out
    assert cli.main(["report", "--folder", str(tmp_path / "nothing")]) == 2


def test_runs_of_a_sweep_bear_their_own_names(tmp_path: Path) -> None:
    for method in ("mad", "merged-only"):
        write_policy(tmp_path, rates(0.9, 0.5, 0.5, 0.5), method=method, folder=f"{method}/policy")
    _, text = report(tmp_path)
    assert "\n\n`mad`, `merged-only`\n\n</details>" in text
    assert "--out runs/merged-only\n" in text and "--policy runs/mad " in text
    assert "runs/policy" not in text


def test_where_most_methods_were_trained_all_stand_in_one_table(tmp_path: Path) -> None:
    methods = ("mad", "naive-both", "merged-only", "singular-only", "q-mean", "attention", "vit")
    for method in methods:
        merge = method if method in ("q-mean", "attention", "vit") else "sum"
        write_policy(tmp_path, GOOD, method=method, merge=merge)
    write_policy(tmp_path, GOOD, method="vib", merge="vib")
    assert "methods-metaworld" not in report(tmp_path)[0]["tables"]
    write_policy(tmp_path, {"all": 0.5}, method="concat", merge="concat")
    result, text = report(tmp_path)
    assert "methods-metaworld" in result["tables"]
    section = text.split("## Every method: metaworld")[1].split("\n## ")[0]
    rows = [line.split(" | ")[1] for line in section.splitlines() if line.startswith("| metaworld")]
    assert rows == [
        *("mad", "vib", "naive-both", "merged-only", "singular-only"),
        *("concat", "attention", "vit", "q-mean"),
    ]
    assert "MAD minus concat: +" in section and "on the mean of all; n = 100" in section
    assert "The paper" not in section

"""``report``: tables that say what the files say, words that follow from the numbers."""

from __future__ import annotations

import json
import xml.etree.ElementTree as xml
from pathlib import Path
from typing import Any

import pytest

from madviz import checkpoint, cli, svg
from madviz.report.bar import judge
from madviz.report.claims import claims, same, signed, verdict
from madviz.report.evidence import find_evidence, read_evidence
from madviz.report.layouts import LAYOUTS, THREE
from madviz.report.results import ReportConfig, run_report
from madviz.report.rows import difference
from madviz.report.tables import Table, build, usual_alphas
from madviz.types import UserError
from tests.evidence import rates, write_policy

GOOD = rates(0.95, 0.90, 0.85, 0.80)


def table(root: Path, key: str, suite: str = "metaworld") -> Table:
    layout = next(layout for layout in LAYOUTS if layout.key == key)
    return next(t for t in build(layout, find_evidence(root)) if t.suite == suite)


def every_table(root: Path) -> list[Table]:
    return [t for layout in LAYOUTS for t in build(layout, find_evidence(root))]


def report(root: Path) -> tuple[dict[str, Any], str]:
    result = run_report(ReportConfig(root))
    return result, Path(result["path"]).read_text()


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


# --- The bar ---


@pytest.mark.parametrize(
    ("measured", "change", "expected"),
    [
        (rates(0.92, 0.76, 0.76, 0.76), {}, "met"),
        (rates(0.91, 0.9, 0.9, 0.9), {}, "not met: all 0.91 is below 0.92"),
        (rates(0.92, 0.75, 0.75, 0.75), {}, "not met: mean 0.79 is below 0.80"),
        ({"all": 1.0, "first": 1.0}, {}, "not met: third_a, third_b not measured"),
        (GOOD, {"episodes": 20}, "not met: 20 episodes, 100 are needed"),
        (GOOD, {"first_seed": 4999}, "not met: seeds below 5000"),
        (rates(0.95, 0.0, 0.9, 0.9), {"task": "maniskill/poke-cube"}, "met"),
        (rates(0.95, 0.0, 0.9, 0.9), {"task": "maniskill/push-cube"}, "mean 0.69 is below 0.80"),
        (GOOD, {"method": "merged-only"}, "not trained"),
        (GOOD, {"setting": "three-rgbd"}, "not trained"),
    ],
)
def test_a_task_meets_the_bar_or_the_table_says_why_not(
    measured: dict[str, float], change: dict[str, Any], expected: str, tmp_path: Path
) -> None:
    write_policy(tmp_path, measured, **change)
    task = change.get("task", "metaworld/hammer")
    assert expected in judge(task, find_evidence(tmp_path)).words


def test_the_bar_has_twenty_tasks_and_the_page_counts_them(tmp_path: Path) -> None:
    write_policy(tmp_path, GOOD)
    write_policy(tmp_path, rates(0.5, 0.5, 0.5, 0.5), task="maniskill/push-cube")
    result, text = report(tmp_path)
    assert len(result["bar"]) == 20
    assert "1 of 20 tasks meet it, 1 do not, 18 have no policy yet" in text
    assert "| metaworld/hammer | `metaworld-hammer-mad-light` | 0.95 [0.89, 0.98] n=100 |" in text
    assert "| metaworld/push | – | – |" in text


def test_what_was_tried_stands_under_the_bar(tmp_path: Path) -> None:
    write_policy(tmp_path, GOOD)
    (tmp_path / "tried.json").write_text(
        '{"maniskill/push-cube": ["12 rounds: 0.4"], "metaworld/push": ["half a point", "more"]}'
    )
    _, text = report(tmp_path)
    lines = text.splitlines()
    first = lines.index("- metaworld/push: half a point")
    assert lines[first + 1 : first + 3] == [
        "- metaworld/push: more",
        "- maniskill/push-cube: 12 rounds: 0.4",
    ]


@pytest.mark.parametrize(
    "text", ["{", "[]", '{"metaworld/nothing": ["x"]}', '{"metaworld/push": "x"}']
)
def test_a_list_of_what_was_tried_has_one_form(tmp_path: Path, text: str) -> None:
    write_policy(tmp_path, GOOD)
    (tmp_path / "tried.json").write_text(text)
    with pytest.raises(UserError, match="expected .*tried.json"):
        report(tmp_path)


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


# --- Sentences ---


@pytest.mark.parametrize(
    ("interval", "words"),
    [
        ((0.4, 0.6), "agrees in direction; the lead is larger"),
        ((0.2, 0.45), "agrees, in direction and size"),
        ((0.02, 0.15), "agrees in direction; the lead is smaller"),
        ((-0.05, 0.1), "undecided"),
        ((-0.3, -0.1), "does not agree"),
    ],
)
def test_a_verdict_follows_from_where_the_interval_lies(
    interval: tuple[float, float], words: str
) -> None:
    assert verdict(interval, 0.3).startswith(words)


def test_alike_takes_an_interval_that_is_narrow() -> None:
    assert same((-0.05, 0.09)).startswith("agrees")
    assert same((-0.2, 0.1)).startswith("undecided")
    assert same((0.01, 0.2)).startswith("does not agree")


def test_the_lead_is_held_against_the_closest_baseline(tmp_path: Path) -> None:
    write_policy(tmp_path, rates(1, 1, 1, 1))
    write_policy(tmp_path, rates(0.2, 0.2, 0.2, 0.2), method="mvd", merge="mvd")
    write_policy(tmp_path, rates(0.6, 0.8, 0.6, 0.6), method="vib", merge="vib")
    write_policy(tmp_path, rates(0.9, 0.9, 0.9, 0.9), method="merged-only")
    said = "\n".join(claims(table(tmp_path, "overall")))
    assert "MAD minus mvd: +80 points" in said and "MAD minus merged-only: +10 points" in said
    assert "+30 points over its baselines" in said
    assert "Against the closest of ours, vib: agrees, in direction and size" in said
    components = "\n".join(claims(table(tmp_path, "components")))
    assert "closest of ours, merged-only: agrees in direction; the lead is smaller" in components


def test_one_training_under_two_names_is_said_to_be_one(tmp_path: Path) -> None:
    for task, alpha in (("metaworld/hammer", 0.5), ("metaworld/push", 0.25)):
        for method in ("mad", "naive-both"):
            write_policy(tmp_path, GOOD, task=task, method=method, alpha=alpha)
    said = [line for line in claims(table(tmp_path, "components")) if "one and the same" in line]
    assert len(said) == 1 and said[0].startswith("On metaworld/push naive-both and MAD")


def test_an_alpha_that_nobody_wrote_down_stops_no_report(tmp_path: Path) -> None:
    write_policy(tmp_path, GOOD, folder="metaworld-hammer-mad-light")
    write_policy(tmp_path, GOOD, method="merged-only")
    bare = write_policy(tmp_path, GOOD, folder="other")
    config = json.loads((bare / "config.json").read_text())
    del config["training"]["alpha"]
    (bare / "config.json").write_text(json.dumps(config))
    report(tmp_path)
    mad = table(tmp_path, "overall").average("mad")
    assert mad is not None and len(mad.evidence) == 1, "what differs from the usual stays out"


def test_cameras_that_see_nothing_have_their_part_of_the_loss(tmp_path: Path) -> None:
    """An alpha that is not a task's usual one has a row of its own here, and says its name."""
    for alpha, folder in ((0.25, "metaworld-hammer-mad-turned-away-light"), (0.8, "other")):
        write_policy(
            tmp_path, {"all": alpha, "third_a": 0.5}, setting="turned-away", alpha=alpha,
            folder=folder,
        )  # fmt: skip
    write_policy(
        tmp_path, {"all": 0.9}, method="single", streams=("third_a",), setting="turned-away"
    )
    away = table(tmp_path, "occlusion")
    assert [row.label for row in away.averages] == ["mad", "mad, alpha 0.8", "single"]
    assert [len(row.evidence) for row in away.averages] == [1, 1, 1]
    first, second, why, *_ = claims(away)
    assert first.startswith("MAD minus single") and "does not agree" in first
    assert second.startswith("MAD, alpha 0.8 minus single")
    # Two of three streams, each (1 - alpha) / 3.
    assert "50% at alpha 0.25, 13% at alpha 0.8" in why


def test_mixed_sizes_stand_beside_one_size(tmp_path: Path) -> None:
    write_policy(tmp_path, GOOD, folder="one")
    assert not any(t.layout.key == "resolution" for t in every_table(tmp_path)), "nothing is mixed"
    write_policy(tmp_path, GOOD, setting="mixed-resolution", folder="mixed")
    sizes = table(tmp_path, "resolution")
    assert [row.label for row in sizes.averages] == ["mad", "mad, one size"]
    (said,) = claims(sizes)
    assert "+0 points" in said and "no loss: agrees: within 10 points" in said


def test_nothing_is_no_debt() -> None:
    assert [signed(share) for share in (-0.002, 0.0, -0.006, 0.42)] == ["+0", "+0", "-1", "+42"]


def test_policies_that_are_figures_only_are_named(tmp_path: Path) -> None:
    bare = write_policy(tmp_path, GOOD, method="vib", merge="vib", folder="bare")
    whole = write_policy(tmp_path, GOOD, folder="whole")
    (whole / "weights.safetensors").write_bytes(b"some")
    told = json.loads((whole / "evaluation.json").read_text())
    told["digest"] = checkpoint.describe(whole).spec.digest
    (whole / "evaluation.json").write_text(json.dumps(told))
    run_report(ReportConfig(tmp_path))
    said = (tmp_path / "RESULTS.md").read_text()
    assert "figures only, without weights: 1 that" in said
    assert f"\n\n`{bare.name}`\n\n</details>" in said


def test_nothing_is_claimed_about_baselines_that_were_not_measured(tmp_path: Path) -> None:
    for method in ("mad", "unknown"):
        write_policy(tmp_path, GOOD, task="maniskill/pull-cube", method=method)
    said = claims(table(tmp_path, "overall", "maniskill"))
    assert (
        len(said) == 1 and "+36 points" in said[0] and "nothing to hold against it yet" in said[0]
    )


def test_the_best_alpha_is_said_with_its_difference(tmp_path: Path) -> None:
    for alpha, rate in ((0.2, 0.9), (0.8, 0.5)):
        write_policy(tmp_path, rates(rate, rate, rate, rate), alpha=alpha, folder=f"alpha{alpha}")
    (said,) = claims(table(tmp_path, "alpha"))
    assert "On metaworld/hammer alpha 0.2 is best" in said and said.endswith("does not agree.")


def test_alphas_are_compared_on_the_task_they_share(tmp_path: Path) -> None:
    """Alpha 0.5 is on the easy task alone, which makes it no better than the paper's."""
    tried = {"hammer": ((0.5, 1.0), (0.8, 1.0)), "push": ((0.2, 0.6), (0.8, 0.9))}
    for task, pairs in tried.items():
        for alpha, rate in pairs:
            write_policy(
                tmp_path, rates(rate, rate, rate, rate), task=f"metaworld/{task}", alpha=alpha,
                folder=f"{task}-{alpha}",
            )  # fmt: skip
    hammer, push = claims(table(tmp_path, "alpha"))
    assert hammer.startswith("On metaworld/hammer") and "undecided" in hammer
    assert push.startswith("On metaworld/push alpha 0.8 is best") and push.endswith("best: agrees.")


@pytest.mark.parametrize(
    ("rate", "end"), [(0.5, "best: agrees."), (0.9, "undecided: no difference could be shown.")]
)
def test_the_papers_alpha_is_called_best_only_where_it_shows(
    tmp_path: Path, rate: float, end: str
) -> None:
    for alpha, each in ((0.5, rate), (0.8, 0.91)):
        write_policy(tmp_path, rates(each, each, each, each), alpha=alpha, folder=f"alpha{alpha}")
    (said,) = claims(table(tmp_path, "alpha"))
    assert said.startswith(
        "On metaworld/hammer alpha 0.8 is best; alpha 0.8 minus alpha 0.5"
    ) and said.endswith(end)


def test_merges_and_modalities_are_held_against_their_sentences(tmp_path: Path) -> None:
    write_policy(tmp_path, {"all": 1.0}, method="merged-only")
    write_policy(tmp_path, {"all": 1.0}, method="concat", merge="concat")
    write_policy(tmp_path, {"all": 0.6}, method="q-mean", merge="q-mean")
    said = claims(table(tmp_path, "merging"))
    assert "concat minus sum: +0 points" in said[0] and "agrees: within 10 points" in said[0]
    assert said[1].endswith("agrees: it is behind.")
    streams = ("third_a.rgb", "third_a.depth")
    write_policy(
        *(tmp_path, {"all": 0.9, "rgb": 0.9, "depth": 0.9}),
        **{"setting": "one-rgbd", "streams": streams, "folder": "mad-both"},
    )
    write_policy(
        *(tmp_path, {"all": 0.3}),
        **{"setting": "one-depth", "streams": streams[1:], "method": "single", "folder": "depth"},
    )
    said = claims(table(tmp_path, "modality"))
    assert len(said) == 1 and "on depth alone: +60 points" in said[0]
    assert said[0].endswith("agrees: MAD is ahead.")


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

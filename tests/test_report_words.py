"""The target, and sentences that follow from the numbers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from madviz.errors import UserError
from madviz.evaluation.evidence import find_evidence
from madviz.policies import checkpoint
from madviz.report.claims import claims, same, signed, verdict
from madviz.report.results import ReportConfig, run_report
from madviz.report.target import judge
from tests.evidence import rates, write_policy
from tests.reports import GOOD, every_table, report, table

# --- The target ---


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
def test_a_task_meets_the_target_or_the_table_says_why_not(
    measured: dict[str, float], change: dict[str, Any], expected: str, tmp_path: Path
) -> None:
    write_policy(tmp_path, measured, **change)
    task = change.get("task", "metaworld/hammer")
    assert expected in judge(task, find_evidence(tmp_path)).words


def test_the_target_has_twenty_tasks_and_the_page_counts_them(tmp_path: Path) -> None:
    write_policy(tmp_path, GOOD)
    write_policy(tmp_path, rates(0.5, 0.5, 0.5, 0.5), task="maniskill/push-cube")
    result, text = report(tmp_path)
    assert len(result["bar"]) == 20
    assert "1 of 20 tasks meet it, 1 do not, 18 have no policy yet" in text
    assert "| metaworld/hammer | `metaworld-hammer-mad-light` | 0.95 [0.89, 0.98] n=100 |" in text
    assert "| metaworld/push | – | – |" in text


def test_what_was_tried_is_listed_under_the_target(tmp_path: Path) -> None:
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
    ("text", "said"),
    [
        ("{", "expected a JSON file"),
        ("[]", "expected a table of named values, found"),
        ('{"metaworld/nothing": ["x"]}', "unknown task 'metaworld/nothing'"),
        ('{"metaworld/push": "x"}', "expected .* to be a list, found .*'x'"),
    ],
)
def test_a_list_of_what_was_tried_has_one_form(tmp_path: Path, text: str, said: str) -> None:
    write_policy(tmp_path, GOOD)
    (tmp_path / "tried.json").write_text(text)
    with pytest.raises(UserError, match=f"tried.json: {said}"):
        report(tmp_path)


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


def test_the_lead_is_compared_with_the_closest_baseline(tmp_path: Path) -> None:
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


def test_a_config_without_alpha_stops_no_report(tmp_path: Path) -> None:
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


def test_a_difference_of_nothing_has_a_plus() -> None:
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
        len(said) == 1 and "+36 points" in said[0] and "nothing to compare with it yet" in said[0]
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


def test_merges_and_modalities_are_compared_with_their_sentences(tmp_path: Path) -> None:
    write_policy(tmp_path, {"all": 1.0}, method="merged-only")
    write_policy(tmp_path, {"all": 1.0}, method="concat", merge="concat")
    write_policy(tmp_path, {"all": 0.6}, method="q-mean", merge="q-mean")
    said = claims(table(tmp_path, "merging"))
    assert "concat minus sum: +0 points" in said[0] and "agrees: within 10 points" in said[0]
    assert said[1].endswith("agrees: it is behind.")
    streams = ("third_a.rgb", "third_a.depth")
    write_policy(
        tmp_path,
        {"all": 0.9, "rgb": 0.9, "depth": 0.9},
        setting="one-rgbd",
        streams=streams,
        folder="mad-both",
    )
    write_policy(
        tmp_path,
        {"all": 0.3},
        setting="one-depth",
        streams=streams[1:],
        method="single",
        folder="depth",
    )
    said = claims(table(tmp_path, "modality"))
    assert len(said) == 1 and "on depth alone: +60 points" in said[0]
    assert said[0].endswith("agrees: MAD is ahead.")

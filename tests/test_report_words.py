"""The acceptance threshold, and sentences that follow from the numbers."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest

from madviz.measure.evidence import find_evidence
from madviz.policies import checkpoint
from madviz.report.claims import claims, same, verdict
from madviz.report.rows import difference, signed
from madviz.report.tables import row_of
from madviz.report.threshold import judge
from tests.evidence import rates, write_policy
from tests.reports import GOOD, average, every_table, report, table

# --- The acceptance threshold ---


@pytest.mark.parametrize(
    ("measured", "change", "expected"),
    [
        (rates(0.92, 0.76, 0.76, 0.76), {}, "met"),
        (rates(0.91, 0.9, 0.9, 0.9), {}, "not met: all 0.91 is below 0.92"),
        (rates(0.92, 0.75, 0.75, 0.75), {}, "not met: mean 0.79 is below 0.80"),
        ({"all": 1.0, "first": 1.0}, {}, "not met: third_a, third_b not measured"),
        (GOOD, {"episodes": 20}, "not met: 20 episodes, 100 are needed"),
        (rates(0.95, 0.0, 0.9, 0.9), {"task": "maniskill/poke-cube"}, "met"),
        (rates(0.95, 0.0, 0.9, 0.9), {"task": "maniskill/push-cube"}, "mean 0.69 is below 0.80"),
        (GOOD, {"method": "merged-only"}, "not trained"),
        (GOOD, {"setting": "three-rgbd"}, "not trained"),
    ],
)
def test_a_task_meets_the_threshold_or_the_table_says_why_not(
    measured: dict[str, float], change: dict[str, Any], expected: str, tmp_path: Path
) -> None:
    write_policy(tmp_path, measured, **change)
    task = change.get("task", "metaworld/hammer")
    assert expected in judge(task, find_evidence(tmp_path)[0]).words


def test_the_threshold_is_for_twenty_tasks_and_the_page_counts_them(tmp_path: Path) -> None:
    write_policy(tmp_path, GOOD)
    write_policy(tmp_path, rates(0.5, 0.5, 0.5, 0.5), task="maniskill/push-cube")
    result, text = report(tmp_path)
    assert len(result["bar"]) == 20
    assert "meet it: 1 of 20; that do not: 1; without a policy: 18" in text
    assert "| metaworld/hammer | 0.95 [0.89, 0.98] n=100 |" in text
    assert "| metaworld/push | – | – |" in text
    assert "with a camera below 0.70**: none." in text


def test_a_policy_that_was_chosen_among_several_trainings_is_named(tmp_path: Path) -> None:
    folder = write_policy(tmp_path, GOOD)
    assert "**Chosen among several trainings**: none.\n" in report(tmp_path)[1]
    (folder / "origin.json").write_text('{"best_of": 2}')
    said = "**Chosen among several trainings**: metaworld/hammer is the better of two trainings.\n"
    assert said in report(tmp_path)[1]


def test_what_is_accepted_with_a_weak_camera_is_named(tmp_path: Path) -> None:
    write_policy(tmp_path, rates(1.0, 0.5, 1.0, 1.0))
    write_policy(tmp_path, rates(0.5, 0.5, 1.0, 1.0), task="metaworld/push")
    said = "below 0.70**: metaworld/hammer with first 0.50 [0.40, 0.60] n=100.\n"
    assert said in report(tmp_path)[1]


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


def test_imitation_stands_beside_the_paper_without_a_verdict(tmp_path: Path) -> None:
    write_policy(tmp_path, rates(1, 1, 1, 1))
    write_policy(tmp_path, rates(0.2, 0.2, 0.2, 0.2), method="mvd", merge="mvd")
    write_policy(tmp_path, rates(0.9, 0.9, 0.9, 0.9), method="merged-only")
    said = "\n".join(claims(table(tmp_path, "overall")))
    assert "MAD minus mvd: +80 points" in said and "MAD minus merged-only: +10 points" in said
    assert "The paper reports +30 points over its baselines, on 15 tasks." in said
    assert "agree" not in said


@pytest.mark.parametrize(("trainings", "judged"), [(2, False), (3, True)])
def test_reinforcement_learning_is_judged_over_several_trainings(
    tmp_path: Path, trainings: int, judged: bool
) -> None:
    """Against the closest of the baselines; the interval is over trainings."""
    for seed in range(1, trainings + 1):
        common: dict[str, Any] = {"recipe": "paper", "seed": seed}
        good = 0.88 + 0.02 * seed
        write_policy(tmp_path, rates(good, good, good, good), **common, folder=f"mad{seed}")
        for method, rate in (("vib", 0.6), ("mvd", 0.2)):
            write_policy(
                tmp_path, rates(rate, rate, rate, rate), **common, method=method, merge=method,
                folder=f"{method}{seed}",
            )  # fmt: skip
    said = claims(table(tmp_path, "scratch"))
    assert said[-1].startswith("The paper reports +30 points over its baselines, on 15 tasks")
    # Leads of 0.30, 0.32 and 0.34 over VIB: Student's interval is 0.32 +- 0.05.
    assert said[-1].endswith(": agrees, in direction and size.") == judged


def test_a_method_with_a_recipe_of_its_own_stands_beside_mads_reinforcement(tmp_path: Path) -> None:
    write_policy(tmp_path, GOOD, recipe="paper")
    write_policy(
        tmp_path, rates(0.5, 0.5, 0.5, 0.5), method="mv-mwm", merge="mv-mwm", recipe="mv-mwm"
    )
    said = claims(table(tmp_path, "scratch"))
    assert said[0].startswith("MAD minus mv-mwm, mv-mwm: +38 points [")
    for method in ("mad", "single"):
        write_policy(tmp_path, GOOD, method=method)
    imitated = claims(table(tmp_path, "overall"))
    assert imitated and not any("mv-mwm" in one for one in imitated)


def test_a_pair_takes_all_episodes_that_the_two_have(tmp_path: Path) -> None:
    """A third row with fewer episodes, and a task that only one of them has, cut nothing."""
    for task, method, count in (
        ("metaworld/hammer", "mad", 100),
        ("metaworld/hammer", "vib", 100),
        ("metaworld/hammer", "mvd", 20),
        ("metaworld/push", "mad", 10),
        ("metaworld/push", "mvd", 10),
    ):
        write_policy(
            tmp_path,
            GOOD,
            task=task,
            method=method,
            merge="sum" if method == "mad" else method,
            episodes=count,
        )
    found = table(tmp_path, "overall")
    assert found.pair("mad", "merged-only") is None
    pairs = [found.pair("mad", other) for other in ("vib", "mvd")]
    gaps = [difference(*pair, ("all",)) for pair in pairs if pair]
    assert [(gap.n, len(gap.tasks)) for gap in gaps if gap] == [(100, 1), (20, 2)]


def test_a_shorter_training_is_said_and_not_held_against_the_paper(tmp_path: Path) -> None:
    """It is as good as MAD: the verdict is on VIB, which was trained as long."""
    for seed in (1, 2, 3):
        for method, merge, recipe, rate, steps in (
            ("mad", "sum", "paper", 0.9, 60_000),
            ("vib", "vib", "paper", 0.4, 64_000),
            ("mv-mwm", "mv-mwm", "mv-mwm", 0.9, 22_000),
        ):
            write_policy(
                tmp_path, rates(rate, rate, rate, rate), method=method, merge=merge,
                recipe=recipe, steps=steps, seed=seed, folder=f"{method}{seed}",
            )  # fmt: skip
    vib, shorter, paper = claims(table(tmp_path, "scratch"))
    assert vib.endswith("; after 60,000 and 64,000 decisions."), "a tenth longer is as long"
    assert shorter.endswith("; after 60,000 and 22,000 decisions, so not a fair comparison.")
    assert paper.endswith(": agrees in direction; the lead is larger than the paper's.")


def test_one_training_under_two_names_is_said_to_be_one(tmp_path: Path) -> None:
    for task, alpha in (("metaworld/hammer", 0.5), ("metaworld/push", 0.25)):
        for method in ("mad", "naive-both"):
            for seed in (1, 2):
                write_policy(
                    tmp_path, GOOD, task=task, method=method, alpha=alpha, seed=seed,
                    folder=f"{task}/{method}-{seed}",
                )  # fmt: skip
    said = [line for line in claims(table(tmp_path, "overall")) if "one and the same" in line]
    assert len(said) == 1 and said[0].startswith("On metaworld/push naive-both and MAD")


def test_a_config_without_alpha_stops_no_report(tmp_path: Path) -> None:
    write_policy(tmp_path, GOOD, folder="metaworld-hammer-mad-light")
    write_policy(tmp_path, GOOD, method="merged-only")
    bare = write_policy(tmp_path, GOOD, folder="other")
    config = json.loads((bare / "config.json").read_text())
    del config["training"]["alpha"]
    (bare / "config.json").write_text(json.dumps(config))
    report(tmp_path)
    mad = average(table(tmp_path, "overall"), "mad")
    assert len(mad.evidence) == 1, "what differs from the usual stays out"


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
    assert first.startswith("MAD minus single") and first.endswith("62% for Single Camera.")
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
    assert "+0 points" in said and said.endswith("The paper reports no loss.")


def test_a_difference_of_nothing_has_a_plus() -> None:
    assert [signed(share) for share in (-0.002, 0.0, -0.006, 0.42)] == ["+0", "+0", "-1", "+42"]


def test_policies_that_are_figures_only_are_counted(tmp_path: Path) -> None:
    write_policy(tmp_path, GOOD, method="vib", merge="vib", folder="bare")
    whole = write_policy(tmp_path, GOOD, folder="whole")
    (whole / "weights.safetensors").write_bytes(b"some")
    told = json.loads((whole / "evaluation.json").read_text())
    told["digest"] = checkpoint.describe(whole).spec.digest
    (whole / "evaluation.json").write_text(json.dumps(told))
    _, text = report(tmp_path)
    assert "2 policies; not edited. The weights of 1 of them are not kept" in text
    lines = csv.DictReader((tmp_path / "rates.csv").read_text().splitlines())
    assert {(line["policies"], line["weights"]) for line in lines} == {
        ("bare", "no"),
        ("whole", "yes"),
    }


def test_nothing_is_claimed_about_baselines_that_were_not_measured(tmp_path: Path) -> None:
    for method in ("mad", "unknown"):
        write_policy(tmp_path, GOOD, task="maniskill/pull-cube", method=method)
    assert claims(table(tmp_path, "overall", "maniskill")) == []


def test_what_the_paper_says_of_meta_world_stands_there_alone(tmp_path: Path) -> None:
    for suite, task in (("maniskill", "pull-cube"), ("metaworld", "push")):
        for method in ("mad", "merged-only"):
            write_policy(
                tmp_path, GOOD, task=f"{suite}/{task}", method=method, folder=f"{task}-{method}"
            )
        said = " ".join(claims(table(tmp_path, "overall", suite)))
        assert "MAD minus merged-only" in said
        assert ("on five Meta-World tasks" in said) == (suite == "metaworld")


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
    assert hammer.startswith("On metaworld/hammer alpha 0.")
    assert "has the highest mean, but no difference shows; " in hammer
    assert push.startswith("On metaworld/push alpha 0.8 has the highest mean; alpha 0.8 minus")
    assert push.endswith("The paper finds alpha 0.8 best.")


def test_alphas_are_compared_on_the_trainings_they_share(tmp_path: Path) -> None:
    """Alpha 0.8 is best where each was trained; two more trainings of it fail."""
    for alpha, seed, rate in ((0.5, 1, 0.8), (0.8, 1, 0.9), (0.8, 2, 0.1), (0.8, 3, 0.1)):
        write_policy(
            tmp_path, rates(rate, rate, rate, rate), alpha=alpha, seed=seed,
            folder=f"alpha{alpha}-{seed}",
        )  # fmt: skip
    (said,) = claims(table(tmp_path, "alpha"))
    assert "alpha 0.8 minus alpha 0.5: +10 points" in said and "n = 100 on 1 task" in said
    assert said.startswith("On metaworld/hammer, with training seed 1 alone, alpha 0.8 has")


def test_alphas_of_two_recipes_do_not_compete(tmp_path: Path) -> None:
    for recipe, better in (("paper", 0.0), ("paper-vectorised", 0.3)):
        for alpha, rate in ((0.5, 0.4), (0.8, 0.6)):
            level = rate + better
            write_policy(
                tmp_path, rates(level, level, level, level), alpha=alpha, recipe=recipe,
                folder=f"{recipe}-{alpha}",
            )  # fmt: skip
    said = claims(table(tmp_path, "alpha"))
    assert len(said) == 2 and all("+20 points" in one for one in said)


def test_nothing_is_chosen_on_reporting_seeds(tmp_path: Path) -> None:
    """Policy a was evaluated on reporting seeds alone, and has a higher mean there."""
    write_policy(tmp_path, rates(1, 1, 1, 1), first_seed=40_000, folder="a")
    write_policy(tmp_path, GOOD, folder="b")
    found = judge("metaworld/hammer", find_evidence(tmp_path)[0])
    assert found.row is not None and found.row.evidence[0].folder == "b"


def test_two_policies_of_one_training_seed_are_not_mixed_into_a_rate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two runs of a sweep over the learning rate have one label and one seed."""
    write_policy(tmp_path, rates(1, 1, 1, 1), folder="a")
    write_policy(tmp_path, rates(0, 0, 0, 0), folder="b", first_seed=5100)
    row = row_of("mad", ("all",), find_evidence(tmp_path)[0])
    rate = row.rate("all")
    assert rate is not None and (rate.value, rate.n) == (1.0, 100)
    assert [one.folder for one in row.evidence] == ["a"]
    assert f"counts; passed over: {tmp_path / 'b'}" in capsys.readouterr().err


def test_a_policy_of_cameras_of_ones_own_does_not_stand_for_the_task(tmp_path: Path) -> None:
    own = write_policy(tmp_path, rates(1, 1, 1, 1), folder="own")
    config = json.loads((own / "config.json").read_text())
    config["training"]["command"] += " --cameras mine.toml"
    (own / "config.json").write_text(json.dumps(config))
    write_policy(tmp_path, GOOD, folder="b")
    found = judge("metaworld/hammer", find_evidence(tmp_path)[0])
    assert found.row is not None and found.row.evidence[0].folder == "b"


def test_a_verdict_follows_from_the_interval_that_stands_beside_it(tmp_path: Path) -> None:
    """Three trainings of few episodes that agree by chance show no difference."""
    for seed in (1, 2, 3):
        for method, rate in (("mad", 0.65), ("vib", 0.6)):
            write_policy(
                tmp_path, rates(rate, rate, rate, rate), recipe="paper", seed=seed, method=method,
                merge="vib" if method == "vib" else "sum", episodes=20, folder=f"{method}{seed}",
            )  # fmt: skip
    (said,) = (one for one in claims(table(tmp_path, "scratch")) if "The paper reports" in one)
    assert said.endswith(": undecided: no difference could be shown.")


def test_methods_that_were_trained_often_are_compared_task_by_task(tmp_path: Path) -> None:
    """Push three times, hammer once: their average has one training of each."""
    for task, seeds in (("metaworld/hammer", (1,)), ("metaworld/push", (1, 2, 3))):
        for seed in seeds:
            mad = rates(0.9, 0.9, 0.9, 0.9)
            write_policy(tmp_path, mad, task=task, seed=seed, folder=f"{task}/mad-{seed}")
            vib = rates(0.9, 0.9, 0.0, 0.2)
            write_policy(
                tmp_path, vib, task=task, seed=seed, method="vib", merge="vib",
                folder=f"{task}/vib-{seed}",
            )  # fmt: skip
    often = [line for line in claims(table(tmp_path, "overall")) if "trainings of each" in line]
    assert len(often) == 1
    assert often[0].startswith("On metaworld/push, 3 trainings of each, MAD minus vib: +40 points")
    assert often[0].endswith("n = 300 on 1 task.")


@pytest.mark.parametrize(
    ("others", "end"),
    [
        ((0.5, 0.5, 0.5), ": agrees."),
        ((0.9, 0.8, 0.99), ": undecided: no difference could be shown."),
    ],
)
def test_the_papers_alpha_is_called_best_only_where_it_shows(
    tmp_path: Path, others: tuple[float, ...], end: str
) -> None:
    for seed, other in enumerate(others, 1):
        for alpha, each in ((0.5, other), (0.8, 0.9 + seed / 100)):
            write_policy(
                tmp_path, rates(each, each, each, each), alpha=alpha, recipe="paper", seed=seed,
                folder=f"alpha{alpha}-{seed}",
            )  # fmt: skip
    (said,) = claims(table(tmp_path, "alpha"))
    assert said.endswith(f"The paper finds alpha 0.8 best{end}")


def test_merges_and_modalities_are_compared_with_their_sentences(tmp_path: Path) -> None:
    write_policy(tmp_path, {"all": 1.0}, method="merged-only")
    write_policy(tmp_path, {"all": 1.0}, method="concat", merge="concat")
    write_policy(tmp_path, {"all": 0.6}, method="q-mean", merge="q-mean")
    said = claims(table(tmp_path, "merging"))
    assert said[0] == "concat minus sum: +0 points [-2, +2] on all; n = 100 on 1 task."
    assert said[1].startswith("q-mean minus sum: -40 points")
    for method, merge in (("merged-only", "sum"), ("vit", "vit")):
        write_policy(
            tmp_path, {"all": 0.8}, method=method, merge=merge, setting="two", folder=f"two-{merge}"
        )
    assert claims(table(tmp_path, "merging")) == said
    said = claims(table(tmp_path, "merging-two"))
    assert said[0] == "vit minus sum: +0 points [-10, +10] on all; n = 100 on 1 task."
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
    assert said[0].endswith("The paper finds MAD ahead.")

"""What notebooks share: moments of episodes, what draws itself, small trainings."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

import madviz
from madviz import teaching
from madviz.agent.methods import METHODS
from madviz.errors import UserError
from madviz.observation.ablation import Occlusion
from madviz.observation.streams import StreamStack
from madviz.policies.checkpoint import find_policy
from madviz.teaching.inside import (
    norm_curves,
    report,
    saliency_sheet,
    shapley_curves,
    success_shapley,
)
from madviz.teaching.lessons import (
    answers,
    camera_sheet,
    feature_sheet,
    interval_figure,
    occlusion_sheet,
    subset_table,
    support_table,
    untrained,
)
from madviz.teaching.show import LABEL, bars, curves, sheet, source, table
from madviz.training.config import TrainConfig
from madviz.training.light import LightConfig
from tests.fakes import AllOrNothing, FakePolicy


def decoded(picture) -> np.ndarray:
    """(H, W, 3) RGB of what a browser would get."""
    raw = cv2.imdecode(np.frombuffer(picture._repr_png_(), np.uint8), cv2.IMREAD_COLOR)
    assert raw is not None
    return cv2.cvtColor(raw, cv2.COLOR_BGR2RGB)


def test_moments_are_the_episode_that_an_evaluation_counts() -> None:
    policy = FakePolicy()
    steps = list(teaching.moments(policy, seed=5001))
    assert [m.step for m in steps] == list(range(26))
    counted = teaching.counts(madviz.evaluate(policy, ["all"], episodes=1, seed=5001).rows)
    assert counted["all"] == (int(steps[-1].success), 1)


def test_a_moment_has_what_the_network_gets() -> None:
    now = teaching.moment_at(FakePolicy(), seed=7, step=4)
    assert now.stack.shape == (3, 9, 84, 84)
    frames = teaching.frames_of(now.stack, 0)
    assert np.array_equal(frames[-1], now.views["first"].rgb)
    assert np.array_equal(now.action("all"), now.probe.readout.action[0])
    assert not np.array_equal(now.action("first"), now.action("all"))


def test_an_occluded_camera_arrives_black_but_is_seen_as_it_is() -> None:
    now = teaching.moment_at(FakePolicy(), step=3, occlusions={"first": Occlusion("black")})
    assert now.arrived["first"].max() == 0 and now.views["first"].rgb.max() > 0
    assert now.stack[0].max() == 0 and now.stack[1].max() > 0


def test_the_same_time_step_with_a_failed_camera() -> None:
    now = teaching.moment_at(FakePolicy(), step=3)
    failed = teaching.occluded(now, {"first": Occlusion("black"), "third_a": Occlusion("freeze")})
    assert failed.stack[0].max() == 0 and now.stack[0].max() > 0
    assert np.array_equal(failed.stack[1], np.tile(now.stack[1, :3], (3, 1, 1)))
    assert np.array_equal(failed.stack[2], now.stack[2])
    assert failed.probe.norms[2] == now.probe.norms[2]
    assert failed.arrived["first"].max() == 0
    late = teaching.occluded(now, {"third_b": Occlusion("delay", strength=0.1)})
    assert late.stack[2, 3:6].tolist() == now.stack[2, :3].tolist() == late.stack[2, :3].tolist()
    assert late.stack[2, 6:].tolist() == now.stack[2, 3:6].tolist()


def test_steps_beyond_the_episode_and_unsupported_subsets_are_refused() -> None:
    with pytest.raises(UserError, match="over before that"):
        teaching.moment_at(FakePolicy(), step=26)
    with pytest.raises(UserError, match="cannot act on 'first'"):
        teaching.moment_at(AllOrNothing(), subset="first")


def test_a_sheet_shows_the_very_pixels() -> None:
    red, grey = np.zeros((4, 4, 3), np.uint8), np.full((4, 4, 1), 90, np.uint8)
    red[..., 0] = 200
    shown = decoded(sheet({"a": red, "b": grey}, size=40))
    assert shown.shape == (40 + LABEL, 86, 3)
    assert (shown[LABEL + 1 : LABEL + 39, 1:39] == (200, 0, 0)).all()
    assert (shown[LABEL + 1 : LABEL + 39, 47:85] == 90).all()
    assert shown[:LABEL, :40].min() < 100, "a label is written above"
    with pytest.raises(UserError):
        sheet({})


def test_pictures_of_a_moment_differ_where_the_world_does() -> None:
    now = teaching.moment_at(FakePolicy(width=64), step=3)
    assert not np.array_equal(camera_sheet(now).pixels, camera_sheet(now, "depth").pixels)
    black = occlusion_sheet(now, "third_b", size=50).pixels[LABEL : LABEL + 50, 56:106]
    assert black.max() == 0, "the second tile is the black one"
    assert feature_sheet(now).pixels.shape[0] == 168 + LABEL


def test_figures_and_tables_have_svg_html_and_plain_text() -> None:
    figure = bars("a title", ["x", "y"], {"s": [(8, 10), 0.5]})
    ElementTree.fromstring(figure._repr_svg_())
    assert "a title" in figure.html
    words = repr(table(["name", "rate"], [["a", 0.5], ["long name", True]]))
    assert words.splitlines()[1].split() == ["a", "0.50"] and "yes" in words
    assert "&lt;b&gt;" in table(["h"], [["<b>"]])._repr_html_()
    ElementTree.fromstring(curves("c", "updates", {"one": ([1, 2], [4.0, 2.0])}).svg)


def test_source_is_the_code_that_ships() -> None:
    text = source(StreamStack.push).text
    assert text.startswith("def push(") and "```python" in source(StreamStack)._repr_markdown_()


def test_numbers_come_with_their_intervals() -> None:
    assert teaching.in_words(8, 10) == "8 of 10 = 0.80, 95% interval [0.49, 0.94]"
    assert repr(teaching.in_words(0, 0)).startswith("0 of 0")
    assert "n = 100" in interval_figure(8, 10).svg
    measured = {"mad": {"all": (9, 10), "first": (1, 10)}, "other": {"all": (0, 10)}}
    assert "not measured" in repr(teaching.success_table(measured))
    assert teaching.success_bars("t", measured).svg.count(">first<") == 0


def test_shipped_numbers_are_those_of_the_card() -> None:
    shipped = teaching.shipped("metaworld-hammer-merged-only-light")
    outcomes = teaching.shipped_outcomes("metaworld-hammer-merged-only-light", "all")
    assert shipped["all"] == (sum(outcomes.values()), len(outcomes))
    with pytest.raises(UserError):
        teaching.shipped("no-such-policy")


@pytest.mark.parametrize("name", sorted(METHODS))
def test_every_method_answers_untrained_or_says_why_not(name: str) -> None:
    moment = teaching.moment_at(FakePolicy(), step=1)
    policy = untrained(name)
    if METHODS[name].one_camera:
        assert policy.spec.streams == ("first",)
        return
    rows = {row[0]: row[1] for row in answers(policy, moment, ["all", "first+third_b"]).rows}
    assert not rows["all"].startswith("refuses")
    row = {r[0]: r for r in support_table().rows}[name]
    assert (row[3] == "🟩") == (not rows["First person + Third B"].startswith("refuses"))


def test_the_subset_table_has_a_row_for_every_set() -> None:
    now = teaching.moment_at(FakePolicy(), step=1)
    assert len(subset_table(now).rows) == 8 and len(subset_table(now, every=False).rows) == 4


def test_saliency_is_dark_where_a_camera_is_not_in_the_sum() -> None:
    moment = teaching.moment_at(untrained("mad"), step=3)
    size = 84
    shown = saliency_sheet(moment, "first", size=size).pixels[LABEL:]
    first, third = shown[:, :size], shown[:, size + 6 : 2 * size + 6]
    assert first.max() > 150 > third.max()
    with pytest.raises(UserError, match="no saliency"):
        saliency_sheet(teaching.moment_at(FakePolicy(), step=1))


def test_shapley_values_for_success_add_up_to_it() -> None:
    streams = ("first", "third_a")
    counted = {"all": (10, 10), "first": (2, 10), "third_a": (6, 10), "none": (0, 10)}
    values, shown = success_shapley(counted, streams)
    assert values.cameras == pytest.approx([0.3, 0.7])
    assert [row[1] for row in shown.rows] == ["+0.30", "+0.70", "+1.00"]
    with pytest.raises(UserError, match="every subset"):
        success_shapley({"all": (1, 2)}, streams)


def test_curves_of_an_episode_have_a_line_for_every_camera() -> None:
    episode = list(teaching.moments(FakePolicy(), seed=1))[:5]
    assert norm_curves(episode).svg.count('class="line"') == 4
    assert shapley_curves(episode).svg.count('class="line"') == 3


def test_a_report_is_whole_and_loads_nothing(tmp_path) -> None:
    shown = report("tests.fakes:FakePolicy", tmp_path, seed=1, drop=["first@3"])._repr_html_()
    assert shown.startswith("<iframe srcdoc=") and "first@3" in shown
    assert "http://" not in shown.replace("http://www.w3.org", "")


def test_a_small_training_is_not_repeated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[TrainConfig] = []

    def train(config: TrainConfig, listener) -> None:
        asked.append(config)
        shutil.copytree(find_policy("metaworld-hammer-mad-light"), str(config.out))
        listener({"kind": "curve", "round": 1, "loss": 0.25, "seconds_left": 290.0})

    monkeypatch.setattr("madviz.training.train.train", train)
    first, again = (
        teaching.train_small("mad", rounds=3, updates=7, folder=tmp_path) for _ in range(2)
    )
    assert len(asked) == 1 and not asked[0].resume
    assert (asked[0].light.rounds, asked[0].light.updates_per_round) == (3, 7)
    assert first.seconds > 0 == again.seconds and first.spec.digest == again.spec.digest
    assert len(first.curve) == len(again.curve) and first.curve[0]["round"] == 1
    assert capsys.readouterr().out.count("round 1: loss 0.250 (5 min to go)") == 1
    other = teaching.train_light("toy/reach", "mad", LightConfig(rounds=3), folder=tmp_path)
    assert len(asked) == 2 and asked[1].light == LightConfig(rounds=3) != asked[0].light
    assert other.folder != first.folder, "another size is another run"


def test_a_training_that_was_stopped_is_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[TrainConfig] = []

    def train(config: TrainConfig, listener) -> None:
        asked.append(config)
        assert (out := config.out) is not None
        if len(asked) == 1:
            (out / "resume").mkdir(parents=True)
            (out / "resume" / "run.json").touch()
        shutil.copytree(find_policy("metaworld-hammer-mad-light"), out, dirs_exist_ok=True)
        described = json.loads((out / "config.json").read_text())
        described["training"]["finished"] = len(asked) > 1
        if len(asked) > 1:
            (out / "resume" / "finished").touch()
        (out / "config.json").write_text(json.dumps(described))

    monkeypatch.setattr("madviz.training.train.train", train)
    with pytest.raises(UserError, match="to resume it"):
        teaching.train_light("toy/reach", "mad", folder=tmp_path)
    done = teaching.train_light("toy/reach", "mad", folder=tmp_path)
    assert [config.resume for config in asked] == [False, True]
    assert asked[0].light == LightConfig() and done.seconds > 0


def test_two_policies_are_compared_on_the_seeds_that_both_have() -> None:
    ours, theirs = {1: True, 2: True, 3: False}, {2: False, 3: False, 4: True}
    row = teaching.paired_table(("a", "b"), {"first": (ours, theirs)}).rows[0]
    assert row[:5] == ("First person", "0", "1", "0", "1") and row[5].startswith("+0.50 [")
    assert row[5].endswith("n=2")


@pytest.mark.parametrize(
    "key, words",
    [
        ("first+third_b.depth", "First person + Third B depth"),
        ("only third_a", "only Third A"),
        ("third_a.rgb", "Third A colour"),
        ("none", "no camera"),
        ("all", "all"),
        ("firsthand", "firsthand"),
    ],
)
def test_a_person_reads_the_names_of_cameras(key: str, words: str) -> None:
    assert teaching.named(key) == words

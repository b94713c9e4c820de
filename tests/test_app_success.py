"""What the page says of a policy: its verdict, how often it succeeds, and what a change did."""

from __future__ import annotations

import re
import traceback
from collections.abc import Hashable
from dataclasses import replace
from html import escape

import numpy as np
import pytest

from madviz.app.layout import Shared
from madviz.app.markup import error_html
from madviz.app.page import Page
from madviz.app.panel import apply
from madviz.app.panels.policy import (
    PolicyChoice,
    PolicyPanel,
    purpose,
    status_html,
    verdict,
)
from madviz.app.panels.subsets import subsets_html
from madviz.app.panels.success import (
    Curve,
    SuccessPanel,
    bars_html,
    strip_html,
)
from madviz.app.panels.words import WordsPanel, both_sides, sentence
from madviz.app.pictures import picture
from madviz.app.success_rates import SuccessRates, side_b
from madviz.envs.registry import make_env
from madviz.measure.live import Request, Tally
from madviz.measure.statistics import SuccessRate
from madviz.observation.ablation import CameraState, Occlusion
from madviz.observation.condition import Condition
from madviz.policies.checkpoint import load_policy
from madviz.recording.facts import condition_words
from madviz.session.commands import (
    Compare,
    Link,
    Pause,
    ReadSubsets,
    SetCamera,
    SetPolicy,
    SetSaliency,
    SetSeed,
)
from madviz.session.frame import Frame
from madviz.session.session import Session
from tests.fakes import FakePolicy, policies
from tests.pages import await_that, browser, recorded, use
from tests.sessions import BLACK, OFF, Recorder, any_task, elsewhere, frame_with, with_pace


def test_a_machine_that_cannot_keep_up_says_so():
    playing = {"phase": "playing", "speed": 10.0}
    kept = status_html(with_pace(frame_with(), rate=9.6, **playing))
    behind = status_html(with_pace(frame_with(), rate=4.2, **playing))
    assert ">9.6/s<" in kept and ">4.2 of 10/s<" in behind


def test_a_policy_without_a_critic_has_no_value():
    frame = frame_with(policy=load_policy("madviz.examples.own_policy:make"))  # type: ignore
    assert "Q" not in status_html(frame)
    assert "nan" not in status_html(frame) + subsets_html(frame)


def test_the_bars_end_in_a_sentence_on_the_cameras_that_are_needed():
    rates = {"all": 1.0, "third_a+third_b": 0.0, "first+third_b": 0.98, "first+third_a": 1.0}
    shipped = {subset: {"success": rate, "n": 100} for subset, rate in rates.items()}
    html = bars_html(frame_with(), SuccessRates(lambda spec: shipped))
    assert "MAD needs First person: without it, 0.00 [0.00, 0.04] n=100." in html
    del shipped["first+third_a"]
    assert "needs" not in bars_html(frame_with(), SuccessRates(lambda spec: shipped))


def test_success_bars_tell_shipped_from_measured(server):
    rates = SuccessRates(lambda spec: {"all": {"success": 0.94, "n": 100}})
    frame = frame_with(SetCamera("third_a", OFF))
    assert rates.best(frame.world.policy, Condition("all")) == SuccessRate.of(94, 100)
    rates.add(frame.world.policy, frame.condition, {2000: True, 2001: False})
    rates.add(frame.world.policy, frame.condition, {2001: False})
    html = bars_html(frame, rates)
    assert "measured 0.94 [0.88, 0.97], n=100; nothing counted here" in html
    assert "nothing measured; counted here 0.50 [0.09, 0.91], n=2" in html
    assert "† First + Third B<" in html and 'title="First person + Third B:' in html
    panel = SuccessPanel(server.gui, frame, rates, visitor=1)
    apply(panel.update(frame))
    panel.remove()


def test_two_policies_with_other_streams_each_have_the_bars_that_mean_something_to_them():
    html = bars_html(frame_with(Compare("toy-rgbd")), SuccessRates())
    assert html.count("<b>A</b>") == 5, "all, each camera alone, no camera"
    assert html.count("<b>B</b>") > 5
    assert "First person depth" in html


def test_a_ninth_bar_makes_all_of_them_lower_so_that_the_panel_needs_no_scrolling():
    pairs = ("first+third_a", "first+third_b", "third_a+third_b")
    rates = SuccessRates(lambda spec: {name: {"success": 1.0, "n": 100} for name in pairs})
    frozen = SetCamera("third_b", CameraState("rgb", Occlusion("freeze")))
    for frame, count in ((frame_with(), 8), (frame_with(frozen), 9)):
        heights = re.findall(r'class="rate.*?height:(\d+)px', bars_html(frame, rates))
        assert len(heights) == count
        assert sum(map(int, heights)) <= 160, "pixels that are left in a window 800 high"


def test_rates_tell_their_listeners_only_news():
    calls = []
    rates = SuccessRates()
    rates.subscribe(lambda: calls.append(1))
    spec = FakePolicy().spec
    rates.add(spec, Condition("all"), {1: True})
    rates.add(spec, Condition("all"), {1: True})
    assert calls == [1]


def test_words_join_effect_and_success():
    frame = frame_with(SetCamera("third_a", OFF))
    rates = SuccessRates(lambda spec: {"all": {"success": 0.94, "n": 100}})
    assert frame.world.change is not None
    line = sentence(frame.world.change, frame, rates)
    assert line.startswith("Third A dropped: action changed by ")
    assert line.endswith("; success measured 0.94 → not measured yet")
    outcomes = {seed: seed % 16 > 2 for seed in range(16)}
    rates.add(frame.world.policy, frame.condition, outcomes)
    assert sentence(frame.world.change, frame, rates).endswith("0.94 → 0.81 (n=16)")


def test_words_stay_until_something_else_happens(server):
    frame = frame_with(SetCamera("third_a", OFF))
    gui = recorded(server.gui)
    panel = WordsPanel(gui, frame_with(), SuccessRates())
    assert "Take a camera away" in gui.html
    apply(panel.update(frame))
    later = replace(frame, world=replace(frame.world, change=None))
    apply(panel.update(later))
    assert "Third A dropped" in gui.html
    other_episode = replace(later, world=replace(later.world, episode=7))
    apply(panel.update(other_episode))
    assert "Third A dropped" in gui.html, "it still is"
    apply(panel.update(frame_with()))
    assert "Third A dropped" not in gui.html, "an earlier step has it"
    session = Recorder()
    session.at(0.0)
    session.ask(SetCamera("third_a", OFF))
    back = session.ask(SetCamera("third_a", CameraState("rgb")))
    apply(panel.update(back))
    assert "Third A" in gui.html
    apply(panel.update(replace(back, world=replace(back.world, change=None, episode=7))))
    assert "Take a camera away" in gui.html
    panel.remove()


def test_curve_marks_changes():
    curve, spec = Curve(), FakePolicy().spec
    assert curve.add(spec, Condition("all"), SuccessRate.of(1, 1))
    assert not curve.add(spec, Condition("all"), SuccessRate.of(1, 1))
    assert curve.add(spec, Condition("first"), SuccessRate.of(0, 0))
    assert curve.add(spec, Condition("first"), SuccessRate.of(0, 1))
    x, low, _, success, change = curve.data()
    assert list(x) == [1, 1.5, 1.5, 1.5, 2]
    assert list(change) == [-1, -1, 1, -1, -1], "seen only while it rises to 1"
    assert list(success) == [1, 1, 1, 1, 0] and low[2] == low[0]


def test_the_strip_shows_how_episodes_ended():
    session = Session(make_env, FakePolicy(), policies, speed=None)
    session.tick(0.0)
    session.send(SetCamera("first", OFF))
    for _ in range(30):
        session.tick(0.0)
    assert isinstance(session.latest, Frame)
    assert "first off" in strip_html(session.latest)
    name = session.latest.world.policy.name
    for shown, there in ((f"{name} (guarded)", True), ("other", False)):
        policy = replace(session.latest.world.policy, name=shown)
        frame = replace(session.latest, world=replace(session.latest.world, policy=policy))
        assert ("first off" in strip_html(frame)) == there, shown


def test_what_a_guard_changes_is_said_where_both_were_measured(server):
    rates = SuccessRates()
    frame = frame_with(SetCamera("first", BLACK))
    bare = frame.world.policy
    guarded = replace(bare, name=f"{bare.name} (guarded)", digest="guarded")
    rates.add(bare, frame.condition, dict.fromkeys(range(20), False))
    rates.add(guarded, frame.condition, dict.fromkeys(range(20), True))
    panel = SuccessPanel(server.gui, frame, rates, None)
    assert "guard" not in panel.update(frame)[0].value, "it was not on here yet"
    on = replace(frame, world=replace(frame.world, policy=guarded))
    words = "The guard helps: 1.00 with it, 0.00 without, on the same 20 scenes"
    assert words in panel.update(on)[0].value
    assert words in panel.update(frame)[0].value
    intact = frame_with()
    assert "The guard" not in panel.update(intact)[0].value
    # A training that calls itself like an included policy.
    mine = replace(bare, digest="mine")
    rates.add(mine, frame.condition, dict.fromkeys(range(20), False))
    own = replace(frame, world=replace(frame.world, policy=mine, reference="runs/mine"))
    assert "The guard" not in panel.update(own)[0].value


def test_verdicts_have_words_and_colours():
    running, paused = frame_with(), frame_with(Pause())
    assert [verdict(frame)[0] for frame in (running, paused)] == ["RUNNING", "PAUSED"]
    broken = frame_with(SetPolicy("nonsense"))
    assert verdict(broken)[0] == "STOPPED"
    assert "<b>Paused: unknown policy" in status_html(broken)
    assert "<details>" in status_html(broken) and "Traceback" in status_html(broken)


@pytest.mark.parametrize("words", ["", "a user's mistake\n\n"])
def test_an_error_says_what_is_wrong_and_keeps_where_closed(words):
    try:
        raise ValueError("3 < 4")
    except ValueError:
        shown = error_html("Paused: ", words + traceback.format_exc())
    said = words.strip() or "ValueError: 3 < 4"
    assert shown.startswith(f"<b>Paused: {escape(said)}</b>")
    assert "test_app_success.py" in shown.partition("<details>")[2]
    assert "<details>" not in error_html("", "only words")


def test_policy_panel_shows_without_sending(server):
    sent: list = []
    choices = [PolicyChoice("toy-mad", "MAD"), PolicyChoice("toy-rgbd", "RGB-D")]
    gui = recorded(server.gui)
    panel = PolicyPanel(gui, sent.append, frame_with(), choices)
    apply(panel.update(frame_with(SetPolicy("toy-rgbd"))))
    assert gui.find("Policy").value == "RGB-D" and sent == []
    apply(panel.update(frame_with(SetSeed(7))))
    assert gui.find("Seed").value == 7 and sent == [], "the field names the episode that runs"
    gui.find("Seed").value = 12
    apply(panel.update(frame_with(SetSeed(7))))
    assert gui.find("Seed").value == 12, "a number that a visitor types stays"
    panel.remove()


def test_policies_are_offered_by_task(server):
    sent: list = []
    choices = [
        PolicyChoice("pusher", "MAD: push", "metaworld/push"),
        PolicyChoice("toy-mad", "MAD: reach", "toy/reach"),
        PolicyChoice("mine", "broken"),
    ]
    gui = recorded(server.gui)
    panel = PolicyPanel(gui, sent.append, frame_with(), choices)
    assert gui.find("Policy").options == ("MAD: reach", "broken")
    assert gui.find("Task").value == "toy/reach"
    assert gui.find("Task").options == ("metaworld/push", "toy/reach")
    use(gui.find("Task"), "metaworld/push")
    assert sent == [SetPolicy("pusher")]
    panel.remove()


def test_what_a_policy_is_for_tells_those_of_one_task_apart():
    words = [
        purpose("mad", "three", "light"),
        purpose("mad", "three-rgbd", "light"),
        purpose("merged-only", "three", "paper"),
    ]
    assert words[0].startswith("MAD: ") and words[1] == f"{words[0]} (three-rgbd)"
    assert words[2].startswith("Merged Only: ") and words[2].endswith("together (paper)")


def test_bars_and_outcomes_of_both_sides_stand_under_each_other(server):
    shipped = {"toy-mad": {"all": {"success": 0.94, "n": 100}}, "toy-other": {}}
    rates = SuccessRates(lambda spec: shipped[spec.name])
    frame = frame_with(Compare("toy-other"))
    html = bars_html(frame, rates)
    rows = bars_html(frame_with(), rates).count('class="rate')
    assert html.count("<b>A</b>") == html.count("<b>B</b>") == rows
    assert "measured 0.94" in html and html.count("first episode is still running") == 0
    assert strip_html(frame).count("the first episode is still running") == 2


def test_a_camera_that_gives_nothing_the_policy_knows_is_as_good_as_dropped():
    only_depth = SetCamera("first", CameraState("depth", Occlusion("black")))
    session = Recorder()
    session.tick(0.0)
    session.ask(only_depth)
    frame = session.steps(30)
    (outcome,) = frame.world.outcomes
    assert outcome.condition == Condition("third_a+third_b")
    assert outcome.cameras == {"first": "off", "third_a": "", "third_b": ""}
    assert "first off" in strip_html(frame) and "all cameras worked" not in strip_html(frame)
    assert [frame.uses(name) for name in outcome.cameras] == [False, True, True]
    assert condition_words(frame) == "Third A + Third B"
    dropped = frame_with(SetCamera("first", OFF))
    assert np.array_equal(picture(frame_with(only_depth), "first"), picture(dropped, "first"))
    both = frame_with(only_depth, policy=FakePolicy("toy-rgbd", "three-rgbd"))
    assert both.uses("first")


def test_both_sides_are_measured_while_there_are_two(server):
    asked = Asked()
    rates = SuccessRates(make_evaluator=lambda listener: asked)  # type: ignore[arg-type]
    panel = SuccessPanel(server.gui, frame_with(), rates, visitor=1)
    apply(panel.update(frame_with(Compare("toy-other"))))
    assert asked.by == {1: "toy-mad", side_b(1): "toy-other"}
    apply(panel.update(frame_with()))
    assert asked.by == {1: "toy-mad"}
    panel.remove()
    assert asked.by == {}


def test_measuring_is_switched_on_again_while_an_episode_stands_still(server):
    asked = Asked()
    rates = SuccessRates(make_evaluator=lambda listener: asked)  # type: ignore[arg-type]
    gui = recorded(server.gui)
    panel = SuccessPanel(gui, frame_with(), rates, visitor=1)
    apply(panel.update(frame_with(Pause())))
    for on in (False, True):
        use(gui.find("Measure"), on)
        assert bool(asked.by) == panel.measures == on
    panel.remove()


def test_what_a_visitor_has_chosen_outlives_a_change_of_task(server):
    asked = Asked()
    rates = SuccessRates(make_evaluator=lambda listener: asked)  # type: ignore[arg-type]
    client, session = browser(server), Recorder(env_factory=any_task, load=elsewhere)
    gui = client.gui
    page = Page(client, session, Shared([], rates))
    page.start()
    session.ask(Pause(), SetSaliency("action"), ReadSubsets(True))
    await_that(lambda: asked.by)
    use(gui.find("Measure"), False)
    page._prediction.take("yes", 1)
    session.ask(SetPolicy("elsewhere"))
    await_that(lambda: len([one for one in gui.added if one_is(one, "save the last 20")]) == 2)
    page.close()
    assert not gui.find("Measure", 1).value and asked.ever == {"toy-mad"}
    assert gui.find("Read every subset", 1).value
    assert page._prediction.guess == "", "a guess is about the episode of its own task"
    page.clear()


def one_is(handle, label: str) -> bool:
    return getattr(handle, "label", None) == label


class Asked:
    """In place of an evaluator: who wants which policy measured."""

    trouble = ""

    def __init__(self) -> None:
        self.by: dict[Hashable, str] = {}
        self.ever: set[str] = set()

    def request(self, visitor: Hashable, policy: str, condition: Condition, digest: str) -> Tally:
        self.by[visitor] = policy
        self.ever.add(policy)
        return Tally(Request(policy, "", condition), ())

    def forget(self, visitor: Hashable) -> None:
        self.by.pop(visitor, None)


def test_words_say_what_came_of_it_on_both_sides():
    frame = frame_with(Compare("toy-other"), SetCamera("third_a", OFF))
    rates = SuccessRates(lambda spec: {"all": {"success": 0.94, "n": 100}})
    assert frame.world.change is not None and frame.second is not None
    said = both_sides(frame.world.change, frame, rates)
    assert said.startswith("Third A dropped: A's action changed by ")
    second = frame.second.world
    assert second.change is not None
    lost = replace(second.change, action_change=np.nan, acts=False)
    unable = replace(frame.second, world=replace(second, change=lost))
    said_of_b = both_sides(frame.world.change, replace(frame, second=unable), rates)
    assert "; B cannot act on that" in said_of_b and "nan" not in said_of_b
    assert "; B's action changed by " in said


def test_an_old_change_of_b_is_not_reported_as_this_one():
    commands = (SetCamera("first", OFF), Link(False), SetCamera("first", CameraState("rgb")))
    frame = frame_with(Compare("toy-other"), *commands)
    assert frame.world.change is not None
    said = both_sides(frame.world.change, frame, SuccessRates())
    assert said.startswith("First person is back: action changed by ")
    back = frame_with(Compare("toy-other"), *commands, SetCamera("first", OFF))
    assert back.world.change is not None
    assert "B's" not in both_sides(back.world.change, back, SuccessRates())

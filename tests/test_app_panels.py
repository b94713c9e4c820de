"""Panels on a real server without a browser: what they compute, and that they leave nothing."""

from __future__ import annotations

import asyncio
import re
from base64 import b64decode
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from msgspec import structs

from madviz.app.connection import CROSSED, _bound, _forgive, is_too_late
from madviz.app.keys import Keys
from madviz.app.panel import Assign, apply
from madviz.app.panels.breaks import BreakPanel
from madviz.app.panels.cameras import CamerasPanel, switched
from madviz.app.panels.features import FeaturesPanel, curve_point, features_html
from madviz.app.panels.policy import PolicyChoice, PolicyPanel, status_html
from madviz.app.panels.save import file_name, save_html
from madviz.app.panels.shapley import shapley_html
from madviz.app.panels.subsets import SubsetsPanel, presence, subsets_html
from madviz.app.panels.success import SuccessPanel
from madviz.app.panels.words import Prediction, WordsPanel
from madviz.app.scene.scene import ScenePanel
from madviz.app.screen import Screen
from madviz.app.success_rates import SuccessRates
from madviz.app.toolkit import Choice
from madviz.drawing.viewpoint import focus
from madviz.envs.registry import make_env
from madviz.observation.ablation import CameraState, Occlusion
from madviz.observation.condition import Condition
from madviz.observation.displacement import Displacement, MoveCamera
from madviz.session.camera_names import subset_label
from madviz.session.commands import (
    Compare,
    Fork,
    Link,
    Pause,
    Play,
    Scrub,
    SetCamera,
    SetPolicy,
    StepOnce,
)
from madviz.session.frame import Frame
from madviz.session.session import Session
from tests.fakes import AllOrNothing, FakePolicy, NanPolicy, policies
from tests.pages import browser, recorded, use
from tests.sessions import OFF, Recorder, frame_with, with_pace, with_world


def test_camera_switches_send_commands_and_never_echo(server):
    sent: list = []
    gui = recorded(server.gui)
    panel = CamerasPanel(gui, sent.append, frame_with(), 622)
    noisy = CameraState("rgb", Occlusion("noise", 0.3))
    frame = frame_with(SetCamera("third_a", noisy))
    apply(panel.update(frame))
    assert sent == [], "showing a state must not set one"
    assert [switched(frame, name) for name in ("first", "third_a")] == ["on", "break"]
    use(gui.find("Third A"), "off")
    assert sent == [SetCamera("third_a", CameraState("off", Occlusion("noise", 0.3)))]
    aside = MoveCamera("third_a", Displacement(right=0.1))
    apply(panel.update(frame_with(sent.pop(), aside)))
    use(gui.find("Third A"), "on")
    assert sent == [SetCamera("third_a", CameraState("rgb")), MoveCamera("third_a", None)]
    panel.remove()


def test_one_camera_at_a_time_is_open_to_be_broken(server):
    sent: list = []
    gui = recorded(server.gui)
    frame = frame_with(SetCamera("third_a", CameraState("off", Occlusion("noise", 0.3))))
    panel = CamerasPanel(gui, sent.append, frame, 622)
    panel.breaks = breaks = BreakPanel(gui, sent.append, frame)
    folder = gui.of("GuiFolderHandle")[0]
    assert not folder.visible
    use(gui.find("Third A"), "break …")
    strength = gui.find("strength")
    assert (folder.visible, folder.label) == (True, "Break or move Third A")
    assert strength.visible and strength.value == 0.3 and not gui.find("x").visible
    use(gui.find("Sends"), "blur")
    assert sent == [SetCamera("third_a", CameraState("rgb", Occlusion("blur", 0.3)))]
    use(gui.find("First person"), "break …")
    assert folder.label == "Break or move First person" and not strength.visible
    use(gui.find("close"))
    assert not folder.visible and len(sent) == 1
    breaks.remove()
    panel.remove()
    assert not gui.present


def test_an_old_frame_does_not_take_back_a_choice(server):
    """The callback that sends a command reads the widget after a frame may have come between."""
    sent: list = []
    choices = [PolicyChoice(name, name) for name in ("toy-mad", "toy-rgbd")]
    gui = recorded(server.gui)
    panel = PolicyPanel(gui, sent.append, frame_with(), choices)
    picker = gui.find("Policy")
    picker.value = "toy-rgbd"
    apply(panel.update(frame_with()))
    assert picker.value == "toy-rgbd"
    apply(panel.update(frame_with(SetPolicy("nonsense"))))
    assert picker.value == "toy-mad", "it could not be loaded"
    panel.remove()


def test_a_slider_being_dragged_is_not_pulled_back(server):
    sent: list = []
    gui = recorded(server.gui)
    old = frame_with(SetCamera("first", CameraState("rgb", Occlusion("blur", 0.5))))
    panel = BreakPanel(gui, sent.append, old)
    apply(panel.turn("first"))
    slider = gui.find("strength")
    use(slider, 0.8)
    apply(panel.update(old))
    assert slider.value == 0.8
    earlier = frame_with(SetCamera("first", CameraState("rgb", Occlusion("blur", 0.6))))
    apply(panel.update(earlier))
    assert slider.value == 0.8, "a frame on its way knows nothing of the drag yet"
    apply(panel.update(frame_with(sent[-1])))
    apply(panel.update(old))
    assert slider.value == 0.5, "once confirmed, later states are shown again"
    panel.remove()


def test_a_dropped_stream_adds_nothing_to_the_curves():
    point = curve_point(frame_with(SetCamera("third_a", OFF)))
    assert point[1] == 0 and min(point[0], point[2], point[3]) > 0


def test_features_follow_the_streams_of_another_policy(server):
    gui = recorded(server.gui)
    panel = FeaturesPanel(gui, frame_with())
    apply(panel.update(frame_with()))
    six = frame_with(SetPolicy("toy-rgbd"))
    apply(panel.update(six))
    assert len(gui.of("GuiUplotHandle")[-1].series) == 8
    assert "Third B depth" in gui.html
    panel.remove()


def test_a_time_step_seen_twice_is_one_point(server):
    gui = recorded(server.gui)
    session = Session(make_env, FakePolicy(), policies, speed=None)
    panel = FeaturesPanel(gui, frame_with())
    for command in (Pause(), SetCamera("first", OFF), StepOnce()):
        session.send(command)
        session.tick(0.0)
        assert isinstance(session.latest, Frame)
        apply(panel.update(session.latest))
    decisions, first, *_ = gui.of("GuiUplotHandle")[0].data
    assert len(decisions) == 2 and list(first) == [0, 0], "dropped before the second step"
    panel.remove()


def test_curves_have_every_decision_though_they_are_drawn_less_often(server):
    session = Session(make_env, FakePolicy(), policies, speed=None)
    session.tick(0.0)
    gui = recorded(server.gui)
    panel = FeaturesPanel(gui, frame_with())
    for _ in range(40):  # An episode has 25 decisions, the next one begins with a frame of its own.
        assert isinstance(session.latest, Frame)
        panel.note(session.latest)
        session.tick(0.0)
    assert isinstance(session.latest, Frame)
    apply(panel.update(session.latest))
    steps = gui.of("GuiUplotHandle")[0].data[0]
    assert list(steps) == list(range(session.latest.world.step + 1)), "of the second episode alone"
    panel.remove()


def test_looking_back_leaves_the_curves_as_they_are(server):
    session = Recorder()
    session.at(0.0)
    gui = recorded(server.gui)
    panel = FeaturesPanel(gui, frame_with())
    for _ in range(5):
        apply(panel.update(session.steps(1)))
    before = gui.of("GuiUplotHandle")[0].data
    for step in (2, 4, 1):
        apply(panel.update(session.ask(Scrub(step))))
    np.testing.assert_array_equal(gui.of("GuiUplotHandle")[0].data, before)
    panel.remove()


def test_curves_go_on_from_an_earlier_step(server):
    session = Recorder()
    session.at(0.0)
    gui = recorded(server.gui)
    panel = FeaturesPanel(gui, frame_with())
    for _ in range(8):
        apply(panel.update(session.steps(1)))
    for command in (Scrub(2), Fork()):
        apply(panel.update(session.ask(command)))
    apply(panel.update(session.steps(2)))
    steps = list(gui.of("GuiUplotHandle")[0].data[0])
    assert steps == sorted(set(steps)) and steps[-1] == session.frames[-1].world.step < 8
    panel.remove()


def asking(server):
    """A session, a page's controls, a visitor's guess, and the panel that asks for it."""
    session = Recorder()
    session.at(0.0)
    gui = recorded(server.gui)
    prediction = Prediction()
    return session, gui, prediction, WordsPanel(gui, session.frames[-1], SuccessRates(), prediction)


def test_an_episode_ends_in_words_and_a_guess_counts_for_one(server):
    session, gui, prediction, panel = asking(server)
    session.ask(Compare("toy-other"))
    prediction.take("both")
    first = session.steps(25)
    apply(panel.update(first))
    assert first.ended and "You said both" in gui.html and "not measured yet" in gui.html
    apply(panel.update(session.steps(1)))
    apply(panel.update(session.steps(25)))
    assert "mv-ending" in gui.html and "You said" not in gui.html
    panel.remove()


def test_nothing_goes_on_by_itself_after_an_end_in_a_pause(server):
    session, gui, _, panel = asking(server)
    session.ask(SetCamera("first", OFF))
    apply(panel.update(session.steps(25)))
    assert "The next one soon" in gui.html
    apply(panel.update(session.ask(Pause())))
    assert "mv-ending" in gui.html and "The next one soon" not in gui.html
    panel.remove()


def test_a_guess_on_a_later_episode_waits_for_it(server):
    session, gui, prediction, panel = asking(server)
    session.ask(Compare("toy-other"))
    prediction.take("both", asked_in=session.frames[-1].world.episode)
    apply(panel.update(session.steps(25)))
    assert "mv-ending" in gui.html and "You said" not in gui.html
    apply(panel.update(session.steps(1)))
    apply(panel.update(session.steps(25)))
    assert "You said both" in gui.html
    panel.remove()


def test_a_dropped_camera_is_a_question_until_it_is_answered_or_silenced(server):
    session, gui, prediction, panel = asking(server)
    answers = gui.find("Your guess")
    apply(panel.update(session.steps(1)))
    assert not answers.visible
    apply(panel.update(session.ask(SetCamera("first", OFF))))
    assert answers.visible and answers.options == ("yes", "no", "just show me")
    assert ". <b>Will it still do it?" in gui.html
    use(answers, "no")
    assert not answers.visible and "You say no." in gui.html
    apply(panel.update(session.steps(24)))
    assert "You said no" in gui.html
    apply(panel.update(session.ask(Compare("toy-other"))))
    apply(panel.update(session.ask(SetCamera("third_a", OFF))))
    assert answers.visible
    assert answers.options == ("MAD", "Merged Only", "both", "neither", "just show me")
    use(answers, "just show me")
    apply(panel.update(session.ask(SetCamera("third_b", OFF))))
    assert not answers.visible and prediction.silent
    panel.remove()


def test_a_question_about_two_policies_is_another_one_than_about_one(server):
    session, gui, prediction, panel = asking(server)
    answers = gui.find("Your guess")
    session.ask(Compare("toy-other"))
    apply(panel.update(session.ask(SetCamera("first", OFF))))
    assert answers.options == ("MAD", "Merged Only", "both", "neither", "just show me")
    apply(panel.update(session.ask(Compare(None))))
    apply(panel.update(session.ask(SetCamera("third_a", OFF))))
    assert answers.visible and answers.options == ("yes", "no", "just show me")
    prediction.take("both", session.frames[-1].world.episode)  # It was given before.
    apply(panel.update(session.steps(1)))
    assert "You say" not in gui.html and answers.visible
    apply(panel.update(session.steps(24)))
    assert "mv-ending" in gui.html and "You said" not in gui.html
    panel.remove()


def test_features_table_names_every_stream_and_the_sum():
    html = features_html(frame_with(SetCamera("third_a", OFF)))
    for words in ("First person", "Third A · dropped", "Third B", "merged: their sum"):
        assert words in html


def test_labels_of_a_policy_are_text_and_no_html():
    frame = frame_with()
    cameras = tuple(replace(one, label="<b>x") for one in frame.world.env.cameras)
    frame = with_world(frame, env=replace(frame.world.env, cameras=cameras))
    shown = [features_html(frame), save_html(frame), shapley_html(frame, SuccessRates())]
    assert "&lt;b&gt;x" in shown[0] and not any("<b>x" in html for html in shown)


def test_the_commands_name_the_file_that_is_saved():
    session = Recorder()
    frame = session.ask(StepOnce())
    task = "my_robots.Lift:make"
    saved = session.save()
    last = structs.replace(saved.episodes[-1], task=task)
    name = file_name(replace(saved, episodes=(last,)))
    own = with_world(frame, env=replace(frame.world.env, task=task))
    assert name == "myrobotsiftmake-seed2000.json" and f"replay {name}" in save_html(own)


def test_space_keeps_an_ending_that_would_go_by():
    frame = frame_with()
    sent: list[object] = []

    def press(**pace):
        keys = Keys(sent.append, lambda: with_pace(frame, **pace), frame)
        next(act for _, key, act in keys.table if key == "space")()
        return sent[-1]

    assert press(phase="ended", auto_next=True) == press(phase="playing") == Pause()
    assert press(phase="ended", auto_next=False) == press(phase="paused") == Play()


def test_features_table_says_what_share_of_the_sum_a_stream_is():
    frame = frame_with(SetCamera("third_a", OFF))
    shares = [f"{100 * share:.0f} %" for share in frame.world.probe.shares(frame.row)]
    html = features_html(frame)
    assert shares[1] == "0 %"
    assert all(f">{share}</td>" in html for share in [*shares, "100 %"])


def test_features_table_claims_no_sum_where_there_is_none():
    frame = frame_with()
    squared = replace(frame.world.probe.readout, merged=frame.world.probe.readout.merged**2)
    probe = replace(frame.world.probe, readout=squared)
    for method, merged in (("mad", "merged"), ("concat", "merged: side by side"), ("x", "merged")):
        other = with_world(frame, probe=probe, policy=replace(frame.world.policy, method=method))
        html = features_html(other)
        assert f"{merged}</td>" in html and "sum" not in html and "100 %</td>" not in html
    blank = replace(frame.world.probe, features=0 * frame.world.probe.features)
    html = features_html(with_world(frame, probe=blank))
    assert html.count("<tr") == 2 and "No camera has a feature of its own" in html


def test_every_subset_has_a_row_and_untrained_ones_say_so(server):
    frame = frame_with(SetCamera("third_a", OFF))
    html = subsets_html(frame)
    assert html.count("<tr") == 1 + 8
    # Three pairs and the empty subset: nobody trained on those.
    assert html.count('title="not trained on"') == 4
    assert html.index("now") < html.index("no camera")
    six = subsets_html(frame_with(policy=policies("toy-rgbd")))
    assert six.count("<tr") == 1 + 64
    SubsetsPanel(server.gui, None, frame).remove()


def test_of_many_subsets_those_of_whole_cameras_are_shown_until_somebody_asks(server):
    frame = frame_with(SetCamera("first", CameraState("depth")), policy=policies("toy-rgbd"))
    html = subsets_html(frame, everything=False)
    # Eight sets of cameras, six single streams, and the present condition, with half a camera.
    assert html.count("<tr") == 1 + 8 + 6 + 1
    assert "49 sets with half a camera are not shown" in html
    gui = recorded(server.gui)
    panel = SubsetsPanel(gui, None, frame)
    switch = gui.find("Every row")
    assert switch.visible and gui.html == html
    use(switch, True)
    assert gui.html.count("<tr") == 1 + 64
    apply(panel.update(frame_with()))
    assert not switch.visible, "eight rows need no switch"
    panel.remove()


def test_subsets_say_how_far_their_actions_are_apart():
    frame = frame_with(SetCamera("third_a", OFF))
    action = frame.world.probe.readout.action
    apart = {
        row: tuple(f"{np.linalg.norm(action[row] - one):.2f}" for one in (frame.action, action[0]))
        for row in range(len(action))
    }
    assert apart[frame.row][0] == "0.00" == apart[0][1] != apart[3][0] != apart[3][1]
    assert sorted(apart_in(subsets_html(frame))) == sorted(apart.values())
    stops = frame_with(SetCamera("third_a", OFF), policy=AllOrNothing("toy-stack"))
    assert apart_in(subsets_html(stops)) == [("–", "0.00")]


def apart_in(html: str) -> list[tuple[str, ...]]:
    """The distances of each row that has an action, from the one now and from that of all."""
    return re.findall(r'<td class="num">([\d.]+|–)</td><td class="num">([\d.]+|–)</td>', html)


def test_a_policy_that_breaks_shows_where():
    html = subsets_html(frame_with(policy=NanPolicy("toy-nan")))
    assert html.count("cannot act on this") == 3


def test_the_goal_is_written_out_and_whether_it_is_met():
    frame = frame_with()
    goal = f">Goal: {frame.world.env.success}</div>"
    for fields, words in (
        ({"success": True}, "✔ Goal met now</div>"),
        ({"success": False, "success_any": True}, "✘ Goal not met now, but it was</div>"),
        ({"success": False, "success_any": False}, "✘ Goal not met now, nor before</div>"),
    ):
        html = status_html(with_world(frame, **fields))
        assert words in html and goal in html


def test_labels_and_squares():
    frame = frame_with(policy=policies("toy-rgbd"))
    assert subset_label(frame, "first+third_b.depth") == "First person + Third B depth"
    assert subset_label(frame, "depth") == "all depth"
    assert subset_label(frame, "first+third_a", short=True) == "First + Third A"
    assert subset_label(frame, "third_a+third_b", short=True) == "Third A + B"
    half = presence(frame, np.array([True, False] + [False] * 4))
    assert "linear-gradient(90deg,#E69F00 50%,transparent 50%)" in half


def test_both_sides_of_a_comparison_stand_side_by_side(server):
    sent: list = []
    gui = recorded(server.gui)
    panel = CamerasPanel(gui, sent.append, frame_with(), 622)
    alone = frame_with()
    apply(panel.update(alone))
    unlink, end = gui.find("Switches act on"), gui.find("end comparison")
    assert not (unlink.visible or end.visible) and "mv-side" not in gui.html
    frame = frame_with(Compare("toy-other"), SetCamera("first", OFF))
    apply(panel.update(frame))
    apply(panel.update(frame))
    shown = [one.content for one in gui.present if "mv-side" in getattr(one, "content", "")]
    assert len(shown) == 2 and all("RUNNING" in one for one in shown)
    sizes = re.findall(r'class="mv-mosaic" alt="[^"]*" width="(\d+)" height="(\d+)"', gui.html)
    assert sizes == [sizes[0]] * 2 and int(sizes[0][1]) < 203
    use(unlink, "A only")
    use(end)
    assert sent == [Link(False), Compare(None)]
    apply(panel.update(alone))
    assert not unlink.visible and not end.visible
    panel.remove()


def test_frusta_stand_where_the_cameras_are_and_dim_when_dropped(server):
    clicked: list[str] = []
    client = browser(server)
    panel = ScenePanel(client, frame_with(), clicked.append)
    frame = frame_with(SetCamera("first", OFF))
    apply(panel.update(frame))
    first, third = (client.scene.find(f"/cameras/{name}") for name in ("first", "third_a"))
    np.testing.assert_allclose(first.position, frame.world.poses["first"].position, atol=1e-6)
    assert first.color != third.color
    assert first.image is not None and np.ptp(first.image.astype(int), axis=2).max() == 0
    panel.remove()


def test_at_full_speed_frusta_change_one_picture_at_a_time(server):
    now, session = [0.0], Session(make_env, FakePolicy(), policies, speed=None)
    session.tick(0.0)
    frame = session.latest
    assert isinstance(frame, Frame)
    panel = ScenePanel(browser(server), frame, None, lambda: now[0])

    def pictures() -> list[str]:
        return [a.handle.name for a in panel.update(frame) if a.name == "image"]

    drawn = []
    for second in range(0, 12, 2):
        now[0] = float(second)
        drawn += pictures()
        assert pictures() == []  # At the same time there is nothing more to do.
    assert sorted(drawn) == sorted(2 * [f"/cameras/{name}" for name in frame.world.poses])
    panel.remove()


def test_a_screen_keeps_its_element_and_feeds_it(server):
    black = np.zeros((8, 12, 3), np.uint8)
    gui = recorded(server.gui)
    screen = Screen(gui, black, "1:0", "a picture")
    image, hidden = gui.added
    element = image.content
    apply([screen.show(black + 255, "1:1")])
    assert image.content == element and 'data-step="1:0"' in element
    feed, (name,) = hidden.content, re.findall(r'<img id="([^"]+)"', element)
    assert f'data-screen="{name}"' in feed and 'data-step="1:1"' in feed
    jpeg = b64decode(feed.split("base64,")[1].split('"')[0])
    picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), 1)
    assert picture is not None and picture.min() > 250
    screen.remove()


def test_lines_of_sight_meet_on_the_table():
    frame = frame_with()
    hand = frame.world.poses["first"].position[:2]
    middle = focus(frame)[:2]
    assert np.abs(middle).max() <= max(1.0, float(np.abs(hand).max()))


def test_panels_leave_nothing(server):
    gui, frame, rates = recorded(server.gui), frame_with(), SuccessRates()
    panels = [
        CamerasPanel(gui, lambda command: None, frame, 622),
        FeaturesPanel(gui, frame),
        SubsetsPanel(gui, None, frame),
        SuccessPanel(gui, frame, rates, None),
        WordsPanel(gui, frame, rates),
        PolicyPanel(gui, lambda command: None, frame, [PolicyChoice("toy-mad", "MAD")]),
    ]
    assert len(gui.present) > 30
    for panel in panels:
        panel.remove()
    assert not gui.present


def test_an_ablation_of_cameras_that_are_off_is_no_other_setting():
    black = CameraState("off", Occlusion("black"))
    assert frame_with(SetCamera("first", black)).condition == Condition("third_a+third_b")
    assert Condition("all", (("first", black.occlusion),)).key() != ""


def test_a_message_that_woke_nobody_wakes_the_sender_from_its_own_thread():
    woken: list[object] = []

    def queue(message: str) -> None:
        raise RuntimeError(message)

    loop = SimpleNamespace(call_soon_threadsafe=woken.append)
    event = SimpleNamespace(set="set")
    waiting = SimpleNamespace(event_loop=loop, message_event=event, message_from_id={}, done=False)
    page = SimpleNamespace(queue_message=queue, get_message_buffer=lambda: waiting)
    _bound(page, None)  # type: ignore[arg-type]
    page.queue_message(CROSSED)
    assert woken == ["set"]
    with pytest.raises(RuntimeError, match="something else"):
        page.queue_message("something else")


def test_a_touch_that_crosses_the_end_of_its_panels_is_no_fault(server):
    gone, there = server.gui.add_html("before"), server.gui.add_html("before")
    gone.remove()
    apply([Assign(gone, "content", "after"), Assign(there, "content", "after")])
    assert there.content == "after"
    with pytest.raises(RuntimeError) as removed:
        gone.content = "after"
    assert is_too_late(removed.value), "what viser says of a widget that is gone"
    there.remove()


def test_only_what_came_too_late_is_left_out_of_the_log(caplog: pytest.LogCaptureFixture) -> None:
    async def handle(client_id: int, message: RuntimeError) -> None:
        raise message

    class Page:
        """Has what viser's connection has of this."""

        _handle_incoming_message = staticmethod(handle)

    page = Page()
    _forgive(page, {7: page})
    late = "Cannot assign to 'content' on a removed GuiHtmlHandle."
    asyncio.run(page._handle_incoming_message(7, RuntimeError(late)))
    assert caplog.records == []
    asyncio.run(page._handle_incoming_message(7, RuntimeError("something else")))
    assert len(caplog.records) == 1


def test_a_button_whose_panel_is_open_has_a_frame_alone(server) -> None:
    choice = Choice(server.gui, "First person", {"on": "on", "break": "break …"}, lambda *_: None)
    filled = choice.style("on", opened="break")
    assert filled.count("background:var(--mv-ink)") == 1
    assert "nth-child(2) {color:var(--mv-ink); border-color:var(--mv-ink)}" in filled
    assert choice.style("break", opened="break").count("nth-child(2)") == 1

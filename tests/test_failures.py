"""Schedules: the language, what a session does with them, scenarios; and the panel to keep one."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import viser

from madviz.app.panels.failures import FailuresPanel, failures_html
from madviz.app.panels.save import SavePanel
from madviz.envs.registry import make_env
from madviz.errors import UserError
from madviz.observation.ablation import CameraState, Occlusion
from madviz.observation.schedule import (
    SCENARIOS,
    Event,
    parse_schedule,
    reached,
    scenario,
    schedule_words,
)
from madviz.session.commands import (
    Pause,
    Play,
    Reset,
    Scrub,
    SetCamera,
    SetPolicy,
    SetSchedule,
    SetSeed,
)
from madviz.session.frame import Frame
from madviz.session.journal import Journal
from madviz.session.session import Session
from madviz.session.session_reader import parse
from tests.fakes import FakePolicy, policies
from tests.pages import Wire, recorded, use
from tests.sessions import any_task, elsewhere

CAMERAS = ("first", "third_a", "third_b")
ENV = make_env("toy/reach").spec


def session() -> Session:
    return Session(make_env, FakePolicy(), policies, seed=3, speed=None)


def run(one: Session, ticks: int) -> list[Frame]:
    """The frames of ``ticks`` more ticks, the last one of each."""
    frames = []
    for _ in range(ticks):
        one.tick(0.0)
        assert isinstance(one.latest, Frame) and not one.latest.pace.error
        frames.append(one.latest)
    return frames


def schedule(*words: str) -> SetSchedule:
    return SetSchedule(parse_schedule(words, CAMERAS))


def test_the_forms_of_the_language() -> None:
    words = ["third_a@20", "first=black@5", "third_b=noise:0.5@10-30", "third_a=off@1-2"]
    events = parse_schedule(words, CAMERAS)
    assert events == (
        Event(1, "third_a", dropped=True),
        Event(2, "third_a"),
        Event(5, "first", occlusion=Occlusion("black")),
        Event(10, "third_b", occlusion=Occlusion("noise", 0.5)),
        Event(20, "third_a", dropped=True),
        Event(30, "third_b"),
    )
    assert schedule_words(events) == [
        "third_a@1-2",
        "first=black@5",
        "third_b=noise:0.5@10-30",
        "third_a@20",
    ]
    assert parse_schedule(schedule_words(events), CAMERAS) == events


def test_a_patch_may_say_where_it_is() -> None:
    (event,) = parse_schedule(["first=patch:1:0.3:0.5:0.4:0.25@5"], CAMERAS)
    assert event.occlusion == Occlusion("patch", 1.0, 0.3, 0.5, 0.4, 0.25)
    assert schedule_words((event,)) == ["first=patch:1:0.3:0.5:0.4:0.25@5"]
    usual = parse_schedule(["first=patch@5", "first=patch:0.5@6"], CAMERAS)
    assert schedule_words(usual) == ["first=patch@5", "first=patch:0.5@6"]


@pytest.mark.parametrize(
    "word",
    [
        "third_a=patch:1:0.3:0.5:0.4@2",
        "third_a=patch:1:0.3:0.5:0.4:1.5@2",
        "third_a=noise:1:0.3:0.5:0.4:0.4@2",
        "third_a=patch:1:0.3:0.5:0.4:0.4:1@2",
        "third_a=patch::0.3:0.5:0.4:0.4@2",
        "",
        "third_a@",
        "@20",
        "third_a@-1",
        "third_a@2.5",
        "third_a@20-",
        "third_a@x",
        "fourth@20",
        "third_a=rain@2",
        "third_a=none@2",
        "third_a=noise:2@2",
        "third_a=noise:@2",
        "third_a=noise:nan@2",
        "third_a@20-20",
        "third_a@20-10",
        "third_a@9999999",
        "a b@3",
        "third_a=noise:0.5.1@2",
        "third_a@20 ",
        "third_a@20\n",
        "third_a=off:0.5@2",
    ],
)
def test_anything_else_is_refused_in_one_line(word: str) -> None:
    with pytest.raises(UserError) as refused:
        parse_schedule([word], CAMERAS)
    assert "\n" not in str(refused.value)


def test_cameras_that_come_back_do_so_before_others_fail() -> None:
    for words in (["first@2-5", "first=black@5"], ["first=black@5", "first@2-5"]):
        states = [event.works for event in parse_schedule(words, CAMERAS) if event.step == 5]
        assert states == [True, False]


def test_a_session_obeys_at_the_step_itself() -> None:
    one = session()
    one.send(schedule("third_a@4-7", "first=noise:0.5@0-2"))
    frames = {frame.world.step: frame for frame in run(one, 10)}
    assert [s for s, frame in frames.items() if frame.camera("third_a").input == "off"] == [4, 5, 6]
    assert frames[1].camera("first") == CameraState("rgb", Occlusion("noise", 0.5))
    assert frames[2].camera("first") == CameraState("rgb")
    assert not np.array_equal(frames[1].world.arrived["first"], frames[1].world.views["first"].rgb)
    np.testing.assert_array_equal(
        frames[2].world.arrived["first"], frames[2].world.views["first"].rgb
    )
    assert frames[4].schedule == parse_schedule(["third_a@4-7", "first=noise:0.5@0-2"], CAMERAS)


def test_another_task_begins_with_no_failure_that_is_still_to_come() -> None:
    one = Session(any_task, FakePolicy(), elsewhere, seed=3, speed=None)
    one.send(schedule("first@3-8"))
    one.send(SetCamera("third_b", CameraState("off")))
    assert run(one, 6)[-1].condition.subset == "third_a"
    one.send(Pause())
    one.send(SetPolicy("elsewhere"))
    for command in (Pause(), Reset()):
        one.send(command)
        (frame,) = run(one, 1)
        assert (frame.world.step, frame.condition.subset) == (0, "first+third_a")


def test_a_reset_begins_it_anew_with_all_its_cameras_intact() -> None:
    one = session()
    one.send(schedule("third_a@4"))
    run(one, 6)
    one.send(Reset())
    frames = {frame.world.step: frame for frame in run(one, 8)}
    off = [step for step, frame in frames.items() if frame.camera("third_a").input == "off"]
    assert min(frames) <= 1 and off == [step for step in frames if step >= 4]


def test_events_that_have_passed_wait_for_the_next_episode() -> None:
    one = session()
    run(one, 6)
    one.send(schedule("third_a@4", "first@9"))
    frames = run(one, 4)
    assert [frame.camera("third_a").input for frame in frames] == ["rgb"] * 4
    assert frames[-1].camera("first").input == "off"
    one.send(SetSeed(8))
    assert run(one, 5)[-1].camera("third_a").input == "off"


def test_another_schedule_ends_the_old_one_and_leaves_other_cameras_alone() -> None:
    one = session()
    one.send(schedule("third_a@2"))
    run(one, 4)
    one.send(SetCamera("third_b", CameraState("off")))
    one.send(SetSchedule())
    frame = run(one, 1)[0]
    assert frame.camera("third_a").input == "rgb" and frame.camera("third_b").input == "off"
    assert frame.schedule == ()


def test_an_unknown_camera_is_refused_and_the_old_schedule_stays() -> None:
    one = session()
    one.send(schedule("third_a@20"))
    run(one, 1)
    one.send(SetSchedule((Event(3, "fourth", dropped=True),)))
    one.tick(0.0)
    assert isinstance(one.latest, Frame)
    assert one.latest.pace.error.startswith("unknown camera 'fourth'")
    assert one.latest.schedule == parse_schedule(["third_a@20"], CAMERAS)


def test_a_fork_before_a_failure_meets_it_again() -> None:
    one = session()
    one.send(schedule("third_a@5"))
    run(one, 8)
    for command in (Pause(), Scrub(3), SetCamera("first", CameraState("off")), Play()):
        one.send(command)
    frames = {frame.world.step: frame for frame in run(one, 5)}
    assert frames[4].camera("third_a").input == "rgb"
    assert frames[5].camera("third_a").input == "off"


def test_an_event_is_in_the_range_of_steps() -> None:
    with pytest.raises(UserError):
        Event(-1, "first")


@pytest.mark.parametrize("one", SCENARIOS, ids=lambda one: one.name)
def test_every_scenario_fits_every_camera_set(one) -> None:
    for count in (1, 2, 3):
        env = ENV.__class__(**{**vars(ENV), "cameras": ENV.cameras[:count], "horizon": 100})
        events = one.schedule(env)
        names = [camera.name for camera in env.cameras]
        assert all(event.camera in names and event.step <= 100 for event in events)
        dropped: set[str] = set()
        for step in range(101):
            for event in reached(events, step, names):
                (dropped.add if event.dropped else dropped.discard)(event.camera)
            assert len(dropped) < count or count == 1, "somebody must be left to see"
    assert one.schedule(ENV), one.name
    eight = tuple(replace(ENV.cameras[0], name=f"c{place}") for place in range(8))
    assert all(event.step < 100 for event in one.schedule(replace(ENV, cameras=eight, horizon=100)))
    assert scenario(one.name) is one and one.words.endswith(".")


def test_scenarios_have_a_name_each() -> None:
    assert len({one.name for one in SCENARIOS}) == len(SCENARIOS)
    with pytest.raises(UserError, match="blackout one by one"):
        scenario("rain")


def test_the_panel_starts_a_scenario_and_says_what_comes_next() -> None:
    one = session()
    run(one, 3)
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        assert isinstance(one.latest, Frame)
        gui = recorded(server.gui)
        panel = FailuresPanel(gui, one.send, one.latest)
        choice, own = gui.find("Scenario"), gui.find("My own")
        assert "No failures" in panel.update(one.latest)[0].value
        choice.value = "lens covered"
        panel.run()
        frames = {frame.world.step: frame for frame in run(one, 10)}
        assert frames[4].camera("first").occlusion.kind == "none"
        assert frames[5].camera("first").occlusion.kind == "black"
        assert "First person is occluded" in failures_html(frames[4])
        assert "at step 18: First person works again" in failures_html(frames[5])
        choice.value, own.value = "my own", "third_b@2, first=blur:0.5@3-4"
        assert schedule_words(panel.chosen()) == ["third_b@2", "first=blur:0.5@3-4"]
        own.value = "third_b@"
        with pytest.raises(UserError):
            panel.run()
        panel.end()
        assert run(one, 1)[0].schedule == ()
        watching = FailuresPanel(server.gui, None, one.latest)
        panel.remove()
        watching.remove()
        assert not server.gui._gui_input_handle_from_uuid
    finally:
        server.stop()


def test_the_save_panel_hands_out_what_was_played() -> None:
    one = session()
    run(one, 5)
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        assert isinstance(one.latest, Frame)
        gui = recorded(server.gui)
        panel = SavePanel(gui, one.save, one.latest)
        sent: list[tuple[str, bytes]] = []
        client = SimpleNamespace(
            send_file_download=lambda name, content, **_: sent.append((name, content)),
            add_notification=lambda *words, **_: sent.append((words[0], b"")),
            _websock_connection=Wire(),
        )
        use(gui.find("save this episode"), client=client)
        ((name, content),) = sent
        assert name == "reach-seed3.json"
        assert parse(content, name).episodes[-1].steps >= 5
        assert "madviz replay reach-seed3.json" in panel.update(one.latest)[0].value
        empty = SavePanel(gui, Journal().saved, one.latest)
        use(gui.find("save the last 20", 1), client=client)
        assert sent[-1] == ("That did not work", b"")
        panel.remove()
        empty.remove()
        assert not server.gui._gui_input_handle_from_uuid
    finally:
        server.stop()

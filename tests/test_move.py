"""Cameras that are moved: the numbers, what a simulation makes of them, and the panel."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
import viser
from scipy.spatial.transform import Rotation

from madviz.app.panel import apply
from madviz.app.panels.move import MovePanel, move_html
from madviz.app.scene.gizmo import Gizmo
from madviz.envs.registry import make_env
from madviz.errors import UserError
from madviz.observation.ablation import Ablation, CameraState, Occlusion
from madviz.observation.condition import Condition
from madviz.observation.displacement import (
    LARGEST,
    MOST_ZOOM,
    Displacement,
    MoveCamera,
    dragged,
    moved_on,
    trained_axes,
    turned,
)
from madviz.session.commands import Compare, Fork, Pause, Reset, Scrub, SetCamera, SetPolicy
from madviz.session.frame import Frame, words
from madviz.session.replay import replay_episode
from madviz.session.session import Session
from madviz.session.session_reader import parse
from madviz.types import CameraSpec
from tests.fakes import FakePolicy, policies
from tests.pages import drag, recorded, use

RIGHT = Displacement(right=0.3)
DOWN = CameraSpec("down", "Down", 60, (0, 0, 2), (1, 0, 0, 0))
ASIDE = MoveCamera("third_a", RIGHT)


class Live(Session):
    """A session that is ticked by hand."""

    def __init__(self) -> None:
        super().__init__(make_env, FakePolicy(), policies)
        self.time = 0.0
        self.tick(0.0)

    def ask(self, *commands) -> Frame:
        for command in commands:
            self.send(command)
        self.tick(self.time)
        return self.now

    def steps(self, count: int) -> Frame:
        for _ in range(count):
            self.time += 0.11
            self.tick(self.time)
        return self.now

    @property
    def now(self) -> Frame:
        assert isinstance(self.latest, Frame)
        assert not self.latest.pace.error, self.latest.pace.error
        return self.latest


def test_a_move_counts_along_the_cameras_own_axes():
    placed = Displacement(forward=0.1, right=0.2).placed(DOWN)
    assert placed.position == pytest.approx((0.2, 0, 1.9))
    assert placed.wxyz == pytest.approx(DOWN.wxyz) and placed.fovy == pytest.approx(60)
    assert Displacement(up=0.2).placed(DOWN).position == pytest.approx((0, 0.2, 2))
    quarter = replace(DOWN, wxyz=(np.sqrt(0.5), 0, 0, np.sqrt(0.5)))  # Its right is the world's y.
    assert Displacement(right=0.2).placed(quarter).position == pytest.approx((0, 0.2, 2))


@pytest.mark.parametrize(
    ("move", "looks_along"),
    [
        (Displacement(pan=90), (1, 0, 0)),  # It looked down; to the right is the world's x.
        (Displacement(tilt=90), (0, 1, 0)),
        (Displacement(pan=-90), (-1, 0, 0)),
    ],
)
def test_a_turn_goes_where_it_says(move, looks_along):
    w, x, y, z = move.placed(DOWN).wxyz
    axis = -np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    assert axis == pytest.approx(looks_along, abs=1e-9)


def test_zoom_halves_what_is_seen_across():
    fovy = Displacement(zoom=2).placed(DOWN).fovy
    assert fovy == pytest.approx(32.2, abs=0.05)
    assert np.tan(np.radians(fovy / 2)) == pytest.approx(np.tan(np.radians(30)) / 2)


@pytest.mark.parametrize("field", ["forward", "right", "up", "pan", "tilt", "zoom"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e9, -91.0, "1", None, True])
def test_numbers_that_are_no_move_are_refused(field, value):
    with pytest.raises(UserError, match=f"expected {field}"):
        Displacement(**{field: value})


def test_a_move_in_words_and_as_a_key():
    move = Displacement(right=-0.1, pan=5, zoom=1.5)
    assert move.words() == "0.10 m to the left, turned right 5°, zoomed in to 1.50"
    assert move.key() == "moved,right=-0.1,pan=5,zoom=1.5"
    assert Displacement().is_none and Displacement().words() == "in its place"


def test_a_moved_camera_is_a_setting_of_its_own_and_old_keys_stay():
    streams = ("first", "third_a")
    still = Ablation({"first": CameraState(occlusion=Occlusion("black"))})
    moved = still.move("third_a", Displacement(right=0.1))
    assert Condition.of(still, streams).key() == "first:black,strength=1,x=0.5,y=0.5,size=0.4"
    assert Condition.of(moved, streams).key() == (
        f"{Condition.of(still, streams).key()};third_a:moved,right=0.1"
    )
    assert Condition.of(moved, streams) != Condition.of(still, streams)
    dropped = moved.replace("third_a", CameraState("off"))  # What is not there cannot be moved.
    gone = still.replace("third_a", CameraState("off"))
    assert Condition.of(dropped, streams) == Condition.of(gone, streams)
    assert moved.move("third_a", None) == still == moved.move("third_a", Displacement())


def test_a_move_is_seen_at_once_and_put_back_also_while_paused():
    live = Live()
    live.steps(2)
    before = live.ask(Pause())
    frame = live.ask(ASIDE)
    assert frame.world.step == before.world.step and frame.pace.number > before.pace.number
    assert not np.array_equal(frame.world.arrived["third_a"], before.world.arrived["third_a"])
    assert np.array_equal(frame.world.arrived["first"], before.world.arrived["first"])
    assert not np.array_equal(frame.action, before.action)
    shift = frame.world.poses["third_a"].position - before.world.poses["third_a"].position
    assert np.linalg.norm(shift) == pytest.approx(0.3)
    assert frame.condition.key() == "third_a:moved,right=0.3"
    assert frame.world.change is not None
    assert words(frame.world.change, frame.world.env).startswith(
        "Third A moved: 0.30 m to the right: action"
    )
    back = live.ask(MoveCamera("third_a", None))
    assert np.array_equal(back.world.arrived["third_a"], before.world.arrived["third_a"])
    assert np.array_equal(back.action, before.action)
    assert back.world.change is not None and back.world.change.moved == "is back in its place"


def test_a_moved_camera_stays_moved_over_steps_occlusions_and_resets():
    live = Live()
    live.ask(ASIDE, SetCamera("third_a", CameraState("rgb", Occlusion("patch"))))
    frame = live.steps(3)
    assert frame.world.ablation.moves == {"third_a": ASIDE.move}
    again = live.ask(Reset())
    assert again.world.step == 0 and again.condition.key().endswith("third_a:moved,right=0.3")


def test_only_whole_episodes_under_one_place_count_for_it():
    live = Live()
    live.steps(3)
    live.ask(ASIDE)
    first = live.steps(22).world.outcomes[-1]
    assert first.condition is None and first.cameras["third_a"] == "moved"
    live.ask(Reset())
    second = live.steps(26).world.outcomes[-1]
    assert second.condition is not None and "third_a:moved" in second.condition.key()


def test_going_back_puts_cameras_where_they_were_then():
    live = Live()
    live.steps(4)
    plain = live.now
    live.ask(ASIDE)
    live.steps(4)
    then = live.ask(Scrub(3))
    assert then.world.ablation.moves == {}
    forked = live.ask(Fork())
    assert forked.world.step == 3 and forked.world.ablation.moves == {}
    again = live.steps(1)
    assert again.world.step == 4 and np.array_equal(
        again.world.views["third_a"].rgb, plain.world.views["third_a"].rgb
    )
    assert np.array_equal(again.action, plain.action)
    moved = live.ask(Pause(), Scrub(2), ASIDE)  # Touching the past forks.
    assert (moved.world.step, moved.past, moved.world.ablation.moves) == (
        2,
        False,
        {"third_a": ASIDE.move},
    )


def test_a_moved_camera_is_kept_and_lives_again_to_the_bit():
    live = Live()
    live.steps(2)
    live.ask(SetCamera("third_a", CameraState("rgb", Occlusion("noise", 0.3))))
    live.ask(MoveCamera("third_a", Displacement(pan=3)), ASIDE)
    live.steps(3)
    live.ask(MoveCamera("third_a", None), MoveCamera("first", Displacement(zoom=1.5)))
    live.steps(2)
    live.ask(Reset())
    live.steps(3)
    kept = parse(live.save().to_json().encode(), "a file")
    assert kept.episodes == live.save().episodes and len(kept.episodes) == 2
    assert kept.episodes[1].ablation.moves == {"first": Displacement(zoom=1.5)}
    moves = [one for one in kept.episodes[0].commands if isinstance(one.command, MoveCamera)]
    assert [one.step for one in moves] == [2, 5, 5]
    for episode in kept.episodes:
        assert replay_episode(episode, lambda wanted: policies(wanted.name)) == episode


@pytest.mark.parametrize("value", [2, float("inf"), None, "0.1"])
def test_a_kept_move_is_believed_only_in_range(value):
    live = Live()
    live.ask(ASIDE)
    live.steps(1)
    document = json.loads(live.save().to_json())
    document["episodes"][0]["commands"][0]["move"]["right"] = value
    with pytest.raises(UserError, match="right|JSON"):
        parse(json.dumps(document).encode(), "a file")


def test_a_twin_begins_with_moved_cameras_and_another_policy_keeps_them():
    live = Live()
    frame = live.ask(ASIDE, Compare("toy-other", Ablation(moves={"third_a": RIGHT})))
    assert frame.second is not None
    assert np.array_equal(frame.second.world.views["third_a"].rgb, frame.world.views["third_a"].rgb)
    assert live.ask(SetPolicy("toy-rgbd")).world.ablation.moves == {"third_a": ASIDE.move}


def test_of_many_moves_only_the_last_is_drawn():
    live = Live()
    number = live.ask(Pause()).pace.number
    frame = live.ask(*(MoveCamera("first", Displacement(right=i / 100)) for i in range(1, 30)))
    assert frame.pace.number == number + 1
    assert frame.world.ablation.moves["first"].right == pytest.approx(0.29)


def test_an_unknown_camera_says_which_are_known():
    live = Live()
    live.send(MoveCamera("third_z", Displacement(right=0.1)))
    live.tick(0.0)
    assert isinstance(live.latest, Frame) and "third_b" in live.latest.pace.error


def test_the_panel_drags_is_not_pulled_back_and_puts_back():
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    live, sent = Live(), []
    frame = live.ask(Pause())
    gui = recorded(server.gui)
    panel = MovePanel(gui, sent.append, frame)
    right, pan = (gui.find(name) for name in ("right", "pan"))
    panel.choose("third_a")
    use(right, 0.1)
    use(pan, 5)
    assert sent[-1] == MoveCamera("third_a", Displacement(right=0.1, pan=5))
    apply(panel.update(live.ask(sent[0])))  # A frame that is behind: the hand is further already.
    assert right.value == 0.1 and pan.value == 5
    apply(panel.update(live.ask(sent[1])))
    assert right.value == 0.1 and pan.value == 5
    panel.choose("third_b")
    assert right.value == 0
    apply(panel.update(live.ask(MoveCamera("third_a", None))))
    panel.choose("third_a")
    assert pan.value == 0
    panel.remove()
    server.stop()


@pytest.mark.parametrize("way", [1, -1])
def test_a_panel_can_be_built_wherever_a_camera_has_been_moved(server, way: int):
    """The arrows in the scene, and a saved session, go as far as a move can."""
    far = Displacement(**{name: way * most for name, most in LARGEST.items()}, zoom=MOST_ZOOM**way)
    gui = recorded(server.gui)
    panel = MovePanel(gui, lambda _: None, Live().ask(MoveCamera("first", far)))
    assert {name: gui.find(name).value for name in asdict(far)} == asdict(far)
    panel.remove()


def test_the_panel_says_where_cameras_are_and_what_counts():
    live = Live()
    assert "Every camera stands where" in move_html(live.now)
    html = move_html(live.ask(ASIDE))
    assert "0.30 m to the right" in html and "First" not in html
    command = "madviz audit --policy toy-mad --along third_a.right=0:0.3 --out audit-right<"
    assert command in html
    html = move_html(live.ask(MoveCamera("third_a", Displacement(tilt=-12, zoom=2))))
    assert "--along third_a.tilt=-12:0 --out audit-tilt<" in html


@pytest.mark.parametrize("camera", ["first", "third_a"])
def test_dragging_counts_along_the_axes_that_the_sliders_have(camera):
    live = Live()
    aside = Displacement(right=0.1, pan=30, tilt=-20, zoom=1.2)
    frame = live.ask(Pause(), MoveCamera(camera, aside))
    pose, spec = frame.world.poses[camera], frame.world.env.camera(camera)
    trained = Rotation.from_quat(spec.wxyz, scalar_first=True)
    axes = trained_axes(pose, aside)
    assert axes.as_matrix() == pytest.approx(trained.as_matrix(), abs=1e-9)
    assert dragged(pose, aside, pose.position) == aside
    there = pose.position + trained.apply([0.2, 0.3, -0.4])  # Right, up, forward.
    assert dragged(pose, aside, there) == replace(aside, right=0.3, up=0.3, forward=0.4)
    far = dragged(pose, aside, pose.position + trained.apply([50, 0, 0]))
    assert far.right == 1.0 and far.forward == 0
    with pytest.raises(UserError, match="expected a place"):
        dragged(pose, aside, np.array([np.nan, 0, 0]))


@pytest.mark.parametrize("camera", ["first", "third_a"])
def test_turning_pans_and_tilts_and_leaves_the_picture_upright(camera):
    live = Live()
    aside = Displacement(right=0.1, pan=30, tilt=-20, zoom=1.2)
    pose = live.ask(Pause(), MoveCamera(camera, aside)).world.poses[camera]

    def after(turn: Rotation, about_trained: bool = False) -> Displacement:
        now = Rotation.from_quat(pose.wxyz, scalar_first=True)
        trained = trained_axes(pose, aside)
        to = trained * turn * trained.inv() * now if about_trained else now * turn
        return turned(pose, aside, to.as_quat(scalar_first=True))

    def about(axis: str, degrees: float) -> Rotation:
        return Rotation.from_euler(axis, degrees, degrees=True)

    assert after(about("x", 0)) == aside
    assert after(about("z", 25)) == aside  # A picture on its side.
    assert after(about("x", 15)) == replace(aside, tilt=-5)  # About the picture's own right.
    assert after(about("y", -12), about_trained=True) == replace(aside, pan=42)
    assert after(about("y", -140), about_trained=True) == replace(aside, pan=90)
    assert after(about("x", -70)) == replace(aside, tilt=-90)  # Straight down, and still panned.


def test_where_a_camera_will_be_is_where_it_comes_to_be():
    live = Live()
    before = Displacement(right=0.1, pan=30, tilt=-20)
    after = Displacement(up=0.2, forward=-0.1, right=0.3, pan=-7, tilt=11)
    pose = live.ask(Pause(), MoveCamera("third_a", before)).world.poses["third_a"]
    there = live.ask(MoveCamera("third_a", after)).world.poses["third_a"]
    will = moved_on(pose, before, after)
    assert will.position == pytest.approx(there.position, abs=1e-6)
    assert abs(will.wxyz @ there.wxyz) == pytest.approx(1, abs=1e-9)


def test_arrows_stand_where_the_camera_does_unless_they_are_dragged(server):
    live, moved = Live(), []
    frame = live.ask(Pause())
    scene = recorded(server.scene)
    gizmo = Gizmo(scene, frame, 1.0, lambda *said: moved.append(said))
    handle = scene.find("/moved")
    apply(gizmo.update(frame))
    assert not handle.visible
    gizmo.camera = "third_a"
    apply(gizmo.update(live.ask(ASIDE)))
    assert handle.visible
    assert handle.position == pytest.approx(live.now.world.poses["third_a"].position)
    assert moved == []  # Our own assignments move nothing.
    place = live.now.world.poses["third_a"].position + [0, 0, 0.1]
    handle.position = place
    drag(handle, "update")
    assert moved == [("third_a", Displacement(right=0.3, forward=-0.1))]
    apply(gizmo.update(live.now))
    assert handle.position == pytest.approx(place)  # In a hand: not pulled back.
    drag(handle, "end")
    apply(gizmo.update(live.now))
    assert handle.position == pytest.approx(live.now.world.poses["third_a"].position)
    gizmo.remove()


def test_a_ring_turns_the_camera_and_on_release_stands_as_the_camera_does(server):
    live, moved = Live(), []
    scene = recorded(server.scene)
    gizmo = Gizmo(scene, live.ask(Pause()), 1.0, lambda *said: moved.append(said))
    gizmo.camera = "third_a"
    apply(gizmo.update(live.ask(ASIDE)))
    pose, handle = live.now.world.poses["third_a"], scene.find("/moved")
    before = Rotation.from_quat(pose.wxyz, scalar_first=True)

    def hear(phase: str, axes: Rotation) -> None:
        handle.wxyz = axes.as_quat(scalar_first=True)
        drag(handle, phase)

    hear("start", before)
    for angle in (3, 8):
        hear("update", before * Rotation.from_euler("y", angle, degrees=True))
    assert [one.pan for _, one in moved] == [0, 3, 8]
    handle.position = pose.position + 0.1  # Whoever turns does not move.
    hear("update", before)  # Back again: a ring, and not an arrow that went nowhere.
    assert moved[-1] == ("third_a", RIGHT)
    sideways = before * Rotation.from_euler("YZ", [8, 40], degrees=True)
    hear("end", sideways)
    assert moved[-1] == ("third_a", replace(RIGHT, pan=8))
    upright = before * Rotation.from_euler("y", 8, degrees=True)
    stands = Rotation.from_quat(handle.wxyz, scalar_first=True)
    assert (stands.inv() * upright).magnitude() < 1e-6
    assert handle.position == pytest.approx(pose.position)
    apply(gizmo.update(live.ask(MoveCamera(*moved[-1]))))
    hear("update", upright)  # The next drag is an arrow's again.
    assert moved[-1] == ("third_a", replace(RIGHT, pan=8))
    gizmo.remove()

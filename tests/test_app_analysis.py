"""Panels that explain a time step: Shapley values, the map of features, saliency, arrows."""

from __future__ import annotations

import asyncio
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import viser

from madviz.analysis.projection import DECISIONS
from madviz.analysis.shapley import set_names
from madviz.app.panel import apply
from madviz.app.panels.features import NO_FEATURES
from madviz.app.panels.projection import ProjectionPanel
from madviz.app.panels.saliency import SaliencyPanel, saliency_words
from madviz.app.panels.shapley import (
    ShapleyPanel,
    action_column,
    q_column,
    shapley_html,
    success_column,
)
from madviz.app.scene.arrows import NEAR, ArrowsPanel, arrows, towards
from madviz.app.scene.paths import OVER, PathsPanel, segments
from madviz.app.success_rates import SuccessRates
from madviz.drawing import mosaic
from madviz.drawing.colours import CAMERA_COLOURS, NOTE, rgb
from madviz.envs.registry import make_env
from madviz.observation.ablation import CameraState, Occlusion
from madviz.session.commands import Pause, Reset, SetCamera, SetPolicy
from madviz.session.frame import Frame, HandPaths
from madviz.session.session import Session
from madviz.types import Array, Encoded, Readout
from tests.fakes import AllOrNothing, FakePolicy, NanPolicy, policies
from tests.pages import browser, recorded, use
from tests.sessions import frame_with, with_pace, with_world

OFF = CameraState("off")
STREAMS = FakePolicy().spec.streams
MEASURED = {name: {"success": 0.25 * name.count("i"), "n": 100} for name in set_names(STREAMS)}


def session_with(policy: FakePolicy | None = None, speed: float | None = 10.0) -> Session:
    session = Session(make_env, policy or FakePolicy(), policies, speed=speed)
    session.tick(0.0)
    return session


def shown(session: Session) -> Frame:
    assert isinstance(session.latest, Frame)
    return session.latest


def text(html: str) -> str:
    return re.sub(r"\s+", " ", re.sub("<[^>]*>", " ", html))


def test_a_camera_has_a_row_with_its_value_in_every_game() -> None:
    frame = frame_with()
    rates = SuccessRates(lambda spec: {**MEASURED, "all": {"success": 1.0, "n": 100}})
    html = shapley_html(frame, rates)
    for column in (q_column(frame), action_column(frame), success_column(frame, rates)):
        assert column.values is not None
        for value in column.values.cameras:
            assert f">{round(float(value), column.digits) + 0.0:+.{column.digits}f}</span>" in html
    assert "0.00 → 1.00" in html and "±" in html
    assert all(label in html for label in ("First person", "Third A", "Third B"))
    assert "-0.00" not in html


def test_values_on_the_page_sum_to_its_last_row() -> None:
    frame = frame_with()
    q, action = q_column(frame).values, action_column(frame).values
    assert q is not None and action is not None
    readout = frame.world.probe.readout
    assert q.cameras.sum() == pytest.approx(float(readout.q[0] - readout.q[-1]), abs=1e-4)
    distance = float(np.linalg.norm(readout.action[0] - readout.action[-1]))
    assert action.cameras.sum() == pytest.approx(distance, abs=1e-5)
    assert f"{distance:.2f} → 0.00 apart" in shapley_html(frame, SuccessRates())


def test_success_says_what_is_not_measured_yet() -> None:
    column = success_column(
        frame_with(), SuccessRates(lambda spec: {"all": {"success": 1, "n": 9}})
    )
    assert column.values is None
    assert "First person + Third A" in column.words and "3 more" in column.words
    assert "with Measure on" not in column.words  # Nobody here measures.


def test_a_dropped_camera_has_no_value_and_half_the_sets_will_do() -> None:
    frame = frame_with(SetCamera("third_b", OFF))
    known = ("first+third_a", "first", "third_a", "none")
    column = success_column(
        frame, SuccessRates(lambda spec: {name: MEASURED[name] for name in known})
    )
    assert column.values is not None and column.values.cameras[2] == 0
    html = shapley_html(frame, SuccessRates())
    assert "Third B · dropped" in html and "opacity:0.45" in html


def test_occlusions_are_no_part_of_the_measured_success() -> None:
    black = SetCamera("first", CameraState("rgb", Occlusion("black")))
    column = success_column(frame_with(black), SuccessRates(lambda spec: MEASURED))
    assert column.values is not None and "clean pictures" in column.words


def test_a_policy_that_cannot_do_without_cameras_has_no_values_and_says_why() -> None:
    frame = frame_with(policy=AllOrNothing("toy-stack"))
    assert q_column(frame).values is None and action_column(frame).values is None
    words = text(shapley_html(frame, SuccessRates()))
    assert "cannot act on First person + Third A, First person + Third B, First person" in words
    assert "4 more" in words
    assert "not defined" in success_column(frame, SuccessRates()).words
    broken = action_column(frame_with(policy=NanPolicy("toy-nan")))
    assert broken.values is None and "not finite" in broken.words


def test_a_map_of_a_policy_that_shows_no_features_says_so(server: viser.ViserServer) -> None:
    class Silent(FakePolicy):
        """Its features are zeros of one number, as the documents ask for."""

        def encode(self, views: Array, state: Array) -> Encoded:
            return replace(super().encode(views, state), features=np.zeros((len(views), 1)))

        def read(self, encoded: Encoded, masks: Array) -> Readout:
            count = len(np.atleast_2d(masks))
            return Readout(np.zeros((count, 1)), np.zeros((count, 2)), np.zeros(count))

    gui = recorded(server.gui)
    ProjectionPanel(gui, frame_with(policy=Silent("own")))
    assert NO_FEATURES in gui.html


def test_a_policy_without_a_critic_has_no_value_in_q() -> None:
    frame = frame_with()
    blind = replace(frame.world.probe.readout, q=np.full(8, np.nan, np.float32))
    column = q_column(with_world(frame, probe=replace(frame.world.probe, readout=blind)))
    assert column.values is None and "no forecast" in column.words


def test_the_panel_follows_another_policy(server: viser.ViserServer) -> None:
    gui = recorded(server.gui)
    panel = ShapleyPanel(gui, frame_with(), SuccessRates())
    apply(panel.update(frame_with(SetPolicy("toy-rgbd"))))
    assert "Third B" in gui.html
    panel.remove()


def circles(html: str) -> list[tuple[str, str, str]]:
    return re.findall(r'<circle cx="(\d+)" cy="(\d+)" r="\d+" fill="([^"]+)"', html)


def test_a_map_is_made_while_an_episode_runs_and_then_stays(server: viser.ViserServer) -> None:
    session, panels = session_with(speed=None), []
    gui = recorded(server.gui)
    panel = ProjectionPanel(gui, shown(session))
    for _ in range(DECISIONS + 3):
        panels.append("<svg" in gui.html)
        session.tick(0.0)
        apply(panel.update(shown(session)))
    assert not any(panels[: DECISIONS - 2]) and panels[-1]
    before = gui.html
    assert len(circles(before)) == 4 and "polyline" in before
    frame = shown(session)
    for _ in range(3):
        session.tick(0.0)
        apply(panel.update(shown(session)))
    assert gui.html != before
    apply(panel.update(replace(frame, history=shown(session).history)))
    assert circles(gui.html) == circles(before), "the same step at the same place"
    panel.remove()


def mapped(server: viser.ViserServer) -> tuple[ProjectionPanel, Session, Any]:
    """A panel that has its map, the session it came from, and what is on the page."""
    session, gui = session_with(speed=None), recorded(server.gui)
    panel = ProjectionPanel(gui, shown(session))
    for _ in range(DECISIONS + 2):
        session.tick(0.0)
        apply(panel.update(shown(session)))
    return panel, session, gui


def test_a_dropped_stream_is_hollow_and_the_merged_one_moves_to_the_rest(
    server: viser.ViserServer,
) -> None:
    panel, session, gui = mapped(server)
    frame = shown(session)
    points = np.array([circle[:2] for circle in circles(gui.html)], float)
    np.testing.assert_allclose(points[:3].mean(0), points[3], atol=1.6)
    session.send(Pause())
    session.send(SetCamera("first", OFF))
    session.tick(0.0)
    assert shown(session).world.step == frame.world.step
    apply(panel.update(shown(session)))
    found = circles(gui.html)
    assert [fill for *_, fill in found] == ["none", *CAMERA_COLOURS[1:3], "#FFFFFF"]
    points = np.array([circle[:2] for circle in found], float)
    np.testing.assert_allclose(points[1:3].mean(0), points[3], atol=1.6)
    panel.remove()


def test_another_episode_begins_another_trail(server: viser.ViserServer) -> None:
    panel, session, gui = mapped(server)
    session.send(Reset())
    session.tick(0.0)
    apply(panel.update(with_world(shown(session), step=0)))
    assert "polyline" not in gui.html
    panel.remove()


def test_without_features_of_their_own_cameras_have_no_map(server: viser.ViserServer) -> None:
    frame = frame_with()
    blank = with_world(
        frame, probe=replace(frame.world.probe, features=0 * frame.world.probe.features)
    )
    gui = recorded(server.gui)
    panel = ProjectionPanel(gui, blank)
    assert "No camera has a feature of its own" in gui.html
    panel.remove()


def looking(frame: Frame, stream: str = "first") -> Frame:
    shares = np.zeros((84, 84), np.float32)
    shares[:42] = 1
    watched = replace(frame)
    object.__setattr__(watched, "saliency", {stream: shares})
    return watched


def test_pixels_that_matter_are_bright_and_the_others_dim() -> None:
    frame = frame_with()
    before, after = (mosaic.mosaic(one, 168)[mosaic.HEADER :] for one in (frame, looking(frame)))
    first, others = np.s_[:, :168], np.s_[:, 174:]
    np.testing.assert_array_equal(before[others], after[others])
    below = np.s_[120:, :168]
    np.testing.assert_allclose(after[below], 0.575 * before[below], atol=1.01)
    assert after[:40, :168].mean() > 150 and not np.array_equal(before[first], after[first])


def test_depth_is_bright_where_it_is_shown() -> None:
    frame = frame_with(SetPolicy("toy-rgbd"), SetCamera("first", CameraState("depth")))
    plain, lit = (mosaic.mosaic(f, 168) for f in (frame, looking(frame, "first.depth")))
    assert not np.array_equal(plain, lit)
    np.testing.assert_array_equal(plain, mosaic.mosaic(looking(frame, "first.rgb"), 168))


def test_the_switch_asks_and_the_line_says_what_comes(server: viser.ViserServer) -> None:
    asked: list[object] = []
    frame = frame_with()
    gui = recorded(server.gui)
    panel = SaliencyPanel(gui, asked.append, frame)
    use(gui.find("Saliency"), "for its Q")
    assert asked == ["q"]
    assert "depends on" in saliency_words(frame)
    frame = replace(frame, explained="q")
    assert "never has one" in saliency_words(frame)
    assert "its Q would change" in saliency_words(looking(frame))
    before = replace(frame, history=frame.history * 3)
    assert before.past and "earlier step" in saliency_words(before)
    assert "full speed" in saliency_words(with_pace(frame, speed=None))
    stuck = frame_with(SetCamera("first", OFF), policy=AllOrNothing("toy-stack"))
    assert "cannot act" in saliency_words(replace(stuck, explained="action"))
    apply(panel.update(looking(frame)))
    assert "SmoothGrad" in gui.html
    other = SaliencyPanel(recorded(server.gui), asked.append, frame)
    assert "nth-child(2)" in other.handles[-1].content, "a page of another task shows the choice"
    other.remove()
    panel.remove()
    SaliencyPanel(server.gui, None, frame).remove()


def test_the_present_setting_is_yellow_thick_and_on_top() -> None:
    frame = frame_with(SetCamera("third_b", OFF))
    points, colours = arrows(frame, 1.0)
    yellow = (colours[:, 0] == colours[-1, 0]).all(1)
    assert yellow.sum() == 15 and yellow[-15:].all()
    assert colours[-1, 0, 0] == 255 and colours[-1, 0, 2] < rgb(NOTE)[2]
    start, tip = points[-15]
    np.testing.assert_allclose(start, frame.world.hand, atol=1e-5)
    np.testing.assert_allclose((tip - start)[:2], 0.3 * frame.action, atol=1e-5)
    assert (tip - start)[2] == 0, "the toy has two numbers"


def test_sets_nobody_trained_are_dashed() -> None:
    _, colours = arrows(frame_with(), 1.0)
    # Three trained single cameras of 3 lines, four other sets as 5 dashes and 2, one thick arrow.
    assert len(colours) == 3 * 3 + 4 * 7 + 15


def test_six_streams_have_arrows_for_whole_cameras_only() -> None:
    frame = frame_with(policy=policies("toy-rgbd"))
    points, _ = arrows(frame, 1.0)
    assert len(points) == 15 + 7 * 7


def test_sets_that_cannot_act_have_no_arrow() -> None:
    points, _ = arrows(frame_with(policy=AllOrNothing("toy-stack")), 1.0)
    assert len(points) == 15
    broken = frame_with(policy=NanPolicy("toy-nan"))
    bad = replace(broken.world.probe.readout, action=np.full((8, 2), np.nan, np.float32))
    nothing, none = arrows(with_world(broken, probe=replace(broken.world.probe, readout=bad)), 1.0)
    assert nothing.shape == none.shape == (0, 2, 3)


def test_moving_a_point_towards_the_eye_leaves_it_where_it_is_seen() -> None:
    eye, points = np.array([1.0, 2.0, 3.0]), np.random.default_rng(0).normal(size=(4, 2, 3))
    nearer = towards(points, eye)
    before, after = points - eye, nearer - eye
    shares = np.linspace(NEAR, 0.9 * NEAR, 4)[:, None, None]
    np.testing.assert_allclose(after, shares * before, atol=1e-6)


def test_arrows_change_four_times_a_second_and_hide_at_full_speed(server) -> None:
    now, client = [0.0], browser(server)
    frame = frame_with()
    panel = ArrowsPanel(client, frame, 1.0, lambda: now[0])
    lines = client.scene.find("/arrows")
    assert len(panel.update(frame)) == 2
    now[0] = 0.2
    assert panel.update(frame) == []
    now[0] = 0.25
    assert len(panel.update(frame)) == 2
    apply(panel.update(with_pace(frame, speed=None)))
    assert not lines.visible and panel.update(with_pace(frame, speed=None)) == []
    now[0] = 1.0
    apply(panel.update(with_pace(frame, phase="paused", speed=None)))
    assert lines.visible
    panel.remove()


def test_arrows_follow_the_visitors_eye(server) -> None:
    client, frame = browser(server), frame_with()
    panel = ArrowsPanel(client, frame, 1.0)
    client.camera.position = np.array([-3.0, 0.0, 1.0])
    asyncio.run(client.followers[0](client.camera))
    expected = towards(arrows(frame, 1.0)[0], client.camera.position)
    np.testing.assert_allclose(client.scene.find("/arrows").points, expected, atol=1e-6)
    panel.remove()
    assert client.followers == []  # A page that was closed is not drawn on, nor kept.


def test_the_paths_of_the_hand_are_drawn_once_they_are_known(server) -> None:
    client, frame = browser(server), frame_with()
    panel = PathsPanel(client, frame)
    thick, thin, other = (
        client.scene.find(f"/paths/{n}") for n in ("a/taken", "a/intact", "b/taken")
    )
    assert panel.update(frame) == [] and len(thick.points) == 0
    straight = np.arange(15, dtype=np.float32).reshape(5, 3) / 14
    bent = straight + np.array([0, 0.1, 0], np.float32)
    known = replace(frame, paths=HandPaths(3, bent, straight))
    apply(panel.update(known))
    eye = np.asarray(client.camera.position, float)
    np.testing.assert_allclose(thick.points, towards(segments(bent), eye), atol=1e-6)
    np.testing.assert_allclose(thin.points, towards(segments(straight), eye, OVER), atol=1e-6)
    assert len(other.points) == 0 and panel.update(known) == []
    client.camera.position = np.array([-3.0, 0.0, 1.0])
    asyncio.run(client.followers[0](client.camera))
    moved = towards(segments(bent), client.camera.position)
    np.testing.assert_allclose(thick.points, moved, atol=1e-6)
    apply(panel.update(frame))
    assert len(thick.points) == len(thin.points) == 0, "the next episode begins"
    panel.remove()
    assert client.followers == []

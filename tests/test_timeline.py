"""The timeline's panel on a real server, and what it says of a past, a fork and its branch."""

from __future__ import annotations

import numpy as np

from madviz.app.chart import Lane
from madviz.app.panel import apply
from madviz.app.panels.timeline import AFTER_DRAG, TimelinePanel, marks, timeline_html
from madviz.envs.registry import make_env
from madviz.observation.ablation import CameraState
from madviz.session.commands import Command, Fork, Scrub, SetCamera, SetPolicy
from madviz.session.frame import Frame
from madviz.session.session import Session
from madviz.session.timeline import MOST_ROWS
from madviz.types import TimeStep
from tests.fakes import policies
from tests.pages import recorded, use

OFF = CameraState("off")


class Played:
    """A session on the toy that takes steps and commands, each at once."""

    def __init__(self, policy: str = "toy-mad", factory=make_env, load=policies) -> None:
        self.session = Session(factory, policies(policy), load, speed=1.0)
        self.now = 0.0
        self.session.tick(self.now)

    def __call__(self, *script: int | Command) -> Frame:
        for item in script:
            if isinstance(item, int):
                for _ in range(item):
                    self.now += 1.0
                    self.session.tick(self.now)
            else:
                self.session.send(item)
                self.session.tick(self.now)
        assert isinstance(self.session.latest, Frame)
        return self.session.latest


def test_marks_are_where_cameras_or_the_policy_changed() -> None:
    frame = Played()(3, SetCamera("first", OFF), 2, SetPolicy("toy-other"), 1)
    assert marks(frame.history) == [(3, "third_a+third_b"), (5, "toy-other")]


def test_the_drawing_has_a_point_for_every_step_and_the_branch() -> None:
    play = Played()
    html = timeline_html(play(6))
    assert html.count("<polyline") == 4 and "original run" not in html
    frame = play(Scrub(2))
    assert "Looking back: step 2 of 6" in timeline_html(frame)
    html = timeline_html(play(SetCamera("first", OFF), Fork()))
    assert "the original run, step 2" in html and "third_a+third_b" in html


def test_a_slider_shows_the_step_and_is_not_pulled_back_while_dragged(server) -> None:
    play, sent = Played(), []
    frame = play(5)
    now = [100.0]
    gui = recorded(server.gui)
    panel = TimelinePanel(gui, sent.append, frame, lambda: now[0])
    handle = gui.find("Step")
    use(handle, 2)
    assert sent == [Scrub(2)]
    apply(panel.update(play(1)))
    assert handle.value == 2  # A frame that has not heard of the drag moves nothing.
    apply(panel.update(play(Scrub(4))))
    assert handle.value == 2  # Nor does one that has: a visitor may still be dragging.
    now[0] += AFTER_DRAG
    apply(panel.update(play(Scrub(2))))
    assert handle.value == 2
    apply(panel.update(play(Scrub(None))))
    assert handle.value == 6
    panel.remove()
    assert not gui.present


def test_watchers_see_the_drawing_without_controls(server) -> None:
    gui = recorded(server.gui)
    panel = TimelinePanel(gui, None, Played()(2))
    assert not gui.of("GuiSliderHandle")
    panel.remove()


def test_many_streams_keep_rounded_merged_features_and_exact_actions() -> None:
    play = Played("toy-rgbd")
    before = play(4)
    assert len(before.world.probe.masks) > MOST_ROWS
    then = play(2, Scrub(4))
    assert then.world.probe.readout.merged.dtype == np.float16
    np.testing.assert_array_equal(then.action, before.action)
    np.testing.assert_allclose(
        then.world.probe.merged_norm(then.row),
        before.world.probe.merged_norm(before.row),
        rtol=1e-3,
    )


def test_a_simulator_that_does_not_repeat_itself_is_found_out() -> None:
    class Drifting:
        """Every reset starts a little elsewhere."""

        def __init__(self, *args) -> None:
            self._env, self._resets = make_env(*args), 0
            self.spec = self._env.spec

        def __getattr__(self, name: str):
            return getattr(self._env, name)

        def reset(self, seed: int) -> TimeStep:
            self._resets += 1
            return self._env.reset(seed + 100 * self._resets)

    frame = Played(factory=Drifting)(4, Scrub(1), Fork())
    assert frame.pace.error.startswith("expected toy/reach to repeat seed")
    assert frame.pace.phase == "paused"


def test_policies_may_be_swapped_in_the_past() -> None:
    play = Played()
    play(6)
    frame = play(Scrub(3), SetPolicy("toy-other"))
    assert (frame.world.step, frame.world.policy.name) == (3, "toy-other")
    assert frame.branch is not None and frame.branch.frame.world.policy.name == "toy-mad"


def test_a_lane_spans_its_scale_and_leaves_out_what_is_not_finite():
    lane = Lane(left=0, right=10, top=0, bottom=20, last=2, low=0.0, high=2.0)
    curve = lane.curve([0.0, float("nan"), 2.0], "#fff")
    assert 'points="0.0,20.0 10.0,0.0"' in curve

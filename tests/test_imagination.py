"""What a policy imagines of a dropped camera: how well, where it is shown, and where it is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import viser

from madviz.analysis.imagination import Imagined, moving_psnr
from madviz.app.panel import apply
from madviz.app.panels.cameras import CamerasPanel
from madviz.drawing.mosaic import GAP, HEADER, Dropped, badge, mosaic
from madviz.session.commands import Scrub, SetCamera, StepOnce
from madviz.session.frame import Frame
from madviz.types import Array, Encoded, Imagines
from tests.fakes import FakePolicy
from tests.pages import recorded, use
from tests.sessions import OFF, Recorder, frame_with, with_world

TILE = 200


class Painter(FakePolicy):
    """Imagines one colour for every camera."""

    imagines = True

    def imagine(self, encoded: Encoded, mask: Array) -> Array:
        return np.full((3, 84, 84, 3), (0, 200, 0), np.uint8)

    def mean_pictures(self) -> Array:
        return np.zeros((3, 84, 84, 3), np.uint8)


def tile(frame: Frame, dropped: Dropped = "imagined", camera: int = 1) -> Array:
    left = camera * (TILE + GAP)
    return mosaic(frame, TILE, dropped=dropped)[HEADER:, left : left + TILE].astype(int)


def test_only_pixels_that_move_count() -> None:
    usual = np.full((20, 20, 3), 100, np.uint8)
    truth, drawn = usual.copy(), usual.copy()
    truth[:4, :5] = 151
    drawn[:4, :5] = 151 - 51  # A fifth of the range.
    drawn[10:] = 255  # Where nothing moves.
    assert moving_psnr(drawn, truth, usual) == pytest.approx(-20 * np.log10(0.2))
    assert moving_psnr(truth, truth, usual) == 100
    truth[:4, :5] = 110  # By 10 of 255: that is not more.
    assert np.isnan(moving_psnr(drawn, truth, usual))
    truth[:3, :3] = 151
    assert np.isnan(moving_psnr(drawn, truth, usual))  # Nine pixels are too few.


def test_depth_of_one_channel_is_held_against_three() -> None:
    usual, drawn = np.zeros((8, 8, 3), np.uint8), np.full((8, 8, 3), 255, np.uint8)
    assert moving_psnr(drawn, np.full((8, 8, 1), 255, np.uint8), usual) == 100


def test_a_frame_holds_what_is_imagined_of_dropped_cameras_alone() -> None:
    assert isinstance(Painter(), Imagines) and not isinstance(FakePolicy(), Imagines)
    assert frame_with(policy=Painter()).world.imagined == {}
    assert frame_with(SetCamera("third_a", OFF)).world.imagined == {}
    found = frame_with(SetCamera("third_a", OFF), policy=Painter()).world.imagined
    assert list(found) == ["third_a"] and found["third_a"].picture[0, 0, 1] == 200
    assert 0 < found["third_a"].psnr < 20


def test_a_policy_that_does_not_support_what_is_left_imagines_nothing() -> None:
    class OneCamera(Painter):
        def supports(self, mask: Array) -> bool:
            return bool(np.any(mask))

    off = [SetCamera(name, OFF) for name in ("first", "third_a", "third_b")]
    assert len(frame_with(*off[:2], policy=OneCamera()).world.imagined) == 2
    assert frame_with(*off, policy=OneCamera()).world.imagined == {}


def test_the_past_shows_what_was_imagined_then() -> None:
    session = Recorder(Painter())
    session.at(0.0)
    now = session.ask(SetCamera("first", OFF), StepOnce())
    assert "first" in now.world.imagined and now.world.step > 0
    past = session.ask(Scrub(0))
    assert "first" in past.world.imagined and past.world.step == 0


def test_a_dropped_tile_is_imagined_or_true_or_both() -> None:
    frame = frame_with(SetCamera("third_a", OFF), policy=Painter())
    drawn, both, true = (tile(frame, how) for how in ("imagined", "both", "truth"))
    assert (drawn[100, 100] == (0, 200, 0)).all() and (both[100, 100] == (0, 200, 0)).all()
    assert not (true == tile(frame_with(), "truth")).all() and np.ptp(true, axis=2).max() == 0
    assert (drawn[-20, -20] == (0, 200, 0)).all() and not (both[-20, -20] == (0, 200, 0)).all()
    edges = np.concatenate([drawn[0], drawn[-1], drawn[:, 0], drawn[:, -1]])
    assert 0.3 < (edges != (0, 200, 0)).any(-1).mean() < 0.8, "a dashed frame"
    assert drawn[3:23].max() > 240, "a word"
    np.testing.assert_array_equal(tile(frame, camera=0), tile(frame, "truth", camera=0))


def test_without_an_imagination_a_dropped_tile_is_as_ever() -> None:
    frame = frame_with(SetCamera("third_a", OFF))
    np.testing.assert_array_equal(tile(frame), tile(frame, "truth"))


def test_the_badge_says_how_near_it_is() -> None:
    frame = frame_with(SetCamera("third_a", OFF), policy=Painter())

    def judged(psnr: float) -> Frame:
        found = frame.world.imagined["third_a"]
        return with_world(frame, imagined={"third_a": Imagined(found.picture, psnr)})

    assert badge(judged(17.3), "third_a") == "OFF, 17 dB"
    assert badge(judged(float("nan")), "third_a") == "OFF"
    assert badge(replace(frame), "first") == "RGB"


def test_a_visitor_chooses_what_dropped_cameras_show(server: viser.ViserServer) -> None:
    gui = recorded(server.gui)
    panel = CamerasPanel(gui, lambda command: None, frame_with(), 622)
    choice = gui.find("Dropped cameras show")
    apply(panel.update(frame_with(SetCamera("third_a", OFF))))
    assert not choice.visible, "this policy imagines nothing"
    apply(panel.update(frame_with(SetCamera("third_a", OFF), policy=Painter())))
    assert choice.visible
    screen = panel._mosaics[0].screen
    before = screen._feed.content
    use(choice, "the truth")
    assert screen._feed.content != before, "at once, also where nothing plays"
    panel.remove()

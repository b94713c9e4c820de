"""Boxes drawn on the mosaic: what is believed of a page, and where the patch comes to lie."""

from __future__ import annotations

import numpy as np
import pytest

from madviz.app.panel import apply
from madviz.app.panels.breaks import BreakPanel
from madviz.app.panels.cameras import CamerasPanel
from madviz.app.panels.patch import Box, parse_box, patched
from madviz.drawing.mosaic import GAP, HEADER, mosaic
from madviz.errors import UserError
from madviz.observation.ablation import CameraState, Occlusion
from madviz.session.commands import Pause, SetCamera, SetPolicy
from tests.pages import recorded, use
from tests.sessions import frame_with

TILE = 202
RGB = CameraState("rgb")


def test_a_line_of_the_script_is_a_box():
    assert parse_box("7 1 0.4200 0.5500 0.2000 0.1000", 3) == Box(1, 0.42, 0.55, 0.2, 0.1)


@pytest.mark.parametrize(
    "line",
    [
        "",
        "1 0 nan 0.5000 0.2000 0.1000",
        "1 0 inf 0.5000 0.2000 0.1000",
        "1 0 0.5000 0.5000 0.2000",
        "1 0 0.5000 0.5000 0.2000 0.1000 0.1000",
        "1 0 1.5000 0.5000 0.2000 0.1000",
        "1 0 0.5000 0.5000 1.0001 0.1000",
        "1 0 0.5000 0.5000 0.1000 1.0001",
        "1 0 0.5000 0.5000 0.0000 0.1000",
        "1 0 0.5000 0.5000 0.1000 0.0000",
        "1 0 -0.500 0.5000 0.2000 0.1000",
        "1 0 5e-1 0.5000 0.2000 0.1000",
        "1 3 0.5000 0.5000 0.2000 0.1000",
        "1 -1 0.5000 0.5000 0.2000 0.1000",
        "1 ١ 0.5000 0.5000 0.2000 0.1000",
        "1 0 0.5000 0.5000 0.2000 0.1000\n",
        "x" * 100_000,
    ],
)
def test_anything_else_is_refused_in_one_short_line(line):
    with pytest.raises(UserError, match="expected a box") as caught:
        parse_box(line, 3)
    assert len(str(caught.value)) < 200 and "\n" not in str(caught.value)


def test_a_patch_that_is_there_keeps_its_strength():
    box = Box(0, 0.5, 0.25, 0.333, 0.004)
    assert patched(RGB, box, TILE).occlusion == Occlusion("patch", 1.0, 0.5, 0.25, 0.33, 0.01)
    faint = CameraState("rgb", Occlusion("patch", 0.4))
    assert patched(faint, box, TILE).occlusion.strength == 0.4
    blurred = CameraState("rgb", Occlusion("blur", 0.4))
    assert patched(blurred, box, TILE).occlusion.strength == 1.0
    with pytest.raises(UserError, match="switch it on"):
        patched(CameraState("off"), box, TILE)


@pytest.mark.parametrize(
    ("shown", "y"), [("rgb", 0.3), ("rgb", 0.7), ("depth", 0.3), ("both", 0.25), ("both", 0.7)]
)
def test_the_patch_lies_where_the_box_was_drawn(shown, y):
    """The tile's pixels that change are the box's, whatever the tile shows there."""
    box = Box(1, 0.4, y, 0.3, 0.15)
    before = frame_with(Pause(), SetPolicy("toy-rgbd"), SetCamera("third_a", CameraState(shown)))
    state = patched(before.camera("third_a"), box, TILE)
    after = frame_with(Pause(), SetPolicy("toy-rgbd"), SetCamera("third_a", state))
    left = TILE + GAP
    one, other = (mosaic(f, TILE)[HEADER:, left : left + TILE].astype(int) for f in (before, after))
    changed = np.abs(one - other).max(2) > 3
    if shown == "both":  # Both halves have the patch; look at the one that was drawn on.
        changed[slice(TILE // 2, None) if y < 0.5 else slice(0, TILE // 2)] = False
    rows, columns = np.nonzero(changed)
    assert (columns.min() + columns.max()) / 2 == pytest.approx(0.4 * TILE, abs=4)
    assert (rows.min() + rows.max()) / 2 == pytest.approx(y * TILE, abs=4)
    assert np.ptp(columns) == pytest.approx(0.3 * TILE, abs=6)
    assert np.ptp(rows) == pytest.approx(0.15 * TILE, abs=6)


def test_the_panel_sends_what_was_drawn_and_nothing_else(server):
    sent = []
    frame = frame_with(Pause())
    gui = recorded(server.gui)
    panel = CamerasPanel(gui, sent.append, frame, 620)
    apply(panel.update(frame))
    assert not use(gui.find("box"), "1 2 0.5000 0.5000 0.2500 0.7500")
    patch = Occlusion("patch", width=0.25, height=0.75)
    assert sent == [SetCamera("third_b", CameraState("rgb", patch))]
    ((_, said),) = use(gui.find("box"), "2 7 0.5000 0.5000 0.2500 0.7500")
    assert said.startswith("expected a box") and len(sent) == 1
    panel.remove()


def test_who_only_watches_cannot_draw(server):
    gui = recorded(server.gui)
    panel = CamerasPanel(gui, None, frame_with(Pause()), 620)
    assert not gui.of("GuiTextHandle") and "data-draw" not in gui.html
    panel.remove()


def test_a_patch_has_a_slider_for_each_side_and_only_a_patch_has(server):
    sent = []
    frame = frame_with(
        Pause(), SetCamera("first", CameraState("rgb", Occlusion("patch", width=0.8)))
    )
    gui, names = recorded(server.gui), ("x", "y", "width", "height")
    panel = BreakPanel(gui, sent.append, frame)
    apply(panel.turn("first"))
    assert [gui.find(side).value for side in ("width", "height")] == [0.8, 0.4]
    assert all(gui.find(name).visible and gui.find(name).hint for name in names)
    use(gui.find("height"), 0.1)
    patch = Occlusion("patch", width=0.8, height=0.1)
    assert sent == [SetCamera("first", CameraState("rgb", patch))]
    apply(panel.turn("third_a"))
    assert not any(gui.find(name).visible for name in names)
    panel.remove()

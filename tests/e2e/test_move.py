"""Moving a camera and drawing a patch, in a real browser."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import viser
from playwright.sync_api import expect
from scipy.spatial.transform import Rotation

from madviz.app.gizmo import SIZE
from madviz.app.scene import extent
from madviz.app.server import App
from madviz.frame import Frame
from madviz.moves import Displacement, MoveCamera, trained_axes
from tests.e2e.conftest import PATIENCE, Visitor


@pytest.fixture
def paused(visitor: Visitor, app: App) -> Iterator[Visitor]:
    """An episode that stands still, with every camera in its place, before and after."""
    visitor.press("pause")
    visitor.until("status.phase === 'paused'")
    visitor.dismiss()
    yield visitor
    for session in filter(None, map(app.users.session_of, app.server.get_clients())):
        for camera in ("first", "third_a", "third_b"):
            session.send(MoveCamera(camera, None))
    visitor.page.get_by_role("tab", name="Features", exact=True).click()


def drag(
    visitor: Visitor, camera: int, start: tuple[float, float], by: tuple[float, float]
) -> None:
    """Drags on a camera's tile, in parts of it; the mouse stays down."""
    box = visitor.page.locator(".mv-mosaic").first.bounding_box()
    scale = box["width"] / float(visitor.page.locator(".mv-mosaic").first.get_attribute("width"))
    side = box["height"] - 24 * scale
    x = box["x"] + camera * (side + 6 * scale) + start[0] * side
    y = box["y"] + 24 * scale + start[1] * side
    mouse = visitor.page.mouse
    mouse.move(x, y)
    mouse.down()
    for part in (0.3, 0.7, 1.0):
        mouse.move(x + by[0] * side * part, y + by[1] * side * part)


def brightness(visitor: Visitor, camera: int) -> np.ndarray:
    """(20, 20) of a tile as the browser shows it."""
    return np.array(visitor.tile(camera)).reshape(20, 20, 3).max(2)


def until_tile(visitor: Visitor, camera: int, fits) -> np.ndarray:
    """Waits until a tile looks as it should, some 60 s at most."""
    for _ in range(240):
        seen = brightness(visitor, camera)
        if fits(seen):
            return seen
        visitor.page.wait_for_timeout(250)
    raise AssertionError(f"the tile never looked like that; it is\n{seen}")


def test_a_box_drawn_on_a_picture_becomes_a_patch(paused: Visitor):
    paused.until("document.querySelector('img[data-draw]')?.naturalWidth > 500")
    assert brightness(paused, 2)[8:14, 8:14].min() > 20
    drag(paused, 2, (0.3, 0.3), (0.5, 0.4))
    band = paused.page.locator(".mv-band").bounding_box()
    assert band is not None and band["width"] == pytest.approx(band["height"], abs=1)
    paused.page.mouse.up()
    paused.until("status.setting.includes('third_b:patch')")
    seen = until_tile(paused, 2, lambda tile: tile[8:14, 8:14].max() < 12)
    assert seen[:4].max() > 60 and seen[18:].max() > 60  # Nothing else of the tile is black.
    assert paused.page.locator(".mv-band").count() == 0
    place, setting = {}, paused.status("setting")
    for part in setting.split("third_b:patch,")[1].split(","):
        name, value = part.split("=")
        place[name] = float(value)
    assert place == pytest.approx({"strength": 1, "x": 0.55, "y": 0.55, "size": 0.5}, abs=0.03)


def test_a_click_on_a_picture_or_a_drag_beside_it_does_nothing(paused: Visitor):
    drag(paused, 1, (0.5, 0.5), (0.01, 0.01))
    paused.page.mouse.up()
    drag(paused, 1, (0.5, -0.08), (0.0, 0.5))  # Begins on the title.
    assert paused.page.locator(".mv-band").count() == 0
    paused.page.mouse.up()
    drag(paused, 1, (0.2, 0.2), (0.5, 0.5))
    paused.page.keyboard.press("Escape")
    paused.page.mouse.up()
    drag(paused, 0, (0.2, 0.2), (0.3, 0.3))
    paused.page.mouse.up()
    paused.until("status.setting.includes('first:patch')")
    assert "third_a" not in paused.status("setting")


def test_a_line_that_no_drag_wrote_becomes_a_note(paused: Visitor):
    paused.page.evaluate(
        """() => {
          const id = document.querySelector('img[data-draw]').dataset.draw;
          const input = document.querySelector(`[data-mv-id="${id}"] input`);
          Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, 'value')
            .set.call(input, '1 0 NaN 0.5000 9.0000');
          input.dispatchEvent(new Event('input', {bubbles: true}));
        }"""
    )
    paused.until("document.body.innerText.includes('expected a box as this page draws one')")
    assert paused.status("setting") == "all"


def test_a_moved_camera_sees_something_else_and_goes_back(paused: Visitor):
    page = paused.page
    before = brightness(paused, 1)
    page.get_by_role("tab", name="Move", exact=True).click()
    page.get_by_role("button", name="Third A", exact=True).click()
    box = page.locator("[data-mv-grid=move] input[inputmode=decimal]").nth(1)  # Right.
    box.fill("0.4")
    box.press("Enter")
    paused.until("status.setting === 'all · third_a:moved,right=0.4'")
    until_tile(paused, 1, lambda tile: np.abs(tile - before).mean() > 4)
    paused.until_text(".mv-moved", "0.40 m to the right")
    page.get_by_role("button", name="back", exact=True).click()
    paused.until("status.setting === 'all'")
    until_tile(paused, 1, lambda tile: np.abs(tile - before).mean() < 1)
    paused.until_text(".mv-moved", "Every camera stands where")
    expect(box).to_have_value("0", timeout=PATIENCE)


def test_an_arrow_in_the_scene_drags_the_camera(paused: Visitor, app: App):
    page = paused.page
    (client,) = app.server.get_clients().values()
    session = app.users.session_of(client.client_id)
    assert session is not None and isinstance(session.latest, Frame)
    frame = session.latest
    page.get_by_role("tab", name="Move", exact=True).click()
    page.get_by_role("button", name="Third A", exact=True).click()
    arrows = page.locator("[data-mv-grid=move] input[type=checkbox]")
    arrows.check(force=True)
    page.wait_for_timeout(3000)  # Nothing of the page says that the scene has been drawn.
    pose = frame.poses["third_a"]
    right = trained_axes(pose, Displacement()).apply([SIZE * extent(frame), 0.0, 0.0])
    start, end = (on_screen(client, pose.position + part * right) for part in (0.85, 1.6))
    page.mouse.move(*start)
    page.wait_for_timeout(500)
    page.mouse.down()
    for part in (0.3, 0.6, 1.0):
        page.mouse.move(*(a + part * (b - a) for a, b in zip(start, end, strict=True)))
        page.wait_for_timeout(300)
    page.mouse.up()
    paused.until("status.setting.startsWith('all · third_a:moved,right=0.')")
    arrows.uncheck(force=True)
    page.get_by_role("button", name="all back", exact=True).click()
    paused.until("status.setting === 'all'")


def on_screen(client: viser.ClientHandle, point: np.ndarray) -> tuple[float, float]:
    """Pixels of a point in the scene, which is 312 wide around 800."""
    eye = client.camera
    seen = Rotation.from_quat(eye.wxyz, scalar_first=True).inv().apply(point - eye.position)
    focal = 400 / np.tan(eye.fov / 2)
    return 800 + focal * seen[0] / seen[2], 400 + focal * seen[1] / seen[2]

"""Moving a camera and drawing a patch, in a real browser."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import viser
from playwright.sync_api import expect
from scipy.spatial.transform import Rotation

from madviz.app.server import App
from madviz.observation.displacement import MoveCamera
from madviz.session.frame import Frame
from tests.e2e.conftest import PATIENCE, Visitor
from tests.pages import sessions_shown

RING = 0.65
"""Radius of a ring, as a share of an arrow's length."""


@pytest.fixture
def paused(visitor: Visitor, app: App) -> Iterator[Visitor]:
    """An episode that stands still, with every camera in its place, before and after."""
    visitor.press("pause")
    visitor.until("status.phase === 'paused'")
    visitor.dismiss()
    yield visitor
    for session in sessions_shown(app.users).values():
        for camera in ("first", "third_a", "third_b"):
            session.send(MoveCamera(camera, None))
    visitor.close_breaks()


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
    paused.until("document.querySelector('img[data-draw]')?.naturalWidth > 400")
    assert brightness(paused, 2)[8:14, 8:14].min() > 20
    drag(paused, 2, (0.3, 0.3), (0.5, 0.4))
    band = paused.page.locator(".mv-band").bounding_box()
    assert band is not None and band["width"] == pytest.approx(band["height"] / 0.4 * 0.5, abs=2)
    paused.page.mouse.up()
    paused.until("status.setting.includes('third_b:patch')")
    seen = until_tile(paused, 2, lambda tile: tile[8:12, 8:14].max() < 12)
    assert seen[:4].max() > 60 and seen[15:18, 6:15].min() > 60  # Lower than wide.
    assert paused.page.locator(".mv-band").count() == 0
    place, setting = {}, paused.status("setting")
    for part in setting.split("third_b:patch,")[1].split(","):
        name, value = part.split("=")
        place[name] = float(value)
    drawn = {"strength": 1, "x": 0.55, "y": 0.5, "width": 0.5, "height": 0.4}
    assert place == pytest.approx(drawn, abs=0.02)
    paused.press("break …", camera=2)
    paused.page.locator("[data-mv-grid=breaks] label", has_text=re.compile("^width$")).wait_for()


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
    paused.press("break …", camera=1)
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


Place = Callable[[np.ndarray], tuple[float, float]]
"""Where a point is on the screen: x to Third A's right, y to its bottom, z ahead of it, in lengths
of an arrow."""


@pytest.fixture
def arrows(paused: Visitor, app: App) -> Iterator[Place]:
    """Third A has its arrows, seen from above it, where no ring is behind another one."""
    page = paused.page
    (client,) = app.server.get_clients().values()
    session = sessions_shown(app.users)[client.client_id]
    assert isinstance(session.latest, Frame)
    pose = session.latest.world.poses["third_a"]
    # Of the scene as it was when the page was opened, hence not known from this frame.
    size = client.scene._handle_from_transform_controls_name["/moved"].scale
    axes, eye = Rotation.from_quat(pose.wxyz, scalar_first=True), client.camera
    paused.press("break …", camera=1)
    arrows = page.locator("[data-mv-grid=move] input[type=checkbox]")
    arrows.check(force=True)
    before = eye.position, eye.look_at
    eye.position = pose.position + size * axes.apply([1.6, -8.0, 0.8])
    eye.look_at = pose.position
    page.wait_for_timeout(4000)  # Nothing of the page says that the scene has been drawn.
    yield lambda point: on_screen(client, pose.position + size * axes.apply(point))
    arrows.uncheck(force=True)
    eye.position, eye.look_at = before
    page.get_by_role("button", name="all back", exact=True).click()
    paused.until("status.setting === 'all'")


def drag_along(visitor: Visitor, points: list[tuple[float, float]]) -> None:
    """Drags slowly, as the scene takes a while to see it, and lets go."""
    mouse = visitor.page.mouse
    mouse.move(*points[0])
    visitor.page.wait_for_timeout(500)
    mouse.down()
    for point in points[1:]:
        mouse.move(*point)
        visitor.page.wait_for_timeout(300)
    mouse.up()


def test_an_arrow_in_the_scene_drags_the_camera(paused: Visitor, arrows: Place):
    drag_along(paused, [arrows(np.array([part, 0, 0])) for part in (0.85, 1.0, 1.3, 1.6)])
    paused.until("/^all · third_a:moved,right=0\\.\\d+$/.test(status.setting)")


def test_a_ring_in_the_scene_turns_the_camera_and_the_slider_follows(
    paused: Visitor, arrows: Place
):
    def on_ring(degrees: float) -> tuple[float, float]:
        """A point of the ring about the camera's vertical, from straight ahead to the right."""
        return arrows(Rotation.from_euler("y", degrees, degrees=True).apply([0.0, 0.0, RING]))

    drag_along(paused, [on_ring(degrees) for degrees in (45, 50, 58, 65)])
    turned = "pan=(1[89]|2[0-2])"  # 20 degrees, to the pixel.
    paused.until(f"/^all · third_a:moved,{turned}$/.test(status.setting)")
    pan = paused.status("setting").split("pan=")[1]
    box = paused.page.locator("[data-mv-grid=move] input[inputmode=decimal]").nth(3)
    expect(box).to_have_value(pan, timeout=PATIENCE)


def on_screen(client: viser.ClientHandle, point: np.ndarray) -> tuple[float, float]:
    """Pixels of a point in the scene, which is 530 wide around 705."""
    eye = client.camera
    seen = Rotation.from_quat(eye.wxyz, scalar_first=True).inv().apply(point - eye.position)
    focal = 400 / np.tan(eye.fov / 2)
    return 705 + focal * seen[0] / seen[2], 400 + focal * seen[1] / seen[2]

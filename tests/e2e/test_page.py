"""What a visitor sees and does, in a real browser."""

from __future__ import annotations

import threading

import numpy as np
import viser
from scipy.spatial.transform import Rotation

from madviz.app.server import App
from madviz.drawing.viewpoint import WIDTH_ON_BODY, extent
from madviz.session.frame import Frame
from madviz.types import CameraPose
from tests.e2e.conftest import PATIENCE, Visitor, arrive, toy_app, wait_until
from tests.pages import seats, sessions_shown


def grey(pixels: list[list[int]]) -> float:
    """Mean distance from grey, 0 for a picture without colour."""
    return float(np.ptp(np.array(pixels), axis=1).mean())


def test_pictures_come_and_change(visitor: Visitor):
    visitor.until("document.querySelector('.mv-mosaic')")
    before, step = (
        visitor.page.locator(".mv-mosaic").first.get_attribute("src"),
        visitor.status("step"),
    )
    visitor.until(
        f"document.querySelector('.mv-mosaic').src !== '{before}' && status.step !== '{step}'"
    )


def test_at_full_speed_the_picture_is_always_whole_and_keeps_up(visitor: Visitor):
    visitor.page.mouse.click(800, 700)
    visitor.page.keyboard.press("f")
    for _ in range(5):
        step = visitor.page.locator(".mv-mosaic").get_attribute("data-step")
        visitor.until(f"document.querySelector('.mv-mosaic').dataset.step !== '{step}'")
        assert grey(visitor.tile(0)) > 10  # A picture that has not loaded draws nothing: black.


def test_the_note_that_there_is_no_gpu_goes_by_itself(browser, app: App):
    visitor = arrive(browser, app.url)  # A slow page may show the note, then the episode.
    note = visitor.page.get_by_text("Software WebGL rendering")
    note.wait_for(timeout=PATIENCE)
    note.wait_for(state="detached", timeout=PATIENCE)
    visitor.close()


DRAWS = """() => new Promise(done => {
  const canvas = WebGL2RenderingContext.prototype, clear = canvas.clear;
  const clock = Performance.prototype, now = clock.now, later = performance.now() + 60000;
  let drawn = 0;
  canvas.clear = function (...rest) { drawn += 1; return clear.apply(this, rest); };
  clock.now = () => later;
  window.__viserMutable.requestRender();
  setTimeout(() => {
    canvas.clear = clear;
    clock.now = now;
    done(drawn);
  }, 4000);
})"""
"""Pictures of the scene in four seconds, after one that was asked for: viser's clock stands still
in the next minute, so whatever it would go on drawing for a while is drawn all the time."""


def test_the_scene_is_drawn_once_for_each_change(visitor: Visitor):
    visitor.page.mouse.click(800, 700)
    visitor.page.keyboard.press(" ")
    visitor.until("status.phase === 'paused'")
    drawn = visitor.page.evaluate(DRAWS)
    assert 1 <= drawn <= 8  # viser itself draws one every second.


AT_ONCE = """() => new Promise(done => {
  const define = Object.defineProperty;
  let taken = 0;
  Object.defineProperty = (what, name, how) => {
    taken += what === document && name === 'hidden';
    return define(what, name, how);
  };
  setTimeout(() => {
    Object.defineProperty = define;
    done(taken);
  }, 3000);
})"""
"""How many changes of the scene in three seconds did not wait for a picture."""


def test_a_change_of_the_scene_does_not_wait_for_a_picture(visitor: Visitor):
    assert visitor.page.evaluate(AT_ONCE) >= 1
    assert not visitor.page.evaluate("document.hidden || Object.hasOwn(performance, 'now')")


IN_SIGHT = """() => {
  const rect = one => {
    const box = one.getBoundingClientRect();
    return [box.x, box.y, box.right, box.bottom];
  };
  const shown = [...document.querySelectorAll('button, .mv, .mv td, .mv span')]
    .filter(one => one.checkVisibility());
  const named = name => shown.filter(one => one.innerText.trim() === name).map(rect);
  const found = {};
  for (const name of ['off', 'break …', 'next', 'max', 'merged: their sum', '† no camera'])
    found[name] = named(name);
  for (const part of ['mv-status', 'mv-words'])
    found[part] = shown.filter(one => one.classList.contains(part)).map(rect);
  found.mosaic = [...document.querySelectorAll('.mv-mosaic')].map(rect);
  return found;
}"""


def test_everything_that_matters_is_in_sight(visitor: Visitor):
    page = visitor.page
    visitor.until("document.querySelector('.mv-mosaic')?.naturalWidth > 400")
    for text in ("merged: their sum", "† no camera"):
        shown = page.get_by_text(text, exact=True).filter(visible=True)
        shown.first.wait_for(timeout=PATIENCE)  # Hidden tabs have some of these words, too.
    found = page.evaluate(IN_SIGHT)
    assert len(found["off"]) == len(found["break …"]) == 3
    for name, boxes in found.items():
        assert boxes, f"{name} is not on the page"
        for left, top, right, bottom in boxes:
            assert 0 <= left and right <= 1280 and 0 <= top and bottom <= 800, name
    left, _, right, _ = found["mosaic"][0]
    assert right - left >= 3 * 130
    marked = page.get_by_role("button", name="on", exact=True).first
    other = page.get_by_role("button", name="off", exact=True).first
    colour = "one => getComputedStyle(one).backgroundColor"
    assert marked.evaluate(colour) != other.evaluate(colour)


def test_switching_a_camera_off_shows_everywhere(visitor: Visitor):
    visitor.press("pause")
    visitor.until("status.phase === 'paused'")
    action = visitor.page.locator(".mv-action").inner_text()
    assert grey(visitor.tile(1)) > 10
    visitor.press("off", camera=1)
    visitor.until("status.setting === 'first+third_b'")
    said = visitor.until_text(".mv-words", "dropped")
    assert said.startswith("Third A dropped: action changed by")
    visitor.until(f"document.querySelector('.mv-action').innerText !== `{action}`")
    wait_until(lambda: grey(visitor.tile(1)) < 6)
    assert grey(visitor.tile(0)) > 10
    wait_until(lambda: "Third A · dropped" in visitor.page.content())  # The scene follows.


def test_dropped_does_not_look_like_black(visitor: Visitor):
    visitor.press("pause")
    visitor.press("off", camera=2)
    visitor.until("status.setting === 'first+third_a'")
    wait_until(lambda: grey(visitor.tile(2)) < 6)
    dropped = np.array(visitor.tile(2), float)
    visitor.press("on", camera=2)
    visitor.until("status.setting === 'all'")
    visitor.breaks("black", camera=2)
    visitor.until("status.setting.includes('third_b:black')")
    wait_until(lambda: np.max(visitor.tile(2)) < 12)
    black = np.array(visitor.tile(2), float)
    assert np.abs(dropped - black).mean() > 10
    assert dropped.max() > 150  # The stamp is white.
    assert "sends black" in visitor.until_text(".mv-words", "black")


def test_policies_swap_in_mid_episode_and_camera_settings_stay(visitor: Visitor):
    visitor.press("pause")
    visitor.press("off", camera=0)
    visitor.until("status.setting === 'third_a+third_b' && status.phase === 'paused'")
    before = visitor.status("episode"), visitor.status("step")
    visitor.pick("toy-other")
    visitor.until_text(".mv-status", "works with all of them together")
    assert visitor.status("setting") == "third_a+third_b"
    visitor.pick("toy-rgbd")
    visitor.until("document.body.innerText.includes('Third B depth')")
    assert (visitor.status("episode"), visitor.status("step")) == before


def test_depth_is_shown_and_said_to_be_unused(visitor: Visitor):
    visitor.breaks("depth", camera=0)
    visitor.until("status.setting === 'third_a+third_b'")
    visitor.until("document.body.innerText.includes('does not reach it')")
    visitor.press("on", camera=0)
    visitor.until("!document.body.innerText.includes('does not reach it')")


def test_strength_appears_where_it_matters(visitor: Visitor):
    strength = visitor.page.get_by_text("strength", exact=True)
    assert strength.count() == 0
    visitor.breaks("noise", camera=1)
    strength.wait_for()
    visitor.press("close")
    strength.wait_for(state="detached")


def test_keys(visitor: Visitor):
    visitor.page.mouse.click(800, 700)
    visitor.page.keyboard.press("Space")
    visitor.until("status.phase === 'paused'")
    visitor.page.keyboard.press("2")
    visitor.until("status.setting === 'first+third_b'")
    visitor.page.keyboard.press("2")
    visitor.until("status.setting === 'all'")
    step = int(visitor.status("step"))
    visitor.page.keyboard.press("s")
    visitor.until(f"status.step !== '{step}'")


def test_a_click_on_a_frustum_drops_its_camera(visitor: Visitor, app: App):
    (client,) = app.server.get_clients().values()
    session = sessions_shown(app.users)[client.client_id]
    assert isinstance(session.latest, Frame)
    visitor.press("pause")
    visitor.until("status.phase === 'paused'")
    visitor.page.wait_for_timeout(1500)  # It rides on the hand; until it is drawn, it is elsewhere.
    pose = session.latest.world.poses["first"]
    depth = WIDTH_ON_BODY * extent(session.latest) / (2 * np.tan(np.radians(pose.fovy) / 2))
    x, y = on_screen(client, pose, depth)  # The picture's middle.
    visitor.page.mouse.move(x - 2, y)
    visitor.page.mouse.click(x, y, delay=60)
    visitor.until("status.setting === 'third_a+third_b'")


def on_screen(client: viser.ClientHandle, pose: CameraPose, depth: float) -> tuple[float, float]:
    """Pixels of a point ``depth`` metres in front of a camera; the scene is 530 wide around 705."""
    point = pose.position + depth * Rotation.from_quat(pose.wxyz, scalar_first=True).apply(
        [0.0, 0.0, 1.0]
    )
    eye = client.camera
    seen = Rotation.from_quat(eye.wxyz, scalar_first=True).inv().apply(point - eye.position)
    focal = 400 / np.tan(eye.fov / 2)
    return 705 + focal * seen[0] / seen[2], 400 + focal * seen[1] / seen[2]


def test_nan_pauses_with_words_and_a_traceback_and_the_page_lives(visitor: Visitor):
    visitor.pick("toy-nan")
    visitor.until_text(".mv-status", "MAD")
    visitor.press("off", camera=0)
    visitor.until("status.setting === 'third_a+third_b'")
    visitor.press("off", camera=1)
    said = visitor.until_text(".mv-error", "finite action")
    assert "Press again" in said and "Traceback" not in said
    visitor.page.locator(".mv-error summary").click()
    visitor.until_text(".mv-error", "Traceback")
    assert visitor.page.locator(".mv-verdict").inner_text() == "STOPPED"
    visitor.press("on", camera=0)
    visitor.until("status.setting === 'first+third_b'")
    visitor.press("again")
    visitor.until("status.phase === 'playing' && !document.querySelector('.mv-error')")
    step = visitor.status("step")
    visitor.until(f"status.step !== '{step}'")


def test_absurd_numbers_from_the_page_do_no_harm(visitor: Visitor):
    visitor.breaks("noise", camera=0)
    visitor.page.get_by_text("strength", exact=True).wait_for()
    box = visitor.page.locator("[data-mv-grid=breaks] input[inputmode=decimal]").first
    box.fill("1e9")
    box.press("Enter")
    visitor.until("status.setting.includes('noise')")
    visitor.press("as it is", camera=0)
    visitor.until("status.setting === 'all'")
    step = visitor.status("step")
    visitor.until(f"status.step !== '{step}'")


def test_two_visitors_do_not_disturb_each_other(visitor: Visitor, visit, app: App):
    other = visit(app.url)
    visitor.press("off", camera=0)
    other.breaks("black", camera=2)
    visitor.until("status.setting === 'third_a+third_b'")
    other.until("status.setting.includes('third_b:black')")
    assert visitor.status("setting") == "third_a+third_b"
    assert seats(app.users)[0] == 2


def test_a_closed_page_frees_its_session(visitor: Visitor, visit, app: App):
    wait_until(lambda: seats(app.users)[0] == 1)
    before = our_threads()
    other = visit(app.url)
    assert len(our_threads()) == len(before) + 2  # The session's and the page's.
    other.close()
    wait_until(lambda: seats(app.users)[0] == 1)
    wait_until(lambda: our_threads() == before)


def our_threads() -> set[threading.Thread]:
    """Of pages and sessions; who tidies up after them comes and goes."""
    names = ("madviz-page", "madviz-session")
    return {thread for thread in threading.enumerate() if thread.name in names}


def test_over_the_cap_one_watches_and_then_inherits(visit):
    app = toy_app(visitors=1)
    owner, watcher = visit(app.url), visit(app.url)
    assert watcher.page.get_by_text("You are watching").is_visible()
    assert watcher.page.get_by_role("button", name="off").count() == 0
    assert seats(app.users) == (1, 1, 0)
    owner.press("off", camera=1)
    watcher.until("status.setting === 'first+third_b'")
    owner.close()
    watcher.page.get_by_role("button", name="off").first.wait_for(timeout=PATIENCE)
    watcher.until("status.setting === 'all'")
    assert seats(app.users) == (1, 0, 0)
    app.stop()

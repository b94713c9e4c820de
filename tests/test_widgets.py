"""Widgets without a browser: what they show, what a click does, and that they end."""

from __future__ import annotations

import gc
import socket
import subprocess
import sys
import threading
import time
import types
import urllib.request
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from madviz.errors import UserError
from madviz.observation.ablation import CameraState, Occlusion
from madviz.observation.condition import Condition
from madviz.session.commands import Play, SetSpeed
from madviz.teaching.inside import record
from madviz.teaching.lessons import interval_figure
from madviz.types import Encoded
from madviz.widgets import Explorer, Predict, TryOut, Viewer, live_page, notebook_page
from madviz.widgets.explorer import MOST
from madviz.widgets.explorer_table import ROWS, table_html, words_html
from madviz.widgets.questions import control_for
from tests.fakes import AllOrNothing, Chunked, FakePolicy
from tests.pages import until
from tests.sessions import frame_with, with_world


@pytest.fixture
def explorer() -> Iterator[Explorer]:
    with closing(Explorer(FakePolicy(), seed=2000)) as explorer:
        yield explorer


def picture(explorer: Explorer) -> np.ndarray:
    raw = np.frombuffer(explorer.picture.value, np.uint8)
    decoded = cv2.imdecode(raw, cv2.IMREAD_COLOR)
    assert decoded is not None
    return decoded


def switch(explorer: Explorer, camera: str):
    """The control for what a camera gives, and the one for how it fails."""
    return explorer.switches[camera].children[1:]


def test_it_waits_at_the_start_and_steps_when_told(explorer: Explorer) -> None:
    assert (explorer.frame.world.step, explorer.frame.pace.phase) == (0, "paused")
    assert explorer.play.description == "Play"
    explorer.step(3)
    assert explorer.frame.world.step == 3
    until(lambda: "decision 3 of 25" in explorer.words.value)


def test_a_click_takes_a_camera_away_in_the_same_picture(explorer: Explorer) -> None:
    image, before = explorer.picture, picture(explorer)
    third = before.shape[1] // 3
    switch(explorer, "third_a")[0].value = "off"
    until(lambda: not explorer.frame.mask[1])
    until(lambda: "Third A dropped" in explorer.words.value)
    after = picture(explorer)
    assert explorer.picture is image, "the widget stays, its value changes"
    tile = after[60:90, third + 20 : 2 * third - 20].astype(int)
    assert (
        np.ptp(tile, axis=2).mean() < 8 < np.ptp(before[60:90, third + 20 :].astype(int), 2).mean()
    )
    assert ">First person + Third B<" in explorer.table.value


def test_an_occluded_camera_stays_in_the_mask(explorer: Explorer) -> None:
    switch(explorer, "third_b")[1].value = "black"
    until(lambda: "sends black" in explorer.words.value)
    assert explorer.frame.mask.all() and explorer.frame.world.arrived["third_b"].max() == 0


def test_cells_can_do_what_clicks_do(explorer: Explorer) -> None:
    explorer.set("first", "off")
    assert not explorer.frame.mask[0]
    with pytest.raises(UserError, match="unknown camera"):
        explorer.set("fourth", "off")


def test_a_cell_that_breaks_a_camera_leaves_all_that_the_policy_knows_of_it() -> None:
    with closing(Explorer(FakePolicy("toy-rgbd", "three-rgbd"))) as explorer:
        explorer.set("third_a", occlusion="black")
        assert explorer.frame.condition.subset == "all"
        explorer.set("third_a")
        assert explorer.frame.condition == Condition("all")


def test_switches_follow_what_a_cell_does_and_a_click_changes_one_thing(
    explorer: Explorer,
) -> None:
    given, fails = switch(explorer, "first")
    explorer.set("first", input="off")
    until(lambda: given.value == "off")
    fails.value = "black"
    until(lambda: explorer.frame.camera("first").occlusion.kind == "black")
    assert explorer.frame.camera("first").input == "off"
    explorer.set("first", input="both", occlusion="blur")
    until(lambda: fails.value == "blur")
    assert given.value is None, "a choice that is not offered"
    assert explorer.frame.camera("first") == CameraState("both", Occlusion("blur"))


def test_it_plays_and_pictures_follow(explorer: Explorer) -> None:
    painted = explorer.painted
    explorer.session.send(SetSpeed(None))
    explorer.session.send(Play())
    until(lambda: explorer.painted > painted + 5)
    assert explorer.play.description == "Pause"
    explorer.play.click()
    until(lambda: explorer.play.description == "Play")


def test_it_says_so_when_a_policy_cannot_act() -> None:
    with closing(Explorer(AllOrNothing())) as explorer:
        explorer.set("first", "off")
        until(lambda: "cannot act on this" in explorer.table.value)
        explorer.step()
        until(lambda: "cannot act on" in explorer.words.value)
        explorer.set("first")
        assert explorer.frame.camera("first").input == "rgb", "an earlier error ends no waiting"


class Broken(FakePolicy):
    """It takes a while for a feature; once it ``breaks``, it raises an error of its author."""

    breaks = False

    def encode(self, views: np.ndarray, state: np.ndarray) -> Encoded:
        time.sleep(0.0 if self.breaks else 0.6)
        if self.breaks:
            raise ValueError("weights have 3 columns, pictures 4")
        return super().encode(views, state)


def test_a_slow_first_answer_is_waited_for_and_an_error_is_shown_by_its_message() -> None:
    policy = Broken()
    with closing(Explorer(policy)) as explorer:
        policy.breaks = True
        explorer.step()
        until(lambda: "weights have 3 columns, pictures 4" in explorer.words.value)
        assert "Traceback" not in explorer.words.value
    before = threads()
    with pytest.raises(UserError, match="found: ValueError: weights have 3 columns, pictures 4"):
        Explorer(policy)
    assert threads() == before


def test_a_set_that_was_not_read_is_not_one_that_it_cannot_act_on() -> None:
    """Nor has it a Q of nan; and a name that the card writes otherwise is the same set."""
    policy = Chunked()
    policy.spec = replace(policy.spec, trained_subsets=("all", "third_b+third_a"))
    html = table_html(frame_with(policy=policy))
    assert html.count("not read") == 7 and "cannot act" not in html
    assert "nan" not in html and "<td>–</td>" in html
    now, trained, *rest = html.split("<tr>")[2:]
    assert "not trained" not in now + trained and "Third A + Third B" in trained
    assert all("not trained" in row for row in rest)


def test_modalities_that_a_policy_lacks_are_not_offered(explorer: Explorer) -> None:
    assert set(switch(explorer, "first")[0].options) == {"colour", "off"}
    with closing(Explorer(FakePolicy("toy-rgbd", "three-rgbd"))) as both:
        assert set(switch(both, "first")[0].options) == {"colour", "depth", "both", "off"}
        assert both.table.value.count("<tr>") == ROWS + 1


def test_there_is_html_where_there_are_no_widgets(explorer: Explorer) -> None:
    bundle = explorer._repr_mimebundle_()
    assert "application/vnd.jupyter.widget-view+json" in bundle
    assert bundle["text/html"].count("<img") == 1 and ">all<" in bundle["text/html"]


def threads() -> set[threading.Thread]:
    """Those of explorers: sessions and painters."""
    return {one for one in threading.enumerate() if one.name.startswith("madviz-")}


def test_closing_ends_all_threads_and_says_so() -> None:
    before = threads()
    explorer = Explorer(FakePolicy())
    names = {"madviz-session", "madviz-attends", "madviz-painter"}
    assert {one.name for one in threads() - before} == names
    explorer.close()
    assert explorer.play.disabled and switch(explorer, "first")[0].disabled
    explorer.close()
    assert explorer.words.value.count("has ended") == 1 and explorer not in Explorer.running
    until(lambda: not threads() - before)


def test_a_cell_that_asks_a_closed_explorer_hears_so(monkeypatch: pytest.MonkeyPatch) -> None:
    explorer = Explorer(FakePolicy())
    explorer.close()
    monkeypatch.setattr("madviz.widgets.explorer.PATIENCE", 0.1)
    for ask in (explorer.step, lambda: explorer.set("first", "off")):
        with pytest.raises(UserError, match="this simulation has ended; run the cell again"):
            ask()


def test_a_simulation_that_does_not_answer_is_an_error(
    explorer: Explorer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("madviz.widgets.explorer.PATIENCE", 0.1)
    monkeypatch.setattr(explorer.session, "send", lambda command: None)
    with pytest.raises(UserError, match=r"answer within 0\.1 s, found no new frame"):
        explorer.step()


def test_too_many_explorers_end_the_oldest(
    explorer: Explorer,
) -> None:
    later = [Explorer(FakePolicy()) for _ in range(MOST)]
    assert explorer.words.value.count("has ended") == 1
    assert explorer not in Explorer.running and Explorer.running == later
    assert all("has ended" not in one.words.value for one in later)
    for one in later:
        one.close()
    assert not Explorer.running


def test_a_failed_start_raises_and_leaves_no_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither a thread nor, when the unfinished widget is deleted, an error."""

    def broken(*_: object):
        raise UserError("expected a simulator, found none")

    before, unraisable = threads(), []
    monkeypatch.setattr(sys, "unraisablehook", lambda x: unraisable.append(str(x.exc_value)))
    with pytest.raises(UserError, match="expected a simulator, found none"):
        Explorer(FakePolicy(), env_factory=broken)
    assert threads() == before
    gc.collect()
    assert not [one for one in unraisable if "Explorer" in one]


def test_a_slider_draws_again_in_place() -> None:
    shown = TryOut(interval_figure, successes=(0, 50, 1), n=(1, 50, 1))
    place, before = shown.drawing, shown.drawing.value
    shown.controls["n"].value = 40
    assert shown.drawing is place and place.value != before and "n = 40" in place.value
    assert "n = 40" in shown.static_html()


def test_every_kind_of_argument_has_its_control() -> None:
    made = [control_for(x) for x in (True, ["a", "b"], (0, 10), (0.0, 1.0), (0, 10, 5))]
    assert [type(one).__name__ for one in made] == [
        "Checkbox",
        "Dropdown",
        "IntSlider",
        "FloatSlider",
        "IntSlider",
    ]
    assert made[3].value == 0.5 and made[4].step == 5
    with pytest.raises(UserError, match="lowest, highest"):
        control_for("word")


def test_a_prediction_is_shown_beside_the_measurement() -> None:
    guess = Predict("Heads or <tails>?", ["heads", "tails"])
    assert guess.said is None and "nothing yet" in guess.compare("heads")
    assert "&lt;tails&gt;" in guess.static_html() and "<li>heads</li>" in guess.static_html()
    guess.choice.value = "tails"
    assert repr(guess.compare("heads")) == "You predicted: tails. Measured: heads."


def test_the_address_behind_a_proxy_ends_with_a_slash(monkeypatch: pytest.MonkeyPatch) -> None:
    assert notebook_page.address(4123, "direct") == "http://127.0.0.1:4123/"
    monkeypatch.setenv("JUPYTERHUB_SERVICE_PREFIX", "/user/ada/")
    assert notebook_page.address(4123) == "/user/ada/proxy/4123/"
    monkeypatch.setattr(notebook_page, "base_url", lambda: None)
    assert notebook_page.address(4123) == "http://127.0.0.1:4123/"
    with pytest.raises(UserError, match="where='direct'"):
        notebook_page.address(4123, "proxy")


def test_the_server_is_the_one_this_kernel_belongs_to(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from ipykernel import connect

    monkeypatch.delenv("JUPYTERHUB_SERVICE_PREFIX", raising=False)
    monkeypatch.setattr(connect, "get_connection_file", lambda: str(tmp_path / "kernel-1.json"))
    (tmp_path / "jpserver-77.json").write_text('{"base_url": "/class/"}')
    monkeypatch.setattr(notebook_page.os, "getppid", lambda: 77)
    assert notebook_page.address(9) == "/class/proxy/9/"
    monkeypatch.setattr(notebook_page.os, "getppid", lambda: 78)
    assert notebook_page.base_url() is None


def test_the_live_page_answers_and_frees_its_port(capsys: pytest.CaptureFixture[str]) -> None:
    page = live_page("tests.fakes:FakePolicy", where="direct")
    try:
        assert urllib.request.urlopen(page.url, timeout=60).status == 200
        assert f'src="{page.url}"' in page._repr_html_()
    finally:
        page.close()
    assert capsys.readouterr().out == "", "viser's banner would have the kernel's address"
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind(("127.0.0.1", page.port))


def test_on_a_class_server_the_live_page_brings_its_token(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MADVIZ_TOKEN", "given")
    with closing(live_page("tests.fakes:FakePolicy", where="direct")) as page:
        assert page.url == f"http://127.0.0.1:{page.port}/?token=given"


def test_colab_is_told_what_works_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "google.colab", types.ModuleType("google.colab"))
    with pytest.raises(UserError, match="Colab.*Explorer"):
        live_page("tests.fakes:FakePolicy")


def test_a_recording_is_served_by_this_machine(tmp_path: Path) -> None:
    file = record("tests.fakes:FakePolicy", tmp_path, seed=3, drop=["third_a@5"])
    viewer = Viewer(file)
    try:
        with urllib.request.urlopen(viewer.url, timeout=60) as answer:
            assert b"wasm" in answer.read()
        assert f'src="{viewer.url}"' in viewer._repr_html_()
    finally:
        viewer.close()
    assert not answers(viewer.url)


def test_a_viewer_that_does_not_start_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(notebook_page, "rerun_program", lambda: "false")
    with pytest.raises(UserError, match="found none"):
        Viewer(Path("nothing.rrd"))


def answers(url: str) -> bool:
    try:
        return urllib.request.urlopen(url, timeout=60).status == 200
    except OSError:
        return False


def test_widgets_need_no_page() -> None:
    program = "import sys, madviz.widgets; print(*{'viser', 'torch', 'mujoco'} & set(sys.modules))"
    loaded = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert loaded.stdout.split() == []


def test_a_goal_that_is_met_is_no_success_before_the_end() -> None:
    frame = frame_with()
    assert "not yet" in words_html(frame)
    assert "goal met now" in words_html(with_world(frame, success=True))
    ended = with_world(frame, step=frame.decisions, last=True)
    assert "failed" in words_html(ended)
    assert "success" in words_html(with_world(ended, success=True))

"""Recordings hold what was recorded: read back with rerun's reader, ffmpeg and an HTML parser."""

from __future__ import annotations

import os
import re
import sys
import threading
from contextlib import closing
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import av
import cv2
import numpy as np
import pytest
from rerun.chunk import RrdReader

from madviz import cli
from madviz.app.scene.fitted_view import FittedView
from madviz.drawing.viewpoint import first_view
from madviz.errors import UserError
from madviz.observation.schedule import parse_schedule
from madviz.recording import record as recording
from madviz.recording.record import Facts, RecordConfig, command_of, frames, run_record, writer_for
from madviz.recording.rerun import ASPECT, FOV
from madviz.session.commands import SetSchedule
from madviz.session.frame import Frame
from madviz.session.replay import policy_words
from madviz.session.session import Session
from madviz.session.session_file import SavedCommand, SavedEpisode, SavedPolicy
from madviz.session.session_reader import read_session
from madviz.types import View
from tests.fakes import FakePolicy, NanPolicy, policies
from tests.mistakes import refused
from tests.sessions import frame_with

CAMERAS = ("first", "third_a", "third_b")
DROPS = ("third_a@3-8", "first=black@5")
FACTS = Facts("madviz record <script>alert(1)</script>", DROPS)


@pytest.fixture(autouse=True)
def fakes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording.checkpoint, "load_policy", policies)


def frames_of(steps: int | None, policy: str = "toy-mad") -> list[Frame]:
    session = Session(recording.make_env, policies(policy), policies, seed=3, speed=None)
    session.send(SetSchedule(parse_schedule(DROPS, CAMERAS)))
    return list(frames(session, steps))


def written(path: Path, steps: int | None = None, policy: str = "toy-mad") -> list[Frame]:
    writer, episode = writer_for(path, FACTS), frames_of(steps, policy)
    for frame in episode:
        writer.add(frame)
    writer.close()
    return episode


def test_there_is_one_frame_for_every_step() -> None:
    episode = frames_of(12)
    assert [frame.world.step for frame in episode] == list(range(13))
    off = [frame.world.step for frame in episode if frame.camera("third_a").input == "off"]
    assert off == [3, 4, 5, 6, 7]
    assert [frame.world.step for frame in frames_of(None)] == list(range(26))


def test_a_policy_that_fails_is_reported_in_one_line() -> None:
    session = Session(recording.make_env, NanPolicy(), policies, seed=3, speed=None)
    session.send(SetSchedule(parse_schedule(["third_a@3", "first@3"], CAMERAS)))
    with pytest.raises(UserError, match="the episode stopped: expected a finite action") as stopped:
        list(frames(session, None))
    assert "\n" not in str(stopped.value)


def test_an_episode_that_stops_leaves_no_file(tmp_path: Path) -> None:
    session = Session(recording.make_env, NanPolicy(), policies, seed=3, speed=None)
    session.send(SetSchedule(parse_schedule(["third_a@3", "first@3"], CAMERAS)))
    for ending in ("mp4", "html", "rrd"):
        with pytest.raises(UserError):
            recording.write_all(tmp_path / f"x.{ending}", FACTS, frames(session, None))
    assert not list(tmp_path.iterdir())


def columns(path: Path) -> dict[str, dict[int, list]]:
    """Entity path -> step -> the values of its first component, as rerun reads them."""
    found: dict[str, dict[int, list]] = {}
    for chunk in RrdReader(path).stream():
        if chunk.is_static or "step" not in chunk.timeline_names:
            found.setdefault(chunk.entity_path, {})
            continue
        assert chunk.timeline_names == ["step"]
        batch = chunk.to_record_batch()
        names = [n for n in batch.schema.names if ":" in n]
        first = next(n for n in names if "blob" in n or "scalars" in n or "translation" in n or n)
        rows = zip(batch["step"].to_pylist(), batch[first].to_pylist(), strict=True)
        found.setdefault(chunk.entity_path, {}).update(rows)
    return found


def first_of(path: Path, entity: str, component: str) -> list:
    """The first value of a component, as rerun reads it."""
    for chunk in RrdReader(path).stream():
        if chunk.entity_path == entity:
            batch = chunk.to_record_batch()
            for name in batch.schema.names:
                if name.endswith(component):
                    return batch[name].to_pylist()[0]
    raise AssertionError(f"no {component} at {entity}")


def decode(blob: list) -> np.ndarray:
    """(H, W, 3) RGB of a JPEG file in a column."""
    pixels = cv2.imdecode(np.frombuffer(bytes(blob[0]), np.uint8), cv2.IMREAD_COLOR)
    assert pixels is not None
    return np.asarray(pixels)[..., ::-1].astype(int)


def test_a_rerun_file_holds_every_step(tmp_path: Path) -> None:
    path = tmp_path / "x.rrd"
    episode = written(path)
    read = columns(path)
    for name in ("features/norm", "features/cosine", "value/q", "reward", "success", "action"):
        assert sorted(read[f"/{name}"]) == list(range(26)), name
    for frame in episode:
        assert read["/mask"][frame.world.step] == frame.mask.astype(float).tolist()
        np.testing.assert_allclose(read["/value/q"][frame.world.step], [frame.q])
        np.testing.assert_allclose(
            read["/features/norm"][frame.world.step][:3], frame.world.probe.norms
        )
        np.testing.assert_allclose(read["/action"][frame.world.step], frame.action)
    for camera in CAMERAS:
        assert len(read[f"/world/cameras/{camera}"]) == 26
    decoded = decode(read["/world/cameras/first/picture"][0])
    assert np.abs(decoded - episode[0].world.arrived["first"]).mean() < 6
    assert decode(read["/world/cameras/first/picture"][6]).max() < 8
    for camera in CAMERAS:  # A frustum of another size shows one giant pixel.
        entity = f"/world/cameras/{camera}"
        assert first_of(path, entity, ":resolution")[0] == [84, 84]
        half = np.tan(np.radians(episode[0].world.poses[camera].fovy) / 2)
        focal = first_of(path, entity, ":image_from_camera")[0][0]
        assert focal == pytest.approx(42 / half, rel=1e-5)
    assert "/about" in read
    (blueprint,) = RrdReader(path).blueprints()
    assert blueprint.application_id == "madviz"
    # Raw pixels of three views would be 63 KB a step.
    assert path.stat().st_size < 26 * 16_000


def test_a_frustum_is_as_large_as_its_picture(tmp_path: Path) -> None:
    """Also where a camera is drawn at another size than a policy takes."""
    path = tmp_path / "x.rrd"
    frame = frame_with()
    shown = {
        **frame.world.views,
        "first": View(np.zeros((48, 48, 3), np.uint8), np.ones((48, 48), np.float32)),
    }
    world = replace(frame.world, views=shown)
    with closing(writer_for(path, FACTS)) as writer:
        writer.add(replace(frame, world=world))
    entity = "/world/cameras/first"
    assert first_of(path, entity, ":resolution")[0] == [84, 84]
    assert decode(columns(path)[f"{entity}/picture"][0]).shape[:2] == (84, 84)


def test_the_viewer_opens_with_the_view_of_the_page(tmp_path: Path) -> None:
    path = tmp_path / "x.rrd"
    first = written(path, 2)[0]
    (blueprint,) = RrdReader(path).blueprints()
    chunks = RrdReader(path).stream(store=blueprint)
    (eye,) = [c.to_record_batch() for c in chunks if c.entity_path.endswith("/EyeControls3D")]
    place, target, up = (
        np.array(eye[f"EyeControls3D:{name}"].to_pylist()[0][0])
        for name in ("position", "look_target", "eye_up")
    )
    page = SimpleNamespace(image_width=600, image_height=500)
    FittedView(page, *first_view(first))
    ahead, ours = target - place, page.look_at - page.position
    np.testing.assert_allclose(
        ahead / np.linalg.norm(ahead), ours / np.linalg.norm(ours), atol=1e-5
    )
    assert up.tolist() == [0, 0, 1]
    points, _ = first_view(first)
    depth = (points - place) @ ahead / np.linalg.norm(ahead)
    across = np.linalg.norm(np.cross(points - place, ahead / np.linalg.norm(ahead)), axis=1)
    corner = np.hypot(1, ASPECT) * np.tan(FOV / 2)
    assert depth.min() > 0 and 0.5 * corner < (across / depth).max() <= corner


def test_depth_that_a_policy_takes_is_in_a_rerun_file(tmp_path: Path) -> None:
    written(tmp_path / "x.rrd", 4, "toy-rgbd")
    read = columns(tmp_path / "x.rrd")
    assert {f"/depth/{camera}" for camera in CAMERAS} <= read.keys()


def test_a_film_has_every_step_and_holds_the_last(tmp_path: Path) -> None:
    path = tmp_path / "x.mp4"
    episode = written(path)
    with av.open(str(path)) as film:
        pictures = [picture.to_ndarray(format="rgb24") for picture in film.decode(video=0)]
    assert len(pictures) == len(episode) + 15
    height, width = pictures[0].shape[:2]
    assert height % 2 == width % 2 == 0 and width >= 3 * 252
    dropped, working = (pictures[step][24:276, 258:510].mean() for step in (5, 1))
    assert dropped < 0.6 * working
    caption = slice(276, 328)
    assert np.abs(pictures[1][caption].astype(int) - pictures[9][caption]).max() > 60
    assert np.abs(pictures[-1].astype(int) - pictures[-5]).mean() < 2


class Page(HTMLParser):
    """What a report would fetch, and its text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.links: list[str] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.links += [str(v) for k, v in attrs if k in ("src", "href", "action", "data")]

    def handle_data(self, data: str) -> None:
        self.text += data


def test_a_report_needs_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "x.html"
    episode = written(path)
    text = path.read_text()
    page = Page(text)
    assert page.links and all(link.startswith("data:image/jpeg;base64,") for link in page.links)
    assert "script" not in page.tags and page.tags.count("svg") == 5
    assert not re.search(r"url\(|@import", text)
    assert "madviz record <script>alert(1)</script>" in page.text
    last = episode[-1]
    assert ("SUCCESS" if last.world.success else "FAIL") in page.text
    for words in (
        "third_a@3-8, first=black@5",
        "seed",
        FakePolicy().spec.digest,
        "step 3: cameras",
    ):
        assert words in page.text
    assert text.count("<title>step ") == 5 * 3  # Three changes, five curves.
    assert len(page.links) >= 11


def test_a_policy_that_is_swapped_in_has_its_own_name_and_curves(tmp_path: Path) -> None:
    episode = [*frames_of(10), *frames_of(None, "toy-rgbd")[11:]]
    facts = replace(FACTS, policies="toy-mad until step 11, then toy-rgbd")
    for name in ("x.rrd", "x.html"):
        writer = writer_for(tmp_path / name, facts)
        for frame in episode:
            writer.add(frame)
        writer.close()
    read = columns(tmp_path / "x.rrd")
    assert sorted(read["/mask"]) == list(range(11)) and len(read["/mask"][0]) == 3
    assert sorted(read["/mask/toy-rgbd"]) == list(range(11, 26))
    assert len(read["/features/norm/toy-rgbd"][11]) == 7
    text = (tmp_path / "x.html").read_text()
    assert "<h1>toy-mad until step 11, then toy-rgbd, seed 3</h1>" in text
    assert "step 11: the policy becomes toy-rgbd" in text and "cameras or policy changed" in text


def test_a_saved_session_says_which_policies_acted() -> None:
    swap = SavedCommand(10, SavedPolicy("b", ""))
    episode = SimpleNamespace(policy=SavedPolicy("a", ""), commands=[swap])
    assert policy_words(cast(SavedEpisode, episode)) == "a until step 10, then b"
    episode.commands = []
    assert policy_words(cast(SavedEpisode, episode)) == ""


def test_an_unfinished_episode_is_called_so(tmp_path: Path) -> None:
    written(tmp_path / "x.html", 6)
    assert "UNFINISHED" in (tmp_path / "x.html").read_text()


def record(tmp_path: Path, *words: str) -> int:
    return cli.main(["record", *words])


def test_a_recording_from_the_command_line_and_the_same_from_a_saved_session(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    saved, out = tmp_path / "saved.json", tmp_path / "x.html"
    drops = ("--drop", "third_a@3-8", "first=black@5")
    words = ("--policy", "toy-mad", "--seed", "7", *drops, "--out", str(out))
    assert record(tmp_path, *words, "--keep", str(saved)) == 0
    first = out.read_text()
    assert f"{out}: 25 decisions of toy-mad, seed 7" in capsys.readouterr().out
    assert len(read_session(saved).episodes[0].commands) == 3
    assert record(tmp_path, "--replay", str(saved), "--out", str(out), "--json", "-") == 0
    assert '"same": true' in capsys.readouterr().out

    def measured(text: str) -> str:
        return text.partition("<h2>What this is")[2].partition("<h2>To make it again")[0]

    assert measured(out.read_text()) == measured(first)
    assert "third_a@3-8" in first and str(tmp_path) not in first


def test_a_scenario_by_its_name(tmp_path: Path) -> None:
    config = RecordConfig(tmp_path / "x.html", "toy-mad", scenario="lens covered", steps=9)
    assert run_record(config)["failures"] == ["first=black@5-18"]


def test_a_link_is_followed_and_a_pipe_written_to(tmp_path: Path) -> None:
    link, pipe, come = tmp_path / "x.html", tmp_path / "y.html", []
    link.symlink_to("far.html")
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: come.append(pipe.read_bytes()), daemon=True)
    reader.start()
    sizes = [run_record(RecordConfig(p, "toy-mad", steps=2))["bytes"] for p in (link, pipe)]
    assert link.is_symlink() and pipe.is_fifo()
    reader.join(10.0)
    assert sizes == [(tmp_path / "far.html").stat().st_size, len(come[0])]
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--policy", "toy-mad", "--out", "x.rrd", "--keep", "."), "--keep .: expected a file"),
        (("--policy", "toy-mad", "--out", "x.gif"), "ends in .rrd, .mp4 or .html, found .gif"),
        (("--policy", "toy-mad", "--out", "x"), "found no ending"),
        (("--policy", "toy-mad", "--out", "nowhere/x.rrd"), "a folder that exists"),
        (("--out", "x.rrd"), "expected --policy NAME or --replay FILE"),
        (("--replay", "k.json", "--drop", "first@2", "--out", "x.rrd"), "leave them out"),
        (("--replay", "k.json", "--out", "x.rrd"), "expected a saved session, found none"),
        (
            ("--policy", "toy-mad", "--drop", "fourth@2", "--out", "x.rrd"),
            "unknown camera 'fourth'",
        ),
        (
            ("--policy", "toy-mad", "--scenario", "rain", "--out", "x.rrd"),
            "unknown scenario 'rain'",
        ),
        (
            ("--policy", "toy-mad", "--steps", "0", "--out", "x.rrd"),
            "--steps: expected a whole number from 1",
        ),
        (
            ("--policy", "toy-mad", "--fps", "nan", "--out", "x.mp4"),
            "--fps: expected a number from 0.5",
        ),
        (
            ("--policy", "toy-mad", "--seed", "-1", "--out", "x.mp4"),
            "--seed: expected a whole number from 0",
        ),
        (("--policy", "toy-mad", "--tile", "83", "--out", "x.mp4"), "from 84 to 1024, found 83"),
        (
            ("--policy", "toy-mad", "--episode", "3", "--out", "x.mp4"),
            "expected --replay FILE beside --episode",
        ),
        (
            ("--replay", "k.json", "--seed", "7", "--out", "x.mp4"),
            "expected a saved session to have seed, failures and length of its own",
        ),
        (("--policy", "wurst", "--out", "x.mp4"), "unknown policy 'wurst'"),
        (
            ("--policy", "toy-mad", "--drop", "first=black@25", "--out", "x.mp4"),
            "expected failures before step 25, where toy/reach ends, found 'first' at step 25",
        ),
    ],
)
def test_a_mistake_is_one_line_and_leaves_no_file(
    words: tuple[str, ...],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    refused(["record", *words], said, capsys)
    assert not list(tmp_path.iterdir())


def test_the_command_that_makes_it_again_can_be_pasted() -> None:
    config = RecordConfig(Path("/a/b/x.mp4"), "/home/me/mine", scenario="taking turns", drop=DROPS)
    assert command_of(config) == (
        "madviz record --policy mine --seed 60000 --drop third_a@3-8 first=black@5 "
        "--scenario 'taking turns' --out x.mp4"
    )
    served, wire = "ws://host:8000?token=secret", Path("/home/me/arm.toml")
    config = RecordConfig(Path("x.mp4"), served, replay=Path("/a/k.json"), wire=wire, episode=2)
    assert command_of(config) == (
        "madviz record --policy ws://host:8000 --replay k.json --episode 2 --wire arm.toml "
        "--out x.mp4"
    )
    config = RecordConfig(
        Path("x.mp4"), "sb3:/home/a@b/m.zip@toy/reach", trust=True, steps=9, tile=84, fps=2
    )
    assert command_of(config) == (
        "madviz record --policy sb3:m.zip@toy/reach --seed 60000 --steps 9 --tile 84 --fps 2 "
        "--trust --out x.mp4"
    )


def test_rerun_is_loaded_for_nothing_else(tmp_path: Path) -> None:
    import subprocess

    program = (
        "import sys, madviz.recording.record, madviz.recording.html, madviz.recording.video;"
        "print('rerun' in sys.modules, 'viser' in sys.modules)"
    )
    asked = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert asked.stdout.split() == ["False", "False"], asked.stderr

"""LeRobot datasets are read frame by frame; broken ones are named in one line and cache nothing."""

from __future__ import annotations

import os
import resource
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from madviz.envs.doctor import check_recordings
from madviz.errors import UserError
from madviz.recorded import films
from madviz.recorded.films import letterboxed
from madviz.recorded.recordings import open_recordings
from madviz.recorded.robot import robot_of
from madviz.recorded.scaling import Scaling
from madviz.recorded.split import held_out
from madviz.recorded.storage import cache_bytes, clear_cache, recordings_cache
from tests.recordings import (
    DATA_FILE,
    EPISODES_FILE,
    TASKS,
    TOP,
    VIDEO,
    WRIST,
    Small,
    level,
    picture,
    png,
    write_film,
)

FILM = VIDEO.format(video_key=TOP, chunk_index=0, file_index=0)


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return recordings_cache()


@pytest.mark.parametrize(
    ("written", "close"),
    [
        (Small(), 6),
        (Small(codec="libsvtav1"), 6),
        (Small(films=False), 0),
    ],
    ids=["H.264", "AV1", "pictures"],
)
def test_every_step_has_its_pictures_and_numbers(
    tmp_path: Path, written: Small, close: int
) -> None:
    found = open_recordings(str(written.write(tmp_path / "mine")))
    assert (found.name, found.fps, found.left_out) == ("mine", 10, ())
    assert [(camera.name, camera.height) for camera in found.cameras] == [
        ("top", 48),
        ("wrist", 64),
    ]
    assert [one.task for one in found.episodes] == [TASKS[0], TASKS[1], TASKS[0]]
    for episode in range(3):
        states, actions = found.numbers(episode)
        rows = slice(6 * episode, 6 * episode + 6)
        np.testing.assert_array_equal(states, written.states[rows])
        np.testing.assert_array_equal(actions, written.actions[rows])
        frames = found.frames(episode, 32)
        assert frames.shape == (6, 2, 32, 32, 3) and not frames.flags.writeable
        for step in range(6):
            wide = frames[step, 0]
            tall = frames[step, 1]
            assert (wide[:4] == 0).all() and (tall[:, :4] == 0).all()  # Letterboxed.
            shown = level(episode, step)
            assert np.abs(wide[6:26, 2:14].astype(int) - shown).max() <= close
            assert np.abs(tall[2:30, 6:14].astype(int) - shown).max() <= close


def test_an_episode_is_decoded_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = Small().write(tmp_path / "mine")
    first = open_recordings(folder).frames(1, 32).copy()
    assert cache_bytes() > first.nbytes

    def decoded(*_: object) -> None:
        raise AssertionError("decoded again")

    found = open_recordings(folder)
    monkeypatch.setattr(films, "_opened", decoded)
    np.testing.assert_array_equal(found.frames(1, 32), first)
    with pytest.raises(AssertionError, match="again"):
        found.frames(1, 16)


def test_a_changed_film_is_decoded_anew(tmp_path: Path, cache: Path) -> None:
    folder = Small().write(tmp_path / "mine")
    open_recordings(folder).frames(0, 32)
    os.utime(folder / FILM, (1, 1))
    open_recordings(folder).frames(0, 32)
    assert len(list(cache.iterdir())) == 2
    clear_cache()
    assert cache_bytes() == 0


def test_the_doctor_names_the_size_of_the_cache_and_clears_it(tmp_path: Path) -> None:
    assert check_recordings(clear=False) == []
    open_recordings(Small().write(tmp_path / "mine")).frames(0, 84)
    [found] = check_recordings(clear=False)
    assert found.sound and not found.needed
    assert found.found.startswith("0.00 GB") and "--clear-recordings removes" in found.found
    [cleared] = check_recordings(clear=True)
    assert cleared.found.endswith("; removed") and cache_bytes() == 0


def test_a_cached_file_that_was_cut_is_made_again(tmp_path: Path, cache: Path) -> None:
    found = open_recordings(Small().write(tmp_path / "mine"))
    before = found.frames(0, 32).copy()
    [file] = cache.iterdir()
    file.write_bytes(file.read_bytes()[:1000])
    np.testing.assert_array_equal(found.frames(0, 32), before)


def test_a_full_disk_is_one_line_and_leaves_nothing(tmp_path: Path, cache: Path) -> None:
    found = open_recordings(Small().write(tmp_path / "mine"))
    found.frames(0, 32)
    size = cache_bytes()
    clear_cache()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        # The system takes a part of the last picture without an error, and refuses the rest.
        resource.setrlimit(resource.RLIMIT_FSIZE, (size - 10, before[1]))
        with pytest.raises(UserError, match="expected room for decoded pictures, found: File too"):
            found.frames(0, 32)
        with pytest.raises(UserError, match="expected room for decoded pictures"):
            found.prepared(32)  # No episode is left out for it.
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(cache.iterdir())


def test_a_film_that_is_gone_is_named(tmp_path: Path, cache: Path) -> None:
    folder = Small().write(tmp_path / "mine")
    found = open_recordings(folder)
    (folder / FILM).unlink()
    with pytest.raises(UserError, match="mp4: expected a file of the recordings, found: No such"):
        found.frames(0, 32)
    fault = found.fault(1, 32)
    assert fault is not None and "expected a file of the recordings" in fault


def test_letterboxed_keeps_shapes() -> None:
    wide = letterboxed(np.full((10, 40, 3), 200, np.uint8), 20)
    assert wide.shape == (20, 20, 3)
    assert (wide[8:12] > 0).any() and (wide[:7] == 0).all() and (wide[13:] == 0).all()
    assert letterboxed(np.full((1, 4096, 3), 9, np.uint8), 84).shape == (84, 84, 3)


def test_scaled_numbers_come_back() -> None:
    scaling = Scaling((-1.0, 2.0, 5.0), (3.0, 4.0, 5.0))
    raw = np.array([[-1, 2, 5], [3, 4, 5], [1, 3.5, 5]], np.float32)
    scaled = scaling.scale(raw)
    np.testing.assert_allclose(scaled, [[-1, -1, 0], [1, 1, 0], [0, 0.5, 0]])
    np.testing.assert_allclose(scaling.unscale(scaled), raw)


@pytest.mark.parametrize(
    ("indices", "held"),
    [
        (range(20), (9, 19)),
        (range(14), (4, 9)),
        (range(9), (2, 5, 8)),
        ((0, 1, 2), (2,)),
        ((4,), ()),
        ((9, 19), (19,)),
        (range(5), (4,)),
        ((9, 19, 20), (20,)),
        ((), ()),
    ],
)
def test_every_tenth_episode_is_held_out(indices: Any, held: tuple[int, ...]) -> None:
    assert held_out(tuple(indices)) == held


def test_scalings_are_those_of_the_episodes_for_training(tmp_path: Path) -> None:
    written = Small()
    written.states[12:] = 1000  # Of the last episode, which is held out.
    written.rows["observation.state"] = list(written.states)
    found = open_recordings(str(written.write(tmp_path / "mine")))
    states, actions = found.scalings()
    assert (found.training, found.held_out) == ((0, 1), (2,))
    np.testing.assert_allclose(states.high, written.states[:12].max(0))
    np.testing.assert_allclose(actions.low, written.actions[:12].min(0))
    np.testing.assert_allclose(found.action_spread(), written.actions[:12].std(0), rtol=1e-5)


def test_recordings_in_other_units_are_refused_for_a_policy(tmp_path: Path) -> None:
    written = Small()
    found = open_recordings(str(written.write(tmp_path / "mine")))
    robot_of(found).check_units(found)
    written.states[0] = 1000
    written.rows["observation.state"] = list(written.states)
    other = open_recordings(written.write(tmp_path / "other"))
    with pytest.raises(UserError, match="found states or actions of another range"):
        robot_of(found).check_units(other)


@pytest.mark.parametrize(
    ("other", "words"),
    [
        (Small(films=False, fps=30), "steps a second 10, found 30"),
        (
            Small(films=False, sizes={TOP: (36, 64), WRIST: (64, 48)}),
            "width to height top 4/3, wrist 3/4, found top 16/9, wrist 3/4",
        ),
        (
            Small(films=False, sizes={"observation.images.Top": (48, 64), WRIST: (64, 48)}),
            "found observation.images.Top, observation.images.wrist",
        ),
    ],
)
def test_recordings_of_another_robot_are_refused(other: Small, words: str, tmp_path: Path) -> None:
    robot = robot_of(open_recordings(Small(films=False).write(tmp_path / "mine")))
    small = Small(films=False, sizes={TOP: (24, 32), WRIST: (64, 48)})
    robot.check(open_recordings(small.write(tmp_path / "small")))
    with pytest.raises(UserError, match=words):
        robot.check(open_recordings(other.write(tmp_path / "other")))


def test_names_of_another_count_are_said(tmp_path: Path) -> None:
    written = Small(films=False)
    features = written.info["features"]
    features["action"] = {**features["action"], "names": ["one", "two"]}
    found = open_recordings(str(written.write(tmp_path / "mine")))
    assert found.action_names == ("action_0", "action_1", "action_2")
    assert found.left_out == ("names of action: expected 3, found 2; they are numbered",)


def test_names_of_cameras_are_words_of_subsets(tmp_path: Path) -> None:
    keys = ("observation.images.Cam Öst 1", "observation.image", "kamera", "rgb", "日本")
    sizes = {key: (16, 24) for key in (*keys, "observation.images.cam_ost_1")}
    found = open_recordings(Small(sizes=sizes, films=False).write(tmp_path / "mine"))
    names = [camera.name for camera in found.cameras]
    assert names == ["cam_ost_1", "image", "kamera", "camera_rgb", "camera", "cam_ost_1_2"]


def test_a_downloads_links_are_followed(tmp_path: Path) -> None:
    """Hugging Face's cache has every file of a dataset in blobs, behind a link."""
    folder = Small().write(tmp_path / "set/snapshots/abc")
    (tmp_path / "set/blobs").mkdir()
    for number, path in enumerate([p for p in folder.rglob("*") if p.is_file()]):
        blob = path.rename(tmp_path / f"set/blobs/{number}")
        path.symlink_to(blob)
    assert len(open_recordings(folder).frames(0, 16)) == 6


def test_depth_is_said_to_be_left_out(tmp_path: Path) -> None:
    written = Small(films=False)
    written.info["features"][TOP]["info"] = {"is_depth_map": True}
    found = open_recordings(str(written.write(tmp_path / "mine")))
    assert [camera.name for camera in found.cameras] == ["wrist"]
    assert found.left_out == (f"camera {TOP}: depth is not read",)


def test_a_camera_without_three_channels_is_said_to_be_left_out(tmp_path: Path) -> None:
    written = Small(films=False)
    written.info["features"][TOP]["shape"] = [48, 64, 1]
    found = open_recordings(str(written.write(tmp_path / "mine")))
    assert [camera.name for camera in found.cameras] == ["wrist"]
    (line,) = found.left_out
    assert line == f"camera {TOP}: expected 3 channels, found the shape [48, 64, 1]"
    written.info["features"][WRIST]["shape"] = [64, 48, 4]
    with pytest.raises(UserError, match="expected a camera, .*the shape \\[64, 48, 4\\]"):
        open_recordings(written.write(tmp_path / "none"))


Change = Callable[[Small], object]


def in_info(change: Callable[[dict[str, Any]], object]) -> Change:
    """A change of info.json."""
    return lambda small: change(small.info)


def feature(key: str, **changes: Any) -> Change:
    return lambda small: small.info["features"].update(
        {key: {**small.info["features"][key], **changes}}
    )


def place(number: int, **changes: Any) -> Change:
    return lambda small: small.places[number].update(changes)


REFUSED: dict[str, tuple[Change, str]] = {
    "version 2.1": (
        in_info(lambda info: info.update(codebase_version="v2.1")),
        "convert it: python -m lerobot.scripts.convert_dataset_v21_to_v30 --repo-id=mine",
    ),
    "version 4": (in_info(lambda info: info.update(codebase_version="v4.0")), "found 'v4.0'"),
    "no version": (
        in_info(lambda info: info.pop("codebase_version")),
        "'codebase_version', found no",
    ),
    "a wrong type": (
        in_info(lambda info: info.update(fps="ten")),
        "'fps' to be a number, found 'ten'",
    ),
    "a list": (lambda small: setattr(small, "info", [1]), "expected a table of named values"),
    "features of text": (
        in_info(lambda info: info.update(features="x")),
        "'features' to be a table",
    ),
    "fps 0": (in_info(lambda info: info.update(fps=0)), "expected 'fps' above 0"),
    "fps too large": (in_info(lambda info: info.update(fps=1e300)), "expected 'fps' above 0"),
    "no camera": (
        in_info(lambda info: [info["features"].pop(key) for key in list(info["features"])[:2]]),
        "expected a camera",
    ),
    "no action": (in_info(lambda info: info["features"].pop("action")), "a feature 'action'"),
    "no state": (
        in_info(lambda info: info["features"].pop("observation.state")),
        "a feature 'observation.state'",
    ),
    "an action of words": (feature("action", dtype="string"), "'action' of shape"),
    "no numbers in an action": (feature("action", shape=[0]), "1 to 1000 numbers, found 0"),
    "huge pictures": (feature(TOP, shape=[100_000, 100_000, 3]), "up to 4096"),
    "a path that leads up": (
        in_info(lambda info: info.update(video_path="../{video_key}.mp4")),
        "expected files inside the dataset, found '../",
    ),
    "an absolute path": (
        in_info(lambda info: info.update(data_path="/etc/passwd")),
        "expected files inside the dataset, found '/etc/passwd'",
    ),
    "a pattern that asks for more": (
        in_info(lambda info: info.update(data_path="{chunk_index:0999999999d}")),
        "expected 'data_path' with {video_key}",
    ),
    "a pattern that looks inside": (
        in_info(lambda info: info.update(video_path="{video_key.__class__}")),
        "expected 'video_path' with {video_key}",
    ),
    "no path of films": (
        in_info(lambda info: info.update(video_path=None)),
        "'video_path' for its",
    ),
    "an endless episode": (place(1, length=10**12), "expected 1 to 100000 steps in episode 1"),
    "an episode twice": (place(1, episode_index=0), "expected every episode once"),
    "a film at no time": (
        place(1, **{f"videos/{TOP}/from_timestamp": float("nan")}),
        "expected where episode 1 lies in the films",
    ),
    "no column of lengths": (
        lambda small: [row.pop("length") for row in small.places],
        "expected a column 'length', found none",
    ),
}


@pytest.mark.parametrize("kind", list(REFUSED))
def test_a_dataset_that_cannot_be_used_is_refused(kind: str, tmp_path: Path, cache: Path) -> None:
    change, words = REFUSED[kind]
    small = Small()
    change(small)
    if kind == "no action":
        small.rows.pop("action")
    with pytest.raises(UserError) as raised:
        open_recordings(small.write(tmp_path / "mine"))
    assert words in str(raised.value) and len(str(raised.value)) < 500
    assert not cache.exists()


def cut(name: str, share: float) -> Callable[[Path], object]:
    def change(folder: Path) -> None:
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(content[: int(len(content) * share)])

    return change


def linked_out(folder: Path) -> None:
    outside = folder.parent / "outside.mp4"
    (folder / FILM).rename(outside)
    (folder / FILM).symlink_to(outside)


FILES: dict[str, tuple[Callable[[Path], object], str]] = {
    "no folder": (lambda folder: folder.rename(folder.parent / "x"), "expected the folder of a"),
    "no info.json": (lambda folder: (folder / "meta/info.json").unlink(), "found no such file"),
    "half an info.json": (cut("meta/info.json", 0.5), "expected a JSON file"),
    "no table of episodes": (
        lambda folder: (folder / EPISODES_FILE).unlink(),
        "expected tables of episodes, found none",
    ),
    "half a table of episodes": (cut(EPISODES_FILE, 0.5), "expected a table (parquet)"),
    "no table of steps": (
        lambda folder: (folder / DATA_FILE).unlink(),
        "expected at least one whole episode, found none: episode 0",
    ),
    "half a table of steps": (cut(DATA_FILE, 0.5), "found none: episode 0"),
    "no film": (lambda folder: (folder / FILM).unlink(), "expected a film, found none"),
    "a film of nothing": (cut(FILM, 0.01), "expected a film (mp4)"),
    "a link that leads out": (linked_out, "expected files inside the dataset"),
    "a film of text": (
        lambda folder: (folder / FILM).write_text("#EXTM3U\nfile:///etc/passwd\n"),
        "expected a film (mp4)",
    ),
}


@pytest.mark.parametrize("kind", list(FILES))
def test_a_dataset_without_its_files_is_refused(kind: str, tmp_path: Path, cache: Path) -> None:
    change, words = FILES[kind]
    folder = Small().write(tmp_path / "mine")
    change(folder)
    with pytest.raises(UserError) as raised:
        open_recordings(folder)
    assert words in str(raised.value) and len(str(raised.value)) < 600
    assert not cache.exists()


def nan(small: Small) -> None:
    small.states[8, 1] = np.nan
    small.rows["observation.state"] = list(small.states)


LEFT_OUT: dict[str, tuple[Change, int, str]] = {
    "NaN in a state": (nan, 1, "expected finite numbers, found others in step 2"),
    "a wrong length": (place(1, length=5), 1, "expected 5 steps in the table, found 6"),
    "steps out of order": (
        lambda small: small.rows["frame_index"].__setitem__(slice(6, 8), [1, 0]),
        1,
        "expected its steps in order",
    ),
    "other times": (
        lambda small: small.rows.update(
            timestamp=pa.array(
                [t.as_py() + (i > 11) * t.as_py() for i, t in enumerate(small.rows["timestamp"])],
                pa.float32(),
            )
        ),
        2,
        "expected 10 steps a second, found other times",
    ),
    "a film that ends early": (
        lambda small: setattr(small, "frames", 14),
        2,
        "top, file-000.mp4: expected 18 pictures, found 14",
    ),
    "an episode that is not in the table": (
        lambda small: small.places.pop(),
        2,
        "expected in meta/episodes, found none",
    ),
    "another table": (
        place(2, **{"data/file_index": 7}),
        2,
        "expected a table (parquet), found none",
    ),
}


@pytest.mark.parametrize("kind", list(LEFT_OUT))
def test_a_broken_episode_is_named_and_left_out(kind: str, tmp_path: Path) -> None:
    change, episode, words = LEFT_OUT[kind]
    small = Small()
    change(small)
    found = open_recordings(small.write(tmp_path / "mine"))
    assert [one.index for one in found.episodes] == [n for n in range(3) if n != episode]
    [line] = found.left_out
    assert line.startswith(f"episode {episode}: ") and words in line
    with pytest.raises(UserError, match="expected one of its 2 whole ones"):
        found.numbers(episode)


def test_a_truncated_film_leaves_the_episodes_before_it(tmp_path: Path) -> None:
    folder = Small(episodes=3, sizes={TOP: (48, 64)}).write(tmp_path / "mine")
    size = (folder / FILM).stat().st_size
    cut(FILM, (size - 8) / size)(folder)
    found = open_recordings(folder)
    assert [one.index for one in found.episodes] == [0, 1]
    assert "truncated: 17 of 18 pictures" in found.left_out[0]


def all_refused(small: Small, tmp_path: Path, words: str) -> None:
    with pytest.raises(UserError) as raised:
        open_recordings(small.write(tmp_path / "mine"))
    assert words in str(raised.value)


def test_a_film_with_far_more_pictures_than_said_is_not_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(films, "MARGIN", 4)
    small = Small(frames=180, sizes={TOP: (48, 64)})
    folder = small.write(tmp_path / "mine")
    path = folder / FILM
    path.unlink()
    write_film(path, [picture(0, 0, (48, 64))] * 180, 100, "libx264")
    with pytest.raises(UserError, match="expected 10 pictures a second, found 180 in 1.8 s"):
        open_recordings(folder)


def test_a_film_of_huge_pictures_is_not_decoded(tmp_path: Path) -> None:
    small = Small(sizes={TOP: (48, 64)}, film_size=(1200, 1600), steps=1, episodes=1)
    all_refused(small, tmp_path, "expected pictures of 48 x 64, found 1200 x 1600")


def test_a_table_with_far_more_rows_than_said_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("madviz.recorded.episodes._SPARE_ROWS", 5)
    small = Small()
    small.places = [{**small.places[0], "length": 2}]
    all_refused(small, tmp_path, "expected 2 rows, found 18")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (png(picture(0, 0, (2000, 2000))), "found: 2000 x 2000 pixels"),
        (b"no picture", "found: cannot identify"),
        (None, "expected pictures in"),
    ],
)
def test_a_broken_picture_leaves_its_episode_out(
    content: bytes | None, words: str, tmp_path: Path, cache: Path
) -> None:
    small = Small(films=False)
    small.rows[TOP][7] = {"bytes": content, "path": None}
    found = open_recordings(small.write(tmp_path / "mine"))
    with pytest.raises(UserError, match=words):
        found.frames(1, 32)
    assert not list(cache.iterdir())
    counted: list[int] = []
    ready = found.prepared(32, counted.append)
    assert [one.index for one in ready.episodes] == [0, 2] and counted == [1, 2, 3]
    assert ready.left_out[0].startswith("episode 1: ") and words in ready.left_out[0]
    with pytest.raises(UserError, match="expected a whole episode, found none"):
        replace(found, episodes=found.episodes[1:2]).prepared(32)


def test_a_film_with_broken_bytes_leaves_its_episode_out(tmp_path: Path, cache: Path) -> None:
    folder = Small(sizes={TOP: (48, 64)}).write(tmp_path / "mine")
    content = bytearray((folder / FILM).read_bytes())
    begin = content.index(b"mdat") + 4
    content[begin:] = bytes(len(content) - begin)
    (folder / FILM).write_bytes(content)
    with pytest.raises(UserError, match="expected (a film|6 pictures), found"):
        open_recordings(folder).frames(1, 32)
    assert not list(cache.iterdir())


@pytest.mark.parametrize(
    ("column", "words"),
    [
        (["a"] * 18, "expected 'action' to hold 3 numbers in each row, found string"),
        ([[1.0, 2.0]] * 18, "found rows of \\[2\\]"),
        ([[1.0, 2.0, None]] * 18, "with 18 empty"),
        ([["a", "b", "c"]] * 18, "found string"),
        (None, "expected a column 'action', found none"),
    ],
)
def test_a_column_of_other_content_is_named(column: Any, words: str, tmp_path: Path) -> None:
    folder = Small().write(tmp_path / "mine")
    table = pq.read_table(folder / DATA_FILE).drop_columns(["action"])
    if column is not None:
        table = table.append_column("action", pa.array(column))
    pq.write_table(table, folder / DATA_FILE)
    with pytest.raises(UserError, match=words):
        open_recordings(folder)

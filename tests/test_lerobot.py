"""A dataset for LeRobot holds what was played; LeRobot's own loader reads it."""

from __future__ import annotations

import io
import json
import os
import subprocess
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow.parquet as pq
import pytest
from PIL import Image

from madviz.envs.registry import make_env
from madviz.envs.toy import ToyReach
from madviz.errors import UserError
from madviz.guard.fit import fit_values
from madviz.guard.policy import GuardedPolicy
from madviz.measure.guard_fit import play_intact
from madviz.recorded.recordings import open_recordings
from madviz.recording import lerobot
from madviz.recording import record as recording
from madviz.recording.dataset_films import DatasetFilms
from madviz.recording.lerobot import Decision, expert_decisions, policy_decisions, write_dataset
from madviz.recording.record import RecordConfig, record_words, run_record
from madviz.types import Array, TimeStep
from tests.fakes import FakePolicy, NanPolicy, policies
from tests.mistakes import refused

CAMERAS = ("first", "third_a", "third_b")
USUAL = Path(__file__).resolve().parent.parent / "integrations/lerobot/.venv/bin/python"
PYTHON = Path(os.environ.get("MADVIZ_LEROBOT", USUAL))


@pytest.fixture(autouse=True)
def fakes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording.checkpoint, "load_policy", policies)


def recorded(out: Path, **options) -> tuple[dict, list[dict]]:
    """What was said of a dataset, and its rows."""
    found = run_record(RecordConfig(out, format="lerobot", **options))
    files = sorted((out / "data").rglob("*.parquet"))
    return found, [row for file in files for row in pq.read_table(file).to_pylist()]


def picture(row: dict, stream: str) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(row[f"observation.images.{stream}"]["bytes"])))


def test_a_row_is_a_decision_with_what_the_policy_was_given(tmp_path: Path) -> None:
    drops = ("third_a@3-8", "first=black@5")
    found, rows = recorded(tmp_path / "set", policy="toy-mad", seed=3, episodes=2, drop=drops)
    assert found["episodes"] == 2 and found["steps"] == len(rows) == 50
    assert [row["index"] for row in rows] == list(range(50))
    assert [row["frame_index"] for row in rows] == [*range(25), *range(25)]
    assert [row["next.done"] for row in rows] == [*[False] * 24, True] * 2
    masks = np.array([row["camera_mask"] for row in rows[:25]])
    assert masks[:, [0, 2]].all() and list(np.flatnonzero(~masks[:, 1])) == [3, 4, 5, 6, 7]
    with closing(make_env("toy/reach")) as env:
        now = env.reset(4)
        for row in rows[25:]:
            np.testing.assert_array_equal(row["observation.state"], now.state.astype(np.float32))
            np.testing.assert_array_equal(picture(row, "third_a"), env.view("third_a").rgb)
            assert picture(row, "first").any() == (row["frame_index"] < 5)
            now = env.step(np.array(row["action"], np.float32))
            assert row["next.reward"] == np.float32(now.reward)
            assert row["next.success"] == now.success
    assert "2 episodes of toy-mad from seed 3" in record_words(found)


def test_statistics_are_those_of_the_rows(tmp_path: Path) -> None:
    _, rows = recorded(tmp_path / "set", policy="toy-mad", episodes=2)
    stats = json.loads((tmp_path / "set/meta/stats.json").read_text())
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    assert set(stats) == set(info["features"]) == set(rows[0])
    pixels = np.stack([picture(row, "first") for row in rows]).reshape(-1, 3) / 255
    for name, values in (
        ("observation.images.first", pixels),
        ("action", np.array([row["action"] for row in rows])),
    ):
        kinds = {"min": np.min, "max": np.max, "mean": np.mean, "std": np.std}
        for what, expected in kinds.items():
            np.testing.assert_allclose(
                np.ravel(stats[name][what]), expected(values, 0), rtol=1e-5, atol=1e-9
            )
        assert stats[name]["count"] == [50]
    assert np.shape(stats["observation.images.first"]["q90"]) == (3, 1, 1)
    middle = np.quantile(pixels, 0.5, axis=0)
    np.testing.assert_allclose(
        np.ravel(stats["observation.images.first"]["q50"]), middle, atol=5e-3
    )
    [first, second] = pq.read_table(
        tmp_path / "set/meta/episodes/chunk-000/file-000.parquet"
    ).to_pylist()
    assert (first["dataset_to_index"], second["dataset_from_index"]) == (25, 25)
    assert second["stats/frame_index/max"] == [24.0]


def test_an_experts_actions_are_kept_without_the_noise(tmp_path: Path) -> None:
    with closing(make_env("toy/reach")) as env:
        clean, noisy = (list(expert_decisions(env, CAMERAS, noise, 7)) for noise in (0.0, 0.5))
        again = list(expert_decisions(env, CAMERAS, 0.5, 7))
        now = env.reset(7)
        for one in clean:
            np.testing.assert_array_equal(one.action, env.expert())
            now = env.step(one.action)
    assert now.success
    assert not np.allclose(clean[5].state, noisy[5].state)
    np.testing.assert_array_equal(noisy[9].state, again[9].state)
    found, rows = recorded(tmp_path / "set", expert="toy/reach", seed=7)
    np.testing.assert_array_equal(rows[5]["action"], clean[5].action)
    assert found["policy"] == "the expert" and found["success"] == 1.0


def test_a_large_dataset_has_several_files(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(lerobot, "FILE_BYTES", 1)
    _, rows = recorded(tmp_path / "set", policy="toy-mad", episodes=3)
    assert len(rows) == 75 and len(list((tmp_path / "set/data").rglob("*.parquet"))) == 3
    episodes = pq.read_table(tmp_path / "set/meta/episodes/chunk-000/file-000.parquet")
    assert episodes["data/file_index"].to_pylist() == [0, 1, 2]


def test_what_fails_on_the_way_leaves_nothing(tmp_path: Path) -> None:
    with closing(make_env("toy/reach")) as env:
        failing = policy_decisions(
            NanPolicy(), env, recording.parse_schedule(("third_a@3", "first@3"), CAMERAS), 3
        )
        with pytest.raises(UserError, match="finite"):
            write_dataset(tmp_path / "set", env.spec, 10, iter([failing]))
    assert not list(tmp_path.iterdir())


def test_a_camera_that_a_policy_cannot_do_without_is_named_with_its_step() -> None:
    from tests.fakes import AllOrNothing

    schedule = recording.parse_schedule(("third_a@3",), CAMERAS)
    with closing(make_env("toy/reach")) as env:
        with pytest.raises(UserError, match="at step 3; let them fail otherwise"):
            list(policy_decisions(AllOrNothing(), env, schedule, 3))


def test_a_camera_that_the_guard_leaves_out_is_none_that_was_given() -> None:
    policy = FakePolicy()
    schedule = recording.parse_schedule(("first=black@3",), CAMERAS)
    with closing(make_env("toy/reach")) as env:
        fitted = fit_values([play_intact(policy, env, seed, True) for seed in range(4)], (84, 84))
        played = list(policy_decisions(GuardedPolicy(policy, fitted), env, schedule, 5))
    masks = np.array([one.mask for one in played])
    assert masks[:, 1:].all() and list(np.flatnonzero(masks[:, 0])) == [0, 1, 2]


class Short(ToyReach):
    """Ends at its fifth decision."""

    def reset(self, seed: int) -> TimeStep:
        self.left = 5
        return super().reset(seed)

    def step(self, action: Array) -> TimeStep:
        self.left -= 1
        return replace(super().step(action), last=self.left == 0)


def test_an_episode_ends_where_the_environment_ends_it(tmp_path: Path) -> None:
    env = Short("reach")
    played = [
        expert_decisions(env, CAMERAS, 0.0, 7),
        policy_decisions(FakePolicy(), env, (), 7),
    ]
    ends, decisions = write_dataset(tmp_path / "set", env.spec, 10, iter(played))
    assert len(ends) == 2 and decisions == 10
    table = pq.read_table(tmp_path / "set" / "data/chunk-000/file-000.parquet")
    assert table["next.done"].to_pylist() == ([False] * 4 + [True]) * 2


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--format", "lerobot", "--out", "x"), "expected --policy NAME or --expert TASK"),
        (("--expert", "toy/reach", "--out", "x.mp4"), "expected --format lerobot beside --expert"),
        (
            ("--format", "lerobot", "--policy", "toy-mad", "--noise", "0.1", "--out", "x"),
            "expected --noise beside --expert",
        ),
        (
            ("--format", "lerobot", "--policy", "toy-mad", "--steps", "3", "--out", "x"),
            "expected whole episodes",
        ),
        (
            ("--format", "lerobot", "--expert", "toy/reach", "--drop", "first@3", "--out", "x"),
            "expected an expert to need no cameras",
        ),
        (("--format", "lerobot", "--policy", "toy-mad", "--out", "a/x"), "make a first"),
        (("--policy", "toy-mad", "--video", "--out", "x.mp4"), "expected --format lerobot beside"),
        (
            ("--format", "lerobot", "--expert", "toy/reach", "--vs", "wurst", "--out", "x"),
            "expected --format without --vs and --acts",
        ),
    ],
)
def test_a_mistake_is_one_line(
    words: tuple[str, ...], said: str, tmp_path: Path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    refused(["record", *words], said, capsys)
    assert not list(tmp_path.iterdir())


def test_a_folder_with_something_in_it_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(UserError, match="expected a new folder"):
        recorded(tmp_path, policy="toy-mad")
    assert [each.name for each in tmp_path.iterdir()] == ["mine.txt"]


def test_a_mount_is_refused_before_anything_is_played(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os.path, "ismount", lambda path: path == tmp_path)
    with pytest.raises(UserError, match="expected a new folder, found a mount; name one in it"):
        lerobot.check_folder(tmp_path)
    lerobot.check_folder(tmp_path / "set")


def test_depth_says_that_it_is_depth_in_which_unit_and_range(tmp_path: Path) -> None:
    _, rows = recorded(tmp_path / "set", policy="toy-rgbd", seed=3, drop=("third_a=black@5",))
    depth = picture(rows[4], "first.depth")
    assert depth.shape == (84, 84) and depth.dtype == np.uint16
    with closing(make_env("toy/reach")) as env:
        env.reset(3)
        for row in rows[:4]:
            env.step(np.array(row["action"], np.float32))
        near, far = env.spec.camera("first").depth_range
        seen = np.clip(env.view("first").depth, near, far) * 1000
    half_a_code = (far - near) * 1000 / 255 / 2
    assert np.abs(depth - seen).max() <= half_a_code + 0.5 + 1e-3
    assert (picture(rows[5], "third_a.depth") == round(near * 1000)).all()
    assert len(rows[0]["camera_mask"]) == len(FakePolicy("x", "three-rgbd").spec.streams)
    feature = json.loads((tmp_path / "set/meta/info.json").read_text())["features"]
    feature = feature["observation.images.first.depth"]
    assert (feature["dtype"], feature["shape"]) == ("image", [84, 84, 1])
    said = {"is_depth_map": True, "depth_unit": "mm"}
    assert feature["info"] == {**said, "video.depth_min": near, "video.depth_max": far}
    stats = json.loads((tmp_path / "set/meta/stats.json").read_text())
    found = stats["observation.images.first.depth"]
    every = np.stack([picture(row, "first.depth") for row in rows]).astype(float)
    assert np.shape(found["mean"]) == (1, 1, 1)
    np.testing.assert_allclose(np.ravel(found["mean"]), every.mean(), rtol=1e-6)
    np.testing.assert_allclose(np.ravel(found["std"]), every.std(), rtol=1e-6)


def test_films_of_a_dataset_hold_its_pictures_and_depth_stays_exact(tmp_path: Path) -> None:
    _, rows = recorded(tmp_path / "exact", policy="toy-rgbd", seed=3, episodes=2)
    recorded(tmp_path / "films", policy="toy-rgbd", seed=3, episodes=2, video=True)
    film = tmp_path / "films/videos/observation.images.first.rgb/chunk-000/file-000.mp4"
    with av.open(str(film)) as read:
        shown = [frame.to_ndarray(format="rgb24") for frame in read.decode(video=0)]
    assert len(shown) == len(rows) == 50
    for row, frame in zip(rows, shown, strict=True):
        assert np.abs(picture(row, "first.rgb").astype(int) - frame).mean() < 3
    (file,) = (tmp_path / "films" / "data").rglob("*.parquet")
    columns = pq.read_table(file).column_names
    assert (
        "observation.images.first.depth" in columns
        and "observation.images.first.rgb" not in columns
    )


def test_a_dataset_of_films_is_read_again(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    _, rows = recorded(tmp_path / "exact", policy="toy-mad", seed=3, episodes=2)
    recorded(tmp_path / "films", policy="toy-mad", seed=3, episodes=2, video=True)
    found = open_recordings(tmp_path / "films")
    assert len(found.episodes) == 2 and not found.left_out
    frames = found.frames(1, 84)  # (T, V, H, W, C), the second episode's.
    expected = np.array([[picture(row, camera) for camera in CAMERAS] for row in rows[25:]])
    assert np.abs(frames.astype(int) - expected).mean() < 3


def test_a_picture_with_odd_sides_cannot_be_a_film(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="even sides, found 63 x 84 in observation.images.first"):
        DatasetFilms(tmp_path, 10.0).add(
            "observation.images.first", [np.zeros((63, 84, 3), np.uint8)]
        )


def test_a_depth_that_millimetres_cannot_say_is_refused() -> None:
    with closing(make_env("toy/reach")) as env:
        far = replace(env.spec.camera("first"), depth_range=(0.0, 70.0))
        spec = replace(env.spec, cameras=(far, *env.spec.cameras[1:]))
    with pytest.raises(UserError, match="first.depth to end within 65.535 m.*found 70 m"):
        lerobot.depth_range_of("first.depth", spec)


def test_a_decision_says_what_came_after_it() -> None:
    with closing(make_env("toy/reach")) as env:
        played = list(expert_decisions(env, CAMERAS, 0.0, 5))
    assert isinstance(played[0], Decision) and not played[0].success and played[-1].success


def read_by_lerobot(program: str, folder: Path) -> Any:
    """The JSON that ``program`` prints in LeRobot's own environment."""
    done = subprocess.run(
        [str(PYTHON), "-c", program, str(folder)],
        capture_output=True,
        text=True,
        env={**os.environ, "HF_HUB_OFFLINE": "1"},
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
@pytest.mark.skipif(not PYTHON.exists(), reason="integrations/lerobot/setup.sh makes it")
def test_lerobots_own_loader_reads_depth_in_millimetres(tmp_path: Path) -> None:
    _, rows = recorded(tmp_path / "set", policy="toy-rgbd")
    program = (
        "import json, sys; from lerobot.datasets.lerobot_dataset import LeRobotDataset\n"
        "key = 'observation.images.third_b.depth'\n"
        "mm = LeRobotDataset('madviz/toy', root=sys.argv[1])\n"
        "m = LeRobotDataset('madviz/toy', root=sys.argv[1], depth_output_unit='m')\n"
        "print(json.dumps([mm.meta.depth_keys, mm[7][key].tolist(), m[7][key].tolist()]))"
    )
    keys, millimetres, metres = read_by_lerobot(program, tmp_path / "set")
    assert keys == [f"observation.images.{camera}.depth" for camera in CAMERAS]
    written = picture(rows[7], "third_b.depth")
    assert np.abs(np.array(millimetres) - written).max() == 0 and np.shape(metres) == (1, 84, 84)
    assert np.abs(np.array(metres) * 1000 - written).max() < 0.01


@pytest.mark.slow
@pytest.mark.skipif(not PYTHON.exists(), reason="integrations/lerobot/setup.sh makes it")
@pytest.mark.parametrize("video", [False, True])
def test_lerobots_own_loader_reads_it(video: bool, tmp_path: Path) -> None:
    played = {"policy": "toy-mad", "episodes": 2, "drop": ("third_a@3",)}
    _, rows = recorded(tmp_path / "exact", **played)
    recorded(tmp_path / "set", **played, video=video)
    program = (
        "import json, sys; from lerobot.datasets.lerobot_dataset import LeRobotDataset\n"
        "d = LeRobotDataset('madviz/toy', root=sys.argv[1], "
        "delta_timestamps={'action': [0, 0.1, 0.2]})\n"
        "r = d[24]\n"
        "print(json.dumps([len(d), d.num_episodes, r['action_is_pad'].tolist(), "
        "r['camera_mask'].tolist(), r['task'], r['observation.images.first'].mean().item(), "
        "d.meta.stats['action']['mean'].tolist()]))"
    )
    found = read_by_lerobot(program, tmp_path / "set")
    count, episodes, padded, mask, task, mean, action = found
    assert (count, episodes, padded) == (50, 2, [False, True, True])
    assert mask == [True, False, True] and task == "Go to the orange target."
    assert mean == pytest.approx(
        picture(rows[24], "first").mean() / 255, abs=5e-3 if video else 1e-5
    )
    np.testing.assert_allclose(action, np.mean([row["action"] for row in rows], 0), atol=1e-6)

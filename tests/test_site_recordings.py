"""Recorded episodes of a site: every subset, what is in a file, and that a recording changes
nothing."""

from __future__ import annotations

import gzip
import io
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from safetensors import safe_open
from safetensors.numpy import load

from madviz.envs.registry import make_env
from madviz.observation.condition import Condition
from madviz.session.simulation import Simulation
from madviz.site import recordings
from madviz.site.recordings import grouped, record_episode, record_policy, sheet
from tests.fakes import FakePolicy

SEED = 5000


@pytest.fixture(scope="module")
def content() -> bytes:
    """An episode without third_a."""
    policy = FakePolicy()
    mask = np.array([stream != "third_a" for stream in policy.spec.streams])
    return record_episode(make_env("toy/reach"), policy, mask, SEED)


def metadata(content: bytes, tmp_path: Path) -> dict[str, str]:
    path = tmp_path / "episode.safetensors"
    path.write_bytes(content)
    with safe_open(path, "numpy") as file:
        return file.metadata()


def test_a_recording_holds_the_episode_that_is_played(content: bytes) -> None:
    env, policy = make_env("toy/reach"), FakePolicy()
    streams = policy.spec.streams
    mask = np.array([stream != "third_a" for stream in streams])
    simulation = Simulation(env, policy, Condition("first+third_b").ablation(streams))
    simulation.begin(SEED)
    found = load(content)
    row = simulation.probe.row(mask)
    for step in range(env.spec.horizon + 1):
        if step:
            simulation.step(lambda: None)
        readout = simulation.probe.readout
        np.testing.assert_array_equal(found["action"][step], readout.action[row])
        np.testing.assert_array_equal(found["readout_q"][step], readout.q.astype(np.float32))
        assert found["success"][step] == simulation.now.time.success


def test_sheets_have_a_tile_for_every_picture(content: bytes, tmp_path: Path) -> None:
    said = metadata(content, tmp_path)
    steps = make_env("toy/reach").spec.horizon + 1
    for name, size, count in (
        ("sheet", int(said["tile"]), steps * len(FakePolicy().spec.streams)),
        ("scene", int(said["scene_width"]), (steps + 1) // int(said["scene_every"])),
    ):
        picture = Image.open(io.BytesIO(load(content)[name].tobytes()))
        assert picture.format == "WEBP"
        assert picture.width % size == picture.height % size == 0
        tiles = picture.width * picture.height // size**2
        assert count <= tiles < count + picture.width // size
    subsets = json.loads(said["subsets"])
    assert subsets[0] == "all" and subsets[-1] == "none"
    assert len(subsets) == load(content)["readout_q"].shape[1]


def test_tiles_stand_row_by_row() -> None:
    tiles = [np.full((16, 16, 3), 40 * number, np.uint8) for number in range(5)]
    picture = np.asarray(Image.open(io.BytesIO(sheet(tiles).tobytes())))
    assert picture.shape == (32, 48, 3)
    for number in range(5):
        row, column = divmod(number, 3)
        middle = picture[16 * row + 8, 16 * column + 8]
        np.testing.assert_allclose(middle, 40 * number, atol=6)


@pytest.mark.parametrize("size", [50, 112, 3136])
def test_groups_keep_the_norm_of_a_feature(size: int) -> None:
    feature = np.random.default_rng(0).normal(size=size).astype(np.float32)
    kept = grouped(feature)
    assert len(kept) == min(size, recordings.GROUPS)
    np.testing.assert_allclose(np.linalg.norm(kept), np.linalg.norm(feature), rtol=1e-5)


def test_every_subset_is_written_and_named(tmp_path: Path, monkeypatch) -> None:
    policy = FakePolicy()
    folder = type("Folder", (), {"spec": policy.spec, "path": tmp_path})()
    monkeypatch.setattr(recordings, "load_policy", lambda path: policy)
    monkeypatch.setattr(recordings, "record_episode", lambda *words: repr(words[2:]).encode())
    monkeypatch.setattr(recordings, "make_env", lambda *words: make_env(words[0]))
    said = dict.fromkeys(
        ("label", "method", "task", "streams", "trained_subsets", "cameras", "measured", "seeds")
    )
    kept = tmp_path / "kept"
    line = record_policy(tmp_path, kept, folder, said, [SEED])  # type: ignore[arg-type]
    assert len(line["files"]) == 2 ** len(policy.spec.streams)
    assert f"{SEED}/first+third_a" in line["files"] and f"{SEED}/none" in line["files"]
    for file in line["files"].values():
        packed = (tmp_path / file["path"]).read_bytes()
        assert len(packed) == file["bytes"] and len(gzip.decompress(packed)) == file["unpacked"]
    monkeypatch.setattr(recordings, "record_episode", None)
    again = record_policy(tmp_path / "again", kept, folder, said, [SEED])  # type: ignore[arg-type]
    assert again == line, "what was recorded is kept"

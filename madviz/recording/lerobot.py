"""``madviz record --format lerobot``: episodes as a LeRobot dataset, version 3.0.

LeRobot cannot be installed beside madviz (it wants older versions of torch and NumPy), so its
format is written here; a slow test reads it with LeRobot's own loader, in its own environment.

    meta/info.json, stats.json       what a row holds; least, largest, mean, std of columns
    meta/tasks.parquet               the task in words
    meta/episodes/…/file-000.parquet where each episode stands, and its own statistics
    data/chunk-000/file-000.parquet  a row for each decision; pictures as PNG, depth as TIFF
    videos/…/file-000.mp4            with ``--video`` the colour pictures, in place of those rows

A row is a decision: what every camera sent (``observation.images.first``), the state, the action,
and ``camera_mask``, 1 for each camera that the policy was given. A dropped camera still has its
picture there; an occluded one has what it sent.

Depth (``observation.images.first.depth``) is LeRobot's own depth feature: uint16 millimetres of one
channel, marked ``is_depth_map``, with its unit and, in metres, the range to which it was clipped.

An expert's actions are kept as it would have done them, also where noise made the robot do
something else: that is how recoveries are shown. A hammer episode of 100 decisions and three
cameras of 84 pixels takes 2.7 MB.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from madviz.envs.checks import check_state, expert_action
from madviz.errors import UserError
from madviz.guard.policy import GuardedPlayer
from madviz.measure.mean_picture import stack_of
from madviz.observation.ablation import Ablation
from madviz.observation.schedule import Schedule, reached
from madviz.observation.streams import StreamStack
from madviz.policies.players import player_of
from madviz.recording.dataset_films import FILMS, DatasetFilms, film_feature
from madviz.recording.dataset_statistics import described, described_pictures, tally
from madviz.runs.demonstrations import slow_noise
from madviz.session.frame import untouched
from madviz.subsets import camera_of
from madviz.system.depth import depth_millimetres
from madviz.system.files import new_folder, write_json
from madviz.types import Array, Environment, EnvSpec, Policy

FILE_BYTES = 100 * 2**20
"""A data file of at least this size is followed by another one, as LeRobot does."""
DEEPEST = 65.535
"""Metres that uint16 millimetres can say."""
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
KINDS = {"float32": pa.float32(), "int64": pa.int64(), "bool": pa.bool_()}


@dataclass(frozen=True)
class Decision:
    """One decision of an episode."""

    pictures: dict[str, Array]
    """(H, W, C) uint8 by stream, as they arrived; depth in its code."""
    mask: Array
    """(V,) bool, the streams that counted."""
    state: Array
    """(S,) float32."""
    action: Array
    """(A,) float32."""
    reward: float
    success: bool
    """The task's condition after it."""


def expert_decisions(
    env: Environment, streams: tuple[str, ...], noise: float, seed: int
) -> Iterator[Decision]:
    """The expert's episode of ``seed``. A noise that changes slowly is added to what is done, not
    to what is kept; its standard deviation is another one in each episode, from 0 to ``noise``."""
    rng = np.random.default_rng([seed, 11])
    pushed = slow_noise(rng, noise * rng.random(), env.spec.action_dim)
    stack = StreamStack(env.spec, streams, length=1)
    intact = Ablation()
    now = env.reset(seed)
    everything = np.ones(len(streams), bool)
    for step in range(env.spec.horizon):
        stack.push({one.name: env.view(one.name) for one in env.spec.cameras}, intact, seed, step)
        pictures = stack.newest
        state = now.state
        check_state(state, env.spec)
        action = expert_action(env)
        now = env.step(np.clip(action + next(pushed), -1, 1).astype(np.float32))
        yield Decision(pictures, everything, state, action, now.reward, now.success)
        if now.last:
            return


def policy_decisions(
    policy: Policy, env: Environment, schedule: Schedule, seed: int
) -> Iterator[Decision]:
    """The episode of ``seed`` in which cameras fail as ``schedule`` says. Raises UserError where
    the policy cannot act on what is left."""
    spec = policy.spec
    stack = stack_of(policy.spec, env.spec)
    ablation = Ablation()
    names = [camera.name for camera in env.spec.cameras]
    now = env.reset(seed)
    with closing(player_of(policy, seed)) as player:
        for step in range(env.spec.horizon):
            for event in reached(schedule, step, names):
                ablation = ablation.replace(event.camera, event.state(untouched(spec)))
            mask = ablation.mask(spec.streams)
            if not policy.supports(mask):
                raise UserError(
                    f"{spec.name} cannot act on what is left of its cameras at step {step}; "
                    "let them fail otherwise, as in third_a=black@5"
                )
            stack.push({name: env.view(name) for name in names}, ablation, seed, step)
            pictures = stack.newest
            state = now.state
            check_state(state, env.spec)
            action = player.act(policy.encode(stack.views, state), mask)
            given = player.report.mask if isinstance(player, GuardedPlayer) else mask
            now = env.step(action)
            yield Decision(pictures, given, state, action, now.reward, now.success)
            if now.last:
                return


def write_dataset(
    out: Path,
    env: EnvSpec,
    fps: float,
    episodes: Iterator[Iterator[Decision]],
    video: bool = False,
) -> tuple[list[bool], int]:
    """Writes all of ``episodes`` in ``env`` to the folder ``out``; whether each ended in success,
    and how many decisions they have. The folder appears when it is complete. Raises UserError for a
    folder that is there already, for a depth that does not fit, and for pictures that no film can
    hold."""
    check_folder(out)
    try:
        with new_folder(out) as part:
            dataset = LeRobotFolder(part, env, fps, video)
            ends = [dataset.add(list(episode)) for episode in episodes]
            dataset.close()
            return ends, dataset.frames
    except OSError as error:
        raise UserError(
            f"--out {out}: could not be written: {error.strerror}; make room there or choose "
            "another"
        ) from error


def check_folder(out: Path) -> None:
    """Raises UserError unless ``out`` can become a new folder."""
    if os.path.ismount(out):
        raise UserError(f"--out {out}: expected a new folder, found a mount; name one in it")
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise UserError(
            f"--out {out}: expected a new folder, found one that is not empty; choose another"
        )
    if not out.resolve().parent.is_dir():
        raise UserError(
            f"--out {out}: expected a folder in one that exists; make {out.parent} first"
        )


class LeRobotFolder:
    """The folder, episode by episode. ``close`` completes it."""

    def __init__(self, folder: Path, env: EnvSpec, fps: float, video: bool) -> None:
        self._folder = folder
        self._films = DatasetFilms(folder, fps) if video else None
        self._task = env.instruction or env.task
        self._env = env
        self._fps = fps
        self._features: dict[str, dict[str, Any]] = {}
        self._episodes: list[dict[str, Any]] = []
        self._columns: dict[str, list[Array]] = {}
        self._tallies: dict[str, Array] = {}
        self._writer: pq.ParquetWriter | None = None
        self._file = 0
        self.frames = 0
        """Decisions so far."""

    def add(self, decisions: Sequence[Decision]) -> bool:
        """Writes an episode; whether it ended in success."""
        columns = self._numbers(decisions)
        pictures = list(decisions[0].pictures)
        ranges = {name: depth_range_of(name, self._env) for name in pictures}
        if not self._features:
            fps = self._fps if self._films else None
            self._features = features(decisions[0], columns, ranges, fps)
        stats = {name: described(column) for name, column in columns.items()}
        data: dict[str, pa.Array] = {}
        filmed: dict[str, float] = {}
        for name in pictures:
            frames = [one.pictures[name] for one in decisions]
            span = ranges[name]
            if span:
                frames = [frame[..., :1] for frame in frames]  # Three equal channels, if three.
            if self._films and not span:
                filmed |= self._films.add(_key(name), frames)
            else:
                data[_key(name)] = _picture_column(frames, span)
            tallied = tally(frames)
            stats[_key(name)] = described_pictures(tallied, len(frames), span)
            self._tallies[name] = self._tallies.get(name, 0) + tallied
        for name, column in columns.items():
            data[name] = _column(column)
            self._columns.setdefault(name, []).append(column)
        place = self._write(pa.table(data))
        first = self.frames
        self.frames += len(decisions)
        self._episodes.append(
            {
                "episode_index": len(self._episodes),
                "tasks": [self._task],
                "length": len(decisions),
                "data/chunk_index": 0,
                "data/file_index": place,
                "dataset_from_index": first,
                "dataset_to_index": self.frames,
                **filmed,
                **{f"stats/{k}/{what}": v for k, each in stats.items() for what, v in each.items()},
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
        )
        return decisions[-1].success

    def close(self) -> None:
        """Writes what holds for all episodes."""
        if self._writer is not None:
            self._writer.close()
        if self._films:
            self._films.close()
        count = len(self._episodes)
        described_by = info(self._features, count, self.frames, self._fps)
        write_json(self._made("meta/info.json"), described_by)
        whole = {name: described(np.concatenate(each)) for name, each in self._columns.items()}
        for name, tallied in self._tallies.items():
            span = depth_range_of(name, self._env)
            whole[_key(name)] = described_pictures(tallied, self.frames, span)
        write_json(self._made("meta/stats.json"), whole)
        pq.write_table(tasks_table(self._task), self._made("meta/tasks.parquet"))
        where = "meta/episodes/chunk-000/file-000.parquet"
        pq.write_table(pa.Table.from_pylist(self._episodes), self._made(where))

    def _numbers(self, decisions: Sequence[Decision]) -> dict[str, Array]:
        """Column -> (T, n), every row of which has n numbers."""
        steps = np.arange(len(decisions))
        length = len(decisions)

        def all_of(values: list[Any], kind: type[np.generic]) -> Array:
            return np.asarray(values, kind).reshape(length, -1)

        return {
            "observation.state": all_of([one.state for one in decisions], np.float32),
            "action": all_of([one.action for one in decisions], np.float32),
            "camera_mask": all_of([one.mask for one in decisions], np.bool_),
            "next.reward": all_of([one.reward for one in decisions], np.float32),
            "next.success": all_of([one.success for one in decisions], np.bool_),
            "next.done": all_of([step == length - 1 for step in steps], np.bool_),
            "timestamp": all_of([step / self._fps for step in steps], np.float32),
            "frame_index": all_of([*steps], np.int64),
            "episode_index": all_of([len(self._episodes)] * length, np.int64),
            "index": all_of([*(self.frames + steps)], np.int64),
            "task_index": all_of([0] * length, np.int64),
        }

    def _write(self, table: pa.Table) -> int:
        """Appends an episode; the number of the file that has it."""
        if self._writer is not None and self._data_file().stat().st_size > FILE_BYTES:
            self._writer.close()
            self._writer = None
            self._file += 1
        if self._writer is None:
            self._writer = pq.ParquetWriter(self._data_file(), table.schema)
        self._writer.write_table(table)
        return self._file

    def _data_file(self) -> Path:
        return self._made(DATA.format(chunk_index=0, file_index=self._file))

    def _made(self, name: str) -> Path:
        path = self._folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path


def depth_range_of(stream: str, env: EnvSpec) -> tuple[float, float] | None:
    """Nearest and farthest metres of ``stream``, None for colour. Raises UserError where
    millimetres do not fit."""
    if not stream.endswith(".depth"):
        return None
    near, far = env.camera(camera_of(stream)).depth_range
    if far > DEEPEST:
        raise UserError(
            f"expected {stream} to end within {DEEPEST} m, the most that millimetres of 16 bits "
            f"can say, found {far:g} m; give the camera a nearer depth_range"
        )
    return near, far


def features(
    one: Decision,
    columns: dict[str, Array],
    ranges: Mapping[str, tuple[float, float] | None],
    film_fps: float | None,
) -> dict[str, dict[str, Any]]:
    """LeRobot's description of every column; ``film_fps``: where colour stands in films."""
    table: dict[str, dict[str, Any]] = {}
    for name, picture in one.pictures.items():
        span = ranges[name]
        if film_fps and not span:
            table[_key(name)] = film_feature(picture, film_fps)
            continue
        shape = [*picture.shape[:2], 1 if span else 3]
        axes = ["height", "width", "channels"]
        table[_key(name)] = {"dtype": "image", "shape": shape, "names": axes}
        if span:
            words = {"video.depth_min": span[0], "video.depth_max": span[1]}
            table[_key(name)]["info"] = {"is_depth_map": True, "depth_unit": "mm", **words}
    for name, column in columns.items():
        named = list(one.pictures) if name == "camera_mask" else None
        table[name] = {"dtype": str(column.dtype), "shape": [column.shape[1]], "names": named}
    return table


def info(features: dict[str, Any], episodes: int, frames: int, fps: float) -> dict[str, Any]:
    """meta/info.json."""
    return {
        "codebase_version": "v3.0",
        "fps": int(fps) if float(fps).is_integer() else fps,
        "features": features,
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": FILE_BYTES >> 20,
        "video_files_size_in_mb": 200,
        "data_path": DATA,
        "video_path": FILMS if any(one["dtype"] == "video" for one in features.values()) else None,
        "robot_type": None,
        "splits": {"train": f"0:{episodes}"},
    }


def tasks_table(task: str) -> pa.Table:
    """meta/tasks.parquet, whose column ``task`` is a table's index to pandas, which reads it."""
    kinds = {"task_index": ("int64", "int64"), "task": ("unicode", "object")}
    columns = [
        {"name": k, "field_name": k, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
        for k, (kind, numpy) in kinds.items()
    ]
    index = {"index_columns": ["task"], "column_indexes": [], "columns": columns}
    table = pa.table({"task_index": pa.array([0], pa.int64()), "task": [task]})
    return table.replace_schema_metadata({"pandas": json.dumps(index)})


def _key(stream: str) -> str:
    return f"observation.images.{stream}"


def _column(column: Array) -> pa.Array:
    """(T, n): lists of n, or plain values where n is 1."""
    kind = KINDS[str(column.dtype)]
    size = column.shape[1]
    flat = pa.array(column.ravel(), kind)
    return flat if size == 1 else pa.FixedSizeListArray.from_arrays(flat, size)


def _picture_column(frames: Sequence[Array], span: tuple[float, float] | None) -> pa.Array:
    """Pictures (H, W, C) as LeRobot keeps them in a table: PNG, or TIFF for depth over ``span``."""
    rows = []
    for number, frame in enumerate(frames):
        buffer = io.BytesIO()
        if span:
            depth = Image.fromarray(depth_millimetres(frame[..., 0], span))  # (H, W)
            depth.save(buffer, "TIFF", compression="tiff_adobe_deflate")
        else:
            Image.fromarray(np.ascontiguousarray(frame)).save(buffer, "PNG")
        kind = "tiff" if span else "png"
        rows.append({"bytes": buffer.getvalue(), "path": f"frame-{number:06d}.{kind}"})
    return pa.array(rows, pa.struct([("bytes", pa.binary()), ("path", pa.string())]))

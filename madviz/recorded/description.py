"""``meta/info.json`` of a LeRobot dataset, version 3: what its columns are and where files lie.

Nothing here is trusted. Paths are patterns in which LeRobot's own three fields may stand and
nothing else, and a file outside the dataset's folder is refused, also behind a link.
"""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import msgspec

from madviz.errors import UserError
from madviz.system.files import read_json
from madviz.system.typed import typed

CONVERT = (
    "python -m lerobot.scripts.convert_dataset_v21_to_v30 --repo-id={name} --root={path} "
    "--push-to-hub=false"
)
"""LeRobot's own command, which converts a dataset of version 2.1 in place."""
INFO = "meta/info.json"
LARGEST = 4096
"""Rows or columns of a picture."""
MOST_NUMBERS = 1000
"""Numbers in a state or an action."""
_FIELD = r"\{(?:video_key|(?:chunk|file)_index(?::0\d?d)?)\}"
_RESERVED = ("all", "none", "rgb", "depth")
"""Words that mean subsets of cameras."""
_FIX = "record it again or restore the file"


@dataclass(frozen=True)
class RecordedCamera:
    """A column of pictures, and the camera that it is to madviz."""

    key: str
    """The column, for example ``observation.images.top``."""
    name: str
    """For example ``top``: small letters, digits and _."""
    height: int
    """Pixels."""
    width: int
    kind: Literal["image", "video"] = "video"
    """Pictures in the tables, or films beside them."""


class _Feature(msgspec.Struct):
    dtype: str
    shape: list[int] = []
    names: Any = None
    info: dict[str, Any] | None = None


class _Info(msgspec.Struct):
    codebase_version: str
    fps: float
    features: dict[str, _Feature]
    data_path: str
    video_path: str | None = None
    total_episodes: int = 0


@dataclass(frozen=True)
class Description:
    """The facts of a dataset that hold for all of its episodes."""

    root: Path
    fps: float
    cameras: tuple[RecordedCamera, ...]
    state_names: tuple[str, ...]
    action_names: tuple[str, ...]
    data_path: str
    video_path: str
    total_episodes: int
    unread: tuple[str, ...]
    """One line for each camera, and all names of numbers, that are not read, and why."""

    def data_file(self, chunk: int, file: int) -> Path:
        """A table of steps. Raises UserError for one outside the dataset."""
        return inside(self.root, self.data_path.format(chunk_index=chunk, file_index=file))

    def film(self, key: str, chunk: int, file: int) -> Path:
        """The film of a camera's column. Raises UserError for one outside the dataset."""
        where = self.video_path.format(video_key=key, chunk_index=chunk, file_index=file)
        return inside(self.root, where)


def read_description(root: Path) -> Description:
    """Reads ``meta/info.json``. Raises UserError, one line, for a dataset that is not usable."""
    where = root / INFO
    if not root.is_dir():
        raise UserError(f"{root}: expected the folder of a LeRobot dataset, found none")
    if not where.exists():
        raise UserError(f"{root}: expected a LeRobot dataset with {INFO}, found no such file")
    value = read_json(inside(root, INFO))
    _check_version(root, value)
    info = typed(value, _Info, where, _FIX)
    if not 0 < info.fps <= 1000:
        raise UserError(f"{where}: expected 'fps' above 0 and up to 1000, found {info.fps:g}")
    cameras, unread = _cameras(where, info.features)
    if any(camera.kind == "video" for camera in cameras) and not info.video_path:
        raise UserError(f"{where}: expected 'video_path' for its films, found none; {_FIX}")
    of_state = _names(where, info.features, "observation.state", unread)
    of_action = _names(where, info.features, "action", unread)
    return Description(
        root,
        info.fps,
        cameras,
        of_state,
        of_action,
        _pattern(where, "data_path", info.data_path),
        _pattern(where, "video_path", info.video_path or ""),
        info.total_episodes,
        tuple(unread),
    )


def inside(root: Path, name: str) -> Path:
    """``name`` within ``root``. Raises UserError for a path that leads elsewhere, also by a link.
    Links to ``blobs`` are a download's own: Hugging Face's cache has the files there."""
    top = root.resolve()
    path = (top / name).resolve()
    blobs = top.parent.parent / "blobs" if top.parent.name == "snapshots" else top
    if not (path.is_relative_to(top) or path.is_relative_to(blobs)):
        raise UserError(f"{root}: expected files inside the dataset, found {name!r:.200} elsewhere")
    return path


def _check_version(root: Path, value: Any) -> None:
    found = value.get("codebase_version") if isinstance(value, dict) else None
    if not isinstance(found, str) or re.match(r"v?3\.", found):
        return
    if re.match(r"v?2\.1", found):
        command = CONVERT.format(name=root.resolve().name, path=root)
        raise UserError(f"{root}: expected LeRobotDataset v3, found {found}; convert it: {command}")
    raise UserError(f"{root}: expected LeRobotDataset v3, found {found!r:.40}; convert it first")


def _pattern(where: Path, word: str, pattern: str) -> str:
    """``pattern``, if only LeRobot's fields stand in it: others could ask for anything."""
    if re.search(r"[{}]", re.sub(_FIELD, "", pattern)):
        raise UserError(
            f"{where}: expected {word!r} with {{video_key}}, {{chunk_index:03d}} and "
            f"{{file_index:03d}} alone, found {pattern!r:.100}; {_FIX}"
        )
    return pattern


def _cameras(
    where: Path, features: dict[str, _Feature]
) -> tuple[tuple[RecordedCamera, ...], list[str]]:
    """The cameras, and a line for each that is not read."""
    cameras: list[RecordedCamera] = []
    unread: list[str] = []
    for key, feature in features.items():
        if feature.dtype not in ("image", "video"):
            continue
        shape = feature.shape
        info = feature.info or {}
        if info.get("is_depth_map") or info.get("video.is_depth_map"):
            unread.append(f"camera {key}: depth is not read")
            continue
        if len(shape) == 3 and shape[0] == 3 and shape[2] != 3:
            shape = [*shape[1:], 3]  # Some datasets say channels first.
        if len(shape) == 3 and shape[2] != 3:
            unread.append(f"camera {key:.80}: expected 3 channels, found the shape {shape!r:.60}")
            continue
        if len(shape) != 3 or not all(0 < n <= LARGEST for n in shape[:2]):
            raise UserError(
                f"{where}: expected {key!r:.80} of shape [height, width, 3] up to {LARGEST}, "
                f"found {shape!r:.60}; {_FIX}"
            )
        name = _camera_name(key, [camera.name for camera in cameras])
        kind = "image" if feature.dtype == "image" else "video"
        cameras.append(RecordedCamera(key, name, shape[0], shape[1], kind))
    if not cameras:
        found = "; ".join(["none", *unread])
        raise UserError(
            f"{where}: expected a camera, a feature of images or video, found {found:.300}"
        )
    return tuple(cameras), unread


def _camera_name(key: str, taken: list[str]) -> str:
    """``observation.images.Top cam`` -> ``top_cam``: a name that subsets of cameras can have."""
    last = re.sub(r"^observation\.(images\.)?", "", key)
    plain = unicodedata.normalize("NFKD", last).encode("ascii", "ignore").decode().lower()
    name = re.sub(r"[^a-z0-9]+", "_", plain).strip("_")[:20]
    if not name or not name[0].isalpha() or name in _RESERVED:
        name = f"camera_{name}".rstrip("_")
    number = 2
    whole = name
    while whole in taken:
        whole = f"{name}_{number}"
        number += 1
    return whole


def _names(
    where: Path, features: dict[str, _Feature], key: str, unread: list[str]
) -> tuple[str, ...]:
    """A name for each number of a column; ``action_0`` and so on where the dataset has none, or
    another count of them, which ``unread`` gets a line on."""
    feature = features.get(key)
    if feature is None:
        raise UserError(f"{where}: expected a feature {key!r}, found none; record it with one")
    shape = feature.shape
    if not re.match(r"u?int|float", feature.dtype) or len(shape) != 1:
        found = f"{feature.dtype} of shape {shape}"
        raise UserError(f"{where}: expected {key!r} of shape [n], found {found:.60}; {_FIX}")
    if not 0 < shape[0] <= MOST_NUMBERS:
        raise UserError(
            f"{where}: expected {key!r} of 1 to {MOST_NUMBERS} numbers, found {shape[0]}; {_FIX}"
        )
    names = feature.names
    if isinstance(names, dict) and len(names) == 1:
        names = next(iter(names.values()))  # {"motors": [...]}, as older writers have it.
    if isinstance(names, list) and len(names) == shape[0]:
        return tuple(str(name)[:60] for name in names)
    if names:
        found = len(names) if isinstance(names, list) else f"{names!r:.40}"
        unread.append(f"names of {key}: expected {shape[0]}, found {found}; they are numbered")
    stem = key.rpartition(".")[2]
    return tuple(f"{stem}_{number}" for number in range(shape[0]))

"""msgpack with arrays, as the two protocols write it; nothing in it is ever executed.

Both protocols write an array as a table that says what it is, with other keys:

    vla-eval   {"__ndarray__": True, "data": bytes, "dtype": "<f4", "shape": [4]}   text keys
    openpi     {b"__ndarray__": True, b"data": ...}                                 keys of bytes

vla-eval may also send a picture as PNG or JPEG: {"__image__": True, "format", "data", "shape"}.

What comes from a wire may be a mistake or a trap, so it is checked before anything is built from
it. A message of 1 GB is refused by the websocket when it is announced (``MOST_BYTES``). An array
whose shape and bytes do not agree is refused before it is made, as are a picture of more than
``MOST_PIXELS`` and tables nested deeper than ``DEEPEST``. Numbers are the only kind of array.
"""

from __future__ import annotations

import io
import math
from typing import Any, Literal

import msgspec
import numpy as np

from madviz.types import Array

Protocol = Literal["vla-eval", "openpi"]
MOST_BYTES = 64 * 2**20
"""The largest size of one message. Sixteen pictures of 512 pixels, three frames each, are 38
MB."""
MOST_PIXELS = 4096 * 4096
DEEPEST = 16
_MARK = "__ndarray__"
_SCALAR = "__npgeneric__"
_IMAGE = "__image__"
MARKS = frozenset({_MARK, _SCALAR, _IMAGE})
"""Keys of a table that stands for an array."""


class BadMessage(Exception):
    """A message that is not what the protocol says; in words."""


def pack(message: Any, protocol: Protocol) -> bytes:
    """``message`` with its arrays, as ``protocol`` writes them."""

    def array(value: Any) -> Any:
        if isinstance(value, np.generic):
            return value.item()
        fields = {
            _MARK: True,
            "data": np.ascontiguousarray(value).tobytes(),
            "dtype": value.dtype.str,
            "shape": value.shape,
        }
        return fields if protocol == "vla-eval" else {k.encode(): v for k, v in fields.items()}

    return msgspec.msgpack.encode(message, enc_hook=array)


def unpack(data: bytes | str) -> Any:
    """The value that ``pack`` of either protocol wrote, with keys as text. Raises BadMessage."""
    if isinstance(data, str):
        raise BadMessage(f"the text {data.strip().splitlines()[-1] if data.strip() else ''!r:.200}")
    try:
        return _built(msgspec.msgpack.decode(data), 0)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise BadMessage(f"{len(data)} bytes that are no msgpack ({error!s:.80})") from error


def _built(value: Any, depth: int) -> Any:
    """``value`` with the arrays that it describes."""
    if depth > DEEPEST:
        raise BadMessage(f"tables nested deeper than {DEEPEST}")
    if isinstance(value, list):
        return [_built(each, depth + 1) for each in value]
    if not isinstance(value, dict):
        return value
    if not all(isinstance(key, str | bytes) for key in value):
        raise BadMessage("a table whose keys are no text")
    table = {_text(key): each for key, each in value.items()}
    if _MARK in table:
        return _array(table)
    if _SCALAR in table:
        return table.get("data")
    if _IMAGE in table:
        return _picture(table)
    return {key: _built(each, depth + 1) for key, each in table.items()}


def _text(key: str | bytes) -> str:
    return key if isinstance(key, str) else key.decode("utf-8", "replace")


def _array(table: dict[str, Any]) -> Array:
    data = table.get("data")
    named = table.get("dtype")
    shape = table.get("shape")
    if not isinstance(data, bytes) or not isinstance(shape, list):
        raise BadMessage("an array without data or shape")
    if not isinstance(named, str | bytes):
        raise BadMessage("an array without a kind")
    kind = _text(named)
    try:
        dtype = np.dtype(kind)
    except (TypeError, ValueError, SyntaxError) as error:
        raise BadMessage(f"an array of the unknown kind {kind!r:.40}") from error
    if dtype.kind not in "biuf":
        raise BadMessage(f"an array of the kind {kind!r:.40}, which holds no plain numbers")
    if not all(type(size) is int and size >= 0 for size in shape) or len(shape) > 8:
        raise BadMessage(f"an array of the shape {shape!r:.60}")
    if math.prod(shape) * dtype.itemsize != len(data):
        raise BadMessage(f"an array of the shape {shape!r:.60} in {len(data)} bytes")
    try:
        return np.frombuffer(data, dtype).reshape(shape).copy()
    except (ValueError, OverflowError) as error:  # No bytes, and sides that numpy cannot count.
        raise BadMessage(f"an array of the shape {shape!r:.60}") from error


def _picture(table: dict[str, Any]) -> Array:
    """(H, W, C) uint8 of a PNG or JPEG, whose size is looked at before it is unpacked."""
    from PIL import Image, UnidentifiedImageError

    data = table.get("data")
    kind = table.get("format")
    if kind == "raw":
        return _array(table)
    if not isinstance(data, bytes) or kind not in ("png", "jpeg"):
        raise BadMessage(f"a picture of the unknown format {kind!r:.40}")
    try:
        with Image.open(io.BytesIO(data), formats=[kind]) as image:
            if image.width * image.height > MOST_PIXELS:
                raise BadMessage(f"a picture of {image.width} by {image.height} pixels")
            found = np.asarray(image)
    except (
        UnidentifiedImageError,
        OSError,
        ValueError,
        SyntaxError,  # Pillow's word for a chunk of a PNG that is broken.
        Image.DecompressionBombError,
    ) as error:
        raise BadMessage(f"a picture that is no {kind}") from error
    return found[..., None] if found.ndim == 2 else found

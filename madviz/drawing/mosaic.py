"""One picture of all cameras with their states drawn in: one message, always in step.

    ┌ First person ───── RGB ┬ Third A ── NOISE 70 % ┬ Third B ──── DROPPED ┐
    │   as it arrives        │  as it arrives         │  dimmed, stamped      │

A tile shows what *arrives* at the policy, occlusions and all, enlarged pixel by pixel. A dropped
camera still sees, but nothing of it is used: its own picture, dimmed and stamped, so that it cannot
be mistaken for a camera that sends black; or, with a policy that can draw it, what that imagines
from the other cameras, marked as imagined, with or without the truth in a corner. Where saliency is
asked for, the pixels that matter glow over the picture, which is dimmed under them. Pure NumPy;
nothing here knows viser.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Literal, TypeVar

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from madviz.analysis.imagination import Imagined
from madviz.drawing.colours import INK, MUTED, NOTE, camera_colours, heat, rgb
from madviz.session.frame import Frame
from madviz.session.guard_words import failing
from madviz.system.depth import depth_code
from madviz.types import Array, CameraSpec

GAP = 6
HEADER = 24
SCALE = 18
"""Pixels between tiles, of a tile's title, of the depth scale under a tile."""
_GROUND = (30, 31, 34)
T = TypeVar("T")
Dropped = Literal["imagined", "both", "truth"]
"""The content of a dropped camera's tile where a policy imagines it; the truth where none does."""
CORNER = 0.38
"""Share of a tile's side that the truth takes in the corner of what is imagined."""
GLOW = 0.85
"""How much of a pixel the brightest saliency covers."""


def mosaic(
    frame: Frame, tile: int, column: int | None = None, dropped: Dropped = "imagined"
) -> Array:
    """(HEADER + tile, V columns, 3) uint8: all cameras side by side, ``tile`` pixels wide each, in
    the middle of columns that are ``column`` wide, or no wider."""
    cameras = frame.world.env.cameras
    column = column or tile
    inset = (column - tile) // 2
    width = len(cameras) * column + (len(cameras) - 1) * GAP
    canvas = np.empty((HEADER + tile, width, 3), np.uint8)
    canvas[:] = _GROUND
    noticed = failing(frame)
    colours = camera_colours(cameras)
    for index, camera in enumerate(cameras):
        left = index * (column + GAP)
        block = canvas[:, left : left + column]
        _header(block[:HEADER], camera.label, badge(frame, camera.name), colours[camera.name])
        picture = block[HEADER:, inset : inset + tile]
        drawn = imagined_of(frame, camera.name) if dropped != "truth" else None
        if drawn is not None:
            _imagined(picture, drawn, _true_picture(frame, camera, dropped, tile))
            continue
        picture[:] = _tile(frame, camera, tile)
        if frame.camera(camera.name).input == "off":
            _stamp(picture, "DROPPED")
        elif camera.name in noticed:
            _label(picture[-20:], noticed[camera.name].badge, 12 if tile >= 180 else 10)
    return canvas


def imagined_of(frame: Frame, camera: str) -> Imagined | None:
    """The picture that the policy imagines of a dropped camera in colour; None where it does
    not."""
    if frame.camera(camera).input != "off":
        return None
    return of_stream(frame.world.imagined, camera, "rgb")


def of_stream(table: Mapping[str, T], camera: str, modality: str) -> T | None:
    """The entry of a camera's stream; None where the policy has no such stream. A policy of colour
    alone calls its streams by their cameras."""
    found = table.get(f"{camera}.{modality}")
    return table.get(camera) if found is None and modality == "rgb" else found


def _true_picture(frame: Frame, camera: CameraSpec, dropped: Dropped, tile: int) -> Array | None:
    """The camera's true picture, small, where it is asked for."""
    if dropped != "both":
        return None
    return _enlarge(frame.world.views[camera.name].rgb, round(CORNER * tile))


def _imagined(picture: Array, drawn: Imagined, truth: Array | None) -> None:
    """The imagined picture, in a dashed frame and with the word for it, so that nobody takes it for
    what a camera sends; and the truth in its corner."""
    tile = len(picture)
    ink = rgb(NOTE)
    picture[:] = _enlarge(drawn.picture, tile)
    for start in range(0, tile, 12):
        for edge in (picture[:3], picture[-3:]):
            edge[:, start : start + 6] = ink
        for edge in (picture[:, :3], picture[:, -3:]):
            edge[start : start + 6] = ink
    _label(picture[3:23], "IMAGINED")
    if truth is not None:
        place = picture[-len(truth) - 3 : -3, -len(truth) - 3 : -3]
        place[:] = truth
        place[:2], place[:, :2] = _GROUND, _GROUND
        _label(place[2:20, 2:], "TRUTH")


def _label(band: Array, text: str, size: int = 12) -> None:
    """A word in white on a darkened band."""
    band[:] = band // 3
    _write(band, text, 4 if size < 12 else 8, "#ffffff", size)


def badge(frame: Frame, camera: str) -> str:
    """The state of ``camera`` in two words, for the corner of its tile."""
    state = frame.camera(camera)
    drawn = imagined_of(frame, camera)
    if drawn is not None and np.isfinite(drawn.psnr):
        return f"OFF, {drawn.psnr:.0f} dB"
    if state.input == "off":
        return "OFF"
    if state.occlusion.kind != "none":
        return state.occlusion.badge
    if camera in frame.world.ablation.moves:
        return "MOVED"
    words = []
    for modality in ("rgb", "depth"):
        if state.input in (modality, "both"):
            unused = of_stream(frame.world.arrived, camera, modality) is None
            words.append(modality.upper() + (" (NOT USED)" if unused else ""))
    return " + ".join(words)


def _tile(frame: Frame, camera: CameraSpec, tile: int) -> Array:
    state = frame.camera(camera.name)
    shown = state.input if state.input != "off" else "rgb"
    if shown == "both":
        height = tile // 2
        top = _colour_picture(frame, camera, tile)[(tile - height) // 2 :][:height]
        return np.concatenate([top, _depth_picture(frame, camera, tile, tile - height)])
    if shown == "depth":
        return _depth_picture(frame, camera, tile, tile)
    if state.input == "off":
        grey = _enlarge(frame.world.views[camera.name].rgb, tile).mean(axis=2, keepdims=True)
        return (0.3 * grey).astype(np.uint8).repeat(3, axis=2)
    return _colour_picture(frame, camera, tile)


def glow(picture: Array, frame: Frame, camera: str, modality: str) -> Array:
    """``picture`` (H, W, 3) with the saliency of its stream laid over it, if there is any."""
    shares = of_stream(frame.saliency or {}, camera, modality)  # (H, W)
    if shares is None:
        return picture
    shares = cv2.resize(shares, picture.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    weight = GLOW * np.sqrt(shares)[..., None]  # (H, W, 1)
    colours = heat(shares, cv2.COLORMAP_INFERNO)  # (H, W, 3)
    dimmed = (1 - 0.5 * GLOW) * picture
    return (dimmed * (1 - weight) + colours * weight).astype(np.uint8)


def _colour_picture(frame: Frame, camera: CameraSpec, tile: int) -> Array:
    arrived = of_stream(frame.world.arrived, camera.name, "rgb")
    if arrived is None:
        arrived = frame.world.views[camera.name].rgb
    return glow(_enlarge(arrived, tile), frame, camera.name, "rgb")


def _depth_picture(frame: Frame, camera: CameraSpec, tile: int, height: int) -> Array:
    """(height, tile, 3): the middle rows of the depth picture above a scale in metres."""
    arrived = of_stream(frame.world.arrived, camera.name, "depth")
    if arrived is None:
        arrived = depth_code(frame.world.views[camera.name].depth, camera.depth_range)
    picture = heat(_enlarge(arrived[..., 0], tile) / 255.0)
    picture = glow(picture, frame, camera.name, "depth")
    rows = height - SCALE
    start = (tile - rows) // 2
    return np.concatenate([picture[start : start + rows], _depth_scale(camera.depth_range, tile)])


def _enlarge(picture: Array, tile: int) -> Array:
    """Nearest neighbour: the policy's own pixels, crisp."""
    return cv2.resize(picture, (tile, tile), interpolation=cv2.INTER_NEAREST)


@lru_cache(maxsize=32)
def _depth_scale(depth_range: tuple[float, float], width: int) -> Array:
    """A strip of the colour map with its ends in metres."""
    strip = heat(np.tile(np.linspace(0, 1, width), (SCALE, 1)))
    near, far = depth_range
    _write(strip, f"{near:.1f} m", 4, "#ffffff", 12)
    _write(strip, f"{far:.1f} m", -4, "#000000", 12)
    return strip


def _header(block: Array, label: str, state: str, colour: str) -> None:
    block[:, :5] = rgb(colour)
    plain = state in ("RGB", "DEPTH", "RGB + DEPTH")
    if 24 + _glyphs(label, 14).shape[1] + _glyphs(state, 12).shape[1] > block.shape[1]:
        state = state.split()[0].strip(",")  # Its number does not fit beside the label.
    _write(block, label, 12, INK, 14)
    _write(block, state, -4, MUTED if plain else NOTE, 12)


def _stamp(picture: Array, text: str) -> None:
    """``text`` across the middle on a dark band, and two diagonals: no camera sends that."""
    height, width = picture.shape[:2]
    for start, end in (((0, 0), (width, height)), ((width, 0), (0, height))):
        cv2.line(picture, start, end, (110, 110, 110), 1, cv2.LINE_AA)
    band = picture[height // 2 - 18 : height // 2 + 18]
    band[:] = band // 3
    alpha = _glyphs(text, 24)
    _blend(band, alpha, (width - alpha.shape[1]) // 2, rgb("#ffffff"))


def _write(block: Array, text: str, x: int, colour: str, size: int) -> None:
    """Text at ``x`` from the left, or from the right where negative, centred vertically."""
    alpha = _glyphs(text, size)
    _blend(block, alpha, x if x >= 0 else block.shape[1] - alpha.shape[1] + x, rgb(colour))


def _blend(block: Array, alpha: Array, left: int, colour: tuple[int, int, int]) -> None:
    left = max(left, 0)
    width = min(alpha.shape[1], block.shape[1] - left)
    top = max((block.shape[0] - alpha.shape[0]) // 2, 0)
    height = min(alpha.shape[0], block.shape[0])
    region = block[top : top + height, left : left + width]
    weight = alpha[:height, :width, None]
    region[:] = region * (1 - weight) + np.array(colour) * weight


@lru_cache(maxsize=256)
def _glyphs(text: str, size: int) -> Array:
    """(H, W) in [0, 1]: coverage of ``text``; drawn once, because text costs more than a tile."""
    font = ImageFont.load_default(size)
    left, _, right, _ = font.getbbox(text)
    _, top, _, bottom = font.getbbox("Hp")  # One height for all, or words would jump up and down.
    image = Image.new("L", (int(right - left) + 2, int(bottom - top) + 4))
    ImageDraw.Draw(image).text((1 - left, 2 - top), text, fill=255, font=font)
    return np.asarray(image, np.float32) / 255

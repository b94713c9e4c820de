"""A box dragged on a camera's picture becomes a patch that covers it.

The problem: viser does not report where a visitor clicks in a picture, and a script of ours has no
connection to Python. The idea: a hidden text field. The script writes a line into it as if somebody
had typed, and viser sends that like any other text:

    drag ─► rubber band ─► "7 1 0.4200 0.5500 0.2000 0.1000" ─► hidden field ─► SetCamera(patch)
                            │ │ └ middle, width and height, parts of the tile
                            │ └ the tile, from 0
                            └ counts, so that the same box twice is two texts

What is drawn is what is covered: the band ends where its tile does. Lines come from a page that
anybody may have changed, so ``parse_box`` takes nothing but this form. A click, or a drag of a few
pixels, does nothing. Fingers scroll the panel instead of drawing.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import viser

from madviz.app.toolkit import selector
from madviz.drawing.mosaic import GAP, HEADER, SCALE
from madviz.errors import UserError
from madviz.observation.ablation import CameraState, Occlusion

HINT = "Drag a box on a picture: a black patch covers it."
_FRACTION = r"([01]\.\d{4})"
_LINE = re.compile(r"[0-9]{1,9} ([0-9]{1,2})" + rf" {_FRACTION}" * 4, re.ASCII)


@dataclass(frozen=True)
class Box:
    """A rectangle on one tile; everything in parts of the tile, which is as high as wide."""

    tile: int
    x: float
    """Middle, from the left."""
    y: float
    """Middle, from the top."""
    width: float
    height: float


def parse_box(text: str, tiles: int) -> Box:
    """The patch that the script has written. Raises UserError for anything that it would not
    write."""
    found = _LINE.fullmatch(text)
    if found is None:
        raise UserError(
            f"expected a box as this page draws one, found {text!r:.60}; load the page again"
        )
    tile = int(found[1])
    numbers = [float(number) for number in found.groups()[1:]]
    if tile >= tiles or max(numbers) > 1 or min(numbers[2:]) == 0:
        raise UserError(
            f"expected a box inside one of {tiles} pictures, found {text!r:.60}; draw it again"
        )
    return Box(tile, *numbers)


def patched(state: CameraState, box: Box, tile: int) -> CameraState:
    """``state`` with a patch where ``box`` is on a tile of ``tile`` pixels; a patch that is there
    already keeps its strength. Raises UserError for a dropped camera: nothing of it is used."""
    if state.input == "off":
        raise UserError("expected a camera that is on, found one that is dropped; switch it on")
    strength = state.occlusion.strength if state.occlusion.kind == "patch" else 1.0
    # Hundredths, as the sliders have them: less than a pixel of what the policy gets.
    x = round(box.x, 2)
    y = round(_row(box.y, state.input, tile), 2)
    width, height = (max(round(side, 2), 0.01) for side in (box.width, box.height))
    return CameraState(state.input, Occlusion("patch", strength, x, y, width, height))


def _row(y: float, shown: str, tile: int) -> float:
    """From a part of the tile to the same part of the picture: ``mosaic`` shows the middle rows
    where there is something else on the tile, colour above depth or a scale under it."""
    half = tile // 2
    row = y * tile
    if shown == "depth":
        above = SCALE // 2
    elif shown == "both" and row < half:
        above = (tile - half) // 2
    elif shown == "both":
        above = (tile - (tile - half - SCALE)) // 2 - half
    else:
        above = 0
    return min(max((row + above) / tile, 0.0), 1.0)


def field_style(field: viser.GuiTextHandle) -> str:
    """CSS that takes the field out of sight; the script finds it all the same."""
    return f"{selector(field)} {{display:none}}"


def attributes(field: viser.GuiTextHandle, tiles: int, tile: int, column: int) -> str:
    """The facts that the script needs of a mosaic of ``tiles`` tiles, ``tile`` pixels wide, in
    columns that are ``column`` wide."""
    return (
        f'data-draw="{field._impl.uuid}" data-tiles="{tiles}" data-tile="{tile}" '
        f'data-pitch="{column + GAP}" data-inset="{(column - tile) // 2}" '
        f'data-header="{HEADER}" draggable="false" title="{HINT}"'
    )

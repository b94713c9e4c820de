"""Textures as the driver holds them: with every smaller level it has made of them.

A software OpenGL rounds upwards when it halves a picture, and a browser's own ``generateMipmap``
rounds otherwise. At 84 pixels a camera sees little but these levels, so they are read from the
driver and shipped. Levels above ``LARGEST`` pixels stay here: no camera comes so near. A texture
of 1024 pixels weighs 3.1 MB, its levels from 256 pixels on 0.26 MB.

What is stored of a row is the difference of each pixel to its left neighbour, which packs better.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from madviz.types import Array

LARGEST = 320
"""Pixels a side of the largest level that is shipped."""


@dataclass(frozen=True)
class Texture:
    """A picture, or the six sides of a cube."""

    cube: bool
    levels: tuple[Array, ...]
    """(F, H, W, 3) uint8, largest first; F is 1, or 6 where the sides differ."""

    def arrays(self) -> dict[str, Array]:
        """As a file has it: differences along rows, by ``level0`` and on."""
        return {f"level{i}": _differences(level) for i, level in enumerate(self.levels)}


def read_textures(model: mujoco.MjModel) -> list[Texture]:
    """All textures of ``model``, in its order."""
    gl = mujoco.GLContext(64, 64)
    gl.make_current()
    try:
        context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        return [_read(model, context, number) for number in range(model.ntex)]
    finally:
        gl.free()


def _read(model: mujoco.MjModel, context: mujoco.MjrContext, number: int) -> Texture:
    # PyOpenGL takes its platform from what MuJoCo has loaded, so it comes after it.
    from OpenGL import GL

    cube = bool(model.tex_type[number] != mujoco.mjtTexture.mjTEXTURE_2D.value)
    kind = GL.GL_TEXTURE_CUBE_MAP if cube else GL.GL_TEXTURE_2D
    first: Any = GL.GL_TEXTURE_CUBE_MAP_POSITIVE_X if cube else GL.GL_TEXTURE_2D
    # A square picture is on all six sides.
    faces = 6 if cube and model.tex_width[number] != model.tex_height[number] else 1
    width = int(model.tex_width[number])
    height = width if cube else int(model.tex_height[number])
    GL.glBindTexture(kind, int(context.texture[number]))
    GL.glPixelStorei(GL.GL_PACK_ALIGNMENT, 1)
    levels = []
    level = 0
    while True:
        if max(width, height) <= LARGEST:
            pixels = np.empty((faces, height, width, 3), np.uint8)
            for face in range(faces):
                GL.glGetTexImage(
                    first + face, level, GL.GL_RGB, GL.GL_UNSIGNED_BYTE, array=pixels[face]
                )
            levels.append(pixels)
        if width == height == 1:
            return Texture(cube, tuple(levels))
        width = max(width // 2, 1)
        height = max(height // 2, 1)
        level = level + 1


def _differences(pixels: Array) -> Array:
    """The difference of every pixel to its left neighbour, modulo 256."""
    return np.diff(pixels, axis=2, prepend=np.zeros_like(pixels[:, :, :1]))

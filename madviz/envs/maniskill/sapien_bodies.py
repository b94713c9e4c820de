"""A SAPIEN scene as meshes: what the cameras draw, for a page to draw once more.

They are read from the copy of the task that is drawn (``render.DrawnCopy``), so the heavy
meshes are light already under the fast profile, and come from the same cache under the full one.
The goal that PickCube hides from its cameras is here: policies do not look at a page. The ground,
a hundred metres wide, is not. Textures become their mean colour. A target is painted as discs one
over the other, each 0.01 mm higher than the larger one under it, which a browser cannot tell apart:
here it is ``LAYER``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from madviz.envs import shapes
from madviz.envs.decimation import ENOUGH, TRIANGLES
from madviz.envs.maniskill.meshes import file_of, lighter
from madviz.types import Array, Body, Part

WIDE = 5.0
"""Metres from which on something is ground."""
LAYER = 0.001
"""Metres between two discs of a target."""


class ManiSkillBodies:
    """The bodies of one SAPIEN scene, and where they are."""

    def __init__(self, scene: Any) -> None:
        import sapien.render

        self._entities = []
        made = []
        for entity in scene.entities:
            drawn = entity.find_component_by_type(sapien.render.RenderBodyComponent)
            shapes = drawn.render_shapes if drawn else ()
            parts = tuple(
                part for layer, shape in enumerate(shapes) for part in _parts(shape, layer)
            )
            if parts:
                self._entities.append(entity)
                made.append(Body(f"{entity.name}-{len(made)}", parts))
        self.bodies = tuple(made)

    def poses(self) -> Array:
        """(N, 7) float32: position in metres and wxyz in the world, in the order of ``bodies``."""
        poses = (entity.pose for entity in self._entities)
        return np.array([[*pose.p, *pose.q] for pose in poses], np.float32)


def _parts(shape: Any, layer: int) -> list[Part]:
    """The pieces of one render shape, in its body's frame; ``layer`` is its number there."""
    made = []
    for piece in shape.parts:
        colour = _colour(piece.material)
        textured = piece.material.base_color_texture is not None
        vertices = piece.vertices
        triangles = piece.triangles
        if len(triangles) > ENOUGH * TRIANGLES and not textured:
            mesh = (vertices, triangles, piece.get_vertex_normal(), piece.get_vertex_uv())
            vertices, triangles, *_ = lighter(mesh, textured, file_of(shape))
        sized = np.asarray(vertices, float) * _scale(shape, layer)
        if np.ptp(sized, axis=0).max() < WIDE:
            solid = (sized, np.asarray(triangles, np.int32))
            made.append(shapes.part(solid, colour, shape.local_pose.p, shape.local_pose.q))
    return made


def _scale(shape: Any, layer: int) -> Array:
    """(3,) what its vertices are to be multiplied by: SAPIEN has boxes, balls and cylinders as
    unit shapes."""
    kind = type(shape).__name__
    if kind == "RenderShapeBox":
        return np.asarray(shape.half_size, float)
    if kind == "RenderShapeSphere":
        return np.full(3, shape.radius, float)
    if kind == "RenderShapeCylinder":
        return np.array([shape.half_length + layer * LAYER, shape.radius, shape.radius], float)
    return np.asarray(getattr(shape, "scale", np.ones(3)), float)


def _colour(material: Any) -> Array:
    """(3,) in [0, 1], with the mean of its texture if it has one."""
    texture = material.base_color_texture
    if texture is None:
        return np.asarray(material.base_color[:3], float)
    texels = np.asarray(texture.download(), float)
    scale = 255.0 if texels.max() > 1 else 1.0
    return texels.reshape(-1, texels.shape[-1])[:, :3].mean(0) / scale

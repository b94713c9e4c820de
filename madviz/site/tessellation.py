"""The shapes that MuJoCo draws, as vertices and triangles, cut the way MuJoCo cuts them.

Its lighting is worked out at vertices alone and is interpolated between them, so a sphere with
other slices has other colours. A box side has 4 x 4 quads, a sphere 28 slices and 16 stacks, and a
plane a grid of its own. Normals and texture coordinates are those of the *unit* shape, as in
fixed-function OpenGL, where the size is a scaling: a normal is divided by it.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from madviz.errors import UserError
from madviz.types import Array

_GRID = 200
"""Most lines in a plane's grid."""


@dataclass(frozen=True)
class Mesh:
    """Triangles with what lighting and textures need."""

    positions: Array
    """(n, 3) float64, in the frame of the shape."""
    normals: Array
    """(n, 3)"""
    units: Array
    """(n, 3) the same places before scaling: what texture coordinates are made from."""
    triangles: Array
    """(m, 3) int, counter-clockwise seen from outside."""

    def scaled(self, size: Array, shift: tuple[float, float, float] = (0, 0, 0)) -> Mesh:
        """The shape with half sides ``size``, moved by ``shift`` before it is scaled."""
        normals = self.normals / size
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        moved = self.positions + np.asarray(shift, float)
        return Mesh(moved * size, normals, self.units, self.triangles)


def joined(parts: list[Mesh]) -> Mesh:
    """One mesh of several."""
    starts = np.cumsum([0, *(len(part.positions) for part in parts)])
    return Mesh(
        np.concatenate([part.positions for part in parts]),
        np.concatenate([part.normals for part in parts]),
        np.concatenate([part.units for part in parts]),
        np.concatenate([p.triangles + start for p, start in zip(parts, starts, strict=False)]),
    )


def shape(model: mujoco.MjModel, geom: mujoco.MjvGeom) -> Mesh:
    """The mesh that MuJoCo draws for ``geom``. Raises UserError for a kind that no task here
    has."""
    kind = mujoco.mjtGeom(int(geom.type))
    size = np.asarray(geom.size, float)
    slices = model.vis.quality.numslices
    stacks = model.vis.quality.numstacks
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        # An even number is the mesh, an odd one its hull.
        return mesh(model, int(geom.dataid) // 2)
    if kind == mujoco.mjtGeom.mjGEOM_PLANE:
        return plane(size)
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return box(model.vis.quality.numquads).scaled(size)
    if kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_ELLIPSOID):
        return sphere(slices, stacks).scaled(size)
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return cylinder(slices, stacks).scaled(size)
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return capsule(slices, stacks, size)
    raise UserError(f"expected a shape that a site can draw, found {kind.name}")


def mesh(model: mujoco.MjModel, number: int) -> Mesh:
    """A mesh of the model. A corner takes its triangle's normal where that differs from its own by
    more than 37 degrees (a cosine below 0.8): MuJoCo's rule for sharp edges."""
    vertex = model.mesh_vertadr[number]
    face = model.mesh_faceadr[number]
    normal = model.mesh_normaladr[number]
    count = model.mesh_facenum[number]
    faces = model.mesh_face[face : face + count]  # (m, 3)
    corners = model.mesh_vert[vertex + faces].astype(float)  # (m, corner, xyz)
    normals = model.mesh_normal[normal + model.mesh_facenormal[face : face + count]].astype(float)
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])  # (m, 3)
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
    sharp = (normals * flat[:, None]).sum(-1) < 0.8  # (m, corner)
    normals = np.where(sharp[..., None], flat[:, None], normals)
    return _indexed(corners.reshape(-1, 3), normals.reshape(-1, 3))


def plane(size: Array) -> Mesh:
    """A finite plane: quads twice ``size[2]`` wide, and narrower ones at the edges."""
    if size[0] <= 0 or size[1] <= 0:
        raise UserError("expected planes with ends, found one without")
    x, y = (_lines(size[axis], size[2]) for axis in (0, 1))
    u, v = np.meshgrid(x, y, indexing="ij")  # (rows, columns)
    places = np.stack([u, v, np.zeros_like(u)], -1)  # (rows, columns, 3)
    quads = np.stack([places[:-1, :-1], places[1:, :-1], places[1:, 1:], places[:-1, 1:]], 2)
    return _quads(quads.reshape(-1, 4, 3), lambda p: np.broadcast_to([0.0, 0, 1], p.shape))


def _lines(half: float, spacing: float) -> Array:
    spacing = max(spacing, half / (_GRID - 2))
    count = int(half / spacing)
    count -= count % 2
    pad = half - count * spacing
    inner = -half + pad + 2 * spacing * np.arange(count + 1)
    return np.concatenate([[-half], inner, [half]])


def box(quads: int) -> Mesh:
    """Six sides of ``quads`` x ``quads``."""
    steps = np.linspace(-1, 1, quads + 1)
    u, v = np.meshgrid(steps, steps, indexing="ij")
    parts = []
    for axis in range(3):
        for sign in (1, -1):
            # The other two axes in the order that makes the quads face outwards.
            first, second = ((axis + 1) % 3, (axis + 2) % 3)[::sign]
            places = np.empty((*u.shape, 3))
            places[..., axis] = sign
            places[..., first] = u
            places[..., second] = v
            corners = [places[:-1, :-1], places[1:, :-1], places[1:, 1:], places[:-1, 1:]]
            normal = np.eye(3)[axis] * sign
            parts.append(
                _quads(
                    np.stack(corners, 2).reshape(-1, 4, 3),
                    lambda p, n=normal: np.broadcast_to(n, p.shape),
                )
            )
    return joined(parts)


def sphere(slices: int, stacks: int) -> Mesh:
    """A unit sphere, poles along z."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, stacks + 1)
    return _turned(np.cos(angles), np.sin(angles), slices, lambda p: p)


def cylinder(slices: int, stacks: int) -> Mesh:
    """Radius 1, z from -1 to 1, with both ends closed."""
    side = tube(slices, stacks)
    rings = np.linspace(0, 1, stacks // 2 + 1)
    top = _turned(rings[::-1], np.ones_like(rings), slices, lambda p: p * 0 + [0, 0, 1])
    bottom = _turned(rings, -np.ones_like(rings), slices, lambda p: p * 0 + [0, 0, -1])
    return joined([bottom, side, top])


def tube(slices: int, stacks: int) -> Mesh:
    """A cylinder without its ends."""
    heights = np.linspace(-1, 1, stacks + 1)
    return _turned(np.ones_like(heights), heights, slices, lambda p: p * [1, 1, 0])


def capsule(slices: int, stacks: int, size: Array) -> Mesh:
    """A tube with half a sphere at each end. ``size`` (3,) is the radius along x, that along y, and
    half of the length of the tube."""
    # MuJoCo makes the two ends as high as the mean radius is.
    height = (size[0] + size[1]) / 2
    ends = np.array([size[0], size[1], height])
    # Half a unit sphere is moved before it is scaled by ``height``, up to the end of the tube.
    shift = size[2] / height
    angles = np.linspace(0, np.pi / 2, stacks // 2 + 1)  # From the rim to the pole.
    radii = np.cos(angles)
    heights = np.sin(angles)
    top = _turned(radii, heights, slices, lambda p: p)
    bottom = _turned(radii[::-1], -heights[::-1], slices, lambda p: p)
    return joined(
        [
            tube(slices, stacks).scaled(size),
            top.scaled(ends, (0, 0, shift)),
            bottom.scaled(ends, (0, 0, -shift)),
        ]
    )


def _turned(radii: Array, heights: Array, slices: int, normal) -> Mesh:
    """A profile turned about z, from below to above; points of radius 0 become triangles."""
    angles = np.linspace(0, 2 * np.pi, slices + 1)
    x = radii[:, None] * np.cos(angles)  # (rings, slices + 1)
    y = radii[:, None] * np.sin(angles)
    z = np.broadcast_to(heights[:, None], x.shape)
    places = np.stack([x, y, z], -1)  # (rings, slices + 1, 3)
    corners = [places[:-1, :-1], places[:-1, 1:], places[1:, 1:], places[1:, :-1]]
    return _quads(np.stack(corners, 2).reshape(-1, 4, 3), normal)


def _quads(quads: Array, normal) -> Mesh:
    """(n, 4, 3) quads as triangles, cut along the diagonal that Mesa cuts; those without area go
    away."""
    triangles = quads[:, [[0, 1, 3], [1, 2, 3]]].reshape(-1, 3, 3)  # (m, corner, xyz)
    area = np.linalg.norm(
        np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1
    )
    corners = triangles[area > 1e-12].reshape(-1, 3)  # (3 m, 3)
    return _indexed(corners, np.array(normal(corners), float))


def _indexed(corners: Array, normals: Array) -> Mesh:
    """The mesh of ``corners`` and ``normals``, both (3 m, 3), three rows a triangle. Corners that
    are equal in both are there once."""
    both = np.round(np.concatenate([corners, normals], 1), 9)  # (3 m, 6)
    # ``first``: where each of the n different rows is first; ``place``: which of them a row is.
    _, first, place = np.unique(both, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)  # In the order of their first use, which packs better.
    new = np.empty_like(order)  # (n,) where a row that np.unique has sorted goes.
    new[order] = np.arange(len(order))
    kept = first[order]
    return Mesh(corners[kept], normals[kept], corners[kept], new[place].reshape(-1, 3))

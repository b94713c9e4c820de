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
    """Triangles with what lighting needs."""

    positions: Array
    """(n, 3) float64, in the frame of the shape."""
    normals: Array
    """(n, 3)"""
    triangles: Array
    """(m, 3) int, counter-clockwise seen from outside."""

    def scaled(self, size: Array, shift: tuple[float, float, float] = (0, 0, 0)) -> Mesh:
        """The shape with half sides ``size``, moved by ``shift`` before it is scaled."""
        normals = self.normals / size
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        moved = self.positions + np.asarray(shift, float)
        return Mesh(moved * size, normals, self.triangles)


def joined(parts: list[Mesh]) -> Mesh:
    """One mesh of several."""
    starts = np.cumsum([0, *(len(part.positions) for part in parts)])
    return Mesh(
        np.concatenate([part.positions for part in parts]),
        np.concatenate([part.normals for part in parts]),
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
    return _indexed(np.concatenate([corners, normals], 2).reshape(-1, 6))


def plane(size: Array) -> Mesh:
    """A finite plane: quads twice ``size[2]`` wide, and narrower ones at the edges."""
    if size[0] <= 0 or size[1] <= 0:
        raise UserError("expected planes with ends, found one without")
    x, y = (_lines(size[axis], size[2]) for axis in (0, 1))
    u, v = np.meshgrid(x, y, indexing="ij")  # (rows, columns)
    return _surface(np.stack([u, v, np.zeros_like(u)], -1), [0, 0, 1])


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
    u, v = np.meshgrid(steps, steps, indexing="ij")  # (rows, columns)
    sides = []
    for axis in range(3):
        for sign in (1, -1):
            # The other two axes in the order that makes the quads face outwards.
            first, second = ((axis + 1) % 3, (axis + 2) % 3)[::sign]
            places = np.empty((*u.shape, 3))
            places[..., axis] = sign
            places[..., first] = u
            places[..., second] = v
            sides.append(_surface(places, np.eye(3)[axis] * sign))
    return joined(sides)


def sphere(slices: int, stacks: int) -> Mesh:
    """A unit sphere, poles along z."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, stacks + 1)
    places = _turned(np.cos(angles), np.sin(angles), slices)
    return _surface(places, places)


def cylinder(slices: int, stacks: int) -> Mesh:
    """Radius 1, z from -1 to 1, with both ends closed."""
    rings = np.linspace(0, 1, stacks // 2 + 1)
    top = _surface(_turned(rings[::-1], np.ones_like(rings), slices), [0, 0, 1])
    bottom = _surface(_turned(rings, -np.ones_like(rings), slices), [0, 0, -1])
    return joined([bottom, tube(slices, stacks), top])


def tube(slices: int, stacks: int) -> Mesh:
    """A cylinder without its ends."""
    heights = np.linspace(-1, 1, stacks + 1)
    places = _turned(np.ones_like(heights), heights, slices)
    return _surface(places, places * [1, 1, 0])


def capsule(slices: int, stacks: int, size: Array) -> Mesh:
    """A tube with half a sphere at each end. ``size`` (3,) is the radius along x, that along y, and
    half of the length of the tube."""
    # MuJoCo makes the two ends as high as the mean radius is.
    height = (size[0] + size[1]) / 2
    ends = np.array([size[0], size[1], height])
    # Half a unit sphere is moved before it is scaled by ``height``, up to the end of the tube.
    shift = size[2] / height
    angles = np.linspace(0, np.pi / 2, stacks // 2 + 1)  # From the rim to the pole.
    above = _turned(np.cos(angles), np.sin(angles), slices)
    below = _turned(np.cos(angles)[::-1], -np.sin(angles)[::-1], slices)
    top = _surface(above, above).scaled(ends, (0, 0, shift))
    bottom = _surface(below, below).scaled(ends, (0, 0, -shift))
    return joined([tube(slices, stacks).scaled(size), top, bottom])


def _turned(radii: Array, heights: Array, slices: int) -> Array:
    """(slices + 1, rings, 3): a profile from below to above, turned about z."""
    angles = np.linspace(0, 2 * np.pi, slices + 1)[:, None]
    x = np.cos(angles) * radii  # (slices + 1, rings)
    y = np.sin(angles) * radii
    return np.stack([x, y, np.broadcast_to(heights, x.shape)], -1)


def _surface(places: Array, normals: Array | list[int]) -> Mesh:
    """A grid of ``places`` (rows, columns, 3) as triangles, cut along the diagonal that Mesa cuts;
    those without area, as at the poles, go away. ``normals`` are a grid, or one for all."""
    both = np.concatenate([places, np.broadcast_to(normals, places.shape)], -1)
    quads = np.stack([both[:-1, :-1], both[1:, :-1], both[1:, 1:], both[:-1, 1:]], 2)
    corners = quads.reshape(-1, 4, 6)[:, [[0, 1, 3], [1, 2, 3]]].reshape(-1, 3, 6)  # (m, corner, 6)
    sides = corners[:, 1:, :3] - corners[:, :1, :3]
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)  # (m,)
    return _indexed(corners[area > 1e-12].reshape(-1, 6))


def _indexed(corners: Array) -> Mesh:
    """The mesh of ``corners`` (3 m, 6), positions and normals, three rows a triangle. Corners that
    are equal in both are there once."""
    # ``first``: where each of the n different rows is first; ``place``: which of them a row is.
    _, first, place = np.unique(
        np.round(corners, 9), axis=0, return_index=True, return_inverse=True
    )
    order = np.argsort(first)  # In the order of their first use, which packs better.
    new = np.empty_like(order)  # (n,) where a row that np.unique has sorted goes.
    new[order] = np.arange(len(order))
    kept = corners[first[order]]
    return Mesh(kept[:, :3], kept[:, 3:], new[place].reshape(-1, 3))

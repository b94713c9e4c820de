"""A MuJoCo scene as meshes: what the cameras draw, for a page to draw once more.

MuJoCo says itself what it would draw: ``mjv_updateScene`` lists every visible shape with its colour
worked out, without OpenGL. So invisible helpers and collision shapes need no rule of ours. Two
things are left out: planes, which have no end, and markers smaller than ``BEAD``, which mean
something to the model's author only. Textures become their mean colour.

Meta-World moves bodies when an episode begins, by their poses; what they look like stays. Markers
such as the goal are moved by themselves and become bodies of their own.
"""

from __future__ import annotations

import mujoco
import numpy as np

from madviz.envs import shapes
from madviz.types import Array, Body, Part

BEAD = 0.015
"""Metres of radius."""
MAX_GEOMS = 2000
"""Shapes in a scene."""


class MuJoCoBodies:
    """The bodies of one model, and where they are."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """``data`` of an episode: what is visible is read from it."""
        parts: dict[int, list[Part]] = {}
        sites: dict[int, Part] = {}
        for geom in visible_scene(model, data)[1]:
            if geom.type == mujoco.mjtGeom.mjGEOM_PLANE:
                continue
            if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM:
                body = int(model.geom_bodyid[geom.objid])
                place = model.geom_pos[geom.objid]
                turn = model.geom_quat[geom.objid]
                part = shapes.part(_shape(model, geom), _colour(model, geom), place, turn)
                parts.setdefault(body, []).append(part)
            elif geom.objtype == mujoco.mjtObj.mjOBJ_SITE and max(geom.size) >= BEAD:
                sites[geom.objid] = shapes.part(_shape(model, geom), _colour(model, geom))
        self._bodies = list(parts)
        self._sites = list(sites)
        self.bodies = (
            *(Body(f"{model.body(i).name or 'body'}-{i}", tuple(p)) for i, p in parts.items()),
            *(Body(f"{model.site(i).name}-site-{i}", (part,)) for i, part in sites.items()),
        )

    def poses(self, data: mujoco.MjData) -> Array:
        """(N, 7) float32: position in metres and wxyz in the world, in the order of ``bodies``."""
        turns = np.empty((len(self._sites), 4))
        for row, site in zip(turns, self._sites, strict=True):
            mujoco.mju_mat2Quat(row, data.site_xmat[site])
        position = np.concatenate([data.xpos[self._bodies], data.site_xpos[self._sites]])
        turn = np.concatenate([data.xquat[self._bodies], turns])
        return np.concatenate([position, turn], 1).astype(np.float32)


def visible_scene(
    model: mujoco.MjModel, data: mujoco.MjData
) -> tuple[mujoco.MjvScene, list[mujoco.MjvGeom]]:
    """The scene that MuJoCo would draw of ``data``, and its shapes that are not transparent."""
    scene = mujoco.MjvScene(model, MAX_GEOMS)
    everything = mujoco.mjtCatBit.mjCAT_ALL.value
    mujoco.mjv_updateScene(
        model, data, mujoco.MjvOption(), None, mujoco.MjvCamera(), everything, scene
    )
    return scene, [geom for geom in scene.geoms[: scene.ngeom] if geom.rgba[3] > 0]


def _shape(model: mujoco.MjModel, geom: mujoco.MjvGeom) -> shapes.Shape:
    kind = mujoco.mjtGeom(int(geom.type))
    size = np.asarray(geom.size, float)
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        return _mesh(model, int(model.geom_dataid[geom.objid]))
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return shapes.cylinder(size[0], size[2])
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return shapes.capsule(size[0], size[2])
    if kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_ELLIPSOID):
        return shapes.sphere(size)
    return shapes.box(size)


def _mesh(model: mujoco.MjModel, mesh: int) -> shapes.Shape:
    vertex = model.mesh_vertadr[mesh]
    face = model.mesh_faceadr[mesh]
    vertices = model.mesh_vert[vertex : vertex + model.mesh_vertnum[mesh]]
    return vertices.copy(), model.mesh_face[face : face + model.mesh_facenum[mesh]].copy()


def _colour(model: mujoco.MjModel, geom: mujoco.MjvGeom) -> Array:
    """(3,) in [0, 1], with the mean of its texture if it has one."""
    colour = np.asarray(geom.rgba[:3], float)
    textures = model.mat_texid[geom.matid] if geom.matid >= 0 else np.array([-1])
    for texture in textures[textures >= 0]:
        start = model.tex_adr[texture]
        channels = model.tex_nchannel[texture]
        count = model.tex_width[texture] * model.tex_height[texture] * channels
        texels = model.tex_data[start : start + count].reshape(-1, channels)
        colour = colour * texels[:, :3].mean(0) / 255
    return colour

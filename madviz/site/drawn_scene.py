"""The scene of a task for a browser: shapes, materials, lights and textures.

MuJoCo says itself what is visible (``mjv_updateScene``). Each shape stands in the frame of a body,
or of a site such as the goal; where these are, the browser's simulation says. The Sawyer's meshes
are those of the ``fast`` profile, so that the policy sees what it was trained on.

A corner is stored in 12 bytes: position (3 x uint16 between the shape's own bounds; 5 micrometres
for a link of 0.3 m) and normal (3 x int16). Corners that are equal are stored once. Hammer has
16,000 triangles: 0.17 MB gzipped, and its textures are files of their own that tasks share.
"""

from __future__ import annotations

import json
from typing import Any

import mujoco
import numpy as np

from madviz.envs.mujoco.meshes import lighter_meshes
from madviz.envs.mujoco.mujoco_bodies import visible_scene
from madviz.errors import UserError
from madviz.site.tessellation import Mesh, cylinder, shape
from madviz.site.textures import Texture, read_textures
from madviz.types import Array

_SKY = -1
"""In place of a body: the sky goes where the camera goes."""


def drawn_scene(
    model: mujoco.MjModel, data: mujoco.MjData
) -> tuple[dict[str, Array], dict[str, Any], list[Texture]]:
    """Arrays (``positions``, ``normals``, ``triangles``), a description of them, and the textures
    in use. ``data`` of an episode: what is visible, and where the lights are, is read from it."""
    with lighter_meshes(model):
        scene, visible = visible_scene(model, data)
        meshes = [shape(model, geom) for geom in visible]
    shapes = [_shape(model, geom) for geom in visible]
    sky = _sky(model)
    if sky is not None:
        quality = model.vis.quality
        meshes.append(_inside_out(cylinder(quality.numslices, quality.numstacks)))
        shapes.append(sky)
    arrays = _arrays(meshes, shapes)
    used = sorted(
        {shape_row["texture"] for shape_row in shapes if shape_row["texture"] is not None}
    )
    for shape_row in shapes:
        shape_row["texture"] = (
            None if shape_row["texture"] is None else used.index(shape_row["texture"])
        )
    textures = read_textures(model)
    description = {
        "shapes": shapes,
        "lights": [_light(light) for light in scene.lights[: scene.nlight]],
        "near": model.vis.map.znear * model.stat.extent,
        "far": model.vis.map.zfar * model.stat.extent,
        "cubes": [textures[number].cube for number in used],
    }
    return arrays, description, [textures[number] for number in used]


def scene_file(arrays: dict[str, Array], description: dict[str, Any]) -> bytes:
    """Both in one file."""
    from safetensors.numpy import save

    return save(arrays, {"scene": json.dumps(description, allow_nan=False)})


def _arrays(meshes: list[Mesh], shapes: list[dict[str, Any]]) -> dict[str, Array]:
    """All corners and triangles one after another; each of ``shapes`` learns where its own are."""
    positions = []
    normals = []
    triangles = []
    corner = 0
    start = 0
    for mesh, row in zip(meshes, shapes, strict=True):
        low = mesh.positions.min(0)
        high = mesh.positions.max(0)
        span = np.where(high > low, high - low, 1.0)
        positions.append(np.round((mesh.positions - low) / span * 65535).astype(np.uint16))
        normals.append(np.round(mesh.normals * 32767).astype(np.int16))
        triangles.append(mesh.triangles + corner)
        row |= {
            "low": low.tolist(),
            "span": span.tolist(),
            "corners": [corner, len(mesh.positions)],
            "triangles": [start, len(mesh.triangles)],
        }
        corner = corner + len(mesh.positions)
        start = start + len(mesh.triangles)
    if corner > 65536:
        raise UserError(f"expected at most 65536 corners in a scene, found {corner}")
    return {
        "positions": np.concatenate(positions),
        "normals": np.concatenate(normals),
        "triangles": np.concatenate(triangles).astype(np.uint16),
    }


def _shape(model: mujoco.MjModel, geom: mujoco.MjvGeom) -> dict[str, Any]:
    number = int(geom.objid)
    if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM:
        frame = {"body": int(model.geom_bodyid[number])}
        place = model.geom_pos[number]
        turn = model.geom_quat[number]
    elif geom.objtype == mujoco.mjtObj.mjOBJ_SITE:
        # Sites are moved by themselves when an episode begins.
        frame = {"site": number}
        place = np.zeros(3)
        turn = np.array([1.0, 0, 0, 0])
    else:
        raise UserError(f"expected shapes and sites in a scene, found {geom.objtype}")
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, turn)
    texture = _texture(model, int(geom.matid))
    scale, shift = _mapping(model, geom, texture)
    return {
        **frame,
        "position": np.asarray(place, float).tolist(),
        "rotation": matrix.tolist(),
        "rgba": _plain(geom.rgba),
        "emission": float(geom.emission),
        "specular": float(geom.specular),
        "shininess": float(geom.shininess) * 128,
        "radius": float(geom.modelrbound),
        "plane": int(geom.type) == mujoco.mjtGeom.mjGEOM_PLANE.value,
        "texture": texture,
        "texture_scale": scale,
        "texture_shift": shift,
    }


def _texture(model: mujoco.MjModel, material: int) -> int | None:
    if material < 0:
        return None
    number = int(model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB.value])
    return number if number >= 0 else None


def _mapping(
    model: mujoco.MjModel, geom: mujoco.MjvGeom, texture: int | None
) -> tuple[list[float], list[float]]:
    """Texture coordinates are scale x position + shift, for each axis, as OpenGL generates them."""
    if texture is None:
        return [0.0] * 3, [0.0] * 3
    if geom.texcoord:
        raise UserError("expected textures without coordinates of their own, found a mesh with")
    size = np.asarray(geom.size, float)
    fixed = geom.dataid >= 0
    unit = np.ones(3) if fixed else 1 / size  # Meshes and planes are not scaled when drawn.
    uniform = bool(model.mat_texuniform[geom.matid])
    if model.tex_type[texture] != mujoco.mjtTexture.mjTEXTURE_2D.value:
        return (unit * (size if uniform else 1)).tolist(), [0.0] * 3
    repeat = model.mat_texrepeat[geom.matid].astype(float)
    for axis in range(2):
        if size[axis] > 0:
            repeat[axis] *= (1 / size[axis] if fixed else 1) * (size[axis] if uniform else 1)
    return [0.5 * repeat[0] * unit[0], -0.5 * repeat[1] * unit[1], 0.0], [-0.5, -0.5, 0.0]


def _sky(model: mujoco.MjModel) -> dict[str, Any] | None:
    """A cylinder about the camera, just inside of what is too far to draw."""
    kinds = list(model.tex_type)
    if mujoco.mjtTexture.mjTEXTURE_SKYBOX.value not in kinds:
        return None
    return {
        "body": _SKY,
        "position": [0.0] * 3,
        "rotation": np.eye(3).ravel().tolist(),
        "rgba": [1.0] * 4,
        "emission": 0.0,
        "specular": 0.0,
        "shininess": 0.0,
        "radius": 0.0,
        "plane": False,
        "texture": kinds.index(mujoco.mjtTexture.mjTEXTURE_SKYBOX.value),
        "texture_scale": [1.0] * 3,
        "texture_shift": [0.0] * 3,
    }


def _inside_out(mesh: Mesh) -> Mesh:
    return Mesh(mesh.positions, mesh.normals, mesh.triangles[:, ::-1])


def _light(light: mujoco.MjvLight) -> dict[str, Any]:
    if not light.directional:
        raise UserError("expected lights from far away in a scene, found one that is near")
    return {
        "headlight": bool(light.headlight),
        "direction": _plain(light.dir),
        "ambient": _plain(light.ambient),
        "diffuse": _plain(light.diffuse),
        "specular": _plain(light.specular),
    }


def _plain(values: Array) -> list[float]:
    return np.asarray(values, float).tolist()

"""Robot, table and objects on the page: one mesh for each body, sent once, then only moved.

A body reaches the browser as binary glTF, with one piece for each of its colours. Browsers average
the normals of all triangles that share a vertex, which would make a box look like a pillow. So
vertices are shared only between triangles that meet at less than ``CREASE`` degrees:

    box: 8 corners, 12 triangles, 3 sides meet in a corner at 90 degrees  ->  24 vertices

A browser without a GPU needs some 40 ms to draw the scene, whatever has moved in it. So poses go
out at most ten times a second, at full speed, when the machine is wanted elsewhere, three times;
and only of bodies that moved by more than can be seen.
"""

from __future__ import annotations

import json
import struct

import numpy as np
import viser

from madviz.app.panel import Assign
from madviz.session.frame import Frame
from madviz.types import Array, Body

CREASE = 40.0
"""Degrees between triangles from which on their edge is drawn sharp."""
STILL, UNTURNED = 0.0005, 0.002
"""Metres, and length of a quaternion's difference, below which a body has not moved."""


class Bodies:
    """The bodies of one visitor's scene."""

    def __init__(self, client: viser.ClientHandle, frame: Frame) -> None:
        self._client = client
        self._shown: tuple[Body, ...] = ()
        self._handles: list[viser.GlbHandle] = []
        self._poses = np.zeros((0, 7))
        self._show(frame)

    def update(self, frame: Frame) -> list[Assign]:
        """What has to change for the bodies to stand where ``frame`` has them."""
        if frame.bodies is not self._shown:
            self.remove()
            self._show(frame)
        away = np.abs(frame.body_poses - self._poses)
        moved = (away[:, :3].max(1) > STILL) | (away[:, 3:].max(1) > UNTURNED)
        changes = []
        for row in np.flatnonzero(moved):
            handle, pose = self._handles[row], frame.body_poses[row].astype(float)
            changes += [Assign(handle, "position", pose[:3]), Assign(handle, "wxyz", pose[3:])]
        self._poses[moved] = frame.body_poses[moved]
        return changes

    def remove(self) -> None:
        """Takes all of them off the page."""
        for handle in self._handles:
            handle.remove()
        self._handles, self._shown = [], ()

    def _show(self, frame: Frame) -> None:
        self._shown, self._poses = frame.bodies, frame.body_poses.copy()
        for body, pose in zip(frame.bodies, frame.body_poses.astype(float), strict=True):
            self._handles.append(
                self._client.scene.add_glb(
                    f"/bodies/{body.name}",
                    glb(body),
                    position=pose[:3],
                    wxyz=pose[3:],
                    cast_shadow=False,
                    receive_shadow=False,
                )
            )


def glb(body: Body) -> bytes:
    """Binary glTF of ``body``: one mesh, a piece and a material for each colour."""
    pieces: dict[tuple[int, ...], list[tuple[Array, Array]]] = {}
    for part in body.parts:
        key = tuple(int(value) for value in part.colour)
        pieces.setdefault(key, []).append(creased(part.vertices, part.faces))
    binary, views, accessors, primitives, materials = b"", [], [], [], []
    for colour, meshes in pieces.items():
        vertices, normals, faces = joined(meshes)
        for data, kind, target in ((vertices, 5126, 34962), (normals, 5126, 34962),
                                   (faces.reshape(-1), 5125, 34963)):  # fmt: skip
            views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": data.nbytes,
                          "target": target})  # fmt: skip
            accessor = {"bufferView": len(views) - 1, "componentType": kind, "count": len(data),
                        "type": "SCALAR" if kind == 5125 else "VEC3"}  # fmt: skip
            accessors.append(accessor)
            binary += data.tobytes()
        first = len(accessors) - 3
        accessors[first] |= {"min": vertices.min(0).tolist(), "max": vertices.max(0).tolist()}
        primitives.append({"attributes": {"POSITION": first, "NORMAL": first + 1},
                           "indices": first + 2, "material": len(materials)})  # fmt: skip
        surface = {"baseColorFactor": linear(colour), "metallicFactor": 0, "roughnessFactor": 0.7}
        materials.append({"pbrMetallicRoughness": surface})
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": primitives}],
        "buffers": [{"byteLength": len(binary)}],
        "bufferViews": views,
        "accessors": accessors,
        "materials": materials,
    }
    return _container(json.dumps(document).encode(), binary)


def _container(text: bytes, binary: bytes) -> bytes:
    """The two chunks of a GLB file. Every number in ``binary`` has four bytes, so it needs no
    padding."""
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def linear(colour: tuple[int, ...]) -> list[float]:
    """RGBA as glTF wants it, linear in light, of an sRGB colour 0..255."""
    share = np.array(colour) / 255
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return [*light.round(5).tolist(), 1.0]


def joined(meshes: list[tuple[Array, Array]]) -> tuple[Array, Array, Array]:
    """One mesh of many: vertices (n, 3), normals (n, 3) float32 and triangles (m, 3) uint32."""
    shift = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    vertices = np.concatenate([vertices for vertices, _ in meshes]).astype(np.float32)
    faces = np.concatenate([f + at for (_, f), at in zip(meshes, shift, strict=False)])
    across = _across(vertices, faces)
    normals = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normals, faces[:, k], across)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return vertices, normals, faces.astype(np.uint32)


def creased(vertices: Array, faces: Array) -> tuple[Array, Array]:
    """The same triangles (m, 3), with vertices (n, 3) shared only where the surface is smooth."""
    _, first, place = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    corner = place.reshape(-1)[faces].reshape(-1)  # (3m,) which place each corner is at.
    across = np.repeat(_across(vertices, faces), 3, axis=0)
    unit = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-20)
    order = np.argsort(corner, kind="stable")
    _, start, count = np.unique(corner[order], return_index=True, return_counts=True)
    # Every corner with every corner at the same place, as two lists of equal length.
    many = np.repeat(count, count)
    one = np.repeat(order, many)
    begin = np.repeat(np.repeat(start, count), many)
    other = order[begin + np.arange(len(one)) - np.repeat(np.cumsum(many) - many, many)]
    alike = (unit[one] * unit[other]).sum(1) > np.cos(np.radians(CREASE))
    normal = np.zeros_like(across)
    np.add.at(normal, one[alike], across[other[alike]])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
    keys = np.c_[corner, np.round(normal, 2)]
    _, chosen, index = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return vertices[first][corner[chosen]], index.reshape(-1, 3)


def _across(vertices: Array, faces: Array) -> Array:
    """(m, 3) normals of triangles, as long as twice their area."""
    a, b, c = (vertices[faces[:, k]].astype(float) for k in range(3))
    return np.cross(b - a, c - a)

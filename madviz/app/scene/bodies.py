"""Robot, table and objects on the page: one mesh for each body, sent once, then only moved.

A body reaches the browser as binary glTF, with one piece for each of its colours. Browsers average
the normals of all triangles that share a vertex, which would round off a box. So vertices are
shared only between triangles that are joined across edges of less than ``CREASE`` degrees:

    box: 8 corners, 12 triangles, 3 sides meet in a corner at 90 degrees  ->  24 vertices

A body whose pose changed by less than can be seen stays where it is on the page.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
import viser
from trimesh.exchange.gltf import export_glb
from trimesh.graph import smooth_shade
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from madviz.app.panel import Assign
from madviz.session.frame import Frame
from madviz.types import Array, Body

CREASE = 30.0
"""Degrees between triangles from which on their edge is drawn sharp."""
STILL = 0.0005
UNTURNED = 0.002
"""Metres, and difference of a quaternion's components, below which a body has not moved."""


class Bodies:
    """The bodies of one visitor's scene."""

    def __init__(self, client: viser.ClientHandle) -> None:
        self._client = client
        self._shown: tuple[Body, ...] = ()
        self._handles: list[viser.GlbHandle] = []
        """None before the first update: the cameras' pictures come first."""
        self._poses: Array = np.zeros((0, 7))

    def update(self, frame: Frame) -> list[Assign]:
        """The changes by which the bodies stand where ``frame`` has them."""
        if frame.world.bodies is not self._shown:
            self.remove()
            self._show(frame)
        away = np.abs(frame.world.body_poses - self._poses)  # (N, 7)
        moved = (away[:, :3].max(1) > STILL) | (away[:, 3:].max(1) > UNTURNED)  # (N,)
        changes = []
        for row in np.flatnonzero(moved):
            handle = self._handles[row]
            pose = frame.world.body_poses[row].astype(float)  # (7,)
            changes += [Assign(handle, "position", pose[:3]), Assign(handle, "wxyz", pose[3:])]
        self._poses[moved] = frame.world.body_poses[moved]
        return changes

    def remove(self) -> None:
        """Takes all of them off the page."""
        for handle in self._handles:
            handle.remove()
        self._handles = []
        self._shown = ()

    def _show(self, frame: Frame) -> None:
        """Sends all bodies of ``frame`` to the page."""
        self._shown = frame.world.bodies
        self._poses = frame.world.body_poses.copy()  # (N, 7): x y z, then a quaternion w x y z
        self._handles = [
            self._add(body, pose.astype(float))
            for body, pose in zip(self._shown, self._poses, strict=True)
        ]

    def _add(self, body: Body, pose: Array) -> viser.GlbHandle:
        return self._client.scene.add_glb(
            f"/bodies/{body.name}",
            glb(body),
            position=pose[:3],
            wxyz=pose[3:],
            cast_shadow=False,
            receive_shadow=False,
        )


def glb(body: Body) -> bytes:
    """Binary glTF of ``body``: a piece and a material for each of its colours."""
    pieces: dict[tuple[int, ...], list[trimesh.Trimesh]] = {}
    for part in body.parts:
        mesh = trimesh.Trimesh(part.vertices, part.faces)
        sharp = smooth_shade(mesh, np.radians(CREASE), facet_minarea=None)
        pieces.setdefault(tuple(part.colour.tolist()), []).append(sharp)
    scene = trimesh.Scene()
    for colour, meshes in pieces.items():
        piece: Any = trimesh.util.concatenate(meshes)
        surface = PBRMaterial(name=_hex(colour), metallicFactor=0.0, roughnessFactor=0.7)
        piece.visual = TextureVisuals(material=surface)
        scene.add_geometry(piece)
    linear_colours = {_hex(colour): linear(colour) for colour in pieces}

    def set_colours(document: dict[str, Any]) -> None:
        """trimesh would round the factors to 1/255, which is coarse for dark colours."""
        for material in document["materials"]:
            factor = linear_colours[material["name"]]
            material["pbrMetallicRoughness"]["baseColorFactor"] = factor

    return export_glb(scene, include_normals=True, tree_postprocessor=set_colours)


def _hex(colour: tuple[int, ...]) -> str:
    return "#" + bytes(colour).hex()


def linear(colour: tuple[int, ...]) -> list[float]:
    """RGBA as glTF wants it, linear in light, of an sRGB colour 0..255."""
    share = np.array(colour) / 255
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return [*light.round(5).tolist(), 1.0]

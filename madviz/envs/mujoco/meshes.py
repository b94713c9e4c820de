"""A lighter robot for the ``fast`` render profile: what is uploaded to OpenGL, not what collides.

A software renderer spends its time on vertices: the Sawyer's eleven meshes hold 67,000 triangles,
and a view of 8 pixels costs as much as one of 84. Quadric decimation to 1,000 triangles a mesh
(12,000 in all) halves the time of a view, and at 84 pixels the mean change of a pixel is 1 of 255.

MuJoCo copies meshes to OpenGL when a context is made. So the decimated ones stand in the model's
own arrays only during that moment; physics never sees them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import mujoco
import numpy as np

from madviz.envs.decimation import TRIANGLES, simplify
from madviz.types import Array

_CHANGED = (
    "mesh_vert",
    "mesh_vertnum",
    "mesh_face",
    "mesh_facenum",
    "mesh_normal",
    "mesh_facenormal",
)


@contextmanager
def lighter_meshes(model: mujoco.MjModel) -> Iterator[None]:
    """Inside, heavy meshes without a texture are decimated; afterwards all is as before, to the
    bit.
    """
    before = {name: getattr(model, name).copy() for name in _CHANGED}
    try:
        for mesh in range(model.nmesh):
            textured = model.mesh_texcoordadr[mesh] >= 0
            if model.mesh_facenum[mesh] > TRIANGLES and not textured:
                _decimate(model, mesh)
        yield
    finally:
        for name, values in before.items():
            getattr(model, name)[:] = values


def _decimate(model: mujoco.MjModel, mesh: int) -> None:
    """Puts the smaller mesh into the places of the larger one."""
    vertex = model.mesh_vertadr[mesh]
    face = model.mesh_faceadr[mesh]
    vertices = model.mesh_vert[vertex : vertex + model.mesh_vertnum[mesh]]
    faces = model.mesh_face[face : face + model.mesh_facenum[mesh]]
    share = 1 - TRIANGLES / len(faces)
    small, triangles = simplify(vertices.copy(), faces.copy(), share)
    normals = _vertex_normals(small, triangles)
    normal = model.mesh_normaladr[mesh]
    if len(small) > min(model.mesh_vertnum[mesh], model.mesh_normalnum[mesh]):
        return  # It would not fit; the mesh stays as it is.
    model.mesh_vert[vertex : vertex + len(small)] = small
    model.mesh_normal[normal : normal + len(small)] = normals
    for faces_of in (model.mesh_face, model.mesh_facenormal):
        faces_of[face : face + len(triangles)] = triangles
    model.mesh_vertnum[mesh] = len(small)
    model.mesh_facenum[mesh] = len(triangles)


def _vertex_normals(vertices: Array, triangles: Array) -> Array:
    """(n, 3) unit normals, the area-weighted mean of the adjoining triangles'."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    normals = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normals, triangles[:, k], np.cross(b - a, c - a))
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)

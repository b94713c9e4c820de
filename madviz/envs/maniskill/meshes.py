"""A lighter scene for the fast render profile: the same shapes with far fewer triangles.

Nearly all of a ManiSkill frame on a CPU goes into 580,000 triangles, however small the picture: the
wrist camera's housing alone has 425,160, the ground 20,000. Here every visual mesh over
``TRIANGLES`` is decimated (quadric error) and shaded anew: normals are averaged over neighbouring
triangles that meet at less than ``CREASE`` degrees, so round things stay round and edges sharp.
A mesh with a texture is touched only if it is flat and convex with texture coordinates linear in
position, as the ground's are; then two triangles draw the same. Collision meshes are never touched.

Decimating takes a few seconds at first, so results are cached in the user's cache folder under a
digest of the mesh and the settings. Three views of 84 pixels then take an eighth of the time. That
housing is a file of one mesh, which the robot's description gives its material. The next scene is
built without loading it (``light_files``): that saves 0.5 s, and 120 MB that SAPIEN keeps of it.
"""

from __future__ import annotations

import hashlib
import io
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from madviz.envs.decimation import TRIANGLES, decimate
from madviz.system.files import cache_folder, write_bytes
from madviz.types import Array

CREASE = 40.0
"""Degrees between triangles from which on their edge is drawn sharp."""
_FORMAT = 2
"""Goes up when what is computed here changes, so that old caches are not read."""

_REPLACING = threading.Lock()

Mesh = tuple[Array, Array, Array, Array]
"""Vertices (n, 3), triangles (m, 3), normals (n, 3), texture coordinates (n, 2)."""


def lighten(scene: Any) -> None:
    """Replaces the heavy visual meshes of a SAPIEN scene, once, after it is built."""
    import sapien.render

    for entity in scene.entities:
        body = entity.find_component_by_type(sapien.render.RenderBodyComponent)
        if body is None or not any(_heavy(shape) for shape in body.render_shapes):
            continue
        lighter = sapien.render.RenderBodyComponent()
        for shape in body.render_shapes:
            for new_shape in _lighter_shapes(shape):
                lighter.attach(new_shape)
        lighter.visibility = body.visibility
        entity.remove_component(body)
        entity.add_component(lighter)


@contextmanager
def light_files() -> Iterator[None]:
    """A scene that this thread builds meanwhile gets the light mesh of a file that was made lighter
    before, where its material is not the file's own. SAPIEN's loaders have no place for that, so
    the class that they call is replaced for as long."""
    from sapien.pysapien import render

    loaders: Any = render
    builder = threading.get_ident()
    with _REPLACING:
        stock = loaders.RenderShapeTriangleMesh

        def shape(*given: Any, **named: Any) -> Any:
            if threading.get_ident() == builder and len(given) == 3 and given[2] is not None:
                file, scale, material = given
                if (light := _cached(_of_file(file))) is not None:
                    made = stock(*light, material)
                    made.scale = scale
                    return made
            return stock(*given, **named)

        loaders.RenderShapeTriangleMesh = shape
        try:
            yield
        finally:
            loaders.RenderShapeTriangleMesh = stock


def _heavy(shape: Any) -> bool:
    return any(len(part.triangles) > TRIANGLES for part in getattr(shape, "parts", ()))


def _lighter_shapes(shape: Any) -> list[Any]:
    """New shapes, one for each part; a shape that belongs to a scene cannot be used again."""
    import sapien.render

    made = []
    for part in shape.parts:
        mesh = (part.vertices, part.triangles, part.get_vertex_normal(), part.get_vertex_uv())
        textured = part.material.base_color_texture is not None
        mesh = lighter(mesh, textured, file_of(shape)) if len(mesh[1]) > TRIANGLES else mesh
        new_shape = sapien.render.RenderShapeTriangleMesh(*mesh, part.material)
        new_shape.local_pose = shape.local_pose
        new_shape.scale = shape.scale
        made.append(new_shape)
    return made


def file_of(shape: Any) -> str:
    """The file that a ``shape`` was loaded from; '' if it has several meshes, or is from none."""
    return getattr(shape, "filename", "") if len(shape.parts) == 1 else ""


def lighter(mesh: Mesh, textured: bool, file: str = "") -> Mesh:
    """A mesh that looks like ``mesh``, the only one of ``file`` if that is given; from the cache
    where it has been made before."""
    if textured:
        return flat_rectangle(mesh) or mesh
    path = _of_file(file) if file else _cache_of(mesh[0].tobytes(), mesh[1].tobytes())
    if (known := _cached(path)) is not None:
        return known
    made = shade(*decimate(mesh[0], mesh[1]))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        content = io.BytesIO()
        np.savez(
            content, **dict(zip(("vertices", "triangles", "normals", "uvs"), made, strict=True))
        )
        write_bytes(path, content.getvalue())
    except OSError:
        pass  # A home that cannot be written costs the same seconds next time.
    return made


def _of_file(file: str) -> Path:
    return _cache_of(Path(file).read_bytes())


def _cache_of(*contents: bytes) -> Path:
    digest = hashlib.sha256(f"{_FORMAT} {TRIANGLES} {CREASE}".encode())
    for content in contents:
        digest.update(content)
    return cache_folder() / "meshes" / f"{digest.hexdigest()[:32]}.npz"


def _cached(path: Path) -> Mesh | None:
    try:
        with np.load(path, allow_pickle=False) as cached:
            return cached["vertices"], cached["triangles"], cached["normals"], cached["uvs"]
    except (OSError, ValueError, KeyError):
        return None


def shade(vertices: Array, triangles: Array) -> Mesh:
    """The mesh with a vertex for every corner of a triangle, and normals by ``CREASE``."""
    corners = vertices[triangles]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    unit = flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
    normals = np.zeros_like(corners)
    around: dict[int, list[int]] = {}
    for triangle, three in enumerate(triangles):
        for vertex in three:
            around.setdefault(int(vertex), []).append(triangle)
    for vertex, near in around.items():
        alike = unit[near] @ unit[near].T > np.cos(np.radians(CREASE))
        for triangle, mean in zip(near, alike @ flat[near], strict=True):
            normals[triangle, triangles[triangle] == vertex] = mean
    normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-12)
    count = 3 * len(triangles)
    order = np.arange(count, dtype=np.uint32).reshape(-1, 3)
    uvs = np.zeros((count, 2), np.float32)
    return (
        corners.reshape(-1, 3).astype(np.float32),
        order,
        normals.reshape(-1, 3).astype(np.float32),
        uvs,
    )


def flat_rectangle(mesh: Mesh) -> Mesh | None:
    """Two triangles for a level rectangle in x and y whose texture is linear in them; None for any
    other mesh."""
    vertices, triangles, normals, uvs = (np.asarray(array) for array in mesh)
    low = vertices.min(0)
    high = vertices.max(0)
    a, b, c = (vertices[triangles[:, k], :2].astype(float) for k in range(3))
    (p, q), (r, s) = (b - a).T, (c - a).T
    covered = np.abs(p * s - q * r).sum() / 2
    known = np.c_[vertices[:, :2], np.ones(len(vertices))].astype(float)
    linear, *_ = np.linalg.lstsq(known, uvs.astype(float), rcond=None)
    level = high[2] - low[2] < 1e-6
    fills = np.isclose(covered, np.prod((high - low)[:2].astype(float)), rtol=1e-4)
    if not (level and fills and np.abs(known @ linear - uvs).max() < 1e-4):
        return None
    places = [(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])]
    corners = np.array([(x, y, low[2]) for x, y in places], np.float32)
    faces = np.array([(0, 1, 2), (0, 2, 3)], np.uint32)
    uv = (np.c_[corners[:, :2], np.ones(4)] @ linear).astype(np.float32)
    return corners, faces, np.repeat(normals[:1], 4, 0).astype(np.float32), uv

"""Where to view a scene from: everything that matters in sight, as large as it can be.

The scene has the space between two panels, 312 x 800 pixels in a small window and 800 x 1080 in a
large one, so a fixed place would cut things off in the first or lose them in the second. Given the
direction, the nearest place from which all points are in the picture has a closed form. With x to
the right, z ahead and ``a`` the tangent of half the field of view, a camera at (e, f) sees the
points whose |x - e| <= a (z - f), so

    e - a f >= max(x - a z) = P,    e + a f <= min(x + a z) = M
    f = (M - P) / 2a,  e = (M + P) / 2        (the same up and down; the smaller f counts)

The page and recordings for rerun open with the same view; nothing here depends on viser.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from madviz.session.frame import Frame
from madviz.types import Array

FOV = float(np.radians(50))
"""Vertical field of view; less than viser's 75 degrees, which bends what is at the edge."""
DOWN = 0.6
"""Metres down for each metre ahead, of the direction of the first view."""
MARGIN = (0.84, 0.94)
"""Share of the picture that the points may fill, across and up; labels are wider than points."""
WIDTH = 0.24
WIDTH_ON_BODY = 0.14
"""How wide a frustum's picture is, as a share of the scene; one on the hand must not hide it."""


def nearest_place(points: Array, ahead: Array, aspect: float, fov: float = FOV) -> Array:
    """(3,) where a camera that looks along ``ahead`` (3,), z upwards, has all ``points`` (n, 3) in
    sight; ``aspect`` is the picture's width by its height, ``fov`` its vertical field of view in
    radians."""
    axes = _axes(ahead)
    x, y, z = (points @ axes.T).T
    half = np.tan(fov / 2)
    places = []
    for along, tangent in ((x, MARGIN[0] * half * aspect), (y, MARGIN[1] * half)):
        most = (along - tangent * z).max()
        least = (along + tangent * z).min()
        places.append(((least + most) / 2, (least - most) / (2 * tangent)))
    depth = min(place[1] for place in places)
    return np.array([places[0][0], places[1][0], depth]) @ axes


def place_and_target(
    points: Array, ahead: Array, aspect: float, fov: float = FOV
) -> tuple[Array, Array]:
    """(3,) the position of a camera, and (3,) the point it looks at: the nearest place, and as far
    ahead of it as the ``points`` are on average, so that a viewer turns about them."""
    place = nearest_place(points, ahead, aspect, fov)
    ahead = ahead / np.linalg.norm(ahead)
    return place, place + float(((points - place) @ ahead).mean()) * ahead


def best_direction(points: Array, pictures: Array, facing: Array, hand: Array) -> Array:
    """(3,) the direction to look along, of unit length: the best of 36, all looking down alike.

    Good is what keeps apart, on the screen, the cameras' ``pictures`` (C, 3) and the ``hand``
    (3,); what sees pictures from behind their cameras, which look along ``facing`` (C, 3), and so
    the right way round; and what faces the robot from the side of its hand. ``points`` (n, 3)
    are all that must be seen; most of them are the robot's.
    """
    reach = hand[:2] - points[:, :2].mean(0)
    reach = reach / max(float(np.linalg.norm(reach)), 1e-6)
    best = np.array([1.0, 0.0, -DOWN])
    most = -np.inf
    for angle in np.arange(36) * np.pi / 18:
        level = np.array([np.cos(angle), np.sin(angle)])
        ahead = np.array([*level, -DOWN])
        places = np.vstack([pictures, hand, points.mean(0)])
        x, y, z = ((places - nearest_place(points, ahead, 1.0)) @ _axes(ahead).T).T
        flat = np.c_[x, y] / (z[:, None] * np.tan(FOV / 2))
        gaps = np.linalg.norm(flat[:, None] - flat, axis=2) + 9 * np.eye(len(flat))
        shown = np.minimum(facing @ ahead / np.linalg.norm(ahead), 0.5).mean()
        score = 2 * np.minimum(gaps.min(1), 0.5).mean() + 2 * shown - 0.3 * (reach @ level)
        if score > most:
            best = ahead
            most = score
    return best / np.linalg.norm(best)


def first_view(frame: Frame) -> tuple[Array, Array]:
    """The points that must be in view at first, (n, 3), and along which direction (3,):
    cameras, the hand and whatever is on the table."""
    size = extent(frame)
    pictures = []
    points = []
    for name, pose in frame.world.poses.items():
        half = (WIDTH_ON_BODY if frame.world.env.camera(name).body else WIDTH) * size / 2
        ahead = half / np.tan(np.radians(pose.fovy) / 2)
        corners = np.array([[x * half, y * half, ahead] for x in (-1, 1) for y in (-1, 1)])
        seen = _to_world(np.vstack([np.zeros(3), corners]), np.r_[pose.position, pose.wxyz])
        pictures.append(seen[1:].mean(0))
        points.append(seen)
    points += things(frame)
    seen = np.concatenate(points)
    places = np.array(pictures)
    facing = places - np.array([frame.world.poses[name].position for name in frame.world.poses])
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    return seen, best_direction(seen, places, facing, frame.world.hand)


def things(frame: Frame) -> list[Array]:
    """(n, 3) each: the robot's hand, and whatever is no table and not under it."""
    size = extent(frame)
    points = [
        frame.world.hand + 0.2 * size * np.array([[1, 1, 0], [-1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    ]
    for body, pose in zip(frame.world.bodies, frame.world.body_poses, strict=True):
        here = _to_world(np.concatenate([part.vertices for part in body.parts]), pose)
        ends = np.c_[here.min(0), here.max(0)]
        if np.ptp(ends[:2], axis=1).max() < size and ends[2, 1] >= 0:  # No table, nothing under it.
            ends[2, 0] = max(ends[2, 0], 0.0)
            points.append(np.array(np.meshgrid(*ends)).reshape(3, -1).T)
    return points


def _to_world(points: Array, pose: Array) -> Array:
    turned = Rotation.from_quat(np.asarray(pose[3:], float), scalar_first=True).apply(points)
    return turned + np.asarray(pose[:3], float)


def extent(frame: Frame) -> float:
    """Metres: the largest distance of a camera from what they all look at, at least 0.5."""
    centre = focus(frame)
    distances = [
        float(np.linalg.norm(pose.position - centre)) for pose in frame.world.poses.values()
    ]
    return max(0.5, max(distances))


def focus(frame: Frame) -> Array:
    """(3,) the point nearest to all lines of sight, by least squares."""
    left = np.zeros((3, 3))
    right = np.zeros(3)
    for pose in frame.world.poses.values():
        w, x, y, z = pose.wxyz
        axis = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
        across = np.eye(3) - np.outer(axis, axis)
        left = left + across
        right = right + across @ pose.position
    return np.linalg.lstsq(left, right, rcond=None)[0] if np.isfinite(left).all() else np.zeros(3)


def _axes(ahead: Array) -> Array:
    """(3, 3) rows: right, up and ahead, all of length 1."""
    ahead = np.asarray(ahead, float) / np.linalg.norm(ahead)
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(right, ahead), ahead])

"""Where it happens: camera frusta at their effective poses, with what they send. Click to drop one.

Pictures on frusta are the dearest thing on the page for a browser without a GPU: each new one makes
it stop until everything before is drawn, some 40 ms, and then draw the whole scene. So they follow
twice a second; at full speed, when the machine is wanted elsewhere, one camera after the other; and
that of a camera which is touched at once.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import viser

from madviz.ablations import CameraState
from madviz.app.colours import camera_colours, rgb
from madviz.app.panel import Assign
from madviz.frame import Frame
from madviz.types import Array

PERIOD = 0.5
"""Seconds between two pictures on a frustum while nothing else happens."""


class ScenePanel:
    """Frusta, labels and a grid under them, for one visitor."""

    def __init__(
        self,
        client: viser.ClientHandle,
        frame: Frame,
        on_click: Callable[[str], None] | None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clock, self._drawn = clock, -PERIOD
        self._states: dict[str, CameraState] = {}
        self._next = 0
        self._frusta: dict[str, viser.CameraFrustumHandle] = {}
        self._nodes: list = []
        colours = camera_colours(frame.env.cameras)
        self._size = _extent(frame)
        with client.atomic():
            self._ground(client, frame)
            for camera in frame.env.cameras:
                self._add(client, frame, camera.name, colours[camera.name], on_click)
        _look(client, frame)

    def update(self, frame: Frame) -> list[Assign]:
        names = self._turn(frame)
        colours = camera_colours(frame.env.cameras)
        changes = []
        for name in names:
            handle = self._frusta[name]
            pose, off = frame.poses[name], frame.camera(name).input == "off"
            changes += [
                Assign(handle, "image", picture(frame, name)),
                Assign(handle, "color", (110, 112, 116) if off else rgb(colours[name])),
                Assign(handle, "position", tuple(map(float, pose.position))),
                Assign(handle, "wxyz", tuple(map(float, pose.wxyz))),
            ]
        return changes

    def _turn(self, frame: Frame) -> list[str]:
        """The cameras whose frusta are brought up to date with this frame."""
        now, names = self._clock(), [name for name in self._frusta if name in frame.poses]
        states = {name: frame.camera(name) for name in names}
        touched = [name for name in names if states[name] != self._states.get(name)]
        self._states = states
        if now - self._drawn < PERIOD:
            return touched
        self._drawn = now
        if touched:
            return touched
        if frame.speed is not None:
            return names
        self._next = (self._next + 1) % len(names)
        return [names[self._next]]

    def remove(self) -> None:
        for node in self._nodes:
            node.remove()

    def _ground(self, client: viser.ClientHandle, frame: Frame) -> None:
        centre, size = _focus(frame), 2 * self._size
        self._nodes.append(
            client.scene.add_grid(
                "/ground",
                width=size,
                height=size,
                cell_size=size / 12,
                section_size=size / 4,
                cell_color=(70, 72, 76),
                section_color=(95, 98, 104),
                position=(float(centre[0]), float(centre[1]), 0.0),
            )
        )

    def _add(
        self,
        client: viser.ClientHandle,
        frame: Frame,
        name: str,
        colour: str,
        on_click: Callable[[str], None] | None,
    ) -> None:
        pose = frame.poses[name]
        frustum = client.scene.add_camera_frustum(
            f"/cameras/{name}",
            fov=float(np.radians(pose.fovy)),
            aspect=1.0,
            scale=0.16 * self._size,
            thickness=0.008 * self._size,
            color=rgb(colour),
            image=picture(frame, name),
            format="jpeg",
            jpeg_quality=80,
            position=np.asarray(pose.position, float),
            wxyz=np.asarray(pose.wxyz, float),
            cast_shadow=False,
            receive_shadow=False,
        )
        if on_click is not None:
            frustum.on_click(lambda _: on_click(name))
        label = client.scene.add_label(f"/cameras/{name}/label", frame.env.camera(name).label)
        self._frusta[name] = frustum
        self._nodes += [label, frustum]


def picture(frame: Frame, camera: str) -> Array:
    """(H, W, 3) uint8: what arrives of the camera's colour; dim and grey where it is dropped."""
    raw = frame.views[camera].rgb
    if frame.camera(camera).input == "off":
        return (0.25 * raw.mean(axis=2, keepdims=True)).astype(np.uint8).repeat(3, axis=2)
    for name in (f"{camera}.rgb", camera):
        if name in frame.arrived:
            return frame.arrived[name]
    return raw


def _extent(frame: Frame) -> float:
    """Metres: how far the cameras are from what they look at."""
    centre = _focus(frame)
    distances = [float(np.linalg.norm(pose.position - centre)) for pose in frame.poses.values()]
    return max(0.5, max(distances))


def _focus(frame: Frame) -> Array:
    """(3,) the point nearest to all lines of sight, by least squares."""
    left, right = np.zeros((3, 3)), np.zeros(3)
    for pose in frame.poses.values():
        w, x, y, z = pose.wxyz
        axis = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
        across = np.eye(3) - np.outer(axis, axis)
        left, right = left + across, right + across @ pose.position
    return np.linalg.lstsq(left, right, rcond=None)[0] if np.isfinite(left).all() else np.zeros(3)


def _look(client: viser.ClientHandle, frame: Frame) -> None:
    """Puts the visitor where all frusta are in sight: behind and above them."""
    centre = _focus(frame)
    positions = np.array([pose.position for pose in frame.poses.values()])
    middle = (positions.mean(0) + centre) / 2
    away = positions.mean(0) - centre
    side = np.array([away[0], away[1], 0.0])
    side = side / np.linalg.norm(side) if np.linalg.norm(side) > 0.05 else np.array([0.7, -0.7, 0])
    turned = np.array([side[0] - 0.8 * side[1], side[1] + 0.8 * side[0], 0.0])
    size = _extent(frame)
    client.camera.position = middle + 2.1 * size * turned + np.array([0, 0, 1.3 * size])
    client.camera.look_at = middle

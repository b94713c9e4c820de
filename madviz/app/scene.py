"""Where it happens: camera frusta at their effective poses, with what they send. Click to drop one.

Pictures on frusta are the dearest thing on the page for a browser without a GPU: each new one makes
it stop until everything before is drawn, some 40 ms, and then draw the whole scene. So they follow
twice a second, and at once when their camera is touched; at full speed, when the machine is wanted
elsewhere, one every two seconds, those that were touched first. Colours follow at once.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import viser

from madviz.app.colours import camera_colours, rgb
from madviz.app.panel import Assign
from madviz.frame import Frame
from madviz.types import Array

PERIOD, PERIOD_AT_FULL_SPEED = 0.5, 2.0
"""Seconds between two times that pictures change; at full speed, one of them."""
OFF = (110, 112, 116)
"""The colour of a dropped camera."""


class ScenePanel:
    """Frusta, labels and a grid under them, for one visitor."""

    def __init__(
        self,
        client: viser.ClientHandle,
        frame: Frame,
        on_click: Callable[[str], None] | None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clock, self._drawn = clock, -PERIOD_AT_FULL_SPEED
        self._states = {name: frame.camera(name) for name in frame.poses}
        self._next = 0
        self._frusta: dict[str, viser.CameraFrustumHandle] = {}
        self._nodes: list = []
        self._colours = colours = camera_colours(frame.env.cameras)
        self._size = _extent(frame)
        with client.atomic():
            self._ground(client, frame)
            for camera in frame.env.cameras:
                self._add(client, frame, camera.name, colours[camera.name], on_click)
        _look(client, frame)

    def update(self, frame: Frame) -> list[Assign]:
        pictures, changes = self._turn(frame), []
        for name, handle in self._frusta.items():
            off = frame.camera(name).input == "off"
            changes.append(Assign(handle, "color", OFF if off else rgb(self._colours[name])))
            if name in pictures:
                pose = frame.poses[name]
                changes += [
                    Assign(handle, "image", picture(frame, name)),
                    Assign(handle, "position", tuple(map(float, pose.position))),
                    Assign(handle, "wxyz", tuple(map(float, pose.wxyz))),
                ]
        return changes

    def _turn(self, frame: Frame) -> list[str]:
        """The cameras whose picture and pose are brought up to date with this frame."""
        states = {name: frame.camera(name) for name in self._frusta if name in frame.poses}
        stale = [name for name in states if states[name] != self._states.get(name)]
        slow, now = frame.speed is not None, self._clock()
        if now - self._drawn < (PERIOD if slow else PERIOD_AT_FULL_SPEED) and not (slow and stale):
            return []
        self._drawn = now
        if not slow:  # One only, and first those that look different from what is the case.
            self._next = (self._next + (not stale)) % len(states)
            stale = stale[:1] or [list(states)[self._next]]
        elif not stale:
            stale = list(states)
        self._states.update({name: states[name] for name in stale})
        return stale

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

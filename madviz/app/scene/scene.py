"""Where it happens: robot, table and objects, moving, and the cameras with what they send.

Everything in the scene costs a browser without a GPU some 40 ms whenever any of it changes, and
pictures on frusta cost most: each new one makes it stop until everything before is drawn. So
bodies and frusta move at most ten times a second, and pictures follow twice a second, or when their
camera is touched. At full speed, when simulator and policy need the machine, things move three
times a second, and one picture changes every two seconds, those that were touched first. When an
episode stands still, nothing waits. Colours follow at once.

A frustum stands where its camera does, moved or not, in the camera's own colour and with what
arrives of it. Dropped, it is grey and its picture dim. Occluded, its picture has a striped frame:
the colour says which camera it is and must not change, and a frozen picture looks like any other.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import viser

from madviz.app.panel import Assign, Panel
from madviz.app.pictures import picture
from madviz.app.scene.bodies import Bodies
from madviz.app.scene.fitted_view import FittedView
from madviz.app.toolkit import guarded, heard
from madviz.drawing.colours import camera_colours, rgb
from madviz.drawing.viewpoint import WIDTH, WIDTH_ON_BODY, extent, first_view
from madviz.session.frame import Frame
from madviz.types import CameraPose

PERIOD = 0.5
PERIOD_AT_FULL_SPEED = 2.0
"""Seconds between two times that pictures change; at full speed, one of them."""
MOVE = 0.09
MOVE_AT_FULL_SPEED = 0.3
"""Seconds between two times that things move; a little less than a step at normal speed."""
AFTER_TOUCH = 0.2
"""Seconds at full speed in which nothing of the scene is in the way of what was just touched: a
browser takes messages in order, and those behind a change of the scene wait until it is drawn."""
OFF = (110, 112, 116)
"""The colour of a dropped camera."""


class ScenePanel(Panel):
    """Bodies, frusta and their labels, for one visitor. Clicking a frustum calls ``on_click``."""

    def __init__(
        self,
        client: viser.ClientHandle,
        frame: Frame,
        on_click: Callable[[str], None] | None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clock = clock
        self._change = frame.world.change
        self._touched = -AFTER_TOUCH
        self._drawn = -PERIOD_AT_FULL_SPEED
        self._moved = -MOVE_AT_FULL_SPEED
        self._states = {name: frame.camera(name) for name in frame.world.poses}
        self._next = 0
        self._still = frame.pace.number
        """Whose turn it is at full speed, and the last frame of which all pictures are shown."""
        self._frusta: dict[str, viser.CameraFrustumHandle] = {}
        self._placed = dict(frame.world.poses)
        self._nodes: list = []
        self._on_hand: list[viser.LabelHandle] = []
        """The labels of cameras that ride on the hand; they would cover its path."""
        self._colours = colours = camera_colours(frame.world.env.cameras)
        self._size = extent(frame)
        self._bodies = Bodies(client)
        with client.atomic():
            self._light(client)
            for camera in frame.world.env.cameras:
                self._add(client, frame, camera.name, colours[camera.name], on_click)
        self._view = FittedView(client.camera, *first_view(frame))

    def update(self, frame: Frame) -> list[Assign]:
        now = self._clock()
        full_speed = frame.pace.speed is None and frame.pace.phase == "playing"
        if frame.world.change is not self._change:
            self._change = frame.world.change
            self._touched = now
        if full_speed and now - self._touched < AFTER_TOUCH:
            return []
        changes = self._view.update()
        for name, handle in self._frusta.items():
            colour = rgb(self._colours[name]) if frame.uses(name) else OFF
            changes.append(Assign(handle, "color", colour))
        ended = [side.paths for side in (frame, frame.second) if side is not None and side.paths]
        changes += [Assign(label, "visible", not ended) for label in self._on_hand]
        if frame.pace.phase != "playing" or now - self._moved >= (
            MOVE_AT_FULL_SPEED if full_speed else MOVE
        ):
            self._moved = now
            changes += self._bodies.update(frame) + self._move_frusta(frame)
        for name in self._turn(frame, now, full_speed):
            changes.append(Assign(self._frusta[name], "image", picture(frame, name)))
        return changes

    def remove(self) -> None:
        self._bodies.remove()
        for node in self._nodes:
            node.remove()

    def _move_frusta(self, frame: Frame) -> list[Assign]:
        """Frusta to where their cameras are, if those went far enough to be seen."""
        changes = []
        for name, handle in self._frusta.items():
            pose = frame.world.poses[name]
            before = self._placed[name]
            if not _same(pose, before) or pose.fovy != before.fovy:
                self._placed[name] = pose
            if not _same(pose, before):
                changes += [
                    Assign(handle, "position", np.asarray(pose.position, float)),
                    Assign(handle, "wxyz", np.asarray(pose.wxyz, float)),
                ]
            if pose.fovy != before.fovy:
                changes += [
                    Assign(handle, "fov", float(np.radians(pose.fovy))),
                    Assign(handle, "scale", self._scale(frame, name)),
                ]
        return changes

    def _turn(self, frame: Frame, now: float, full_speed: bool) -> list[str]:
        """The cameras whose picture is brought up to date with this frame."""
        states = {name: frame.camera(name) for name in self._frusta if name in frame.world.poses}
        stale = [name for name in states if states[name] != self._states.get(name)]
        still = frame.pace.phase != "playing" and frame.pace.number != self._still
        waited = now - self._drawn >= (PERIOD_AT_FULL_SPEED if full_speed else PERIOD)
        if not (waited or still or (stale and not full_speed)):
            return []
        self._drawn = now
        if full_speed:  # One only, and first those whose state has changed.
            self._next = (self._next + (not stale)) % len(states)
            stale = stale[:1] or [list(states)[self._next]]
        elif not stale or still:
            stale = list(states)
            self._still = frame.pace.number
        self._states.update({name: states[name] for name in stale})
        return stale

    def _light(self, client: viser.ClientHandle) -> None:
        """Two plain lights: reflections of surroundings and shadows cost more than all the rest."""
        scene = client.scene
        scene.configure_environment_map(None)
        scene.configure_default_lights(enabled=False)
        self._nodes += [
            scene.add_light_hemisphere(
                "/lights/sky", sky_color=(255, 255, 255), ground_color=(90, 86, 80), intensity=2.6
            ),
            scene.add_light_directional("/lights/sun", intensity=2.1, position=(0.6, -0.4, 1.0)),
        ]

    def _scale(self, frame: Frame, name: str) -> float:
        """viser's size of a frustum: the cube root of its volume."""
        half = np.tan(np.radians(frame.world.poses[name].fovy) / 2)
        ridden = frame.world.env.camera(name).body is not None
        width = (WIDTH_ON_BODY if ridden else WIDTH) * self._size
        return float(np.cbrt(half * half / 3) * width / (2 * half))

    def _add(
        self,
        client: viser.ClientHandle,
        frame: Frame,
        name: str,
        colour: str,
        on_click: Callable[[str], None] | None,
    ) -> None:
        pose = frame.world.poses[name]
        frustum = client.scene.add_camera_frustum(
            f"/cameras/{name}",
            fov=float(np.radians(pose.fovy)),
            aspect=1.0,
            scale=self._scale(frame, name),
            thickness=0.004 * self._size,
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
            frustum.on_click(heard(lambda _: guarded(client, lambda: on_click(name))))
        label = client.scene.add_label(
            f"/cameras/{name}/label",
            frame.world.env.camera(name).label,
            font_screen_scale=0.8,
            anchor="bottom-center",
        )
        self._frusta[name] = frustum
        self._nodes += [label, frustum]
        if frame.world.env.camera(name).body is not None:
            self._on_hand.append(label)


def _same(pose: CameraPose, before: CameraPose) -> bool:
    """Whether the two poses cannot be distinguished in the scene."""
    near = np.abs(np.subtract(pose.position, before.position)).max() < 0.0005
    return bool(near and np.abs(np.subtract(pose.wxyz, before.wxyz)).max() < 0.002)

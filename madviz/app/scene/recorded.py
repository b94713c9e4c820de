"""In place of a scene, where a recording is shown: the pictures, large, one below the other.

There is no simulator, so nobody knows where robot and cameras stand. A dropped camera's picture is
dim, an occluded one's has a striped frame, as in the scene of a simulator; a click takes a camera
away or back.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import viser

from madviz.app.panel import Assign, Panel
from madviz.app.pictures import picture
from madviz.app.scene.fitted_view import FittedView
from madviz.app.toolkit import guarded, heard
from madviz.recorded.known import LABEL
from madviz.session.frame import Frame

PERIOD = 0.09
PERIOD_AT_FULL_SPEED = 0.3
"""Seconds between two times that pictures change, as things in a scene."""
EACH = 1.25
"""Height of a picture of height 1, with its label."""
UPRIGHT = (np.sqrt(0.5), -np.sqrt(0.5), 0.0, 0.0)
"""A picture that faces the visitor, who looks along the world's y."""


class PicturesPanel(Panel):
    """A picture and a label for each camera. Clicking a picture calls ``on_click``."""

    def __init__(
        self,
        client: viser.ClientHandle,
        frame: Frame,
        on_click: Callable[[str], None] | None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clock = clock
        self._drawn = -PERIOD_AT_FULL_SPEED
        self._change = frame.world.change
        self._images: dict[str, viser.ImageHandle] = {}
        self._nodes: list = []
        with client.atomic():
            client.scene.configure_environment_map(None)
            for number, camera in enumerate(frame.world.env.cameras):
                self._add(client, frame, camera.name, -EACH * number, on_click)
            top = np.array([0.0, 0.0, 0.75])
            self._label(client, "/recorded", LABEL, top)
        lowest = -EACH * (len(self._images) - 1) - 0.5
        corners = [[x, 0.0, z] for x in (-0.5, 0.5) for z in (lowest, 0.85)]
        self._view = FittedView(client.camera, np.array(corners), np.array([0.0, 1.0, 0.0]))

    def update(self, frame: Frame) -> list[Assign]:
        changes = self._view.update()
        now = self._clock()
        playing = frame.pace.phase == "playing"
        wait = PERIOD_AT_FULL_SPEED if playing and frame.pace.speed is None else PERIOD
        touched = frame.world.change is not self._change
        if playing and not touched and now - self._drawn < wait:
            return changes
        self._drawn = now
        self._change = frame.world.change
        for name, handle in self._images.items():
            changes.append(Assign(handle, "image", picture(frame, name)))
        return changes

    def remove(self) -> None:
        for node in self._nodes:
            node.remove()

    def _add(
        self,
        client: viser.ClientHandle,
        frame: Frame,
        name: str,
        height: float,
        on_click: Callable[[str], None] | None,
    ) -> None:
        place = np.array([0.0, 0.0, height])
        image = client.scene.add_image(
            f"/pictures/{name}",
            picture(frame, name),
            1.0,
            1.0,
            format="jpeg",
            jpeg_quality=90,
            cast_shadow=False,
            receive_shadow=False,
            wxyz=np.array(UPRIGHT),
            position=place,
        )
        if on_click is not None:
            image.on_click(heard(lambda _: guarded(client, lambda: on_click(name))))
        self._images[name] = image
        self._nodes.append(image)
        label = frame.world.env.camera(name).label
        self._label(client, f"/pictures/{name}-label", label, place + [0.0, 0.0, 0.51])

    def _label(self, client: viser.ClientHandle, name: str, words: str, place: np.ndarray) -> None:
        label = client.scene.add_label(
            name, words, position=place, font_screen_scale=0.8, anchor="bottom-center"
        )
        self._nodes.append(label)

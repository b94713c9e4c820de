"""A recording for rerun's viewer: one file with data and layout, on the timeline ``step``.

    world/cameras/NAME           frustum at its effective pose; below it the picture that arrived,
                                 occlusions and all, dark where the camera is dropped
    world/bodies                 the robot and what it works on, as far as the simulator tells
    depth/NAME                   depth as it arrived at the policy, where it takes any
    features/norm, cosine        norm of every stream's feature, its cosine to the merged one
    value/q, reward, success     of the decision at this step
    action, mask                 the action that comes next; 1 for every stream that is present

Pictures go in as JPEG files, which the viewer decodes when it shows them. A hammer episode of
100 decisions is 1.0 MB, 0.9 of it pictures of 84 pixels; raw, these alone would be 6.4 MB.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from madviz.drawing.colours import camera_colours, rgb
from madviz.drawing.jpeg import jpeg
from madviz.drawing.viewpoint import first_view, place_and_target
from madviz.recording.facts import Facts, headline, verdict
from madviz.session.frame import Frame
from madviz.subsets import camera_of, modality_of
from madviz.types import Array

BATCHES = rr.ChunkBatcherConfig(flush_tick=60.0, flush_num_bytes=8_000_000)
"""By default what was logged is written out every fifth of a second, each time with a header for
every path: on a busy machine more than half of the file."""
NEUTRAL = (130, 130, 140)
"""The merged feature's colour here: the page's white is nothing on rerun's light ground."""
FOV = float(np.radians(55))
ASPECT = 1.2
"""Vertical field of view of rerun's eye, which a blueprint cannot set, and the shape of the scene's
part of the layout: narrower than in any window that is wider than high."""
OTHERS = (NEUTRAL, (77, 182, 255), (255, 138, 61), (60, 170, 100))


class RerunWriter:
    """See the module."""

    def __init__(self, path: Path, facts: Facts) -> None:
        self._path = path
        self._facts = facts
        self._stream = rr.RecordingStream("madviz", batcher_config=BATCHES)
        self._begun = False
        self._policy = ""
        self._under = ""
        """Where the curves of features are: a policy that is swapped in has other streams, and so
        curves with names of their own."""

    def add(self, frame: Frame) -> None:
        if not self._begun:
            self._begin(frame)
        if frame.world.policy.name != self._policy:
            self._under = f"/{frame.world.policy.name}" if self._policy else ""
            self._policy = frame.world.policy.name
            self._streams(frame)
        self._stream.set_time("step", sequence=frame.world.step)
        for camera in frame.world.env.cameras:
            self._camera(frame, camera.name)
        for stream, picture in frame.world.arrived.items():
            if modality_of(stream) == "depth":
                self._picture(f"depth/{camera_of(stream)}", picture)
        for index, (*position, w, x, y, z) in enumerate(frame.world.body_poses.tolist()):
            place = rr.Transform3D(
                translation=position, quaternion=rr.Quaternion(xyzw=[x, y, z, w])
            )
            self._stream.log(f"world/bodies/{index}", place)
        self._curves(frame)
        self._stream.log("log", rr.TextLog(f"step {frame.world.step}: {verdict(frame)}"))

    def close(self) -> None:
        self._stream.flush()
        self._stream.disconnect()

    def _begin(self, frame: Frame) -> None:
        """Opens the file with its layout, and writes what holds for all steps."""
        stream = self._stream
        stream.save(self._path, default_blueprint=layout(frame))
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        stream.send_recording_name(headline(frame, self._facts))
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        stream.log("about", rr.TextDocument(about(frame, self._facts)), static=True)
        hands = [f"action {index}" for index in range(frame.world.env.action_dim)]
        self._series("action", hands, [OTHERS[i % len(OTHERS)] for i in range(len(hands))])
        for index, name in enumerate(("value/q", "reward", "success")):
            self._series(name, [name], [OTHERS[index]])
        for index, body in enumerate(frame.world.bodies):
            for number, part in enumerate(body.parts):
                mesh = rr.Mesh3D(
                    vertex_positions=part.vertices,
                    triangle_indices=part.faces,
                    vertex_colors=np.tile(part.colour, (len(part.vertices), 1)),
                )
                stream.log(f"world/bodies/{index}/{number}", mesh, static=True)
        self._begun = True

    def _streams(self, frame: Frame) -> None:
        """Names and colours of the curves of each stream of the policy that acts now."""
        colours = camera_colours(frame.world.env.cameras)
        streams = [rgb(colours[camera_of(name)]) for name in frame.world.policy.streams]
        names = list(frame.world.policy.streams)
        self._series(f"features/norm{self._under}", [*names, "merged"], [*streams, NEUTRAL])
        self._series(f"features/cosine{self._under}", names, streams)
        self._series(f"mask{self._under}", names, streams)

    def _series(self, path: str, names: list[str], colours: list[tuple[int, int, int]]) -> None:
        self._stream.log(path, rr.SeriesLines(names=names, colors=colours), static=True)

    def _camera(self, frame: Frame, name: str) -> None:
        """Its pose and opening, and what arrives of it; dark where that is nothing."""
        world = frame.world
        off = not frame.uses(name)
        pose = world.poses[name]
        picture = world.views[name].rgb
        for stream in (f"{name}.rgb", name):
            picture = world.arrived.get(stream, picture)
        w, x, y, z = (float(number) for number in pose.wxyz)
        size = picture.shape[0]
        path = f"world/cameras/{name}"
        self._stream.log(
            path,
            rr.Transform3D(translation=pose.position, quaternion=rr.Quaternion(xyzw=[x, y, z, w])),
            rr.Pinhole(  # In pixels: given an angle, rerun takes the picture for one of 1 x 1.
                focal_length=float(size / 2 / np.tan(np.radians(pose.fovy) / 2)),
                width=size,
                height=size,
                image_plane_distance=0.25,
                color=(110, 112, 116) if off else rgb(camera_colours(world.env.cameras)[name]),
            ),
        )
        self._picture(f"{path}/picture", (picture // 4) if off else picture)

    def _picture(self, path: str, picture: Array) -> None:
        image = rr.EncodedImage(contents=jpeg(picture), media_type="image/jpeg")
        self._stream.log(path, image)

    def _curves(self, frame: Frame) -> None:
        probe = frame.world.probe
        row = frame.row
        values = {
            f"features/norm{self._under}": [*probe.norms, probe.merged_norm(row)],
            f"features/cosine{self._under}": probe.cosines(row),
            f"mask{self._under}": frame.mask.astype(float),
            "action": frame.action,
            "value/q": [frame.q],
            "reward": [frame.world.reward],
            "success": [float(frame.world.success)],
        }
        for path, numbers in values.items():
            self._stream.log(path, rr.Scalars(np.asarray(numbers, float)))


def layout(frame: Frame) -> rrb.Blueprint:
    """Where it happens, what the cameras send, and what the policy makes of it."""
    pictures = [
        rrb.Spatial2DView(origin=f"world/cameras/{camera.name}", name=camera.label)
        for camera in frame.world.env.cameras
    ]
    paths = ("features/norm", "features/cosine", "value/q", "action", "mask", "success")
    curves = [rrb.TimeSeriesView(origin=path, name=path) for path in paths]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.Spatial3DView(
                    origin="world", name="Where it happens", eye_controls=first_eye(frame)
                ),
                rrb.Grid(*pictures),
                row_shares=[3, 2],
            ),
            rrb.Vertical(*curves),
            rrb.TextDocumentView(origin="about", name="About"),
            column_shares=[4, 3, 2],
        ),
        rrb.TimePanel(timeline="step", state="collapsed"),
        collapse_panels=True,
    )


def first_eye(frame: Frame) -> rrb.EyeControls3D:
    """Looks at the scene as the page does at first: rerun by itself begins behind the robot."""
    position, target = place_and_target(*first_view(frame), ASPECT, FOV)
    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=position.tolist(),
        look_target=target.tolist(),
        eye_up=(0.0, 0.0, 1.0),
    )


def about(frame: Frame, facts: Facts) -> str:
    """The recording's facts, for the viewer's text panel."""
    failing = ", ".join(facts.failures) or "none"
    return "\n\n".join(
        [
            f"{facts.policies or frame.world.policy.name} on {frame.world.env.task}, "
            f"seed {frame.world.seed}.",
            f"Success: {frame.world.env.success}, at the last step.",
            f"Cameras that fail: {failing}.",
            f"Made with: {facts.command}",
        ]
    )

"""The scene on a real server without a browser: what is sent, what is not, and where one stands."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from io import BytesIO
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
import viser

from madviz.app.panel import apply
from madviz.app.pictures import picture
from madviz.app.scene.bodies import glb, linear
from madviz.app.scene.fitted_view import FittedView
from madviz.app.scene.scene import MOVE, MOVE_AT_FULL_SPEED, ScenePanel
from madviz.drawing.viewpoint import FOV, MARGIN, first_view, nearest_place
from madviz.envs import shapes
from madviz.envs.registry import make_env
from madviz.observation.ablation import CameraState, Occlusion
from madviz.session.commands import Pause, SetCamera, SetSpeed, StepOnce
from madviz.session.frame import Frame, HandPaths
from madviz.session.session import Session
from madviz.types import Body, CameraPose
from tests.fakes import FakePolicy, policies
from tests.pages import browser
from tests.sessions import with_world


class Stage:
    """A panel on the toy's scene, with a clock and a session that tests move."""

    def __init__(self, server: viser.ViserServer, *commands) -> None:
        self.session = Session(make_env, FakePolicy(), policies)
        self.now, self.ticks = 0.0, 0.0
        self.frame = self.after(*commands)
        self.camera = SimpleNamespace(
            image_width=800, image_height=800, position=np.zeros(3), look_at=np.zeros(3), fov=1.0
        )
        client = browser(server, camera=self.camera)
        self.nodes = client.scene
        self.panel = ScenePanel(client, self.frame, None, lambda: self.now)

    def after(self, *commands) -> Frame:
        """The frame after ``commands`` and another step, if it plays."""
        for command in commands:
            self.session.send(command)
        self.ticks += 1.0
        self.session.tick(self.ticks)
        assert isinstance(self.session.latest, Frame)
        self.frame = self.session.latest
        return self.frame

    def moved(self) -> list[str]:
        """Names of the nodes that the present frame moves."""
        changes = self.panel.update(self.frame)
        apply(changes)
        return [change.handle.name for change in changes if change.name == "position"]


def test_only_what_moved_is_sent_again(server):
    stage = Stage(server)
    stage.now = 1.0
    assert stage.moved() == [], "everything stands where it was put"
    stage.after()
    stage.now = 2.0
    assert stage.moved() == ["/bodies/hand", "/cameras/first"]
    hand = stage.nodes.find("/bodies/hand")
    np.testing.assert_allclose(hand.position, stage.frame.world.body_poses[1, :3], atol=1e-6)
    stage.now = 3.0
    assert stage.moved() == []
    stage.panel.remove()


def test_things_move_ten_times_a_second_and_less_often_at_full_speed(server):
    stage = Stage(server)
    for speed, wait in ((10.0, MOVE), (None, MOVE_AT_FULL_SPEED)):
        stage.after(SetSpeed(speed))
        stage.now += 10.0
        assert stage.moved()
        stage.after()
        stage.now += 0.9 * wait
        assert stage.moved() == []
        stage.now += 0.2 * wait
        assert stage.moved()
    stage.panel.remove()


def test_what_stands_still_is_shown_as_it_is_at_once(server):
    stage = Stage(server, SetSpeed(None))
    stage.now = 10.0
    stage.after()
    assert stage.moved()
    stage.after(Pause(), StepOnce())
    assert stage.frame.pace.phase == "paused"
    changes = stage.panel.update(stage.frame)
    assert "/bodies/hand" in [c.handle.name for c in changes if c.name == "position"]
    assert sum(change.name == "image" for change in changes) == 3
    again = stage.panel.update(stage.frame)
    assert not [change for change in again if change.name in ("image", "position")]
    stage.panel.remove()


def test_another_episode_may_hold_other_bodies(server):
    stage = Stage(server)
    old = [one.name for one in stage.nodes.present if one.name.startswith("/bodies/")]
    ball = Body("ball", (shapes.part(shapes.sphere(np.ones(3)), np.ones(3)),))
    pose = np.array([[1, 2, 3, 1, 0, 0, 0]], np.float32)
    stage.now = 1.0
    apply(stage.panel.update(with_world(stage.frame, bodies=(ball,), body_poses=pose)))
    (handle,) = (one for one in stage.nodes.present if one.name.startswith("/bodies/"))
    assert handle.name == "/bodies/ball" and handle.name not in old
    np.testing.assert_allclose(handle.position, [1, 2, 3])
    stage.panel.remove()


def test_a_frustum_goes_where_its_camera_was_put(server):
    stage = Stage(server)
    elsewhere = CameraPose(np.array([1.0, 1.0, 1.0]), np.array([0.0, 1.0, 0.0, 0.0]), 20.0)
    frame = with_world(stage.frame, poses={**stage.frame.world.poses, "third_b": elsewhere})
    frustum = stage.nodes.find("/cameras/third_b")
    before = frustum.scale
    stage.now = 1.0
    apply(stage.panel.update(frame))
    np.testing.assert_allclose(frustum.position, elsewhere.position)
    assert np.degrees(frustum.fov) == pytest.approx(20) and frustum.scale != before
    for fovy in (35.0, 20.0):  # Zoomed where it stands, and back.
        stage.now += 1.0
        zoomed = {**frame.world.poses, "third_b": replace(elsewhere, fovy=fovy)}
        apply(stage.panel.update(with_world(frame, poses=zoomed)))
        assert np.degrees(frustum.fov) == pytest.approx(fovy)
    stage.panel.remove()


def test_occluded_pictures_have_a_striped_frame_and_dropped_ones_are_dim(server):
    stage = Stage(server)
    plain = picture(stage.frame, "first")
    stage.after(Pause(), SetCamera("first", CameraState("rgb", Occlusion("freeze"))))
    frozen = picture(stage.frame, "first")
    np.testing.assert_array_equal(
        frozen[7:-7, 7:-7], stage.frame.world.arrived["first"][7:-7, 7:-7]
    )
    assert np.ptp(frozen[0, :, 0].astype(int)) > 150 and np.ptp(plain[0, :, 0].astype(int)) < 150
    stage.after(SetCamera("first", CameraState("off", Occlusion("freeze"))))
    dropped = picture(stage.frame, "first").astype(int)
    assert np.ptp(dropped, axis=2).max() == 0 and dropped.mean() < 0.4 * plain.mean()
    stage.panel.remove()


def test_a_body_is_whole_glb_with_sharp_edges_and_one_piece_for_each_colour():
    half = np.array([1.0, 2.0, 3.0])
    red, blue = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 0.5])
    boxes = ((half, red, 0), (half, blue, 4), (half, red, 8))
    parts = tuple(shapes.part(shapes.box(h), c, (x, 0, 0)) for h, c, x in boxes)
    data = glb(Body("boxes", parts))
    pieces = loaded(data)
    assert [len(piece.vertices) for piece in pieces] == [48, 24], "by colour"
    assert [len(piece.faces) for piece in pieces] == [24, 12]
    assert pieces[0].bounds[1].tolist() == [9, 2, 3]
    surfaces = [each["pbrMetallicRoughness"] for each in document(data)["materials"]]
    assert [surface["baseColorFactor"] for surface in surfaces] == [
        linear((255, 0, 0)),
        linear((0, 0, 128)),
    ]
    assert {(each["metallicFactor"], each["roughnessFactor"]) for each in surfaces} == {(0, 0.7)}


def test_colours_are_linear_in_light():
    assert linear((255, 0, 128)) == pytest.approx([1, 0, 0.216, 1], abs=0.001)
    assert linear((0, 255, 10))[2] == pytest.approx(10 / 255 / 12.92, abs=1e-5)


def document(data: bytes) -> dict:
    """The JSON chunk of a GLB file."""
    magic, version, size, text = struct.unpack("<4sIII", data[:16])
    assert (magic, version, size) == (b"glTF", 2, len(data))
    return json.loads(data[20 : 20 + text])


def loaded(data: bytes) -> list[trimesh.Trimesh]:
    """The pieces of a GLB file, with its vertices as they are in it."""
    scene = trimesh.load_scene(BytesIO(data), file_type="glb", process=False)
    return [piece for piece in scene.geometry.values() if isinstance(piece, trimesh.Trimesh)]


@pytest.mark.parametrize(
    ("shape", "vertices"),
    [
        (shapes.box(np.ones(3)), 24),
        (shapes.cylinder(1.0, 1.0), 2 * shapes.AROUND + 2 * (shapes.AROUND + 1)),
        (shapes.sphere(np.ones(3)), 11 * shapes.AROUND + 2),
    ],
)
def test_normals_are_smooth_on_round_things_and_sharp_at_edges(shape, vertices):
    (made,) = loaded(glb(Body("one", (shapes.part(shape, np.ones(3)),))))
    assert len(made.vertices) == vertices
    assert (made.vertex_normals * made.vertices).sum(1).min() > 0, "outwards"
    before = trimesh.Trimesh(*shape, process=False)
    assert made.volume == pytest.approx(before.volume) and made.area == pytest.approx(before.area)


def test_the_nearest_place_has_everything_just_in_sight():
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    ahead = np.array([-1.0, 0.5, -0.4])
    for aspect in (0.39, 1.6):
        place = nearest_place(points, ahead, aspect)
        forward = ahead / np.linalg.norm(ahead)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        x, y, z = ((points - place) @ np.stack([right, np.cross(right, forward), forward]).T).T
        across, up = np.abs(x / z).max() / aspect, np.abs(y / z).max()
        fill = np.array([across, up]) / np.tan(FOV / 2) / MARGIN
        assert fill.max() == pytest.approx(1.0, abs=0.02)


def test_a_visitor_sees_all_of_it_until_they_look_elsewhere():
    camera = SimpleNamespace(image_width=1280, image_height=800, position=np.zeros(3))
    seen = FittedView(
        camera, np.random.default_rng(1).uniform(-1, 1, (9, 3)), np.array([-1.0, 0, -1])
    )
    first = camera.position
    assert seen.update() == []
    camera.image_width = 312  # Panels dock.
    apply(seen.update())
    assert np.linalg.norm(camera.position) > 1.5 * np.linalg.norm(first)
    camera.position, camera.image_width = camera.position + 1.0, 500
    assert seen.update() == []


def test_the_first_place_has_cameras_apart_and_pictures_the_right_way_round():
    env = make_env("metaworld/hammer")
    env.reset(0)
    session = Session(lambda *_: env, FakePolicy(task="metaworld/hammer"))
    session.tick(0.0)
    frame = session.latest
    assert isinstance(frame, Frame)
    camera = SimpleNamespace(image_width=312, image_height=800)
    FittedView(camera, *first_view(frame))
    ahead = camera.look_at - camera.position
    for name in ("third_a", "third_b"):
        _, x, y, z = frame.world.poses[name].wxyz
        w = frame.world.poses[name].wxyz[0]
        looks = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
        assert looks @ ahead > 0.2 * np.linalg.norm(ahead), name
    env.close()


def test_no_name_of_a_camera_covers_the_path_of_the_hand_it_rides_on(server) -> None:
    stage = Stage(server)
    riding, standing = (stage.nodes.find(f"/cameras/{n}/label") for n in ("first", "third_a"))
    path = np.zeros((2, 3), np.float32)
    for paths, seen in ((None, True), (HandPaths(3, path, path), False), (None, True)):
        apply(stage.panel.update(replace(stage.frame, paths=paths)))
        assert (riding.visible, standing.visible) == (seen, True)

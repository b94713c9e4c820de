"""What a site is made from: model, scene, textures, start states, and the command."""

from __future__ import annotations

import gzip
import json
import os
import shutil
import zipfile
from pathlib import Path

import mujoco
import numpy as np
import pytest
from safetensors.numpy import load, save

from madviz.envs.metaworld.environment import MetaWorld
from madviz.envs.tasks import METAWORLD_SUCCESS
from madviz.errors import UserError
from madviz.policies.checkpoint import describe
from madviz.site import runtime, site
from madviz.site.drawn_scene import drawn_scene, scene_file
from madviz.site.exports import labels_of
from madviz.site.files import write_packed, write_shared, write_zip
from madviz.site.mjcf import model_text
from madviz.site.starts import start_states
from madviz.site.tessellation import box, cylinder, sphere
from madviz.site.textures import Texture, read_textures

SEED = 5000
TASKS_FILE = Path(site.__file__).parent / "web" / "tasks.js"


@pytest.fixture(scope="module")
def hammer():
    env = MetaWorld("hammer")
    env.reset(SEED)
    yield env
    env.close()


def test_a_model_written_and_compiled_again_moves_the_same_way(hammer: MetaWorld) -> None:
    hammer.reset(SEED)
    own, data = hammer.simulation.model, hammer.simulation.data
    model = mujoco.MjModel.from_xml_string(model_text(own))
    for name in ("body_pos", "body_inertia", "dof_damping", "eq_data", "qpos0", "jnt_range"):
        np.testing.assert_array_equal(getattr(model, name), getattr(own, name), name)
    again = mujoco.MjData(model)
    for name in ("qpos", "qvel", "ctrl", "mocap_pos", "mocap_quat", "qacc_warmstart"):
        getattr(again, name)[:] = getattr(data, name)
    mujoco.mj_forward(model, again)
    low, high = hammer.simulation.mocap_low, hammer.simulation.mocap_high
    for _ in range(40):
        action = hammer.expert().astype(np.float32)
        hammer.step(action)
        for _ in range(2):
            again.mocap_pos[0] = np.clip(again.mocap_pos[0] + action[:3] * 0.01, low, high)
            again.mocap_quat[0] = [1, 0, 1, 0]
            again.ctrl[:] = [action[3], -action[3]]
            mujoco.mj_step(model, again, nstep=5)
            mujoco.mj_forward(model, again)
    np.testing.assert_allclose(again.qpos, data.qpos, atol=1e-9)


def test_only_what_collides_is_in_the_model(hammer: MetaWorld) -> None:
    own = hammer.simulation.model
    model = mujoco.MjModel.from_xml_string(model_text(own))
    assert model.ngeom == int(np.count_nonzero(own.geom_contype | own.geom_conaffinity))
    assert model.nbody == own.nbody


@pytest.mark.parametrize(
    ("parts", "said"),
    [
        ('<sensor><jointpos joint="j"/></sensor>', "sensors"),
        ('<option integrator="RK4"/>', "an integrator other than Euler's"),
    ],
)
def test_a_model_with_unknown_parts_is_refused(parts: str, said: str) -> None:
    text = f"""<mujoco><worldbody><body><joint name="j"/><geom size="1"/></body></worldbody>
      {parts}</mujoco>"""
    with pytest.raises(UserError, match=f"found one with {said}"):
        model_text(mujoco.MjModel.from_xml_string(text))


def test_a_scene_holds_every_shape_and_where_its_corners_are(hammer: MetaWorld) -> None:
    arrays, said, textures = drawn_scene(hammer.simulation.model, hammer.simulation.data)
    shapes = said["shapes"]
    last = shapes[-1]
    assert last["body"] == -1, "the sky comes last"
    assert sum(shape["corners"][1] for shape in shapes) == len(arrays["positions"])
    assert last["triangles"][0] + last["triangles"][1] == len(arrays["triangles"])
    assert arrays["triangles"].max() < len(arrays["positions"])
    assert len(textures) == len(said["cubes"]) > 0
    content = scene_file(arrays, said)
    assert len(gzip.compress(content)) < 400_000
    assert load(content)["positions"].dtype == np.uint16


@pytest.mark.parametrize("shape", [box(4), sphere(28, 16), cylinder(28, 16)])
def test_shapes_are_closed_and_look_outwards(shape) -> None:
    corners = shape.positions[shape.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((normals * corners.mean(1)).sum(1) > 0).all()
    np.testing.assert_allclose(normals.sum(0), 0, atol=1e-9)
    assert ((normals[:, None] * shape.normals[shape.triangles]).sum(-1) > 0).all()


def test_a_texture_comes_back_from_differences() -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (1, 4, 5, 3), np.uint8)
    found = Texture(False, (pixels,)).arrays()["level0"]
    np.testing.assert_array_equal(np.cumsum(found, 2, dtype=np.uint8), pixels)


def test_textures_have_every_level_down_to_one_pixel(hammer: MetaWorld) -> None:
    for texture in read_textures(hammer.simulation.model):
        sizes = [level.shape[1] for level in texture.levels]
        assert sizes[0] <= 320 and sizes[-1] == 1
        assert all(after == before // 2 for before, after in zip(sizes, sizes[1:], strict=False))


def test_start_states_are_those_of_their_seeds(hammer: MetaWorld) -> None:
    states = start_states(hammer, range(SEED, SEED + 3))
    moment = hammer.reset(SEED + 1)
    np.testing.assert_array_equal(states["seeds"], [SEED, SEED + 1, SEED + 2])
    np.testing.assert_array_equal(states["state"][1], moment.state)
    np.testing.assert_array_equal(states["qpos"][1], hammer.simulation.data.qpos)


def test_every_metaworld_task_has_a_line_that_says_when_it_is_a_success() -> None:
    text = TASKS_FILE.read_text()
    missing = [task for task in METAWORLD_SUCCESS if f"'metaworld/{task}':" not in text]
    assert not missing


def test_files_are_packed_and_say_their_sizes(tmp_path: Path) -> None:
    said = write_packed(tmp_path, "a/b.gz", b"x" * 1000)
    content = (tmp_path / "a/b.gz").read_bytes()
    assert gzip.decompress(content) == b"x" * 1000
    assert said == {"path": "a/b.gz", "bytes": len(content), "unpacked": 1000}


def test_a_zip_holds_the_folder_and_has_no_times(tmp_path: Path) -> None:
    site = tmp_path / "site"
    write_packed(site, "a/b.gz", b"x" * 1000)
    (site / "index.html").write_text("<p>x</p>" * 100)
    first = write_zip(site).read_bytes()
    os.utime(site / "index.html", (0, 0))
    assert write_zip(site) == tmp_path / "site.zip"
    assert (tmp_path / "site.zip").read_bytes() == first
    with zipfile.ZipFile(tmp_path / "site.zip") as archive:
        assert archive.namelist() == ["a/b.gz", "index.html"]
        assert archive.read("index.html") == b"<p>x</p>" * 100


def test_equal_arrays_share_a_file(tmp_path: Path) -> None:
    arrays = {"level0": np.zeros((1, 2, 2, 3), np.uint8)}
    assert write_shared(tmp_path, "t", arrays) == write_shared(tmp_path, "t", dict(arrays))
    assert len(list((tmp_path / "t").iterdir())) == 1
    assert save(arrays)


@pytest.mark.parametrize("text", ["", "5000", "5000:5000", "5:x", "9:5", "-1:3", "0:2000"])
def test_seeds_that_are_no_range_are_refused(text: str) -> None:
    with pytest.raises(UserError, match="expected a range such as 5000:5050"):
        site.seed_range(text)


@pytest.mark.parametrize("digits", [20, 5000])
def test_seeds_beyond_all_sizes_are_refused(digits: int) -> None:
    with pytest.raises(UserError, match="expected a range such as 5000:5050"):
        site.seed_range(f"0:{'9' * digits}")


def test_seeds_are_a_range() -> None:
    assert list(site.seed_range("5000:5003")) == [5000, 5001, 5002]


def test_policies_of_one_label_and_task_say_their_recipes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ["push-cube-mad-light", "push-cube-mad-paper-vectorised", "pick-cube-mad-light"]
    folders = [describe(f"maniskill-{name}") for name in names]
    assert list(labels_of(folders).values()) == ["MAD, light", "MAD, paper-vectorised", "MAD"]
    assert list(labels_of(folders[:1] * 2).values()) == ["MAD"]
    for name in ("find_packages", "write_runtime", "write_licences"):
        monkeypatch.setattr(site, name, lambda *_: {})
    monkeypatch.setattr(site, "chosen", lambda names: folders)
    monkeypatch.setattr(
        site, "record_policy", lambda out, kept, folder, described, seeds: described
    )
    found = site.run_site(site.SiteConfig(str(tmp_path / "site")))
    assert [one["label"] for one in found["recordings"]] == list(labels_of(folders).values())


def test_the_opening_s_policies_come_first() -> None:
    names = [one.spec.name for one in site.chosen(())]
    assert names[:2] == [site.OPENING["first"], site.OPENING["second"]]
    assert all(site.fits(describe(name)) for name in names)


def test_two_trainings_of_one_name_are_refused(tmp_path: Path) -> None:
    first = describe(site.OPENING["first"]).path
    for name in ("one", "two"):
        shutil.copytree(first, tmp_path / name)
    with pytest.raises(UserError, match="of different names, found .* in .*one and in .*two"):
        site.chosen([str(tmp_path / "one"), str(tmp_path / "two")])


def test_a_folder_with_other_files_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(UserError, match="expected an empty folder or a site, found 'thesis.tex'"):
        site.check_place(tmp_path)
    (tmp_path / site.MANIFEST).write_text('{"name": "a web app", "icons": []}')
    with pytest.raises(UserError, match="which would be lost"):
        site.check_place(tmp_path)
    (tmp_path / site.MANIFEST).write_text('{"schema": 1, "runtime": {}}')
    with pytest.raises(UserError, match="found 'thesis.tex', which would be lost"):
        site.check_place(tmp_path)
    (tmp_path / ".git").mkdir()
    with pytest.raises(UserError, match="found '.git', which would be lost"):
        site.check_place(tmp_path)
    assert (tmp_path / "thesis.tex").read_text() == "mine"
    with pytest.raises(UserError, match="expected a folder, found a file"):
        site.check_place(tmp_path / "thesis.tex")


def test_a_site_is_replaced_when_the_new_one_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "build" / "site"
    out.mkdir(parents=True)
    (out / site.MANIFEST).write_text('{"schema": 1, "runtime": {}}')
    (out / "old.js").write_text("")
    monkeypatch.setattr(site, "find_packages", lambda folder: folder)
    monkeypatch.setattr(site, "chosen", lambda names: [])
    monkeypatch.setattr(site, "write_licences", lambda out, packages: None)

    def stopped(out: Path, packages: Path) -> dict:
        raise OSError("No space left on device")

    monkeypatch.setattr(site, "write_runtime", stopped)
    with pytest.raises(OSError, match="No space left"):
        site.run_site(site.SiteConfig(str(out)))
    assert (out / "old.js").exists() and [path.name for path in out.parent.iterdir()] == ["site"]
    monkeypatch.setattr(site, "write_runtime", lambda out, packages: {})
    found = site.run_site(site.SiteConfig(str(out)))
    assert found["page_bytes"] > 10_000 and found["opening"] is None
    assert (out / "worker.js").is_file() and not (out / "old.js").exists()
    for again in (out, tmp_path / "new" / "site"):
        site.run_site(site.SiteConfig(str(again)))
        assert (again / "worker.js").is_file()
    monkeypatch.chdir(out)
    assert site.run_site(site.SiteConfig(".", zip=True))["zip"] == f"{out}.zip"
    assert (out / "worker.js").is_file() and Path(f"{out}.zip").is_file()


def test_missing_packages_are_named_with_the_line_that_installs_them(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="expected @mujoco/mujoco .*, found none.*npm install"):
        runtime.find_packages(tmp_path)


def test_another_version_of_a_package_is_refused(tmp_path: Path) -> None:
    for name in runtime.versions():
        folder = tmp_path / name
        folder.mkdir(parents=True)
        (folder / "package.json").write_text(json.dumps({"version": "0.0.1"}))
    with pytest.raises(UserError, match=r"found 0\.0\.1"):
        runtime.find_packages(tmp_path)


def test_versions_are_exact() -> None:
    assert all(version[0].isdigit() for version in runtime.versions().values())


@pytest.mark.slow
def test_a_graph_does_what_its_policy_does() -> None:
    import onnx
    from onnx.reference import ReferenceEvaluator

    from madviz.policies.checkpoint import load_policy
    from madviz.site.graph import policy_graph

    policy = load_policy("metaworld-hammer-mad-light")
    evaluator = ReferenceEvaluator(onnx.load_from_string(policy_graph(policy)))
    rng = np.random.default_rng(0)
    views = rng.integers(0, 256, (3, 9, 84, 84), np.uint8)
    state = rng.normal(size=24).astype(np.float32)
    masks = np.array([[1, 1, 1], [0, 1, 0], [0, 0, 0]], np.float32)
    found = evaluator.run(None, {"views": views, "state": state[None], "masks": masks})
    features, _, action, q = (np.asarray(one) for one in found)
    encoded = policy.encode(views, state)
    readout = policy.read(encoded, masks.astype(bool))
    np.testing.assert_allclose(features, encoded.features, atol=1e-4)
    np.testing.assert_allclose(action, readout.action, atol=1e-4)
    np.testing.assert_allclose(q, readout.q, atol=2e-3)

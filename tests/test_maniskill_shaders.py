"""ManiSkill draws with SAPIEN's shaders less the table of reflections that takes seconds."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from madviz.envs.maniskill import render, shaders
from madviz.envs.maniskill.environment import ManiSkill
from madviz.types import Array

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning:mani_skill")


@pytest.fixture
def unread() -> Iterator[None]:
    """What is known of the copy is forgotten before and after."""
    shaders._without_table.cache_clear()
    yield
    shaders._without_table.cache_clear()


def stock() -> Path:
    import sapien

    return Path(sapien.__file__).parent / "vulkan_shader"


def pictures() -> list[Array]:
    env = ManiSkill("push-cube")
    env.reset(3)
    views = [env.view(camera.name) for camera in env.spec.cameras]
    env.close()
    return [each for view in views for each in (view.rgb, view.depth)]


def test_pictures_are_those_of_the_stock_shaders(monkeypatch: pytest.MonkeyPatch) -> None:
    ours = pictures()
    monkeypatch.setattr(render, "shader_pack", lambda scene: shaders.STOCK)
    assert all(np.array_equal(a, b) for a, b in zip(ours, pictures(), strict=True))
    assert np.ptp(ours[0]) > 50  # Something is drawn.


def test_no_shader_asks_for_the_table(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    ours = shaders.copied(stock())
    assert ours is not None and ours.is_relative_to(tmp_path / "madviz" / "shaders")
    before, after = (
        {file.name: file.read_bytes() for file in folder.iterdir()}
        for folder in (stock() / shaders.STOCK, ours)
    )
    assert [n for n in sorted(before) if before[n] != after[n]] == [
        "composite0.frag",
        "gbuffer.frag",
    ]
    assert not any(b"samplerBRDFLUT" in content for content in after.values())
    (ours / "gbuffer.frag").write_bytes(b"\xff")  # What somebody spoiled is written again.
    assert shaders.copied(stock()) == ours
    assert (ours / "gbuffer.frag").read_bytes() == after["gbuffer.frag"]


def test_a_shader_written_otherwise_is_not_changed(tmp_path: Path) -> None:
    for folder in (shaders.STOCK, "common"):
        (tmp_path / folder).mkdir()
    (tmp_path / shaders.STOCK / "gbuffer.frag").write_text("e = texelFetch(samplerBRDFLUT, x, 0);")
    assert shaders.copied(tmp_path) is None


@pytest.mark.usefixtures("unread")
def test_surroundings_or_a_home_that_cannot_be_written_leave_the_stock_shaders(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def scene(cubemap: object) -> SimpleNamespace:
        return SimpleNamespace(render_system=SimpleNamespace(cubemap=cubemap))

    (tmp_path / "a file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "a file"))
    assert shaders.shader_pack(scene(None)) == shaders.STOCK
    shaders._without_table.cache_clear()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert shaders.shader_pack(scene(object())) == shaders.STOCK
    assert Path(shaders.shader_pack(scene(None))).is_dir()

"""Drawing a MuJoCo scene from any pose: colour and metric depth in one pass.

``mujoco.Renderer`` collects the scene anew for every camera and draws depth in a second pass. Here
the scene is collected once per simulator step, every camera is put into it by pose (so that cameras
need not exist in the model), and colour and depth are read from the same frame buffer.

The ``fast`` profile draws without shadows, reflections and multisampling, and a lighter robot. On
two CPU cores three 84-pixel views then take 8 ms where MuJoCo's stock flags take 170; resolution
hardly matters, flags and triangles do. The depth buffer is reversed (1 near, 0 far), where
1/metres is linear:

    1 / z = 1 / far + r (1 / near - 1 / far);  near 0.02 m, far 100 m, r = 0.02  ->  z = 0.99 m
"""

from __future__ import annotations

from contextlib import nullcontext

import mujoco
import numpy as np

from madviz.envs.checks import MAX_SIZE, check_size, largest_view
from madviz.envs.mujoco.meshes import lighter_meshes
from madviz.errors import UserError
from madviz.types import Array, View

_MAX_GEOMS = 2000


class SceneCameras:
    """Draws one model's data. Belongs to the thread that makes it, as its OpenGL context does."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, render_profile: str) -> None:
        """Raises UserError where no OpenGL can be had."""
        self._model = model
        self._data = data
        self._largest = largest_view(render_profile)
        model.vis.global_.offwidth = model.vis.global_.offheight = self._largest
        if render_profile == "fast":
            model.vis.quality.offsamples = 0
            model.vis.quality.shadowsize = 0  # Else 64 MB for a shadow map that nothing reads.
        gl = _gl_context()
        gl.make_current()
        self._gl: mujoco.GLContext | None = gl
        with lighter_meshes(model) if render_profile == "fast" else nullcontext():
            self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR.value
        self._scene = mujoco.MjvScene(model, _MAX_GEOMS)
        if render_profile == "fast":
            self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW.value] = 0
            self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION.value] = 0
        self._option = mujoco.MjvOption()
        self._free = mujoco.MjvCamera()
        self._stale = True

    def scene_changed(self) -> None:
        """Says that the simulation moved: the next draw collects the scene again."""
        self._stale = True

    def draw(self, position: Array, rotation: Array, fovy: float, size: int) -> View:
        """The view from ``position`` (3,) metres; ``rotation`` (3, 3) has the OpenGL camera's axes
        (right, up, back) as columns; ``fovy`` in degrees; square of ``size`` pixels."""
        check_size(size, self._largest)
        if self._gl is None:
            raise RuntimeError("these cameras are closed")
        self._gl.make_current()
        if self._stale:
            categories = mujoco.mjtCatBit.mjCAT_ALL.value
            mujoco.mjv_updateScene(
                self._model, self._data, self._option, None, self._free, categories, self._scene
            )
            self._stale = False
        near, far = self._place(position, rotation, fovy)  # Metres.
        rectangle = mujoco.MjrRect(0, 0, size, size)
        rgb = np.empty((size, size, 3), np.uint8)
        raw = np.empty((size, size), np.float32)
        mujoco.mjr_render(rectangle, self._scene, self._context)
        mujoco.mjr_readPixels(rgb, raw, rectangle, self._context)
        depth = 1.0 / (1.0 / far + raw * (1.0 / near - 1.0 / far))  # (H, W)
        # OpenGL's first row is the bottom one.
        return View(np.ascontiguousarray(rgb[::-1]), np.ascontiguousarray(depth[::-1]))

    def close(self) -> None:
        """Frees the OpenGL objects; safe to call twice."""
        if self._gl:
            self._gl.make_current()
            self._context.free()
            self._gl.free()
            self._gl = None

    def _place(self, position: Array, rotation: Array, fovy: float) -> tuple[float, float]:
        extent = self._model.stat.extent
        near = self._model.vis.map.znear * extent
        far = self._model.vis.map.zfar * extent
        half_height = near * np.tan(np.radians(fovy) / 2)
        for camera in self._scene.camera:  # The two eyes of a stereo pair, here at one place.
            camera.pos[:] = position
            camera.up[:] = rotation[:, 1]
            camera.forward[:] = -rotation[:, 2]
            camera.frustum_center = 0.0
            camera.frustum_width = half_height
            camera.frustum_bottom = -half_height
            camera.frustum_top = half_height
            camera.frustum_near = near
            camera.frustum_far = far
        # The headlight shines from the camera, so it moves with it.
        mujoco.mjv_makeLights(self._model, self._data, self._scene)
        return near, far


def _gl_context() -> mujoco.GLContext:
    try:
        return mujoco.GLContext(MAX_SIZE, MAX_SIZE)
    except Exception as error:  # Every GL back end raises its own type.
        raise UserError(
            f"expected an OpenGL back end (MUJOCO_GL=egl or osmesa), found none ({error}); "
            "`madviz doctor` names the missing library and the line that installs it"
        ) from error

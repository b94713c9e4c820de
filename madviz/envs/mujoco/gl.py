"""Whether MuJoCo can draw on this machine, asked before it fails in its own words.

MuJoCo picks its OpenGL library from ``MUJOCO_GL`` while it is imported. It fails in many ways:
without libEGL an AttributeError of PyOpenGL, without a driver an ImportError out of the first
context and a second exception out of its destructor, and ``glfw`` without a display makes a context
of nothing that crashes when it is used. ``check_gl`` turns all of them into one sentence.

``python -m madviz.envs.mujoco.gl`` prints which driver would draw: the doctor runs it in a
process of its own for every back end, since a back end that was imported once stays.
"""

from __future__ import annotations

import json
import os
import sys

from madviz.errors import UserError


def check_gl() -> None:
    """Raises UserError unless the back end of ``MUJOCO_GL`` loads and finds a driver."""
    backend = os.environ.get("MUJOCO_GL", "").lower().strip()
    if sys.platform == "linux" and backend in ("", "glfw", "glx") and "DISPLAY" not in os.environ:
        raise _missing("there is no display; MUJOCO_GL=egl needs none")
    try:
        import mujoco.gl_context  # noqa: F401  (Importing it is what loads the library.)
    except (ImportError, AttributeError, RuntimeError, OSError) as error:
        raise _missing(f"its library did not load ({error})") from error
    if backend == "egl" and not _egl_has_driver():
        raise _missing("EGL is there, a driver for it is not")


def _egl_has_driver() -> bool:
    from mujoco import egl

    return egl.create_initialized_egl_device_display() != egl.EGL.EGL_NO_DISPLAY


def _missing(why: str) -> UserError:
    backend = os.environ.get("MUJOCO_GL", "")
    return UserError(
        f"expected OpenGL that works under MUJOCO_GL={backend or '(unset)'}, found none: {why}; "
        "`madviz doctor` names the line that installs it"
    )


def probe() -> dict[str, str]:
    """Version and renderer of OpenGL under ``MUJOCO_GL``. Raises UserError where none works."""
    check_gl()
    import mujoco

    context = mujoco.GLContext(64, 64)
    context.make_current()
    # PyOpenGL takes its platform from what MuJoCo has loaded, so it comes after it.
    from OpenGL import GL

    version = GL.glGetString(GL.GL_VERSION)
    renderer = GL.glGetString(GL.GL_RENDERER)
    context.free()
    if not (isinstance(version, bytes) and isinstance(renderer, bytes)):
        raise _missing("a context could be made, but no version be read from it")
    return {"version": version.decode(), "renderer": renderer.decode()}


if __name__ == "__main__":
    try:
        print(json.dumps(probe()))
    except UserError as error:
        raise SystemExit(str(error)) from None

"""Whether SAPIEN can draw on this machine, asked before it fails in its own words.

SAPIEN draws with Vulkan. Without a graphics card that is Mesa's lavapipe, and SAPIEN needs features
that lavapipe has since Mesa 24.3: an older one ends in ``ErrorFeatureNotPresent``, no driver at all
in ``Failed to find a supported physical device``. ``renderer`` turns all of them into one sentence.

``python -m madviz.envs.maniskill.vulkan`` says which device would draw: the doctor runs it in a
process of its own, since a broken driver can crash it.
"""

from __future__ import annotations

import json
from functools import cache
from typing import Any

from madviz.errors import UserError


@cache
def renderer() -> Any:
    """The render system that keeps SAPIEN's Vulkan device alive for this process, 0.2 s at first.
    Raises UserError where SAPIEN is not installed or cannot draw."""
    try:
        import sapien
        import sapien.render
    except (ImportError, OSError) as error:
        raise _missing(f"the package sapien does not load ({error})") from error
    try:
        return sapien.render.RenderSystem(sapien.Device("cpu"))
    except Exception as error:  # Vulkan's errors come as RuntimeError of several kinds.
        raise _missing(str(error).strip() or type(error).__name__) from error


def _missing(why: str) -> UserError:
    return UserError(
        f"expected Vulkan with Mesa 24.3 or newer to draw ManiSkill, found: {why}; run `make "
        "setup` (it installs libvulkan1 and mesa-vulkan-drivers); `madviz doctor` says what is here"
    )


def probe() -> dict[str, str]:
    """The device that draws, by name. Raises UserError where none does."""
    renderer()
    import sapien.render

    return {"device": device_name(sapien.render.get_device_summary())}


def device_name(summary: str) -> str:
    """The first device in SAPIEN's summary whose entry says that it is supported.

    ``GPU: llvmpipe (LLVM 15.0.6, 256 bits)`` with ``Supported: 1`` -> ``llvmpipe (LLVM 15.0.6, 256
    bits)``; '' if there is none."""
    name = ""
    for line in summary.splitlines():
        key, _, value = line.partition(":")
        if key.strip() == "GPU":
            name = value.strip()
        elif key.strip() == "Supported" and value.strip() == "1":
            return name
    return ""


if __name__ == "__main__":
    try:
        print(json.dumps(probe()))
    except UserError as error:
        raise SystemExit(str(error)) from None

"""SAPIEN's shaders without a table that takes seconds before the first picture.

Before its first picture SAPIEN computes how much of the light around it a surface reflects, for
every roughness and angle (the BRDF's table). A GPU does that at once. lavapipe, which computes on
one core, takes seconds for it in every process that draws: simulations, workers, recorders. On a
slow server the second visitor's first picture came after 14 to 15 s, and comes after 2.5 to 2.7 s
without it. The tasks' scenes have no picture of surroundings, so what the table says is multiplied
by black.

SAPIEN computes the table only if a shader reads it. So its shader pack is copied into the user's
cache folder with a zero where the table was read. Pictures are the same to the bit. A scene that
has surroundings, a shader written otherwise than expected, or a home that cannot be written: the
stock pack is taken, and only the time is lost.
"""

from __future__ import annotations

import hashlib
import re
from functools import cache
from pathlib import Path
from typing import Any

from madviz.system.files import cache_folder, write_bytes

STOCK = "minimal"
"""ManiSkill's default pack for observations, a folder of SAPIEN's."""
_TABLE = b"samplerBRDFLUT"
_DECLARED = re.compile(rb"^layout\([^)]*\) uniform sampler2D samplerBRDFLUT;\n", re.MULTILINE)
_READ = re.compile(rb"texture\(samplerBRDFLUT, vec2\(\w+, \w+\)\)\.xy")


def shader_pack(scene: Any) -> str:
    """The pack to draw a SAPIEN ``scene`` with: its name, or a folder."""
    if scene.render_system.cubemap is not None:
        return STOCK
    return _without_table() or STOCK


@cache
def _without_table() -> str:
    """The folder of the changed copy; '' where there can be none."""
    import sapien

    stock = Path(sapien.__file__).parent / "vulkan_shader"
    try:
        return str(copied(stock) or "")
    except OSError:
        return ""


def copied(stock: Path) -> Path | None:
    """The pack of SAPIEN's shader folder ``stock``, copied without the table into the cache; None
    if a shader would still name it. Raises OSError where it cannot be written."""
    files = {
        file.relative_to(stock): without_table(file.read_bytes())
        for folder in (STOCK, "common")  # Shaders of the one include files of the other.
        for file in sorted((stock / folder).iterdir())
    }
    if any(_TABLE in content for content in files.values()):
        return None
    digest = hashlib.sha256(repr(sorted(files.items())).encode()).hexdigest()
    made = cache_folder() / "shaders" / digest[:32]
    for name, content in files.items():
        path = made / name
        if not path.is_file() or path.read_bytes() != content:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(path, content)
    return made / STOCK


def without_table(shader: bytes) -> bytes:
    """The text of a ``shader`` with a zero where it reads the table."""
    return _READ.sub(b"vec2(0)", _DECLARED.sub(b"", shader))

"""A check of this machine: its parts, its drawing speed, and the command that adds a missing part.

Nothing here may fail because something is missing: that is the case it is for. OpenGL back
ends are therefore tried in processes of their own (a broken driver can take its process along, and
MuJoCo keeps the back end it was imported with), and packages are looked up without importing them.
"""

from __future__ import annotations

import json
import os
import platform
import re
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from ctypes.util import find_library
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, get_args

from madviz.envs.custom import is_own
from madviz.envs.registry import RenderProfile, TaskName, check_task, env_spec, make_env
from madviz.errors import UserError
from madviz.recorded.storage import cache_bytes, clear_cache, recordings_cache
from madviz.system.browser import find_browser
from madviz.system.machine import cores
from madviz.types import Environment

PACKAGES = (
    "torch",
    "metaworld",
    "mujoco",
    "mani-skill",
    "sapien",
    "gymnasium",
    "viser",
    "numpy",
)
EXTENSIONS = ("avx2", "avx512f", "avx512_bf16", "amx_bf16", "amx_int8", "bf16")
"""CPU extensions that make this package quick; ``bf16`` is what ARM calls it."""
TESTED_MESA = (25, 0)
"""The bundled policies learned from its pictures."""

PROVIDERS = {
    "egl": "libegl1 libegl-mesa0 libgl1-mesa-dri",
    "osmesa": "libosmesa6",
    "vulkan": "libvulkan1 mesa-vulkan-drivers",
    "browser": "chromium",
}
"""Debian's packages for what may be missing."""


@dataclass(frozen=True)
class DoctorConfig:
    """Says what is missing here and the command that fixes it."""

    json: str | None = None
    """Write the report to this file; ``-`` is standard output, and then nothing else goes there."""
    task: TaskName = "metaworld/hammer"
    """The task whose frames are timed; ``maniskill/push-cube`` times Vulkan's."""
    clear_recordings: bool = False
    """Remove the decoded pictures of recordings; they are decoded anew when they are needed."""


@dataclass(frozen=True)
class Check:
    """One thing that was checked."""

    name: str
    found: str
    """The part that is there, in words; '' if none."""
    needed: bool = True
    """Whether madviz cannot run without it."""
    fix: str = ""
    """The line to run if it is missing or too old."""

    @property
    def sound(self) -> bool:
        return bool(self.found) and not self.fix


def install_line(what: str) -> str:
    """The line that installs what may be missing; without sudo for root, who may not have it."""
    sudo = "" if os.geteuid() == 0 else "sudo "
    return f"{sudo}apt-get install -y {PROVIDERS[what]}"


def check_opengl(probe: Callable[[str], dict[str, str] | None], chosen: str = "egl") -> list[Check]:
    """EGL, OSMesa and the Mesa behind them. Only the back end that is ``chosen`` is needed."""
    checks = []
    mesa = ""
    for backend, label in (("egl", "EGL"), ("osmesa", "OSMesa")):
        answer = probe(backend)
        needed = backend == chosen
        if answer is None:
            other = os.environ.get("PYOPENGL_PLATFORM", backend) not in ("", backend)
            fix = "unset PYOPENGL_PLATFORM" if needed and other else install_line(backend)
            checks.append(Check(label, "", needed, fix))
            continue
        checks.append(Check(label, answer["renderer"], needed))
        mesa = mesa or mesa_version(answer["version"])
    old = bool(mesa) and tuple(map(int, mesa.split(".")[:2])) < TESTED_MESA
    if mesa:
        found = f"{mesa} (policies were trained under 25.0)" if old else mesa
        checks.append(
            Check("Mesa", found, needed=False, fix="python3 tools/system.py" if old else "")
        )
    return checks


def mesa_version(gl_version: str) -> str:
    """``4.5 (Compatibility Profile) Mesa 25.0.7-2`` -> ``25.0.7``; '' if it is another's driver."""
    match = re.search(r"Mesa (\d+(?:\.\d+)+)", gl_version)
    return match[1] if match else ""


def probe_opengl(backend: str) -> dict[str, str] | None:
    """Version and renderer under ``MUJOCO_GL=backend``, asked of another process; None if that
    process found nothing, hung or did not survive."""
    return _ask("madviz.envs.mujoco.gl", {"MUJOCO_GL": backend})


def probe_vulkan() -> dict[str, str] | None:
    """The device SAPIEN draws with, asked of another process; None as for ``probe_opengl``."""
    return _ask("madviz.envs.maniskill.vulkan", {})


def _ask(module: str, variables: dict[str, str]) -> dict[str, str] | None:
    command = [sys.executable, "-m", module]
    environment = {**os.environ, **variables}
    try:
        asked = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    except subprocess.TimeoutExpired:
        return None
    return json.loads(asked.stdout) if asked.returncode == 0 else None


def check_vulkan(
    probe: Callable[[], dict[str, str] | None] = probe_vulkan,
    folders: tuple[str, ...] = ("/usr/share/vulkan", "/etc/vulkan"),
) -> Check:
    """Whether ManiSkill can draw: the loader, the drivers it would find, and a device that has what
    SAPIEN needs. Without one, everything but ManiSkill's tasks works."""
    drivers = [path.stem for f in folders for path in sorted(Path(f, "icd.d").glob("*.json"))]
    if not (find_library("vulkan") and drivers):
        return Check("Vulkan", "", needed=False, fix=install_line("vulkan"))
    answer = probe()
    if answer is None:
        found = f"drivers {' '.join(drivers)}, none that SAPIEN can use (Mesa 24.3 or newer)"
        return Check("Vulkan", found, needed=False, fix="python3 tools/system.py")
    return Check("Vulkan", answer["device"], needed=False)


def check_packages(names: tuple[str, ...] = PACKAGES) -> list[Check]:
    """Python and the packages whose versions matter."""
    checks = [Check("Python", platform.python_version())]
    for name in names:
        try:
            checks.append(Check(name, version(name)))
        except PackageNotFoundError:
            checks.append(Check(name, "", fix="make setup"))
    return checks


def check_browser() -> Check:
    path = find_browser()
    return Check("Chromium", path or "", needed=False, fix="" if path else install_line("browser"))


def check_recordings(clear: bool) -> list[Check]:
    """The size of what is decoded of recordings, if anything is; with ``clear`` it is removed."""
    size = cache_bytes()
    if not size:
        return []
    found = f"{size / 1e9:.2f} GB of decoded pictures in {recordings_cache()}"
    if clear:
        clear_cache()
    said = "; removed" if clear else "; --clear-recordings removes them"
    return [Check("Recordings", found + said, needed=False)]


def describe_cpu(cpuinfo: str, cores: int) -> Check:
    """Cores this process may use, and the matrix and bfloat16 instructions among the flags."""
    flags = set(re.findall(r"\w+", " ".join(re.findall(r"(?:flags|Features)\s*:(.*)", cpuinfo))))
    quick = [flag for flag in EXTENSIONS if flag in flags]
    return Check("CPU", f"{cores} cores, {' '.join(quick) or 'no bf16 or AMX'}")


def check_cpu() -> Check:
    path = Path("/proc/cpuinfo")
    return describe_cpu(path.read_text() if path.exists() else "", cores())


def time_frames(
    task: str, make: Callable[[str, str], Environment] = make_env, repeats: int = 5
) -> dict[str, dict[str, float]]:
    """Milliseconds of one frame by render profile and camera, the median of ``repeats``."""
    table: dict[str, dict[str, float]] = {}
    profiles = [env_spec(task).render_profile] if is_own(task) else get_args(RenderProfile)
    for profile in profiles:
        env = make(task, profile)
        env.reset(seed=0)
        table[profile] = {}
        for camera in env.spec.cameras:
            env.view(camera.name)  # The first one also compiles shaders.
            times = []
            for _ in range(repeats):
                started = time.perf_counter()
                env.view(camera.name)
                times.append(1000 * (time.perf_counter() - started))
            table[profile][camera.name] = round(statistics.median(times), 2)
        env.close()
    return table


def examine(config: DoctorConfig) -> dict[str, Any]:
    """The whole report. Key ``ok`` is True if nothing that madviz needs is missing. Raises
    UserError for an unknown task."""
    check_task(config.task)
    checks = [check_cpu(), *check_packages()]
    checks += check_opengl(probe_opengl, os.environ.get("MUJOCO_GL", "egl"))
    checks += [check_vulkan(), check_browser(), *check_recordings(config.clear_recordings)]
    report: dict[str, Any] = {
        "schema": 1,
        "ok": all(check.sound or not check.needed for check in checks),
        "checks": [row(check) for check in checks],
        "frames_ms": {},
    }
    if report["ok"]:
        try:
            report["frames_ms"] = time_frames(config.task)
        except UserError as error:
            report["ok"] = False
            report["checks"].append(row(Check("A frame", "", fix=str(error))))
    return report


def row(check: Check) -> dict[str, Any]:
    """``check`` in the report. ``mend`` is the older name of ``fix``, kept for scripts."""
    return {**asdict(check), "mend": check.fix, "ok": check.sound}


def in_words(report: Mapping[str, Any]) -> str:
    """The report as a person reads it."""
    lines = []
    for check in report["checks"]:
        mark = "ok" if check["ok"] else "MISSING" if check["needed"] else "without"
        lines.append(f"{mark:8} {check['name']:10} {check['found'] or 'not found'}")
        if check["fix"]:
            lines.append(f"{'':19} fix it:   {check['mend']}")
    for profile, frames in report["frames_ms"].items():
        times = ", ".join(f"{camera} {ms:.1f} ms" for camera, ms in frames.items())
        lines.append(f"{'frame':8} {profile:10} {times}; together {sum(frames.values()):.1f} ms")
    lines.append("All that madviz needs is here." if report["ok"] else "Something is missing.")
    return "\n".join(lines)

"""The doctor on machines that lack something, and one that lacks everything."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from madviz.envs import doctor
from madviz.envs.doctor import Check, DoctorConfig, check_opengl, check_packages, describe_cpu
from madviz.errors import UserError

MESA = {"version": "4.5 (Compatibility Profile) Mesa 25.0.7-2", "renderer": "llvmpipe"}


def by_name(checks: list[Check]) -> dict[str, Check]:
    return {check.name: check for check in checks}


def test_opengl_that_is_found_is_ok() -> None:
    checks = by_name(check_opengl(lambda backend: MESA))
    assert all(check.sound for check in checks.values())
    assert checks["Mesa"].found == "25.0.7"


def test_only_the_chosen_back_end_is_needed() -> None:
    checks = by_name(check_opengl(lambda backend: MESA if backend == "osmesa" else None, "osmesa"))
    assert not checks["EGL"].needed and checks["OSMesa"].needed
    assert "apt-get install" in checks["EGL"].fix and "libegl1" in checks["EGL"].fix


def test_a_variable_that_stands_against_the_back_end_is_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("PYOPENGL_PLATFORM", "glx")
    checks = by_name(check_opengl(lambda backend: None))
    assert checks["EGL"].fix == "unset PYOPENGL_PLATFORM"
    assert "apt-get" in checks["OSMesa"].fix


def test_a_task_that_is_none_is_a_mistake_and_nothing_is_missing() -> None:
    with pytest.raises(UserError, match="unknown task"):
        doctor.examine(doctor.DoctorConfig(task="metaworld/hamer"))


def test_an_old_mesa_is_named_with_the_line_that_replaces_it() -> None:
    old = {**MESA, "version": "4.5 (Compatibility Profile) Mesa 22.3.6"}
    mesa = by_name(check_opengl(lambda backend: old))["Mesa"]
    assert not mesa.sound and not mesa.needed and "tools/system.py" in mesa.fix


def test_a_driver_that_is_not_mesa_has_no_mesa_line() -> None:
    checks = by_name(check_opengl(lambda backend: {"version": "4.6 NVIDIA 570", "renderer": "H"}))
    assert "Mesa" not in checks


def test_a_package_that_is_missing_points_to_the_set_up() -> None:
    python, missing = check_packages(("no-such-package-of-ours",))
    assert python.sound and not missing.sound and missing.fix == "make setup"


def test_the_processor_is_described_by_cores_and_fast_instructions() -> None:
    cpu = describe_cpu("flags\t: fpu avx2 amx_bf16 amx_tile\nbugs : bf16\n", 2)
    assert cpu.found == "2 cores, avx2 amx_bf16"
    assert "no bf16" in describe_cpu("", 1).found


def test_frames_are_timed_for_every_profile_and_camera() -> None:
    frames = doctor.time_frames("toy/reach", repeats=1)
    assert frames.keys() == {"fast", "full"}
    assert frames["fast"].keys() == {"first", "third_a", "third_b"}
    assert all(ms > 0 for profile in frames.values() for ms in profile.values())


def test_a_task_of_ones_own_is_timed_in_the_profile_that_it_has(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("MADVIZ_TASKS", "madviz.examples.own_task:make")
    assert list(doctor.time_frames("madviz.examples.own_task:make", repeats=1)) == ["fast"]


def test_a_machine_without_anything_gets_a_whole_report(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "probe_opengl", lambda backend: None)
    monkeypatch.setattr(doctor, "find_library", lambda name: None)
    monkeypatch.setattr(doctor, "PACKAGES", ("no-such-package-of-ours",))
    monkeypatch.setenv("PATH", "/nonexistent")
    report = doctor.examine(DoctorConfig())
    missing = [check for check in report["checks"] if not check["ok"]]
    assert not report["ok"] and report["frames_ms"] == {}
    assert {"EGL", "OSMesa", "Vulkan", "Chromium"} <= {check["name"] for check in missing}
    assert all(check["fix"] for check in missing)
    assert "fix it:" in doctor.in_words(report)


def test_opengl_without_a_driver_is_reported_without_a_traceback(tmp_path: Path) -> None:
    environment = {**os.environ, "MUJOCO_GL": "egl", "__EGL_VENDOR_LIBRARY_DIRS": str(tmp_path)}
    command = [sys.executable, "-m", "madviz", "doctor", "--json", "-"]
    asked = subprocess.run(command, env=environment, capture_output=True, text=True)
    report = json.loads(asked.stdout)
    assert asked.returncode == 1 and not report["ok"]
    egl = next(check for check in report["checks"] if check["name"] == "EGL")
    assert not egl["ok"] and "libegl" in egl["fix"]
    assert "Traceback" not in asked.stderr

"""The wheel: what it holds, and that it works in an empty folder without this repository."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import urllib.request
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "madviz"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from the source archive, as for a release."""
    out = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out), str(ROOT)]
    subprocess.run(command, check=True, capture_output=True)
    [built] = out.glob("*.whl")
    assert list(out.glob("*.tar.gz"))
    return built


def test_a_wheel_holds_every_file_of_the_package(wheel: Path) -> None:
    held = set(zipfile.ZipFile(wheel).namelist())
    files = {
        path.relative_to(ROOT).as_posix()
        for path in PACKAGE.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert sorted(files - held) == []
    assert {name.split("/")[0] for name in held if "dist-info" not in name} == {"madviz"}
    assert wheel.stat().st_size < 10_000_000


def test_an_installed_wheel_finds_its_two_policies(wheel: Path, tmp_path: Path) -> None:
    target, empty = tmp_path / "installed", tmp_path / "empty"
    empty.mkdir()
    zipfile.ZipFile(wheel).extractall(target)
    listed = subprocess.run(
        [sys.executable, "-m", "madviz", "list", "--json", "-"],
        cwd=empty,
        env={**os.environ, "PYTHONPATH": str(target), "MADVIZ_CHECKPOINTS": ""},
        capture_output=True,
        text=True,
        check=True,
    )
    policies = {each["name"]: each["path"] for each in json.loads(listed.stdout)["policies"]}
    assert set(policies) == {"metaworld-hammer-mad-light", "metaworld-hammer-merged-only-light"}
    assert all(path.startswith(str(target)) for path in policies.values())


@pytest.mark.slow
def test_a_wheel_in_an_environment_of_its_own_serves_the_page(wheel: Path, tmp_path: Path) -> None:
    """Everything is installed anew, some 3 GB."""
    python = tmp_path / "venv" / "bin" / "python"
    subprocess.run([sys.executable, "-m", "venv", str(tmp_path / "venv")], check=True)
    pinned = ["--constraint", str(ROOT / "constraints.txt")]
    subprocess.run([python, "-m", "pip", "install", "-q", *pinned, str(wheel)], check=True)
    empty = tmp_path / "empty"
    empty.mkdir()
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    serving = subprocess.Popen(
        [python.with_name("madviz"), "explore", "--port", "0"],
        cwd=empty,
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert serving.stdout is not None
        address = next(
            word for line in serving.stdout for word in line.split() if "http://" in word
        )
        with urllib.request.urlopen(address, timeout=60) as page:
            assert b"<html" in page.read(2000).lower()
    finally:
        serving.terminate()
        serving.wait(30)

"""Scripts and styles of the page: that an installed wheel has them, and that each runs once."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from zipfile import ZipFile

import pytest

from madviz.app.browser import SCRIPTS, equip, read
from madviz.app.viser_patches import SWITCH, patch_rendering

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "madviz" / "app" / "browser"
FILES = sorted(path.name for path in FOLDER.iterdir() if path.suffix in (".css", ".html", ".js"))


class Client:
    """A visitor's page that notes which scripts it is sent."""

    def __init__(self) -> None:
        self.sources: list[str] = []
        self._websock_connection = SimpleNamespace(
            queue_message=lambda message: self.sources.append(message.source)
        )


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """A folder with what a wheel of this package installs."""
    folder = tmp_path_factory.mktemp("wheel")
    source, site = folder / "source", folder / "site"
    shutil.copytree(ROOT / "madviz", source / "madviz", ignore=shutil.ignore_patterns("*.pyc"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    program = "from setuptools import build_meta; build_meta.build_wheel('..')"
    subprocess.run([sys.executable, "-c", program], cwd=source, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    ZipFile(wheel).extractall(site)
    return site


def test_an_installed_wheel_reads_every_script_and_style(installed: Path):
    program = (
        "import sys; sys.path.insert(0, '.'); import madviz.app.browser as browser\n"
        "print(browser.__file__)\n"
        "for name in sys.argv[1:]: print(len(browser.read(name)))"
    )
    found = subprocess.run(
        [sys.executable, "-I", "-c", program, *FILES],
        cwd=installed,
        check=True,
        capture_output=True,
        text=True,
    )
    place, *lengths = found.stdout.split()
    assert Path(place).resolve().is_relative_to(installed.resolve())
    assert list(map(int, lengths)) == [len((FOLDER / name).read_text("utf-8")) for name in FILES]


def test_every_script_is_sent_to_a_page_and_runs_once():
    client = Client()
    equip(client)  # type: ignore[arg-type]
    patch_rendering(client)  # type: ignore[arg-type]
    sent = {f"{name}.js" for name in (*SCRIPTS, "rendering")}
    otherwise = {"arrive.js", "returned.js"}  # With the page itself, and at every connection.
    assert sent | otherwise == {name for name in FILES if name.endswith(".js")}
    assert len(client.sources) == len(sent) + 1, "and the style"
    for source in client.sources:
        assert "if (ran." in source.splitlines()[0]
    assert any(read("grid.js") in source for source in client.sources)


def test_viser_stays_as_it_is_where_the_environment_says_so(monkeypatch):
    client = Client()
    monkeypatch.setenv(SWITCH, "0")
    patch_rendering(client)  # type: ignore[arg-type]
    assert client.sources == []

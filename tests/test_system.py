"""tools/system.py: which packages it wants, and the apt source it derives. And the pinned ones."""

from __future__ import annotations

import importlib.util
import tomllib
from importlib.metadata import distributions
from pathlib import Path
from types import ModuleType

import pytest
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
SCRIPT = ROOT / "tools" / "system.py"

DEB822 = """\
Types: deb deb-src
# a comment, with a colon: here
URIs: http://mirror.example/debian
Suites: bookworm bookworm-updates
Components: main contrib
Signed-By:
 -----BEGIN PGP PUBLIC KEY BLOCK-----
 key
 -----END PGP PUBLIC KEY BLOCK-----

Types: deb
URIs: http://mirror.example/debian-security
Suites: bookworm-security
Components: main
"""
DERIVED = """\
Types: deb
Suites: bookworm-backports
Components: main
URIs: http://mirror.example/debian
Signed-By:
 -----BEGIN PGP PUBLIC KEY BLOCK-----
 key
 -----END PGP PUBLIC KEY BLOCK-----
"""


@pytest.fixture
def system() -> ModuleType:
    spec = importlib.util.spec_from_file_location("system", SCRIPT)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def everything(system: ModuleType) -> dict[str, str]:
    """A machine on which nothing is missing."""
    return dict.fromkeys((*system.LIBRARIES, *system.MESA), "25.0.7-2")


def derive(system: ModuleType, folder: Path, name: str, text: str) -> tuple[str, str] | None:
    (folder / "sources.list.d").mkdir(exist_ok=True)
    (folder / name).write_text(text)
    found = system.derived_source(folder, "bookworm", "bookworm-backports")
    return found and (str(found[0].relative_to(folder)), found[1])


def test_a_stanza_keeps_mirror_and_key(system: ModuleType, tmp_path: Path) -> None:
    found = derive(system, tmp_path, "sources.list.d/debian.sources", DEB822)
    assert found == ("sources.list.d/madviz-backports.sources", DERIVED)


def test_a_line_keeps_mirror_and_options(system: ModuleType, tmp_path: Path) -> None:
    text = (
        "# deb http://old.example/debian bookworm main\n"
        "deb cdrom:[Debian 12]/ bookworm main\n"
        "deb [arch=amd64 signed-by=/k] http://mirror.example/debian bookworm main contrib\n"
    )
    line = "deb [arch=amd64 signed-by=/k] http://mirror.example/debian bookworm-backports main\n"
    found = derive(system, tmp_path, "sources.list", text)
    assert found == ("sources.list.d/madviz-backports.list", line)


@pytest.mark.parametrize(
    "change", [("Types: deb deb-src", "Types: deb-src"), ("bookworm ", "sid ")]
)
def test_no_source_is_derived_from_what_does_not_serve_the_suite(
    system: ModuleType, tmp_path: Path, change: tuple[str, str]
) -> None:
    text = DEB822.replace(*change)
    assert derive(system, tmp_path, "sources.list.d/debian.sources", text) is None


def test_a_disabled_source_is_none(system: ModuleType, tmp_path: Path) -> None:
    text = "Enabled: no\n" + DEB822
    assert derive(system, tmp_path, "sources.list.d/debian.sources", text) is None


def test_backports_that_are_known_already_are_noticed(system: ModuleType, tmp_path: Path) -> None:
    derive(system, tmp_path, "sources.list.d/debian.sources", DEB822)
    assert not system.serves(tmp_path, "bookworm-backports")
    (tmp_path / "sources.list.d" / "mine.sources").write_text(DERIVED)
    assert system.serves(tmp_path, "bookworm-backports")


def test_a_machine_that_has_everything_is_left_alone(
    system: ModuleType, everything: dict[str, str]
) -> None:
    assert system.wanted(everything, "bookworm", browser=False) == []


def test_old_mesa_is_replaced_only_where_backports_exist(
    system: ModuleType, everything: dict[str, str]
) -> None:
    old = everything | dict.fromkeys(system.MESA, "22.3.6-1+deb12u1")
    assert system.wanted(old, "bookworm", browser=False) == list(system.MESA)
    assert system.wanted(old, "jammy", browser=False) == []


def test_what_is_missing_is_wanted_but_the_optional_alone_is_not(
    system: ModuleType, everything: dict[str, str]
) -> None:
    without = {n: v for n, v in everything.items() if n != "libosmesa6"}
    assert system.wanted(without, "trixie", browser=False) == []
    del without["libegl1"]
    assert system.wanted(without, "trixie", browser=False) == ["libegl1", "libosmesa6"]


def test_without_root_and_without_sudo_the_line_to_run_is_printed(
    system: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(system.shutil, "which", lambda name: None)
    assert system.as_root(["python3", "tools/system.py", "--browser"]) == 1
    assert "\n    sudo python3 tools/system.py --browser\n" in capsys.readouterr().out


@pytest.mark.parametrize("offers", [True, False])
def test_backports_that_cannot_be_had_leave_no_source_behind(
    system: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, offers: bool
) -> None:
    derive(system, tmp_path, "sources.list.d/debian.sources", DEB822)
    ran: list[str] = []
    monkeypatch.setattr(system, "SOURCES", tmp_path)
    monkeypatch.setattr(system, "apt", lambda *words: ran.append(words[0]) or 0)
    monkeypatch.setattr(system, "ask", lambda *words: "500 bookworm-backports/main" * offers)
    target = system.add_backports("bookworm")
    written = tmp_path / "sources.list.d" / "madviz-backports.sources"
    assert target == (["-t", "bookworm-backports"] if offers else [])
    assert written.exists() == offers and ran == ["update"] * (1 if offers else 2)


def test_every_pinned_package_works_with_the_oldest_python() -> None:
    """Debian 12 has Python 3.11.2; the versions are chosen on a newer one."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    oldest = project["requires-python"].removeprefix(">=") + ".0"
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pinned = {canonicalize_name(line.split("==")[0]) for line in lines if "==" in line}
    found = [one for one in distributions() if canonicalize_name(one.name) in pinned]
    assert len(found) > len(pinned) / 2
    needs = {f"{one.name} {one.version}": one.metadata["Requires-Python"] or "" for one in found}
    assert {k: v for k, v in needs.items() if not SpecifierSet(v).contains(oldest)} == {}

"""The system libraries madviz draws with:
``python3 tools/system.py [--browser] [--node] [--dry-run]``.

Problem: Debian 12's own Mesa is 22.3. MuJoCo draws with it, but the bundled policies learned from
pictures of Mesa 25.0, and simulators that draw through Vulkan need 24.3 or newer. Idea: Debian 12
offers 25.0.7 in its backports, so write a second apt source, derived from the one this machine
already uses (same mirror, same key, suite ``bookworm-backports``), and install Mesa from there.
Newer systems bring a Mesa that will do. Where backports cannot be had, the stock Mesa has to.

What is there already is left alone: with everything installed this ends in 0.1 s. As root it
installs; as somebody with passwordless sudo it calls itself through sudo; otherwise it stops and
prints the one line to run. Standard library only, since it runs before there is an environment.
"""

from __future__ import annotations

import argparse
import ctypes.util
import importlib.util
import os
import platform
import re
import shutil
import subprocess
import sys
from pathlib import Path

LIBRARIES = ("libegl1", "libgl1", "libvulkan1")
MESA = ("libegl-mesa0", "libgl1-mesa-dri", "libglx-mesa0", "mesa-vulkan-drivers", "libosmesa6")
OPTIONAL = ("libosmesa6",)
"""Mesa 25.1 dropped OSMesa; EGL does the same work."""
NEWEST_TOO_OLD = (24, 2)
"""Mesa releases up to this one are replaced where backports exist."""
BACKPORTS = {"bookworm": "bookworm-backports"}
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
NODE = {"nodejs": "node", "npm": "npm"}
"""Package and program: for ``madviz site``, which takes its browser's programs from npm."""
SOURCES = Path("/etc/apt")


def deb822_backports(text: str, suite: str, backports: str) -> str | None:
    """The first stanza of a ``.sources`` text that serves ``suite``, rewritten to ``backports``."""
    for stanza in re.split(r"\n\s*\n", text):
        lines = [line for line in stanza.splitlines() if line.strip() and line[0] != "#"]
        heads = [line.split(":", 1) for line in lines if ":" in line and not line[0].isspace()]
        fields = {name.lower(): value.split() for name, value in heads}
        usable = "deb" in fields.get("types", []) and fields.get("enabled") != ["no"]
        if not usable or suite not in fields.get("suites", []):
            continue
        replaced = {"types": "deb", "suites": backports, "components": "main"}
        others = [line for line in lines if line.split(":")[0].lower() not in replaced]
        return "\n".join([f"{k.title()}: {v}" for k, v in replaced.items()] + others) + "\n"
    return None


def one_line_backports(text: str, suite: str, backports: str) -> str | None:
    """The first ``deb`` line of a ``.list`` file that serves ``suite``, rewritten alike."""
    for line in text.splitlines():
        found = re.match(r"deb\s+(\[[^]]*\]\s+)?(\S+)\s+(\S+)\s", line)
        if found and found[3] == suite and not found[2].startswith("cdrom:"):
            return f"deb {found[1] or ''}{found[2]} {backports} main\n"
    return None


def derived_source(root: Path, suite: str, backports: str) -> tuple[Path, str] | None:
    """The file to write below ``root`` so that apt knows ``backports``; None if there is nothing
    to derive it from."""
    for path in (root / "sources.list", *sorted((root / "sources.list.d").glob("*"))):
        derive = {".list": one_line_backports, ".sources": deb822_backports}.get(path.suffix)
        text = derive(path.read_text(), suite, backports) if derive and path.is_file() else None
        if text:
            return root / "sources.list.d" / f"madviz-backports{path.suffix}", text
    return None


def serves(root: Path, suite: str) -> bool:
    """Whether a source below ``root`` names ``suite`` already."""
    paths = [root / "sources.list", *(root / "sources.list.d").glob("*")]
    texts = [p.read_text() for p in paths if p.suffix in (".list", ".sources") and p.is_file()]
    lines = [line for text in texts for line in text.splitlines() if not line.startswith("#")]
    return any(suite in line.split() for line in lines)


def release(version: str) -> tuple[int, ...]:
    """``25.0.7-2~bpo12+1`` -> (25, 0)."""
    return tuple(int(number) for number in re.findall(r"\d+", version)[:2])


def wanted(
    installed: dict[str, str], codename: str, browser: bool, node: bool = False
) -> list[str]:
    """The packages to install, given those (name: version) that are there."""
    missing = [name for name in (*LIBRARIES, *MESA) if name not in installed]
    if codename in BACKPORTS:
        old = [n for n in MESA if n in installed and release(installed[n]) <= NEWEST_TOO_OLD]
        missing += old
    if set(missing) <= set(OPTIONAL):
        missing = []
    if ctypes.util.find_library("gthread-2.0") is None:  # For OpenCV; its package's name varies.
        missing.append("libglib2.0-0")
    if importlib.util.find_spec("ensurepip") is None and not shutil.which("uv"):
        missing.append(f"python3.{sys.version_info.minor}-venv")
    if browser and not any(map(shutil.which, BROWSERS)):
        missing.append("chromium")
    if node:
        missing += [package for package in NODE if not shutil.which(NODE[package])]
    return missing


def ask(*command: str) -> str:
    """What ``command`` prints; '' if it fails."""
    found = subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL)
    return found.stdout if found.returncode == 0 else ""


def installed_versions() -> dict[str, str]:
    """Name and version of every installed package among those of interest."""
    show = ("dpkg-query", "-W", "-f", "${db:Status-Status} ${Package} ${Version}\n")
    listed = subprocess.run([*show, *LIBRARIES, *MESA], capture_output=True, text=True).stdout
    rows = [line.split() for line in listed.splitlines()]
    return {name: version for status, name, version in rows if status == "installed"}


def offered(package: str) -> bool:
    """Whether apt has any version of ``package``."""
    return bool(re.search(r"Candidate: (?!\(none\))", ask("apt-cache", "policy", package)))


def apt(*words: str) -> int:
    """Runs apt-get without questions; its output goes to the terminal."""
    command = ["apt-get", "-o", "DPkg::Lock::Timeout=300", *words]
    print("+", *command, flush=True)
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    return subprocess.run(command, stdin=subprocess.DEVNULL, env=environment).returncode


def add_backports(codename: str) -> list[str]:
    """Makes apt know the backports, refreshes its lists; the ``-t`` words for the install."""
    suite, added = BACKPORTS.get(codename, ""), None
    if suite and not serves(SOURCES, suite):
        added = derived_source(SOURCES, codename, suite)
        if added:
            added[0].write_text(added[1])
    apt("update")
    if suite and suite in ask("apt-cache", "policy", "libgl1-mesa-dri"):
        return ["-t", suite]
    if added:
        added[0].unlink()
        apt("update")
    if suite:
        print(
            f"warning: {suite} cannot be had here, so Mesa stays at the stock version. madviz runs "
            "with it; pictures may differ a little from those the bundled policies learned from."
        )
    return []


def install(packages: list[str], codename: str) -> int:
    """Installs as root. Chromium comes from the stock suite, which gets security updates."""
    target = add_backports(codename)
    graphics = [p for p in packages if p in (*LIBRARIES, *MESA)]
    graphics = [p for p in graphics if p not in OPTIONAL or offered(p)]
    others = [p for p in packages if p not in (*LIBRARIES, *MESA)]
    words = ("install", "--yes", "--no-install-recommends")
    for options, names in ((target, graphics), ([], others)):
        if names and apt(*words, *options, *names) != 0:
            print(f"error: apt could not install {' '.join(names)}; its own message is above")
            return 1
    return 0


def as_root(command: list[str]) -> int:
    """Runs ``command`` through sudo where that asks no password; otherwise prints the line."""
    sudo = shutil.which("sudo")
    if sudo and subprocess.run([sudo, "-n", "true"], capture_output=True).returncode == 0:
        return subprocess.run([sudo, "-n", *command]).returncode
    print("error: this needs root. Run this line, then the same make command again:")
    print("    sudo " + " ".join(command))
    return 1


def unfit() -> str:
    """Why this cannot run here; '' if it can."""
    if sys.version_info < (3, 11):  # noqa: UP036  (This file meets the machine's own Python.)
        found = platform.python_version()
        return (
            f"error: expected Python 3.11 or newer, found {found}; try `make PYTHON=python3.11 …`"
        )
    if not (shutil.which("apt-get") and shutil.which("dpkg-query")):
        return (
            "note: no apt here; docs/install.md lists what to install, `madviz doctor` what lacks"
        )
    return ""


def main() -> int:
    parser = argparse.ArgumentParser(description="Installs the system libraries madviz draws with.")
    parser.add_argument("--browser", action="store_true", help="Chromium too, for the tests")
    parser.add_argument("--node", action="store_true", help="Node and npm too, for a site")
    parser.add_argument("--dry-run", action="store_true", help="only say what would be installed")
    options = parser.parse_args()
    if complaint := unfit():
        print(complaint)
        return int(complaint.startswith("error"))
    system = platform.freedesktop_os_release()
    codename = system.get("VERSION_CODENAME", "")
    packages = wanted(installed_versions(), codename, options.browser, options.node)
    if "chromium" in packages and system.get("ID") == "ubuntu":
        packages.remove("chromium")
        print("note: Ubuntu's chromium is a snap; the browser tests take a google-chrome instead")
    if packages:
        print("System packages to install:", *packages, flush=True)
    if options.dry_run or not packages:
        return 0
    if os.geteuid() == 0:
        return install(packages, codename)
    return as_root([sys.executable, str(Path(__file__).resolve()), *sys.argv[1:]])


if __name__ == "__main__":
    raise SystemExit(main())

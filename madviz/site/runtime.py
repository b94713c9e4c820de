"""The programs that a site runs in the browser: MuJoCo and ONNX Runtime, and their licences.

They come from npm at exactly the versions of ``package.json`` beside this file, and are copied into
the site, so that a visitor's browser asks no other host for anything.
"""

from __future__ import annotations

import json
from importlib import metadata, resources
from pathlib import Path

from madviz.errors import UserError
from madviz.site.files import SiteFile, write_packed
from madviz.system.files import write_bytes

LICENCES = "licences.txt"
"""All licences in one file, which the page links."""
_ORT = "onnxruntime-web/dist"
FILES = {
    "mujoco.js": "@mujoco/mujoco/mujoco.js",
    "mujoco.wasm": "@mujoco/mujoco/mujoco.wasm",
    "ort.js": f"{_ORT}/ort.wasm.min.mjs",
    "ort_glue.js": f"{_ORT}/ort-wasm-simd-threaded.mjs",
    "ort.wasm": f"{_ORT}/ort-wasm-simd-threaded.wasm",
}
ASKED_MEMORY = b"WebAssembly.Memory({initial:256,maximum:65536,shared:!0})"
GIVEN_MEMORY = b"WebAssembly.Memory({initial:256,maximum:4096,shared:!0})"
"""In pages of 64 KiB: 256 MiB at most. A program takes a memory that may grow less than it says."""
_OF_PYTHON = {"mujoco": ("LICENSE", "LICENSES_THIRD_PARTY.md"), "metaworld": ("LICENSE",)}
"""Licence files that Python packages bring: MuJoCo's npm package has none of its own."""
_OF_NPM = {"flatbuffers": "LICENSE", "protobufjs": "LICENSE", "long": "LICENSE"}


def versions() -> dict[str, str]:
    """The versions of the npm packages that a site needs."""
    text = resources.files("madviz.site").joinpath("package.json").read_text()
    return json.loads(text)["dependencies"]


def find_packages(folder: Path) -> Path:
    """``folder`` with the npm packages. Raises UserError where one is missing or has another
    version, with the command that installs them."""
    wanted = versions()
    words = " ".join(f"{name}@{version}" for name, version in wanted.items())
    install = f"npm install --ignore-scripts --no-package-lock --prefix {folder.parent} {words}"
    for name, version in wanted.items():
        file = folder / name / "package.json"
        found = json.loads(file.read_text())["version"] if file.is_file() else "none"
        if found != version:
            raise UserError(
                f"{folder}: expected {name} {version}, found {found}; run `make site`, or: "
                f"{install}"
            )
    return folder


def write_runtime(out: Path, packages: Path) -> dict[str, SiteFile]:
    """Copies the programs; their lines of the manifest. Raises UserError where ONNX Runtime asks
    for its memory in other words than are known here."""
    return {
        name: write_packed(out, f"runtime/{name}.gz", _program(name, packages / path))
        for name, path in FILES.items()
    }


def _program(name: str, path: Path) -> bytes:
    """A program as it runs here. ONNX Runtime reserves 4 GiB of memory to share between threads,
    which small devices refuse. One thread with a policy of 5 MB needs a fraction."""
    source = path.read_bytes()
    if name != "ort_glue.js":
        return source
    if source.count(ASKED_MEMORY) != 1:
        raise UserError(f"{path}: expected {ASKED_MEMORY.decode()!r} once; take another version")
    return source.replace(ASKED_MEMORY, GIVEN_MEMORY)


def write_licences(out: Path, packages: Path) -> None:
    """The licences of everything in the site that is not madviz's own: a file each, and all in
    ``LICENCES``."""
    folder = out / "licences"
    folder.mkdir(parents=True, exist_ok=True)
    for package, names in _OF_PYTHON.items():
        files = metadata.files(package) or []
        for name in names:
            text = next(file for file in files if file.name == name).read_text()
            write_bytes(folder / f"{package}-{name}".replace(".md", ""), text.encode())
    for package, name in _OF_NPM.items():
        if (packages / package / name).is_file():
            write_bytes(folder / f"{package}-{name}", (packages / package / name).read_bytes())
    for text in resources.files("madviz.site").joinpath("licences").iterdir():
        write_bytes(folder / text.name, text.read_bytes())
    whole = [f"{'=' * 20} {path.name}\n\n{path.read_text()}" for path in sorted(folder.iterdir())]
    write_bytes(out / LICENCES, "\n\n".join(whole).encode())

"""Files of a site: gzipped, with their sizes, so that a page can say how far it is."""

from __future__ import annotations

import gzip
import hashlib
import zipfile
from pathlib import Path
from typing import TypedDict

from safetensors.numpy import save

from madviz.system.files import replacing, write_bytes
from madviz.types import Array


class SiteFile(TypedDict):
    """A file in the manifest."""

    path: str
    """From the site's folder."""
    bytes: int
    """As sent."""
    unpacked: int
    """Bytes."""


def write_packed(out: Path, name: str, content: bytes) -> SiteFile:
    """Writes ``content`` gzipped to ``out / name``, which ends with .gz."""
    # Without a time in it, the same content makes the same file.
    packed = gzip.compress(content, 9, mtime=0)
    path = out / name
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, packed)
    return {"path": name, "bytes": len(packed), "unpacked": len(content)}


def write_shared(out: Path, folder: str, arrays: dict[str, Array]) -> SiteFile:
    """Writes arrays under the name of their content: tasks that have them in common share a
    file."""
    content = save(arrays)
    name = hashlib.sha256(content).hexdigest()[:16]
    return write_packed(out, f"{folder}/{name}.gz", content)


def write_zip(folder: Path) -> Path:
    """Everything in ``folder``, as FOLDER.zip beside it. The same files give the same bytes: no
    times are in it."""
    archive = folder.with_name(f"{folder.resolve().name}.zip")
    with replacing(archive) as part, zipfile.ZipFile(part, "w") as written:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                name = path.relative_to(folder).as_posix()
                entry = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
                written.writestr(entry, path.read_bytes(), zipfile.ZIP_DEFLATED)
    return archive

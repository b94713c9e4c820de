"""Where decoded pictures are kept, how large that is, and how it is emptied."""

from __future__ import annotations

import shutil
from pathlib import Path

from madviz.system.files import cache_folder


def recordings_cache() -> Path:
    """The folder; it may not be there yet."""
    return cache_folder() / "recordings"


def cache_bytes() -> int:
    """The size of all that is cached."""
    return sum(path.stat().st_size for path in recordings_cache().rglob("*") if path.is_file())


def clear_cache() -> None:
    """Removes all cached pictures; they are decoded anew when they are needed."""
    shutil.rmtree(recordings_cache(), ignore_errors=True)

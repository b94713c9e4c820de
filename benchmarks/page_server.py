"""``madviz explore`` in a process of its own, as a user would start it."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from madviz.errors import UserError


@contextmanager
def serving(
    words: Sequence[str], log: IO[str] | None = None, root: Path | None = None
) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """``madviz explore`` with ``words``, on a free port: its address once it answers, and its
    process. What it writes to standard error goes to ``log``. ``root`` is another checkout of
    madviz, which is run in place of this one."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "madviz", "explore", "--port", str(port), *words]
    process = subprocess.Popen(command, stdout=sys.stderr, stderr=log, cwd=root)
    url = f"http://127.0.0.1:{port}"
    try:
        await_answer(url, process)
        yield url, process
    finally:
        process.terminate()
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def await_answer(url: str, process: subprocess.Popen[bytes], patience: float = 60.0) -> None:
    """Returns when ``url`` answers, with a refusal too. Raises UserError if the server ends or
    stays silent."""
    deadline = time.monotonic() + patience
    while time.monotonic() < deadline and process.poll() is None:
        try:
            urllib.request.urlopen(url, timeout=1).close()
            return
        except urllib.error.HTTPError:
            return
        except (urllib.error.URLError, OSError):
            time.sleep(0.02)
    raise UserError("the page did not start; try: madviz explore")

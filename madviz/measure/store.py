"""Results of single episodes in SQLite, so that nothing is rolled out twice.

An episode is a pure function of what is in its key: weights and config (the digest), task, success
definition, render profile, occlusions, subset and seed. Change any of them and the old result no
longer answers. The store is a cache: losing it costs time, never truth. ``madviz eval`` does not
read it unless asked to; the live page does, so that bars are there from the first second. Tables of
older versions are dropped.

One file serves many threads (a lock) and many processes (SQLite's write-ahead log). SQLite reports
a broken file at every use and does not repair it; so a broken one is moved aside here, with a
warning, and a new one begun. Otherwise no command could use the cache until a user removed it. A
folder that cannot be written to, a full disk, and what is no file, mean memory only.
"""

from __future__ import annotations

import os
import sqlite3
import threading
import time
import warnings
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import TypeVar

from madviz.system.files import cache_folder

T = TypeVar("T")

MEMORY = ":memory:"
BUSY_SECONDS = 10.0
"""How long a write waits for another process before it gives up."""

_COLUMNS = ("digest", "task", "definition", "render_profile", "occlusions", "subset", "seed")
_CREATE = f"""
CREATE TABLE IF NOT EXISTS episodes_2 (
    digest TEXT, task TEXT, definition TEXT, render_profile TEXT, occlusions TEXT, subset TEXT,
    seed INTEGER, success INTEGER NOT NULL, success_any INTEGER NOT NULL,
    total_reward REAL NOT NULL, outside REAL NOT NULL, noticed INTEGER,
    PRIMARY KEY ({", ".join(_COLUMNS)})
) WITHOUT ROWID
"""
_MATCH = " AND ".join(f"{column} = ?" for column in _COLUMNS[:-1])
_INSERT = f"INSERT OR REPLACE INTO episodes_2 VALUES ({', '.join('?' * 12)})"
_CORRUPT = {sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB}


@dataclass(frozen=True)
class EpisodeResult:
    """The outcome of one episode."""

    subset: str
    seed: int
    success: bool
    """At the last step: the number that is reported."""
    success_any: bool
    """At any step."""
    total_reward: float
    """The return: rewards summed over the episode, undiscounted."""
    outside: float = 0.0
    """The share of action numbers that lay outside [-1, 1] and were clipped."""
    noticed: int | None = None
    """The first step at which a guard found that a camera fails."""


@dataclass(frozen=True)
class ResultKey:
    """Everything but the seed that decides how an episode goes."""

    digest: str
    """The digest of the policy's weights and config; a result under '' is never stored."""
    task: str
    definition: str
    render_profile: str
    occlusions: str
    subset: str


def is_store(path: Path) -> bool:
    """True for a file that has results of this version; it is only read."""
    if not path.is_file():
        return False
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as db:
            db.execute("SELECT 1 FROM episodes_2")
    except sqlite3.Error:
        return False
    return True


class Store:
    """See the module. ``path`` None is ``$XDG_CACHE_HOME/madviz/results.sqlite`` (``~/.cache`` if
    the variable is not set), ``":memory:"`` is gone with the process."""

    def __init__(self, path: str | Path | None = None) -> None:
        self.path = str(path or cache_folder() / "results.sqlite")
        self.trouble = ""
        """Why results stay in memory only; '' where they are on disk as asked."""
        self._lock = threading.RLock()
        self._db = self._open()

    def put(self, key: ResultKey, result: EpisodeResult) -> None:
        """Stores a result; the same episode again changes nothing."""
        if key.digest:
            row = (*astuple(key), *astuple(result)[1:])
            self._run(lambda db: db.execute(_INSERT, row))

    def results(self, key: ResultKey) -> dict[int, EpisodeResult]:
        """All known episodes under ``key``, by seed, in the order of seeds."""
        query = (
            "SELECT seed, success, success_any, total_reward, outside, noticed FROM episodes_2 "
            f"WHERE {_MATCH} ORDER BY seed"
        )
        rows = self._run(lambda db: db.execute(query, astuple(key)).fetchall())
        return {
            seed: EpisodeResult(key.subset, seed, bool(success), bool(anytime), total, *more)
            for seed, success, anytime, total, *more in rows
        }

    def close(self) -> None:
        """Closes the file; the store answers no more."""
        with self._lock:
            self._db.close()

    def _run(self, query: Callable[[sqlite3.Connection], T]) -> T:
        """One transaction. A file found broken meanwhile is replaced and the query asked again. On
        a disk that is full or takes no more for another reason, it goes on in memory."""
        with self._lock:
            try:
                with self._db:
                    return query(self._db)
            except sqlite3.DatabaseError as error:
                corrupt = getattr(error, "sqlite_errorcode", None) in _CORRUPT
                operational = isinstance(error, sqlite3.OperationalError)
                if self.path == MEMORY or not (corrupt or operational):
                    raise
                if corrupt:
                    self._db.close()
                    self._move_aside(error)
                    self._db = self._open()
                else:
                    self._db = self._copied_to_memory(error)
                with self._db:
                    return query(self._db)

    def _copied_to_memory(self, error: sqlite3.Error) -> sqlite3.Connection:
        """A store in memory with what the file holds, as far as that can still be read."""
        rows: list[tuple[object, ...]] = []
        with suppress(sqlite3.Error):
            rows = self._db.execute("SELECT * FROM episodes_2").fetchall()
        with suppress(sqlite3.Error):
            self._db.close()
        db = self._in_memory(error)
        with db:
            db.executemany(_INSERT, rows)
        return db

    def _in_memory(self, error: Exception) -> sqlite3.Connection:
        self.trouble = f"{self.path}: {error}; results stay in memory only"
        warnings.warn(self.trouble, stacklevel=5)
        self.path = MEMORY
        return self._connect()

    def _open(self) -> sqlite3.Connection:
        if self.path == MEMORY:
            return self._connect()
        try:
            Path(self.path).parent.mkdir(parents=True, exist_ok=True)
            if Path(self.path).exists() and not Path(self.path).is_file():
                raise OSError("expected a file, found a device, a pipe or a folder")
            try:
                return self._connect()
            except sqlite3.DatabaseError as error:
                if isinstance(error, sqlite3.OperationalError):
                    raise
                self._move_aside(error)
                return self._connect()
        except (OSError, sqlite3.OperationalError) as error:
            return self._in_memory(error)

    def _connect(self) -> sqlite3.Connection:
        db = sqlite3.connect(self.path, timeout=BUSY_SECONDS, check_same_thread=False)
        try:
            db.execute("PRAGMA journal_mode = WAL")
            # A power cut may cost the last results, never the file: it is a cache.
            db.execute("PRAGMA synchronous = NORMAL")
            verdict = db.execute("PRAGMA quick_check(1)").fetchone()[0]
            if verdict != "ok":
                raise sqlite3.DatabaseError(verdict)
            with db:
                db.execute(_CREATE)
                for old in ("episodes_1", "outside_1", "noticed_1"):
                    db.execute(f"DROP TABLE IF EXISTS {old}")
        except sqlite3.Error:
            db.close()
            raise
        return db

    def _move_aside(self, error: sqlite3.DatabaseError) -> None:
        path = os.path.realpath(self.path)  # A link stays a link.
        aside = f"{path}.broken-{time.time_ns()}"
        warnings.warn(f"{self.path}: {error}; moved to {aside}, starting anew", stacklevel=5)
        with suppress(FileNotFoundError):  # Another process may have been faster.
            os.replace(path, aside)
        for suffix in ("-wal", "-shm"):
            Path(path + suffix).unlink(missing_ok=True)

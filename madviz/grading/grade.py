"""madviz grade FOLDER: runs every returned notebook and writes a table, one row for each exercise.

    student,lesson,exercise,passed,hint,error
    ada,02_merge,02.merge,yes,,
    ada,02_merge,02.mean,no,"with no camera present the result has to be zeros",
    bob,02_merge,02.merge,no,,"cell 7: did not end within 150 s"

The problem: thirty copies by thirty people; some crash, some never end, and in some the checks were
edited. The idea: each copy runs in a process of its own, in an empty folder with an empty home,
with limits of time and memory; the checks that count are the installed package's (``copies.py``),
and whatever happens to a copy, each of its exercises has its row.

``hint`` is what the check found missing. ``error`` is what went wrong around it: an error of the
student's code, a limit, an edited check.

A copy runs as whoever grades. It does not see the teacher's environment, but code that searches the
disk finds the teacher's files, and code that changes the package in its own process can give itself
any mark: grade with an account that has nothing else, and look at a copy before an examination.
"""

from __future__ import annotations

import csv
import io
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from madviz.errors import UserError
from madviz.policies.checkpoint import policy_roots
from madviz.system.files import write_bytes, written_to
from madviz.system.numbers import Count, check_numbers
from madviz.system.streams import say

SUFFIX = ".ipynb"
FORMULA = ("=", "+", "-", "@")
"""A spreadsheet runs a cell that begins so."""


@dataclass(frozen=True)
class GradeConfig:
    """Runs returned notebooks and says which exercises are right."""

    returned: Path
    """The folder with what came back: STUDENT/LESSON.ipynb, or STUDENT_LESSON.ipynb."""
    lessons: Path = Path("build/class/student")
    """The notebooks that were handed out (`make student-copies`)."""
    out: Path = Path("grades.csv")
    """The table: student, lesson, exercise, passed, hint, error."""
    seconds: Count = 300
    """The time of one copy, at most; a cell may take half of it."""
    gigabytes: Count = 4
    """Memory of one copy, at most."""
    workers: Count = 1
    """Copies that run at the same time; each takes about a core."""
    json: str | None = None
    """Also write the table to this JSON file; - prints it."""


@dataclass(frozen=True)
class Grade:
    """One exercise of one copy."""

    student: str
    lesson: str
    exercise: str
    """'' where it is not known of which lesson a file is."""
    passed: bool
    hint: str = ""
    error: str = ""


def grade(config: GradeConfig) -> dict[str, Any]:
    """Grades every file in ``config.returned`` and writes the table. Raises UserError where there
    is none, and where the notebooks that were handed out are not there."""
    try:
        import nbclient  # noqa: F401
    except ImportError as error:
        raise UserError("grading runs notebooks; pip install 'madviz[notebooks]'") from error
    from madviz.grading.copies import handed_out, returned

    check_numbers(config)
    written_to(config.out, "--out")
    if not config.returned.is_dir():
        raise UserError(f"expected a folder of returned notebooks, found none at {config.returned}")
    began = time.monotonic()
    lessons = handed_out(config.lessons)
    copies = list(returned(config.returned, list(lessons)))
    if not copies:
        raise UserError(f"expected returned notebooks in {config.returned}, found no file")
    stop = threading.Event()
    with ThreadPoolExecutor(config.workers) as pool:
        jobs = [pool.submit(graded, one, lessons, config, stop) for one in copies]
        try:
            rows = [
                row
                for number, job in enumerate(jobs)
                for row in announced(number, jobs, job.result())
            ]
        finally:
            stop.set()
    write_bytes(config.out, table(rows).encode())
    return {
        "schema": 1,
        "copies": len(copies),
        "seconds": round(time.monotonic() - began, 1),
        "rows": [asdict(row) for row in rows],
    }


def announced(number: int, jobs: list, rows: list[Grade]) -> list[Grade]:
    """``rows`` of a copy, after a line about them."""
    right = sum(row.passed for row in rows)
    first = rows[0]
    trouble = next((f"; {row.error}" for row in rows if row.error), "")
    say(
        f"{number + 1} of {len(jobs)}: {first.student}, {first.lesson or 'no lesson'}: "
        f"{right} of {len(rows)} right{trouble}"
    )
    return rows


def graded(
    one: Any, lessons: dict[str, Any], config: GradeConfig, stop: threading.Event
) -> list[Grade]:
    """The rows of one copy, whatever happens to it."""
    from madviz.grading.copies import checks_of, prepare
    from madviz.grading.run import Bounds, run_copy

    if not one.lesson:
        known = ", ".join(lessons)
        problem = f"expected a name with one of {known}, found {one.file.name}"
        return [Grade(one.student, "", "", False, error=problem)]
    exercises = list(checks_of(lessons[one.lesson]))
    try:
        if one.file.suffix != SUFFIX:
            raise UserError(f"expected a notebook, found {one.file.name}")
        copy = prepare(one.file, lessons[one.lesson])
    except UserError as error:
        return [Grade(one.student, one.lesson, name, False, error=str(error)) for name in exercises]
    bounds = Bounds(config.seconds, config.gigabytes << 30)
    run = run_copy(copy.notebook, [p.resolve() for p in policy_roots()], bounds, stop)
    return list(rows_of(one, exercises, copy.edited, run))


def rows_of(one: Any, exercises: list[str], edited: frozenset[str], run: Any) -> Iterator[Grade]:
    """A row for each exercise: what its check found, or why it was never reached."""
    for name in exercises:
        result = run.results.get(name)
        troubles = [run.errors.get(name) or (result or {}).get("error") if result else run.end]
        if name in edited:
            troubles.append("check edited; the original one was run" if result else "check edited")
        error = "; ".join(filter(None, troubles))
        passed = bool(result and result["passed"])
        hint = "" if result is None or passed else result["missing"]
        yield Grade(one.student, one.lesson, name, passed, hint, error)


def table(rows: list[Grade]) -> str:
    """The rows as CSV, with nothing in them that a spreadsheet would run."""
    written = io.StringIO()
    writer = csv.writer(written)
    writer.writerow(Grade.__dataclass_fields__)
    for row in rows:
        cells = (
            "yes" if cell is True else "no" if cell is False else cell
            for cell in asdict(row).values()
        )
        writer.writerow(f"'{cell}" if cell.startswith(FORMULA) else cell for cell in cells)
    return written.getvalue()


def grade_words(result: dict[str, Any]) -> str:
    """The grades in words: each exercise with how many copies have it right."""
    counted: dict[str, list[bool]] = {}
    for row in result["rows"]:
        if row["exercise"]:
            counted.setdefault(row["exercise"], []).append(row["passed"])
    lines = [f"{result['copies']} files in {result['seconds']:.0f} s"]
    lines += [f"  {name:24} {sum(found)} of {len(found)} right" for name, found in counted.items()]
    return "\n".join(lines)

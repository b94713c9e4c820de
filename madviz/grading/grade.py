"""madviz grade FOLDER: runs every returned notebook and writes a table, one row for each exercise.

    student,lesson,exercise,passed,hint,error,file
    ada,02_merge,02.merge,yes,,,ada/02_merge.ipynb
    ada,02_merge,02.mean,no,"with no camera present …",,ada/02_merge.ipynb
    bob,02_merge,02.merge,no,,"cell 7: did not end within 150 s",bob_02_merge.ipynb

The problem: thirty copies by thirty people; some crash, some never end, and in some the checks were
edited. The idea: each copy runs in a process of its own, in an empty folder with an empty home,
with limits of time and memory; the checks that count are the installed package's (``copies.py``),
and whatever happens to a copy, each of its exercises has its row.

``hint`` is what the check found missing. ``error`` is what went wrong around it: an error of the
student's code, a limit, an edited check, a second file of the same student and lesson.

A copy runs with the teacher's account. It does not see the teacher's environment, but code that
searches the disk finds the teacher's files, and code that changes the package in its own process
can give itself any mark: grade with an account that has nothing else, and look at a copy before an
examination.
"""

from __future__ import annotations

import csv
import io
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

from madviz.errors import UserError, printable, saving
from madviz.policies.checkpoint import policy_roots
from madviz.system.files import write_bytes, written_to
from madviz.system.numbers import Count, check_numbers
from madviz.system.streams import say

if TYPE_CHECKING:
    from nbformat import NotebookNode

    from madviz.grading.copies import Returned
    from madviz.grading.run import CopyRun

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
    """The table: student, lesson, exercise, passed, hint, error, file."""
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
    file: str = ""


class Graded(TypedDict):
    """The document that ``--json`` writes."""

    schema: int
    copies: int
    seconds: float
    rows: list[dict[str, Any]]
    """Those of the table: a ``Grade`` each."""


def grade(config: GradeConfig) -> Graded:
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
    rows: list[Grade] = []
    with ThreadPoolExecutor(config.workers) as pool:
        jobs = [pool.submit(graded, copy, lessons, config, stop) for copy in copies]
        try:
            for number, job in enumerate(jobs):
                say(f"{number + 1} of {len(jobs)}: {in_a_line(job.result())}")
                rows += job.result()
        except BaseException:
            if rows:
                with suppress(OSError):  # What stopped it is the news.
                    part = config.out.with_suffix(f".part{config.out.suffix}")
                    write_bytes(part, table(rows).encode())
                    say(f"madviz: the copies that were graded are in {part}")
            raise
        finally:
            stop.set()
    document: Graded = {
        "schema": 1,
        "copies": len(copies),
        "seconds": round(time.monotonic() - began, 1),
        "rows": [asdict(row) for row in rows],
    }
    with saving(document, f"--out {config.out}"):
        write_bytes(config.out, table(rows).encode())
    return document


def in_a_line(rows: list[Grade]) -> str:
    """The rows of a copy: ``ada, 02_merge: 1 of 2 right``, and its first error."""
    right = sum(row.passed for row in rows)
    trouble = next((f"; {row.error}" for row in rows if row.error), "")
    lesson = rows[0].lesson or "no lesson"
    return f"{rows[0].student}, {lesson}: {right} of {len(rows)} right{trouble}"


def graded(
    copy: Returned, lessons: dict[str, NotebookNode], config: GradeConfig, stop: threading.Event
) -> list[Grade]:
    """The rows of one copy, whatever happens to it."""
    from madviz.grading.copies import checks_of, prepare
    from madviz.grading.run import run_copy

    if not copy.lesson:
        return [_row(copy, "", f"expected a name with one of {', '.join(lessons)}")]
    exercises = list(checks_of(lessons[copy.lesson]))
    roots = [root.resolve() for root in policy_roots()]
    try:
        if copy.file.suffix != SUFFIX:
            raise UserError("expected a notebook, found another file")
        notebook, edited = prepare(copy.file, lessons[copy.lesson])
        run = run_copy(notebook, roots, config.seconds, config.gigabytes << 30, stop)
    except UserError as error:
        return [_row(copy, exercise, str(error)) for exercise in exercises]
    except Exception as error:  # Whatever a copy has done: the others are graded.
        trouble = printable(f"it could not be graded: {type(error).__name__}: {error}")
        return [_row(copy, exercise, trouble) for exercise in exercises]
    return list(rows_of(copy, exercises, edited, run))


def rows_of(
    copy: Returned, exercises: list[str], edited: frozenset[str], run: CopyRun
) -> Iterator[Grade]:
    """A row for each exercise: what its check found, or why it was never reached."""
    for name in exercises:
        result = run.results.get(name)
        troubles = [run.errors.get(name) or (result.error if result else run.end)]
        if name in edited:
            troubles.append("check edited; the original one was run" if result else "check edited")
        passed = result is not None and result.passed
        hint = "" if result is None or passed else result.missing
        yield _row(copy, name, *troubles, passed=passed, hint=hint)


def _row(
    copy: Returned, exercise: str, *troubles: str, passed: bool = False, hint: str = ""
) -> Grade:
    several = ""
    if copy.lesson and copy.alike > 1:
        several = f"one of {copy.alike} files of {copy.student} for {copy.lesson}"
    error = "; ".join(filter(None, (*troubles, several)))
    return Grade(copy.student, copy.lesson, exercise, passed, hint, error, copy.name)


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


def grade_words(result: Graded) -> str:
    """The grades in words: each exercise with how many copies have it right."""
    counted: dict[str, list[bool]] = {}
    for row in result["rows"]:
        if row["exercise"]:
            counted.setdefault(row["exercise"], []).append(row["passed"])
    lines = [f"{result['copies']} files in {result['seconds']:.0f} s"]
    lines += [f"  {name:24} {sum(right)} of {len(right)} right" for name, right in counted.items()]
    return "\n".join(lines)

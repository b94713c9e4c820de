"""Grading: whose copy it is, checks put back, and a row for every exercise whatever a copy does."""

from __future__ import annotations

import csv
import json
import os
from pathlib import Path

import nbformat
import pytest
from nbformat.v4 import new_code_cell, new_notebook

from madviz.errors import UserError
from madviz.grading import run as grading_run
from madviz.grading.copies import checks_of, handed_out, prepare, returned
from madviz.grading.grade import Grade, GradeConfig, grade, grade_words, rows_of, table
from madviz.grading.run import CopyRun, environment, read
from madviz.grading.worker import ReportFile
from madviz.teaching.checks.exercise import Result

RIGHT = "def merge(features, present):\n    return features[present].sum(0)"
SUM_OF_ALL = "def merge(features, present):\n    return features.sum(0)"
EMPTY = "def merge(features, present):\n    return ..."
CHECK = 'teaching.check("02.merge", merge)'
LESSON = "02_merge"


def notebook(answer: str, check: str = CHECK) -> nbformat.NotebookNode:
    cells = [
        new_code_cell("from madviz import teaching", id="02-00"),
        new_code_cell(answer, id="02-01"),
        new_code_cell(check, id="02-02"),
    ]
    cells[2].metadata.tags = ["check"]
    return new_notebook(cells=cells)


@pytest.fixture
def class_(tmp_path: Path) -> Path:
    """A folder with what was handed out, and one for what comes back."""
    (tmp_path / "lessons").mkdir()
    (tmp_path / "returned").mkdir()
    nbformat.write(notebook(EMPTY), tmp_path / "lessons" / f"{LESSON}.ipynb")
    return tmp_path


def come_back(class_: Path, name: str, copy: nbformat.NotebookNode) -> Path:
    file = class_ / "returned" / name
    file.parent.mkdir(exist_ok=True)
    nbformat.write(copy, file)
    return file


def graded(class_: Path, seconds: int = 120, gigabytes: int = 4) -> dict[str, dict]:
    """The rows by student, from the table itself."""
    config = GradeConfig(
        class_ / "returned", class_ / "lessons", class_ / "grades.csv", seconds, gigabytes
    )
    found = grade(config)
    with config.out.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(found["rows"]) and grade_words(found).startswith(f"{found['copies']} ")
    return {row["student"]: row for row in rows}


def test_a_folder_or_a_file_name_says_whose_copy_it_is(class_: Path) -> None:
    for name in ("ada/02_merge.ipynb", "bob_02_merge.ipynb", "cy.docx", ".hidden/02_merge.ipynb"):
        come_back(class_, name, notebook(RIGHT))
    found = [(one.student, one.lesson) for one in returned(class_ / "returned", [LESSON])]
    assert found == [("ada", LESSON), ("bob", LESSON), ("cy", "")]


def test_two_copies_of_a_student_are_told_apart(class_: Path) -> None:
    for name in ("all/ada_02_merge.ipynb", "all/bob_02_merge.ipynb", "cy/02_merge.ipynb"):
        come_back(class_, name, notebook(RIGHT))
    rows = [
        next(rows_of(one, ["02.merge"], frozenset(), CopyRun()))
        for one in returned(class_ / "returned", [LESSON])
    ]
    several = "one of 2 files of all for 02_merge"
    assert [(row.file, row.error) for row in rows] == [
        ("all/ada_02_merge.ipynb", several),
        ("all/bob_02_merge.ipynb", several),
        ("cy/02_merge.ipynb", ""),
    ]


def test_a_name_that_no_text_file_can_have_is_written_in_ascii(class_: Path) -> None:
    come_back(class_, "J\udcf6rg/02_merge.ipynb", notebook(RIGHT))
    (one,) = returned(class_ / "returned", [LESSON])
    (row,) = rows_of(one, ["02.merge"], frozenset(), CopyRun())
    assert b"J\\udcf6rg/02_merge.ipynb" in table([row]).encode()


@pytest.mark.parametrize(
    ("change", "edited"),
    [
        (lambda copy: None, False),
        (lambda copy: copy.cells[2].update(source='print("02.merge: right")'), True),
        (lambda copy: copy.cells.pop(2), True),
        (lambda copy: copy.cells[2].update(id="another", cell_type="code"), False),
        (lambda copy: copy.cells[2].metadata.update(tags=["skip-execution"]), False),
    ],
)
def test_the_original_check_is_put_back(class_: Path, change, edited: bool) -> None:
    copy = notebook(RIGHT)
    change(copy)
    file = come_back(class_, "ada_02_merge.ipynb", copy)
    ready, found = prepare(file, handed_out(class_ / "lessons")[LESSON])
    assert found == ({"02.merge"} if edited else set())
    last = ready.cells[-1]
    assert "madviz.grading.inside" in last.source and '"02.merge"' in last.source.replace("'", '"')
    assert last.metadata == {"madviz": "02.merge"}
    assert sum("madviz.grading.inside" in cell.source for cell in ready.cells) == 1


@pytest.mark.parametrize("kept", ["02-01", "02-02"])
def test_an_answer_in_the_cell_of_its_check_is_kept(class_: Path, kept: str) -> None:
    copy = notebook(EMPTY)
    copy.cells[1:] = [new_code_cell(f"{RIGHT}\n{CHECK}", id=kept), new_code_cell("1 / 0")]
    file = come_back(class_, "ada_02_merge.ipynb", copy)
    ready, _ = prepare(file, handed_out(class_ / "lessons")[LESSON])
    sources = [cell.source for cell in ready.cells]
    assert RIGHT in sources[1] and "madviz.grading.inside" in sources[2] and sources[3] == "1 / 0"


def test_a_folder_that_cannot_be_read_is_named(
    class_: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Root reads any folder, so the error is made here; a hidden folder is not looked into."""
    for name in ("ada/02_merge.ipynb", "bob/02_merge.ipynb", ".hidden/02_merge.ipynb"):
        come_back(class_, name, notebook(RIGHT))
    look, closed = os.scandir, {".hidden", "bob"}

    def scandir(path):
        if Path(path).name in closed:
            raise PermissionError(13, "Permission denied", path)
        return look(path)

    monkeypatch.setattr(os, "scandir", scandir)
    with pytest.raises(UserError, match=r"expected folders .* found .*/bob: Permission denied; "):
        list(returned(class_ / "returned", [LESSON]))
    closed.remove("bob")
    (class_ / "returned" / "cy_02_merge").symlink_to(class_ / "lessons")  # One file, as before.
    found = [one.name for one in returned(class_ / "returned", [LESSON])]
    assert found == ["ada/02_merge.ipynb", "bob/02_merge.ipynb", "cy_02_merge"]


def test_a_broken_notebook_that_was_handed_out_is_named(class_: Path) -> None:
    file = class_ / "lessons" / f"{LESSON}.ipynb"
    whole = file.read_text()
    bare = json.loads(whole)
    del bare["cells"][2]["metadata"]
    for text in (whole[: len(whole) // 2], json.dumps(bare)):
        file.write_text(text)
        with pytest.raises(UserError, match=f"found a broken one at {file}"):
            handed_out(class_ / "lessons")


def test_only_tagged_cells_are_checks() -> None:
    lesson = notebook(EMPTY)
    assert list(checks_of(lesson)) == ["02.merge"]
    lesson.cells[2].metadata.clear()
    assert not checks_of(lesson)


def test_what_is_no_notebook_is_said(class_: Path) -> None:
    lesson = handed_out(class_ / "lessons")[LESSON]
    broken = class_ / "returned" / "ada_02_merge.ipynb"
    for text in ("hello", "{}", '{"cells": 3, "nbformat": 4, "nbformat_minor": 5, "metadata": {}}'):
        broken.write_text(text)
        with pytest.raises(UserError, match="expected a notebook"):
            prepare(broken, lesson)
    half = notebook("x = 1").copy()
    half.cells[1].source = "x = 'HALF'"
    broken.write_text(nbformat.writes(half).replace("HALF", "\\ud83d"))
    with pytest.raises(UserError, match="UnicodeEncodeError"):
        prepare(broken, lesson)
    link = class_ / "returned" / "link_02_merge.ipynb"
    link.symlink_to(class_ / "lessons" / "02_merge.ipynb")
    with pytest.raises(UserError, match="found a link"):
        prepare(link, lesson)


def test_a_copy_that_cannot_be_graded_has_its_rows(
    class_: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(notebook, *limits):
        if "features.sum(0)" in notebook.cells[1].source:
            raise OSError("no \x1b such report")
        return CopyRun({"02.merge": Result("02.merge", True)})

    monkeypatch.setattr(grading_run, "run_copy", fails)
    come_back(class_, "ada_02_merge.ipynb", notebook(SUM_OF_ALL))
    come_back(class_, "bob_02_merge.ipynb", notebook(RIGHT))
    rows = graded(class_)
    assert rows["ada"]["error"] == "it could not be graded: OSError: no \\x1b such report"
    assert (rows["ada"]["passed"], rows["bob"]["passed"]) == ("no", "yes")


def test_a_check_that_never_ends_has_its_reason_and_the_next_one_none(
    class_: Path, tmp_path: Path
) -> None:
    report = ReportFile(tmp_path / "report", 150)
    stopped = {"content": {"status": "error", "ename": "KeyboardInterrupt", "evalue": ""}}
    check = new_code_cell("check()")
    check.metadata["madviz"] = "02.merge"
    report.executed(check, 6, stopped)
    report.line(result={"name": "02.mean", "passed": True, "missing": "", "error": ""})
    run = read(tmp_path / "report")
    assert run.errors == {"02.merge": "cell 7: did not end within 150 s", "02.mean": ""}
    (one,) = returned_of(class_, "bob_02_merge.ipynb")
    first, second = rows_of(one, ["02.merge", "02.mean"], frozenset(), run)
    assert (first.passed, first.error) == (False, "cell 7: did not end within 150 s")
    assert (second.passed, second.error) == (True, "")


def test_copies_that_are_graded_are_in_the_table_when_it_is_stopped(
    class_: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("ada_02_merge.ipynb", "bob_02_merge.ipynb"):
        come_back(class_, name, notebook(RIGHT))

    def graded(copy, lessons, config, stop):
        if copy.student == "bob":
            raise KeyboardInterrupt
        return [Grade(copy.student, LESSON, "02.merge", True)]

    monkeypatch.setattr("madviz.grading.grade.graded", graded)
    config = GradeConfig(class_ / "returned", class_ / "lessons", class_ / "t.csv", workers=1)
    with pytest.raises(KeyboardInterrupt):
        grade(config)
    assert "ada,02_merge,02.merge,yes" in (class_ / "t.part.csv").read_text()
    assert not (class_ / "t.csv").exists()


def test_every_exercise_has_its_row(class_: Path) -> None:
    (one,) = returned_of(class_, "ada_02_merge.ipynb")
    wrong = Result("02.merge", False, "it is not the sum")
    run = CopyRun(
        {"02.merge": wrong}, {"02.merge": "cell 2: NameError"}, "it did not end within 9 s"
    )
    first, second = rows_of(one, ["02.merge", "02.mean"], frozenset({"02.merge"}), run)
    assert first == Grade(
        "ada", LESSON, "02.merge", False, "it is not the sum",
        "cell 2: NameError; check edited; the original one was run", one.name,
    )  # fmt: skip
    ended = "it did not end within 9 s"
    assert second == Grade("ada", LESSON, "02.mean", False, "", ended, "ada_02_merge.ipynb")


def returned_of(class_: Path, name: str):
    come_back(class_, name, notebook(RIGHT))
    return list(returned(class_ / "returned", [LESSON]))


def test_a_spreadsheet_runs_nothing_of_a_student() -> None:
    text = table([Grade("=cmd|' /C calc'!A0", LESSON, "02.merge", False, "-1", "+1")])
    assert text.splitlines()[0] == "student,lesson,exercise,passed,hint,error,file"
    (row,) = csv.DictReader(text.splitlines())
    assert all(row[name][0] == "'" for name in ("student", "hint", "error"))


def test_a_copy_gets_little_of_the_teachers_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SECRET", "x")
    found = environment(tmp_path, [Path("/checkpoints")])
    assert "SECRET" not in found and found["HOME"] == str(tmp_path / "home")


def test_a_folder_without_copies_or_lessons_is_a_mistake(class_: Path) -> None:
    config = GradeConfig(class_ / "returned", class_ / "lessons", class_ / "grades.csv")
    with pytest.raises(UserError, match="found no file"):
        grade(config)
    with pytest.raises(UserError, match="make student-copies"):
        grade(GradeConfig(class_ / "returned", class_ / "returned", class_ / "grades.csv"))


def test_a_copy_that_claims_to_be_right_is_run_and_found_wrong(class_: Path) -> None:
    come_back(class_, "ada_02_merge.ipynb", notebook(SUM_OF_ALL, 'print("02.merge: right")'))
    row = graded(class_)["ada"]
    assert (row["passed"], row["error"]) == ("no", "check edited; the original one was run")
    assert "not the sum of those cameras" in row["hint"]


UNENDING = """import time
while True:
    try:
        time.sleep(1)
    except BaseException:
        pass"""


@pytest.mark.slow
def test_whatever_a_copy_does_it_has_its_row(class_: Path) -> None:
    answers = {
        "right": RIGHT,
        "empty": EMPTY,
        "crashing": "import os\nos._exit(3)",
        "failing": "1 / 0",
        "endless": "while True: pass",
        "unending": UNENDING,
        "hungry": "x = bytearray(20 << 30)",
    }
    for name, answer in answers.items():
        come_back(class_, f"{name}_02_merge.ipynb", notebook(answer))
    (class_ / "returned" / "broken_02_merge.ipynb").write_text("hello")
    (class_ / "returned" / "essay.txt").write_text("hello")
    rows = graded(class_, seconds=60)
    assert [name for name, row in rows.items() if row["passed"] == "yes"] == ["right"]
    expected = {
        "empty": "",
        "crashing": "the kernel ended in cell 2: a crash, or too much memory",
        "failing": "cell 2: ZeroDivisionError: division by zero",
        "endless": "cell 2: did not end within 30 s",
        "unending": "it did not end within 60 s",
        "hungry": "cell 2: MemoryError",
        "broken": "expected a notebook, found another file (NotJSONError)",
        "essay": "expected a name with one of 02_merge",
    }
    assert {name: rows[name]["error"] for name in expected} == expected
    assert "nothing is answered yet" in rows["empty"]["hint"]

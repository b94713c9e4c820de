"""What a class is given: copies of the lessons, and the class server's script and configuration."""

from __future__ import annotations

import os
import runpy
from pathlib import Path
from types import SimpleNamespace

import nbformat
import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output

ROOT = Path(__file__).resolve().parent.parent
COPIES = runpy.run_path(str(ROOT / "tools" / "student_copies.py"))
FOLDER = ROOT / "tools" / "class_server"
SERVER = runpy.run_path(str(FOLDER / "server.py"))
TAGS = ("", "prediction", "answer", "solution", "check")


def lesson() -> nbformat.NotebookNode:
    cells = [
        new_markdown_cell("# 2. Merge"),
        new_markdown_cell("the reason", metadata={"tags": ["solution"]}),
    ]
    for number, tag in enumerate(TAGS):
        cell = new_code_cell(f"{number}", id=f"02-{number:02}", execution_count=1)
        cell.metadata = nbformat.from_dict({"tags": [tag]} if tag else {})
        cell.outputs = [new_output("display_data", {"text/html": f"<b>shown {number}</b>"})]
        cells.append(cell)
    return new_notebook(cells=cells, metadata={"widgets": {"x": 1}})


def test_a_students_copy_has_no_outputs_and_no_solutions(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    nbformat.write(lesson(), tmp_path / "in" / "02_merge.ipynb")
    (made,) = COPIES["make"](tmp_path / "out", tmp_path / "in")
    copy = nbformat.read(made, 4)
    code = [cell for cell in copy.cells if cell.cell_type == "code"]
    assert [cell.metadata.get("tags", [""])[0] for cell in code] == [
        "",
        "prediction",
        "answer",
        "check",
    ]
    assert [cell.id for cell in code] == ["02-00", "02-01", "02-02", "02-04"]
    assert not any(cell.outputs or cell.execution_count for cell in code)
    assert "the reason" not in made.read_text() and "widgets" not in copy.metadata
    whole = nbformat.read(tmp_path / "out" / "teacher" / "02_merge.ipynb", 4)
    assert len(whole.cells) == len(TAGS) + 2 and whole.cells[2].outputs


def test_copies_that_are_there_are_kept(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    nbformat.write(lesson(), tmp_path / "in" / "02_merge.ipynb")
    (made,) = COPIES["make"](tmp_path / "out", tmp_path / "in")
    made.write_text("an answer")
    with pytest.raises(SystemExit, match="in which answers may be"):
        COPIES["make"](tmp_path / "out", tmp_path / "in")
    assert made.read_text() == "an answer"


def test_pages_to_read_have_what_the_copies_have(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    nbformat.write(lesson(), tmp_path / "in" / "02_merge.ipynb")
    COPIES["make"](tmp_path / "out", tmp_path / "in")
    pages = {
        kind: (tmp_path / "out" / f"{kind}-html" / "02_merge.html").read_text()
        for kind in COPIES["COPIES"]
    }
    assert "shown 3" in pages["teacher"] and "the reason" in pages["teacher"]
    assert "shown 3" not in pages["student"] and "the reason" not in pages["student"]
    assert "require.min.js" not in pages["student"]


def test_no_students_copy_of_a_lesson_has_a_solution() -> None:
    for file in sorted((ROOT / "notebooks").glob("*.ipynb")):
        notebook = nbformat.read(file, 4)
        hidden = {c.source for c in notebook.cells if "solution" in COPIES["tags"](c)}
        kept = {c.source for c in COPIES["student_copy"](notebook).cells}
        assert not hidden & kept, file.name


def config_of(name: str, monkeypatch: pytest.MonkeyPatch, **variables: str):
    """A configuration, run as Jupyter runs it."""
    for variable, value in variables.items():
        monkeypatch.setenv(variable, value)

    class Section(SimpleNamespace):
        def __getattr__(self, asked: str):
            setattr(self, asked, Section())
            return getattr(self, asked)

    c = Section()
    names = runpy.run_path(str(FOLDER / name), init_globals={"get_config": lambda: c})
    return c, names


def test_students_are_local_accounts_of_the_class_with_limits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    c, _ = config_of(
        "jupyterhub_config.py", monkeypatch, MADVIZ_CLASS="/opt/x", MADVIZ_CLASS_ADDRESS="http://:1"
    )
    assert c.JupyterHub.authenticator_class == "pam"
    assert c.PAMAuthenticator.allowed_groups == {SERVER["GROUP"]}
    assert c.Spawner.cmd[0] == "prlimit" and f"--data={3 << 30}" in c.Spawner.cmd
    token = c.Spawner.environment["MADVIZ_TOKEN"]
    assert token(None) != token(None), "every student's server has its own"


def test_the_launcher_sends_a_browser_to_the_page_with_its_token(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    c, names = config_of("jupyter_server_config.py", monkeypatch, MADVIZ_TOKEN="T")
    answer = SimpleNamespace(code=401, reason="", body=b"asked", headers={})
    names["forward"](answer, 41234)
    assert (answer.code, answer.body) == (302, b"")
    assert answer.headers["Location"] == "../proxy/41234/?token=T"
    assert c.ServerProxy.servers["madviz"]["command"][:2] == ["madviz", "explore"]


def test_a_password_is_kept_where_a_later_account_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given, gone = [], []

    def run(command: str, *words: str, input: str = "", text: bool = True) -> None:
        if command == "userdel":
            gone.append(words[-1])
        if input.startswith("student03"):
            raise OSError("no more passwords")
        if input:
            given.append(input.strip().replace(":", ","))

    monkeypatch.setitem(SERVER["students"].__globals__, "run", run)
    passwords = tmp_path / "passwords.csv"
    with pytest.raises(OSError, match="no more"):
        SERVER["students"](["student01", "student02", "student03"], passwords)
    assert gone == ["student03"] and len(given) == 2 and passwords.read_text().splitlines() == given
    assert passwords.stat().st_mode & 0o077 == 0


def test_a_link_is_never_collected(tmp_path: Path) -> None:
    contents = SERVER["contents"]
    home = tmp_path / "home"
    (home / "lessons").mkdir(parents=True)
    secret = tmp_path / "secret"
    secret.write_text("x")
    (home / "lessons" / "mine.ipynb").write_text("{}")
    assert contents(home / "lessons", "mine.ipynb") == b"{}"
    (home / "lessons" / "link.ipynb").symlink_to(secret)
    os.link(secret, home / "lessons" / "hard.ipynb")
    os.mkfifo(home / "lessons" / "pipe.ipynb")
    (home / "other").symlink_to(tmp_path)
    for name in ("link", "hard", "pipe", "none"):
        assert contents(home / "lessons", f"{name}.ipynb") is None
    assert contents(home / "other", "secret") is None


def test_a_python_in_a_closed_home_is_refused(tmp_path: Path) -> None:
    closed = tmp_path / "root"
    (closed / "bin").mkdir(parents=True)
    closed.chmod(0o700)
    assert SERVER["out_of_reach"](closed / "bin" / "python") is not None
    assert SERVER["out_of_reach"](Path("/usr/bin/python3")) is None


def test_a_service_starts_the_hub_with_what_its_configuration_reads(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    SERVER["service"](Path("/opt/x"), "", 8000, tmp_path)
    unit = (tmp_path / "madviz-class.service").read_text()
    assert "ExecStart=/opt/x/venv/bin/jupyterhub --config /opt/x/etc/jupyterhub_config.py" in unit
    assert 'Environment="MADVIZ_CLASS=/opt/x"' in unit and "systemctl" in capsys.readouterr().out

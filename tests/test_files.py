"""JSON for people, and files that are whole or not there."""

import json
import os
import re
import resource
import socket
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from madviz.errors import UserError
from madviz.system import files
from madviz.system.files import (
    LINE,
    OTHERS,
    allow_open_files,
    new_folder,
    pretty,
    read_json,
    replacing,
    write_bytes,
    write_json,
    written_to,
)
from tests.disks import room_for

VALUES = {
    "short": {"a": [1, 2, {"b": None}], "c": "[\n { x"},
    "long list": [{"seed": n, "return": n / 3} for n in range(20)],
    "long text": ["x" * 200, "y"],
    "nothing": [{}, [], "", 0, True, None],
    "deep": {"a" * 50: {"b" * 50: {"c" * 50: [1.5e-9] * 40}}},
}


@pytest.mark.parametrize("value", VALUES.values(), ids=VALUES)
def test_pretty_json_is_the_same_json(value):
    assert json.loads(pretty(value)) == value
    assert pretty(value).endswith("\n")


def test_what_fits_on_a_line_stays_on_one():
    lines = pretty({"episodes": [{"seed": n, "success": True} for n in range(9)]}).splitlines()
    assert lines[:3] == ["{", '  "episodes": [', '    {"seed": 0, "success": true},']
    assert max(map(len, lines)) < LINE


def test_json_has_no_nan(tmp_path):
    with pytest.raises(ValueError, match="Out of range float"):
        write_json(tmp_path / "x.json", {"loss": float("nan")})
    assert list(tmp_path.iterdir()) == []


def test_writing_replaces_the_whole_file_and_others_may_read_it(tmp_path):
    file = tmp_path / "x.json"
    write_bytes(file, b"0" * 10_000)
    write_json(file, [1])
    assert read_json(file) == [1] and stat.S_IMODE(file.stat().st_mode) == 0o644
    assert list(tmp_path.iterdir()) == [file]


def test_who_writes_files_goes_through_one_place():
    """But for the cache of results; and what sets a priority is no file."""
    direct = re.compile(
        r"os\.(replace|rename)\(|\.rename\(|NamedTemporaryFile|mkstemp|\.write_text\("
    )
    package = Path(files.__file__).parent.parent
    found = {path.stem for path in package.rglob("*.py") if direct.search(path.read_text())}
    assert found == {"files", "priority", "store"}


def test_what_cannot_be_read_is_named(tmp_path):
    with pytest.raises(UserError, match="absent.json: expected a JSON file, found: No such file"):
        read_json(tmp_path / "absent.json")


def read_in_background(fifo: Path) -> tuple[threading.Thread, list[bytes]]:
    come: list[bytes] = []
    thread = threading.Thread(target=lambda: come.append(fifo.read_bytes()), daemon=True)
    thread.start()
    return thread, come


@pytest.mark.parametrize("linked", [False, True])
def test_a_pipe_is_written_to_and_stays_a_pipe(tmp_path, linked):
    fifo = path = tmp_path / "pipe"
    os.mkfifo(fifo)
    if linked:
        path = tmp_path / "link"
        path.symlink_to("pipe")
    thread, come = read_in_background(fifo)
    write_json(path, [1])
    if not fifo.is_fifo():  # Then nobody writes to it any more.
        pytest.fail("expected a pipe, found that it was replaced")
    thread.join(10.0)
    assert come == [b"[1]\n"] and path.is_symlink() == linked
    assert {file.name for file in tmp_path.iterdir()} == {"pipe", path.name}


def test_a_device_is_written_to_and_stays_a_device(tmp_path):
    device, terminal = os.openpty()
    name = Path(os.ttyname(terminal))
    link = tmp_path / "terminal"
    link.symlink_to(name)
    write_bytes(link, b"all of it\n")
    assert link.is_symlink() and name.is_char_device()
    assert os.read(device, 100) == b"all of it\r\n"


def test_a_link_is_followed_and_stays_a_link(tmp_path):
    (tmp_path / "far").mkdir()
    target, link = tmp_path / "far" / "target", tmp_path / "x.json"
    link.symlink_to("far/target")
    for content in ([1], [2]):  # At first the link leads to a file that is not there yet.
        write_json(link, content)
        assert link.is_symlink() and not target.is_symlink() and read_json(target) == content
    assert sorted(tmp_path.rglob("*")) == [tmp_path / "far", target, link]


def test_a_file_is_replaced_and_not_written_over(tmp_path):
    file = tmp_path / "x"
    write_bytes(file, b"old")
    with file.open("rb") as reader:
        write_bytes(file, b"new")
        assert reader.read() == b"old" and file.read_bytes() == b"new"


def test_if_the_block_fails_the_file_stays_as_it_is(tmp_path):
    file = tmp_path / "x.svg"
    write_bytes(file, b"old")
    with pytest.raises(RuntimeError), replacing(file) as part:
        assert part.suffix == ".svg"
        part.write_bytes(b"half of")
        raise RuntimeError
    assert file.read_bytes() == b"old" and list(tmp_path.iterdir()) == [file]


def test_what_a_process_has_opened_is_added_to(tmp_path):
    log, link = tmp_path / "log", tmp_path / "stdout"
    log.write_text("before\n")
    link.symlink_to("/proc/self/fd/1")  # As /dev/stdout is, which a mistake here must not replace.
    program = (
        "import sys\nfrom pathlib import Path\nfrom madviz.system.files import write_json\n"
        "write_json(Path(sys.argv[1]), [1])\nprint('after')"
    )
    with log.open("a") as out:
        subprocess.run([sys.executable, "-c", program, link], stdout=out, check=True)
    assert log.read_text() == "before\n[1]\nafter\n" and link.is_symlink()


def test_what_is_no_place_for_a_file_is_refused(tmp_path):
    folder, link, ring = tmp_path / "folder", tmp_path / "link", tmp_path / "ring"
    folder.mkdir()
    link.symlink_to("folder")
    ring.symlink_to("ring")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "socket"))
        for name, found in {
            "folder": "a folder",
            "link": "a folder",
            "socket": "a socket",
            "ring": "symbolic links in a circle",
            "none/x": f"no folder {tmp_path}/none",
        }.items():
            path = tmp_path / name
            for write in (
                lambda path=path: write_bytes(path, b""),
                lambda path=path: written_to(path),
            ):
                with pytest.raises(
                    UserError, match=f"/{name}: expected a file.*found {found};"
                ) as no:
                    write()
                assert "\n" not in str(no.value)
    assert {p.name for p in tmp_path.iterdir()} == {"folder", "link", "ring", "socket"}
    with pytest.raises(UserError, match="^--json .*folder: expected"):
        written_to(folder, "--json")


def test_a_name_as_long_as_names_can_be_is_written_and_a_longer_one_refused(tmp_path):
    write_bytes(tmp_path / ("x" * 255), b"1")
    assert not written_to(tmp_path / ("y" * 255))
    with pytest.raises(UserError, match="^--json .*found: File name too long; choose another"):
        written_to(tmp_path / ("x" * 256), "--json")
    assert len(list(tmp_path.iterdir())) == 1


def test_a_disk_that_is_full_is_noticed_before_the_work(tmp_path):
    with (
        room_for(),
        pytest.raises(UserError, match="^--json .*found: File too large; choose another"),
    ):
        written_to(tmp_path / "x", "--json")
    assert list(tmp_path.iterdir()) == []


def test_many_files_may_be_open_where_the_system_lets_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    limits = [1024, 4096]
    monkeypatch.setattr(resource, "getrlimit", lambda which: tuple(limits))

    def raised(which: int, both: tuple[int, int]) -> None:
        if both[0] > both[1]:
            raise ValueError("current limit exceeds maximum limit")
        limits[:] = both

    monkeypatch.setattr(resource, "setrlimit", raised)
    allow_open_files(100)
    assert limits == [1024, 4096], "there is room"
    allow_open_files(2000)
    assert limits == [2000 + OTHERS, 4096]
    with pytest.raises(UserError, match="found a limit of 4096; raise it"):
        allow_open_files(5000)


@pytest.mark.parametrize("place", [".", "link"])
def test_a_new_folder_may_be_where_one_stands_or_behind_a_link(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    there = tmp_path / "there"
    there.mkdir()
    (tmp_path / "link").symlink_to(there)
    monkeypatch.chdir(there if place == "." else tmp_path)
    with new_folder(Path(place)) as part:
        (part / "file").touch()
    assert [one.name for one in there.iterdir()] == ["file"]
    assert (tmp_path / "link").is_symlink()

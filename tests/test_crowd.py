"""What a crowd of visitors takes, counted over a family of processes."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest

from benchmarks import crowd
from benchmarks.crowd import CrowdConfig, bench_crowd
from benchmarks.memory import proportional_megabytes
from benchmarks.page_server import await_answer
from madviz.errors import UserError
from madviz.system.processes import family

PARENT = (
    "import subprocess, sys\n"
    "block = bytearray(b'x' * 40_000_000)\n"
    "child = subprocess.Popen([sys.executable, '-c', 'while True: pass'])\n"
    "print(child.pid, flush=True)\n"
    "input()\n"
    "child.kill()\n"
)


def test_processor_time_and_memory_of_children_count():
    with subprocess.Popen(
        [sys.executable, "-c", PARENT], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None and process.stdin is not None
        child = int(process.stdout.readline())
        assert family(process.pid) == [process.pid, child]
        assert proportional_megabytes(process.pid) > 40
        before = crowd._cpu_seconds(process.pid)
        deadline = time.monotonic() + 30
        while crowd._cpu_seconds(process.pid) < before + 0.2 and time.monotonic() < deadline:
            time.sleep(0.05)
        assert crowd._cpu_seconds(process.pid) >= before + 0.2
        print(file=process.stdin, flush=True)


def test_each_number_of_visitors_has_its_figures(monkeypatch):
    figures = {"decisions_per_s": 9.5, "least": 9.0, "cores": 1.2, "mb": 700}
    monkeypatch.setattr(crowd, "_measured", lambda config, count: figures | {"mb": 100 * count})
    result = bench_crowd(CrowdConfig(visitors=(1, 4)))
    assert result["visitors"] == [1, 4] and result["mb"] == [100, 400]
    assert result["decisions_per_s"] == [9.5, 9.5] and result["cores"] == [1.2, 1.2]


def test_visitors_who_get_no_picture_are_an_error(monkeypatch):
    monkeypatch.setattr(crowd, "STARTING", 0.2)
    silent = type("Silent", (), {"steps": []})()
    with pytest.raises(UserError, match="a picture for every visitor within 0.2 s"):
        crowd._await_pictures([silent])  # type: ignore[list-item]


def test_a_server_that_refuses_has_answered():
    class Refuses(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_error(403)

        def log_message(self, *words):
            pass

    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        with HTTPServer(("127.0.0.1", 0), Refuses) as server:
            threading.Thread(target=server.serve_forever, daemon=True).start()
            await_answer(f"http://127.0.0.1:{server.server_port}/", process, patience=5)
            server.shutdown()
        with pytest.raises(UserError, match="did not start"):
            await_answer(f"http://127.0.0.1:{server.server_port}/", process, patience=0.3)
        process.kill()

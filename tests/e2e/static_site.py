"""A site for tests: the page's own files, with a fake worker and made-up policies."""

from __future__ import annotations

import json
import shutil
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from madviz.envs.registry import make_env
from madviz.site.files import write_packed
from madviz.site.recordings import record_episode
from madviz.subsets import every_mask, name_of
from tests.fakes import FakePolicy

ROOT = Path(__file__).resolve().parents[2]
WEB = ROOT / "madviz" / "site" / "web"
FAKE_WORKER = ROOT / "tests" / "site" / "fake_worker.js"
FILE = {"path": "nothing.gz", "bytes": 1, "unpacked": 1}
CAMERAS = (("first", "First person"), ("third_a", "Third A"), ("third_b", "Third B"))
NO_WEBGL = """
const real = OffscreenCanvas.prototype.getContext;
OffscreenCanvas.prototype.getContext = function (kind, ...rest) {
  return kind === 'webgl2' ? null : real.call(this, kind, ...rest);
};
"""
"""Runs in a page before its own scripts: a browser without WebGL2."""
MAD, MERGED_ONLY = "metaworld-hammer-mad-light", "metaworld-hammer-merged-only-light"


class QuietHandler(SimpleHTTPRequestHandler):
    extensions_map = {**SimpleHTTPRequestHandler.extensions_map, ".js": "text/javascript"}

    def log_message(self, format: str, *args: Any) -> None:
        pass


@contextmanager
def served(folder: Path, handler: type[SimpleHTTPRequestHandler] = QuietHandler) -> Iterator[str]:
    """The address at which ``folder`` is, below a path, as on many hosts."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(handler, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/"
    finally:
        server.shutdown()
        server.server_close()


def fake_site(folder: Path, **changes: Any) -> Path:
    """The page with its fake worker; ``changes`` to the manifest."""
    shutil.copytree(WEB, folder, dirs_exist_ok=True)
    shutil.copy(FAKE_WORKER, folder / "worker.js")
    (folder / "manifest.json").write_text(json.dumps(manifest() | changes))
    return folder


def manifest() -> dict[str, Any]:
    """Two policies on one task, one of which fails without a camera."""
    whole = {"all": 0.99, "first": 1.0, "third_a": 1.0, "third_b": 1.0, "third_a+third_b": 1.0}
    alone = {"all": 1.0, "first": 0.02, "third_a": 0.0, "third_b": 0.0, "third_a+third_b": 0.0}
    hammer = {
        "name": "metaworld/hammer",
        "label": "Hammer",
        "success": "the nail is driven in by more than 0.09 m",
        "done": ["drive the nail in", "drove the nail in"],
        "horizon": 30,
        "action_repeat": 2,
        "seeds": [5000, 5001, 5002],
        "model": FILE,
        "scene": FILE,
        "starts": FILE,
    }
    return {
        "schema": 1,
        "version": "0.1.0",
        "versions": {},
        "tasks": [hammer],
        "policies": [
            policy(MAD, "MAD", "mad", whole),
            policy(MERGED_ONLY, "Merged Only", "merged-only", alone),
        ],
        "recordings": [],
        "opening": {
            "first": MAD,
            "second": MERGED_ONLY,
            "camera": "first",
            "step": 15,
            "seed": 5000,
        },
        "runtime": {},
    }


def toy_recording(folder: Path) -> dict[str, Any]:
    """Writes recordings of toy/reach into a site; their line of the manifest."""
    policy = FakePolicy()
    streams, files = policy.spec.streams, {}
    with closing(make_env("toy/reach")) as env:
        for mask in every_mask(len(streams)):
            subset = name_of(mask, streams)
            content = record_episode(env, policy, mask, 5000)
            files[f"5000/{subset}"] = write_packed(folder, f"recordings/{subset}.gz", content)
        horizon = env.spec.horizon
    return {
        "policy": policy.spec.name,
        "label": "MAD",
        "method": "mad",
        "task": "maniskill/reach",
        "task_label": "Reach",
        "success": "the hand is near the goal",
        "horizon": horizon,
        "streams": list(streams),
        "trained_subsets": ["all"],
        "cameras": [camera(name, name.title()) for name in streams],
        "measured": {"all": rate(0.9)},
        "seeds_words": "development seeds",
        "seeds": [5000],
        "files": files,
    }


def policy(name: str, label: str, method: str, rates: dict[str, float]) -> dict[str, Any]:
    """A policy as the manifest has it."""
    return {
        "name": name,
        "label": label,
        "task": "metaworld/hammer",
        "method": method,
        "setting": "three",
        "streams": [one for one, _ in CAMERAS],
        "trained_subsets": ["all", *(one for one, _ in CAMERAS if method == "mad")],
        "digest": "0" * 64,
        "cameras": [camera(*one) for one in CAMERAS],
        "measured": {subset: rate(value) for subset, value in rates.items()},
        "seeds": "development seeds",
        "graph": FILE,
    }


def camera(name: str, label: str) -> dict[str, Any]:
    """A camera as the manifest has it."""
    return {
        "name": name,
        "label": label,
        "fovy": 60,
        "position": [0.7, 0.1, 0.7],
        "wxyz": [1, 0, 0, 0],
        "body": "hand" if name == "first" else None,
        "depth_range": [0, 2],
        "size": 84,
    }


def rate(success: float, n: int = 100) -> dict[str, Any]:
    """A measured rate with an interval that is near enough."""
    interval = [max(success - 0.04, 0), min(success + 0.04, 1)]
    return {"success": success, "n": n, "ci95": interval, "trained": True}


def until(page: Any, text: str, selector: str = "body") -> str:
    """Waits for a text, and returns all of the element's."""
    page.wait_for_function(
        "([selector, text]) => document.querySelector(selector)?.innerText.includes(text)",
        arg=[selector, text],
    )
    return page.locator(selector).inner_text()

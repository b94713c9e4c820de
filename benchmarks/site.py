"""Measures a site in a real browser: what a visitor downloads, how fast it acts, how often it
succeeds.

Chromium is driven headless on each software renderer: ``llvmpipe`` (Mesa) and ``swiftshader`` (the
browser's own). Bytes are those that came over the wire until the first decision of one policy, and
until both of the opening act. Episodes run as fast as the machine can, from the first seed on.

    {"first_load_mb": 12.0, "one_policy_mb": 9.6,
     "decisions_per_s": {"llvmpipe": {"one", "side_by_side"}, "swiftshader": {...}},
     "success": {policy: {subset: {"success", "n"}}}, "episodes": [...]}
"""

from __future__ import annotations

import functools
import http.server
import json
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.resources import files
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.live import started
from madviz.errors import UserError
from madviz.subsets import mask_of
from madviz.system.browser import CHROMIUM_FLAGS
from madviz.system.numbers import Count, Time

if TYPE_CHECKING:
    from playwright.sync_api import Page

BACKENDS = ("llvmpipe", "swiftshader")
_LLVMPIPE = ("--use-gl=angle", "--use-angle=gl-egl", "--ignore-gpu-blocklist")
DRIVER = files("benchmarks").joinpath("site_driver.js")
"""Runs in the page, in place of the page's own code, and talks to the site's worker."""
_PATIENCE = 3_600_000
"""Milliseconds for all episodes of a subset."""


@dataclass(frozen=True)
class BenchSiteConfig:
    """Measures a site that ``madviz site`` wrote, in a headless Chromium."""

    site: str
    """The site's folder."""
    episodes: Count = 20
    """Episodes for each policy and subset."""
    policies: tuple[str, ...] = ()
    """Policies to count successes of; by default those that the page opens with."""
    subsets: tuple[str, ...] = ()
    """Subsets to count successes under; by default all cameras, and each alone."""
    backend: str = "llvmpipe"
    """The renderer under which successes are counted: llvmpipe or swiftshader."""
    seconds: Time = 10.0
    """How long decisions are counted for the speed."""
    json: str | None = None
    """Write the result to this file; ``-`` is standard output, and then nothing else goes there."""


def bench_site(config: BenchSiteConfig) -> dict[str, Any]:
    """See the module. Raises UserError for a folder that is no site and for unknown names."""
    manifest = read_manifest(Path(config.site))
    if config.backend not in BACKENDS:
        raise UserError(f"expected a backend of {', '.join(BACKENDS)}, found {config.backend!r}")
    known = {policy["name"]: policy for policy in manifest["policies"]}
    opening = manifest["opening"] or {"first": next(iter(known)), "second": None}
    both = [opening["first"], opening["second"]] if opening["second"] else [opening["first"]]
    names = config.policies or tuple(both)
    if missing := [name for name in names if name not in known]:
        raise UserError(f"expected policies of this site, found {missing[0]!r:.100}")
    seeds = manifest["tasks"][0]["seeds"]
    result: dict[str, Any] = {"schema": 1, "site": config.site, "seed": seeds[0]}
    with serving(Path(config.site)) as url:
        with opened(url, config.backend) as page:
            result["one_policy_mb"] = megabytes(page, both[:1], seeds[0])
        with opened(url, config.backend) as page:
            result["first_load_mb"] = megabytes(page, both, seeds[0])
        result["decisions_per_s"] = {
            backend: speeds(url, backend, both, seeds[0], config.seconds) for backend in BACKENDS
        }
        result["success"], result["episodes"] = {}, []
        for name in names:
            with opened(url, config.backend) as page:
                rows, played = successes(page, known[name], config)
            result["success"][name] = rows
            result["episodes"] += played
    return result


def read_manifest(site: Path) -> dict[str, Any]:
    """Raises UserError for a folder without one."""
    path = site / "manifest.json"
    if not path.is_file():
        raise UserError(f"{site}: expected a site, found no manifest.json; make it: madviz site")
    return json.loads(path.read_text())


@contextmanager
def serving(site: Path) -> Iterator[str]:
    """The folder on a free port, as any static host serves it; its address."""
    handler = functools.partial(_Quiet, directory=str(site))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/"
    finally:
        server.shutdown()
        server.server_close()


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: Any) -> None:
        pass


def browser_flags(backend: str) -> list[str]:
    """Chromium's command-line flags for drawing with ``backend``."""
    if backend == "swiftshader":
        return list(CHROMIUM_FLAGS)
    others = [flag for flag in CHROMIUM_FLAGS if "gl=" not in flag and "swiftshader" not in flag]
    return [*others, *_LLVMPIPE]


@contextmanager
def opened(url: str, backend: str) -> Iterator[Page]:
    """An empty page of the site's origin, with the driver in it. Raises UserError where there is
    no browser."""
    with started(None, browser_flags(backend)) as browser:
        page = browser.new_page()
        page.set_default_timeout(_PATIENCE)
        page.goto(f"{url}manifest.json")
        page.evaluate(DRIVER.read_text())
        yield page


def megabytes(page: Page, policies: list[str], seed: int) -> float:
    """Transferred until all ``policies`` have acted: the page's own files and what they need."""
    packed = page.evaluate("([names, seed]) => driver.open(names, seed)", [policies, seed])
    plain = page.evaluate("driver.pageBytes()")
    return round((packed["bytes"] + plain) / 1e6, 2)


def speeds(
    url: str, backend: str, policies: list[str], seed: int, seconds: float
) -> dict[str, float]:
    """Decisions a second of one policy, and of each of two side by side."""
    found = {}
    for name, some in (("one", policies[:1]), ("side_by_side", policies)):
        with opened(url, backend) as page:
            page.evaluate("([names, seed]) => driver.open(names, seed)", [some, seed])
            found[name] = round(page.evaluate("seconds => driver.rate(seconds)", seconds), 2)
    return found


def successes(
    page: Page, policy: dict[str, Any], config: BenchSiteConfig
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Success of a policy under each subset, and every episode. Raises UserError for a subset that
    the policy's cameras don't have."""
    rows = {}
    played = []
    cameras = [camera["name"] for camera in policy["cameras"]]
    seeds = page.evaluate("task => driver.seeds(task)", policy["task"])
    episodes = min(config.episodes, len(seeds))
    for subset in config.subsets or ("all", *cameras):
        present = list(compress(cameras, mask_of(subset, tuple(cameras))))
        page.evaluate(
            "([name, seed, present]) => driver.prepare(name, seed, present)",
            [policy["name"], seeds[-1], present],
        )
        found = page.evaluate("count => driver.play(count)", episodes)
        count = sum(outcome["success"] for outcome in found)
        rows[subset] = {"success": count / len(found), "n": len(found)}
        played += [
            {"policy": policy["name"], "subset": subset, "seed": one["seed"],
             "success": one["success"], "success_any": one["success_any"]}
            for one in found
        ]  # fmt: skip
        print(f"{policy['name']} {subset}: {count}/{len(found)}", file=sys.stderr, flush=True)
    return rows, played

"""madviz site: the explorer as a folder of static files, which any host can serve.

    index.html, *.js, *.css   the page and what it runs (madviz/site/web)
    manifest.json             tasks, policies, and every other file with its size
    runtime/                  MuJoCo and ONNX Runtime in WebAssembly
    tasks/ textures/          what is simulated and drawn
    policies/                 one graph each
    recordings/               episodes of tasks that no browser can simulate
    licences/                 of all that is not madviz's own

A visitor's browser fetches what the chosen policy needs, some 9 MB, and asks no other host. The
folder needs no server of its own, no special headers, and no place at the root of a host.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from madviz.errors import UserError
from madviz.policies.checkpoint import PolicyFolder, describe, policy_folders
from madviz.session.session_file import versions_here
from madviz.site.exports import description_of, export_policy, export_task, labels_of
from madviz.site.files import write_zip
from madviz.site.recordings import record_policy
from madviz.site.runtime import LICENCES, find_packages, versions, write_licences, write_runtime
from madviz.system.files import new_folder, read_json, write_json
from madviz.system.numbers import CountOrNone
from madviz.vocabulary.words import shown_meanings

SCHEMA = 1
MANIFEST = "manifest.json"
FOLDERS = ("runtime", "tasks", "textures", "policies", "recordings", "licences")
PAGE = (".js", ".css", ".html", ".svg")
"""All that a site has at its top: its folders, and the endings of the page's own files."""
OPENING = {
    "first": "metaworld-hammer-mad-light",
    "second": "metaworld-hammer-merged-only-light",
    "camera": "first",
    "step": 15,
}
"""The first comparison that a visitor sees: two policies, and the camera that goes. Without First
person, MAD has 1.00 and Merged Only 0.00; without Third A both succeed most of the time."""
LIVE = "metaworld/"
"""Tasks that a browser can simulate begin so; others are only recorded."""


@dataclass(frozen=True)
class SiteConfig:
    """Writes the explorer as static files, for example
    ``madviz site --out build/site --policies metaworld-hammer-mad-light``."""

    out: str
    """The folder to write; what madviz wrote there before is replaced."""
    policies: tuple[str, ...] = ()
    """Names from ``madviz list``, or folders; by default all that a site can hold."""
    seeds: str = "5000:5050"
    """The first seed of the episodes that a visitor can choose from, and the one after the last."""
    recorded: CountOrNone = 1
    """How many of these seeds are recorded, of tasks that no browser can simulate and of the
    policies that are shown first; 0 for none. A minute or two for each policy, once."""
    recordings: str = "build/recordings"
    """Where recordings are kept for the next site."""
    zip: bool = False
    """Also write OUT.zip, which hosts of static files take."""
    packages: str = ".venv/node/node_modules"
    """The folder with the npm packages; ``make site`` fills it."""
    json: str | None = None
    """Write what was made to this file; ``-`` is standard output, and then nothing else goes
    there."""


def run_site(config: SiteConfig) -> dict[str, Any]:
    """Writes the folder; its manifest with the bytes in all. Raises UserError for a policy that no
    site can hold, for seeds that are no range, where packages are missing, and for a folder that
    holds something else."""
    seeds = seed_range(config.seeds)
    packages = find_packages(Path(config.packages).resolve())
    folders = chosen(config.policies)
    out = Path(config.out)
    named = Path(os.path.abspath(out))  # ``.`` has no name, and is another folder afterwards.
    place = out.resolve()  # A link stays one.
    check_place(place)
    place.parent.mkdir(parents=True, exist_ok=True)
    with new_folder(place) as part:
        manifest = _written(part, config, folders, seeds, packages)
        size = sum(path.stat().st_size for path in part.rglob("*") if path.is_file())
        if place.exists():
            shutil.rmtree(place)  # Last: what fails before leaves the old site.
    archive = write_zip(named) if config.zip else None
    return {"out": str(out), "bytes": size, "zip": str(archive or ""), **manifest}


def _written(
    out: Path,
    config: SiteConfig,
    folders: Sequence[PolicyFolder],
    seeds: range,
    packages: Path,
) -> dict[str, Any]:
    """Writes all files of a site into ``out``; its manifest."""
    manifest: dict[str, Any] = {
        "schema": SCHEMA,
        "page_bytes": copy_page(out),
        "version": versions_here()["madviz"],
        "versions": {**versions_here(), **versions()},
        "runtime": write_runtime(out, packages),
        "meanings": shown_meanings(),
    }
    labels = labels_of(folders)
    live = [folder for folder in folders if folder.spec.task.startswith(LIVE)]
    tasks = list(dict.fromkeys(folder.spec.task for folder in live))
    manifest["tasks"] = [announced(task, export_task, out, task, seeds) for task in tasks]
    manifest["policies"] = [
        announced(folder.spec.name, export_policy, out, folder, labels[folder.spec.name])
        for folder in live
    ]
    manifest["recordings"] = [
        announced(
            f"recordings of {folder.spec.name}",
            record_policy,
            out,
            Path(config.recordings),
            folder,
            description_of(folder, labels[folder.spec.name]),
            list(seeds)[: config.recorded],
        )
        for folder in folders
        if config.recorded and (folder not in live or folder.spec.name in OPENING.values())
    ]
    manifest["opening"] = opening(manifest["policies"], seeds)
    write_licences(out, packages)
    write_json(out / MANIFEST, manifest)
    return manifest


def site_words(result: dict[str, Any]) -> str:
    """A summary of what was written, and how to look at it."""
    films = [one["policy"] for one in result["recordings"]]
    names = {policy["name"] for policy in result["policies"]}
    recorded = len(set(films) - names)
    more = f" and {recorded} that are recorded" if recorded else ""
    zipped = f"{result['zip']}: the same, for a host of static files\n" if result["zip"] else ""
    return (
        f"{result['out']}: {len(result['tasks'])} tasks, {len(names)} policies that act{more}, "
        f"{result['bytes'] / 1e6:.1f} MB\n{zipped}"
        f"python -m http.server --bind 127.0.0.1 --directory {result['out']} 8000   serves it"
    )


def seed_range(text: str) -> range:
    """``5000:5050`` as a range. Raises UserError for anything else."""
    first, colon, last = text.partition(":")
    if colon and first.isdecimal() and last.isdecimal() and len(text) <= 60:
        seeds = range(int(first), int(last))
        if seeds.start < seeds.stop <= min(seeds.start + 1000, 2**31):
            return seeds
    raise UserError(
        f"--seeds: expected a range such as 5000:5050, at most 1000, found {text!r:.60}"
    )


def chosen(names: Sequence[str]) -> list[PolicyFolder]:
    """The policies to write: those the page opens with first, then the others by name."""
    folders = [describe(name) for name in names or policy_folders()]
    if not names:
        folders = [folder for folder in folders if fits(folder)]
    for folder in folders:
        if not fits(folder):
            raise UserError(
                f"expected policies that sum the features of the three cameras, "
                f"found {folder.spec.name}; leave it out of --policies"
            )
    paths: dict[str, Path] = {}
    for folder in folders:
        if (other := paths.setdefault(folder.spec.name, folder.path)) != folder.path:
            raise UserError(
                f"expected policies of different names, found {folder.spec.name} in {other} and in "
                f"{folder.path}; leave one out"
            )
    first = [OPENING["first"], OPENING["second"]]
    return sorted(folders, key=lambda folder: (folder.spec.name not in first, folder.spec.name))


def fits(folder: PolicyFolder) -> bool:
    """Whether a site can hold the policy. Depth is drawn within 1 mm of the server's."""
    return folder.config.merge == "sum" and folder.spec.setting in ("three", "three-rgbd")


def check_place(out: Path) -> None:
    """Raises UserError for a folder that holds anything but a site, which would be lost, and for a
    file."""
    if not out.exists():
        return
    if not out.is_dir():
        raise UserError(f"{out}: expected a folder, found a file; choose another name")
    found = sorted(path.name for path in out.iterdir())
    if not found:
        return
    try:
        manifest = read_json(out / MANIFEST)
        ours = isinstance(manifest, dict) and {"schema", "runtime"} <= manifest.keys()
    except UserError:
        ours = False
    others = [name for name in found if not (ours and _of_a_site(name))]
    if others:
        raise UserError(
            f"{out}: expected an empty folder or a site, found {others[0]!r:.60}, which would be "
            "lost; choose another folder"
        )


def _of_a_site(name: str) -> bool:
    """True for a name at the top of a site, of this version or an earlier one."""
    return name in (MANIFEST, LICENCES, *FOLDERS) or name.endswith(PAGE)


def copy_page(out: Path) -> int:
    """Copies the page into ``out``; its bytes."""
    web = resources.files("madviz.site").joinpath("web")
    with resources.as_file(web) as source:
        shutil.copytree(source, out, dirs_exist_ok=True)
    return sum(path.stat().st_size for path in out.iterdir() if path.is_file())


def opening(policies: list[dict[str, Any]], seeds: range) -> dict[str, Any] | None:
    """The first comparison, if its policies are there."""
    names = [policy["name"] for policy in policies]
    if OPENING["first"] not in names or OPENING["second"] not in names:
        return None
    return {**OPENING, "seed": seeds[0]}


def announced(name: str, work: Any, *arguments: Any) -> Any:
    """Says on standard error what is being written: it takes seconds."""
    print(f"writing {name}", file=sys.stderr, flush=True)
    return work(*arguments)

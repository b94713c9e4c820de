"""The audits of docs/audit.md, and the pages that it links to.

    python tools/audits.py runs/audits NAME...    plays those of them, and writes results/audits/
                                                  and results/along/

A served policy must be served first, and a file of Stable-Baselines3 must lie where the command is
called (``integrations/``). An audit that was stopped goes on where it was.
"""

from __future__ import annotations

import shlex
import shutil
import subprocess
import sys
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from pathlib import Path
from typing import Any

from measurements import read, table
from policy_files import LABELS, ROOT, SINGLES

from madviz.measure.audit.account import account
from madviz.measure.audit.along_account import along_account, at, breaking
from madviz.measure.audit.sentences import change, deciding, in_words
from madviz.measure.blocks import html
from madviz.measure.statistics import SuccessRate

FIRST_SEED = 10_000
"""A development seed."""
OURS = "--how dropped black"
AUDITS = {
    "metaworld-hammer-mad-light": f"--policy metaworld-hammer-mad-light {OURS}",
    "metaworld-hammer-merged-only-light": f"--policy metaworld-hammer-merged-only-light {OURS}",
    "maniskill-push-cube-mad-paper-vectorised": (
        f"--policy maniskill-push-cube-mad-paper-vectorised {OURS}"
    ),
    "lerobot-act-plain": f"--policy ws://127.0.0.1:8001 {OURS} --episodes 50",
    "lerobot-act-view-dropout": f"--policy ws://127.0.0.1:8002 {OURS} --episodes 50",
    "sb3-ppo-reach": "--policy sb3:ppo-reach.zip@toy/reach --trust --how mean black",
}
"""By the name of its file, the options of an audit."""
AXES = "--along third_a.pan=-20:20 third_a.blur=0:1 light=0.3:2 third_a.delay=0:8"
ALONG = {
    "hammer-mad": f"--policy metaworld-hammer-mad-light {AXES}",
    "hammer-merged-only": f"--policy metaworld-hammer-merged-only-light {AXES}",
}
"""The same of audits along axes."""


def command(name: str) -> str:
    """The command line of an audit, but for its folder."""
    return f"madviz audit {(AUDITS | ALONG)[name]} --seed {FIRST_SEED}"


def audits() -> str:
    """A row each, with a link: the verdict of every camera, success without it against all cameras,
    and success with it black."""
    rows = []
    for name in AUDITS:
        found = _document(name)
        intact = SuccessRate.read(found["intact"])
        cells = [
            f"{verdict}, {change(deciding(found, camera, 'removed'))}; {_black(found, camera)}"
            for camera, verdict in found["verdict"].items()
        ]
        link = f"[{found['policy']}](audits/{name}.html), {found['task']}"
        rows.append((link, intact, *cells))
    return table(("policy, task", "all cameras", *(LABELS[camera] for camera in SINGLES)), rows)


def along() -> str:
    """A row for each way, with a column for each policy: where half of its success is gone."""
    found = [read(f"along/{name}") for name in ALONG]
    rows = []
    for axes in zip(*(one["axes"] for one in found), strict=True):
        who = found[0]["labels"].get(axes[0]["camera"] or "", "All cameras")
        for sides in zip(*(axis["sides"] for axis in axes), strict=True):
            ends = map(breaking, axes, sides)
            rows.append(
                (f"{who}, {sides[0]['way']}, to {at(axes[0]['unit'], sides[0]['end'])}", *ends)
            )
    heads = (
        f"[{one['policy']}](along/{name}.html)" for name, one in zip(ALONG, found, strict=True)
    )
    return table(("change", *heads), rows)


def _black(found: Any, camera: str) -> str:
    where = {"camera": camera, "what": "removed", "how": "black"}
    rows = (row for row in found["conditions"] if where.items() <= row.items())
    return "".join(f"black {row['success']:.2f}" for row in rows)


def sentences(name: str) -> str:
    """The command of an audit and its result in words."""
    lines = "".join(f"- {line}\n" for line in in_words(_document(name)))
    return f"`{command(name)} --out DIR`:\n\n{lines}"


def pages() -> dict[str, str]:
    """By address in the documentation, the page of every audit; films are made only where an audit
    is played."""
    return {
        f"audits/{name}.html": html(account(_document(name), f"{command(name)} --out {name}"))
        for name in AUDITS
    } | {
        f"along/{name}.html": html(
            along_account(read(f"along/{name}"), f"{command(name)} --out along-{name}")
        )
        for name in ALONG
    }


def _document(name: str) -> Any:
    return read(f"audits/{name}")


def play(out: Path, name: str) -> None:
    """Plays an audit and keeps its document."""
    words = shlex.split(command(name))[1:]
    subprocess.run([sys.executable, "-m", "madviz", *words, "--out", out / name], check=True)
    kind = "along" if name in ALONG else "audit"
    folder = "along" if name in ALONG else "audits"
    shutil.copy(out / name / f"{kind}.json", ROOT / "results" / folder / f"{name}.json")


def main(words: list[str]) -> None:
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("policies", nargs="+", choices=[*AUDITS, *ALONG], metavar="policy")
    asked = parser.parse_args(words)
    asked.out.mkdir(parents=True, exist_ok=True)
    for name in asked.policies:
        play(asked.out, name)


if __name__ == "__main__":
    main(sys.argv[1:])

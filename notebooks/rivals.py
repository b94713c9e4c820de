"""Makes measured/rivals.json, which lesson 6 shows: every rival is trained small on toy/reach, as
``mad`` is in lesson 3, and then meets every way to lose a camera.

    python notebooks/rivals.py             all ten: about twenty minutes on two cores
    python notebooks/rivals.py vib mvd     these again; the others stay as they are

Trainings are kept in a temporary folder (``madviz-lessons``), so a second run only measures.
"""

from __future__ import annotations

import sys
from pathlib import Path

from madviz.teaching.rivals import RIVALS, keep, take_away, train_rival

FILE = Path(__file__).resolve().parent / "measured" / "rivals.json"


def main(names: list[str]) -> None:
    FILE.parent.mkdir(exist_ok=True)
    for name in names or RIVALS:
        run = train_rival(name)
        outcomes = take_away(run.policy)
        keep(FILE, name, outcomes)
        print(f"\n{name}: {run.seconds:.0f} s, succeeds {outcomes['all'].count('1')} times of "
              f"{len(outcomes['all'])}", flush=True)  # fmt: skip


if __name__ == "__main__":
    main(sys.argv[1:])

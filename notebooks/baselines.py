"""Makes measured/baselines.json, which lesson 6 shows: MAD and nine baselines are trained small on
toy/reach, as ``mad`` is in lesson 3, and then measured with cameras missing in every way.

    python notebooks/baselines.py             all ten: about twenty minutes on two cores
    python notebooks/baselines.py vib mvd     these again; the others stay as they are

Trainings are saved in a temporary folder (``madviz-lessons``), so a second run only measures.
"""

from __future__ import annotations

import sys
from pathlib import Path

from madviz.teaching.baselines import COMPARED, run_cases, save_outcomes, train_baseline

FILE = Path(__file__).resolve().parent / "measured" / "baselines.json"


def main(names: list[str]) -> None:
    FILE.parent.mkdir(exist_ok=True)
    for name in names or COMPARED:
        run = train_baseline(name)
        outcomes = run_cases(run.policy)
        save_outcomes(FILE, name, outcomes)
        digits = outcomes["all"]
        successes = f"{digits.count('1')} of {len(digits)}"
        print(f"\n{name}: {run.seconds:.0f} s, {successes} succeed", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])

"""Makes madviz/teaching/baselines.json, which lesson 6 shows. MAD and nine baselines are trained on
toy/reach, as small as ``mad`` in lesson 3, and then measured with cameras missing in every way.

    python notebooks/baselines.py             all ten: about twenty minutes on two cores
    python notebooks/baselines.py vib mvd     these again; the others stay as they are

Trainings are saved in a temporary folder (``madviz-lessons``), so a second run only measures.
"""

from __future__ import annotations

import sys

from madviz.teaching.baselines import run_cases, train_baseline
from madviz.teaching.outcomes import COMPARED, SHIPPED, save_outcomes


def main(names: list[str]) -> None:
    for name in names or COMPARED:
        run = train_baseline(name)
        outcomes = run_cases(run.policy)
        save_outcomes(SHIPPED, name, outcomes)
        digits = outcomes["all"]
        successes = f"{digits.count('1')} of {len(digits)}"
        print(f"\n{name}: {run.seconds:.0f} s, {successes} succeed", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])

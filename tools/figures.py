"""docs/hammer.svg and docs/push.svg, README's two plots, from the files of the policies.

python tools/figures.py
"""

from __future__ import annotations

from pathlib import Path

from policy_files import LABELS, SINGLES, measured, seeds

from madviz.plots.figures import Bar, bars

DOCS = Path(__file__).resolve().parent.parent / "docs"
GROUPS = ("all", *SINGLES)
HAMMER = {
    "MAD": "metaworld-hammer-mad-light",
    "Merged Only": "metaworld-hammer-merged-only-light",
    "Singular Only": "metaworld-hammer-singular-only-light",
}
PUSH = {
    "MAD": "metaworld-push-mad-light-12x300",
    "Single": "metaworld-push-single-{camera}-light",
    "Singular Only": "metaworld-push-singular-only-light",
    "MVD": "metaworld-push-mvd-light",
    "Merged Only": "metaworld-push-merged-only-light",
    "VIB": "metaworld-push-vib-light",
}


def figure(title: str, policies: dict[str, str]) -> str:
    """SVG text: a group of bars for all cameras and for each one alone. ``Single`` is a policy for
    each camera, and has no bar for all."""
    folders = {
        (name, group): policy.format(camera=group)
        for name, policy in policies.items()
        for group in GROUPS
        if group != "all" or "{camera}" not in policy
    }
    found = dict(zip(folders, measured(*folders.values()), strict=True))
    series: dict[str, list[Bar | None]] = {}
    for name, policy in policies.items():
        for group in GROUPS:
            one = found.get((name, group), {"subsets": {}})
            row = one["subsets"].get("all" if "{camera}" in policy else group)
            bar = Bar(row["success"], *row["ci95"]) if row else None
            series.setdefault(name, []).append(bar)
    names = ["all cameras", *(f"{LABELS[one]} alone" for one in SINGLES)]
    use = seeds(next(iter(found.values())))
    return bars(f"{title}: success at the last step, 95% intervals, {use}", names, series)


def main() -> None:
    (DOCS / "hammer.svg").write_text(figure("Hammer", HAMMER))
    (DOCS / "push.svg").write_text(figure("Push, small budget", PUSH))


if __name__ == "__main__":
    main()

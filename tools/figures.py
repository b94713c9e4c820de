"""docs/hammer.svg and docs/push.svg, README's two plots, from the files of the policies.

python tools/figures.py
"""

from __future__ import annotations

from pathlib import Path

from fill_figures import LABELS, SINGLES, evaluation

from madviz.plots import Bar, bars

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


def bar(policy: str, group: str) -> Bar | None:
    """The success rate of a policy on a subset; of ``Single``, of the policy with that camera."""
    if "{camera}" in policy:
        if group == "all":
            return None
        policy, group = policy.format(camera=group), "all"
    row = evaluation(policy)["subsets"].get(group)
    return Bar(row["success"], *row["ci95"]) if row else None


def figure(title: str, policies: dict[str, str]) -> str:
    """SVG text: a group of bars for all cameras and for each one alone."""
    names = ["all cameras", *(f"{LABELS[one]} alone" for one in SINGLES)]
    series = {name: [bar(policy, group) for group in GROUPS] for name, policy in policies.items()}
    return bars(title, names, series)


def main() -> None:
    note = "success at the last step, 95% intervals"
    (DOCS / "hammer.svg").write_text(figure(f"Hammer: {note}", HAMMER))
    (DOCS / "push.svg").write_text(figure(f"Push, small budget: {note}", PUSH))


if __name__ == "__main__":
    main()

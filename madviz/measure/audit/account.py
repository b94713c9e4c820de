"""audit.html and audit.md: one account of an audit, as a page that needs nothing else and as text.

Both are made from the same blocks. The page loads nothing and runs nothing; a content security
policy in its head tells the browser so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from madviz.measure.audit.document import AuditFile, ConditionRow
from madviz.measure.audit.guarded import GuardedRow, noticed_words
from madviz.measure.audit.lost_cameras import HOWS
from madviz.measure.audit.sentences import (
    HOW_WORDS,
    MEANING,
    broken,
    change,
    deciding,
    in_words,
    planned,
)
from madviz.measure.episodes import clipped_words
from madviz.measure.statistics import SuccessRate
from madviz.plots import figures
from madviz.policies.seeds import use_of
from madviz.system.markdown import markdown_table

HOW_TO_READ = (
    "Success counts at the last step of an episode. All conditions met the same scenes, so that a "
    "difference comes from the cameras. Brackets are 95 % intervals: Wilson's for a rate, "
    "Newcombe's for a paired difference, Agresti and Min's for a Shapley value.",
    "p is McNemar's, exact, with Holm's correction for the other tests of its kind, and for the "
    "looks at which the audit could have stopped: 0.05 is the limit. The verdicts together claim a "
    "significant difference that is not there in at most 5 of 100 audits.",
    "'Needed' is said only where an interval shows a loss of half or more, and 'makes no "
    "difference' where one lies within 5 points either way. These intervals hold for all cameras "
    "and looks together, so they are wider than the ones in brackets. 'No use shown' does not mean "
    "no use: more episodes may show one.",
    "The Shapley value of a camera is the success that it adds, on average over all orders in "
    "which cameras can come. The values sum to the difference between all cameras and none.",
    "An audit is about one training of a policy, in simulation, on the scenes of these seeds.",
)

_STYLE = """
body{font:15px/1.55 sans-serif;max-width:960px;margin:28px auto;padding:0 18px;color:#222;
background:#fff}h1{font-size:24px;margin:0 0 10px;overflow-wrap:anywhere}
h2{font-size:17px;margin:30px 0 8px}
ul{padding-left:20px;margin:0}li{margin:0 0 5px}ul.words{font-size:17px}
table{border-collapse:collapse;margin:0 0 8px}.wide{overflow-x:auto}
td,th{padding:3px 16px 3px 0;text-align:left;white-space:nowrap;
border-bottom:1px solid #e4e4e4}th{font-weight:600;color:#555}
code{background:#f1f1f1;padding:2px 5px;overflow-wrap:anywhere}p{margin:0 0 8px}
svg{max-width:100%;height:auto;display:block;margin-bottom:10px}
"""


@dataclass(frozen=True)
class Block:
    """A piece of an account: a heading, lines, a table or a picture."""

    kind: str
    """``h1``, ``h2``, ``p``, ``words``, ``list``, ``code``, ``table`` or ``svg``."""
    lines: Sequence[str] = ()
    """Text; of a table, its heads."""
    rows: Sequence[Sequence[str]] = ()


def account(found: AuditFile, command: str) -> list[Block]:
    """All blocks; ``command`` makes the audit again."""
    clipped = clipped_words(found.get("outside", 0.0))
    return [
        Block("h1", [f"Does {found['policy']} use its cameras?"]),
        Block("words", in_words(found)),
        Block("p", [planned(found)]),
        Block("h2", ["Verdicts"]),
        Block("table", VERDICT_HEADS, _verdict_rows(found)),
        *([Block("p", [clipped])] if clipped else []),
        Block("list", [f"{name}: {meaning}." for name, meaning in MEANING.items()]),
        Block("h2", ["Success by condition"]),
        Block("svg", [rates_picture(found)]),
        *_shapley(found),
        Block("h2", ["Every condition"]),
        Block("table", _heads(found), [_condition_row(found, r) for r in found["conditions"]]),
        Block("h2", ["How to read this"]),
        Block("list", HOW_TO_READ),
        Block("h2", ["What was measured"]),
        Block("table", ("", ""), _facts(found)),
        Block("h2", ["To make it again"]),
        Block("code", [command]),
    ]


VERDICT_HEADS = ("camera", "verdict", "without it", "p", "alone", "alone against none", "p")
CONDITION_HEADS = ("cameras", "how", "success", "against all cameras", "p")


def _heads(found: AuditFile) -> tuple[str, ...]:
    return (*CONDITION_HEADS, "guarded", "noticed") if "guarded" in found else CONDITION_HEADS


def _verdict_rows(found: AuditFile) -> list[list[str]]:
    rows = []
    for name, verdict in found["verdict"].items():
        removed = deciding(found, name, "removed")
        alone = deciding(found, name, "alone")
        above = alone.get("above_none")
        rows.append(
            [
                found["labels"][name],
                verdict,
                change(removed),
                f"{removed['p_holm']:.2g}",
                str(_rate(alone)),
                change(above) if above else "",
                f"{above['p_holm']:.2g}" if above else "",
            ]
        )
    return rows


def _condition_row(found: AuditFile, row: ConditionRow) -> list[str]:
    label = condition_label(found, row)
    how = HOW_WORDS[row["how"]]
    cells = [label, how, str(_rate(row)), change(row), f"{row['p_holm']:.2g}"]
    if "guarded" not in found:
        return cells
    guarded = found["guarded"]["broken"].get(str(row["camera"]), {}).get(row["how"])
    if guarded is None or not broken(row):
        return [*cells, "", ""]
    return [*cells, str(_rate(guarded)), noticed_words(guarded["noticed"]).removeprefix("noticed ")]


def condition_label(found: AuditFile, row: ConditionRow) -> str:
    """``First person removed``, ``no camera``."""
    if row["camera"] is None:
        return "no camera"
    return f"{found['labels'][row['camera']]} {row['what']}"


def _rate(row: ConditionRow | GuardedRow) -> SuccessRate:
    n = row["n"]
    return SuccessRate.of(round(row["success"] * n), n)


def _shapley(found: AuditFile) -> list[Block]:
    if not found["shapley"]:
        return []
    labels = [found["labels"][name] for name in found["shapley"]]
    bars = [
        figures.Bar(row["value"], row["ci95"][0], row["ci95"][1])
        for row in found["shapley"].values()
    ]
    away = "cameras are dropped" if found["shapley_how"] == "dropped" else "cameras send the mean"
    title = f"Shapley values: what a camera adds to success ({away})"
    return [Block("svg", [figures.dots(title, labels, {found["shapley_how"]: bars}, signed=True)])]


def rates_picture(found: AuditFile) -> str:
    """SVG: a line for every camera removed and alone and for none, a dot for every way."""
    labels = list(dict.fromkeys(condition_label(found, row) for row in found["conditions"]))
    series: dict[str, list[figures.Bar | None]] = {}
    for how in HOWS:
        rows = {condition_label(found, r): r for r in found["conditions"] if r["how"] == how}
        if rows:
            words = HOW_WORDS[how].removeprefix("the ")
            series[words] = [_bar(rows[label]) if label in rows else None for label in labels]
    intact = found["intact"]["success"]
    title = f"{found['policy']}: success; the dashed line is all cameras"
    return figures.dots(title, labels, series, marks=(intact,))


def _bar(row: ConditionRow) -> figures.Bar:
    rate = _rate(row)
    return figures.Bar(rate.value, *rate.interval)


def _facts(found: AuditFile) -> list[tuple[str, str]]:
    n = found["intact"]["n"]
    seed = found["seed"]
    used = range(seed, seed + n)
    return [
        ("policy", found["policy"]),
        ("digest", found["digest"] or "none"),
        ("task", found["task"]),
        ("a success is", found["definition"]),
        ("seeds", f"{used[0]} to {used[-1]} ({use_of(used)})"),
        ("looks", ", ".join(map(str, found["looks"])) + " episodes"),
    ]


def markdown(found: AuditFile, command: str) -> str:
    """audit.md: the account without its pictures."""
    return "\n\n".join(filter(None, map(_as_markdown, account(found, command)))) + "\n"


def _as_markdown(block: Block) -> str:
    if block.kind == "table":
        rows = [[cell.replace("|", "/") for cell in row] for row in (block.lines, *block.rows)]
        return markdown_table(rows[0], rows[1:])
    if block.kind in ("words", "list"):
        return "\n".join(f"- {line}" for line in block.lines)
    text = " ".join(block.lines)
    marks = {"h1": "# {}", "h2": "## {}", "code": "```sh\n{}\n```", "svg": ""}
    return marks.get(block.kind, "{}").format(text)


def html(found: AuditFile, command: str) -> str:
    """audit.html."""
    blocks = account(found, command)
    policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="viewport" content="width=device-width">'
        f"<title>{escape(blocks[0].lines[0])}</title><style>{_STYLE}</style></head>"
        f"<body>{''.join(map(_as_html, blocks))}</body></html>\n"
    )


def _as_html(block: Block) -> str:
    if block.kind == "svg":
        return block.lines[0]
    if block.kind == "table":
        heads = "".join(f"<th>{escape(head)}</th>" for head in block.lines)
        head = f"<tr>{heads}</tr>" if any(block.lines) else ""
        rows = "".join(
            "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>"
            for row in block.rows
        )
        return f'<div class="wide"><table>{head}{rows}</table></div>'
    if block.kind in ("words", "list"):
        items = "".join(f"<li>{escape(line)}</li>" for line in block.lines)
        return f'<ul class="{block.kind}">{items}</ul>'
    text = escape(" ".join(block.lines))
    if block.kind == "code":
        return f"<p><code>{text}</code></p>"
    return f"<{block.kind}>{text}</{block.kind}>"

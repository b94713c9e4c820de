"""An account of a measurement as a page that needs nothing else, and as text.

Both are made from the same blocks. The page loads nothing and runs nothing; a content security
policy in its head tells the browser so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from madviz.system.markdown import markdown_table

_STYLE = """
:root{color-scheme:light dark}
body{font:15px/1.55 sans-serif;max-width:960px;margin:28px auto;padding:0 18px;color:#222;
background:#fff}h1{font-size:24px;margin:0 0 10px;overflow-wrap:anywhere}
h2{font-size:17px;margin:30px 0 8px}
ul{padding-left:20px;margin:0}li{margin:0 0 5px}ul.words{font-size:17px}
table{border-collapse:collapse;margin:0 0 8px}
/* A shadow at an edge says that the table goes on there; at its end, what scrolls covers it. */
.wide{--page:#fff;overflow-x:auto;background:
linear-gradient(90deg,var(--page) 40%,transparent) 0 0/30px 100% no-repeat local,
linear-gradient(270deg,var(--page) 40%,transparent) 100% 0/30px 100% no-repeat local,
linear-gradient(90deg,#0006,transparent) 0 0/10px 100% no-repeat,
linear-gradient(270deg,#0006,transparent) 100% 0/10px 100% no-repeat}
td,th{padding:3px 16px 3px 0;text-align:left;white-space:nowrap;
border-bottom:1px solid #e4e4e4}th{font-weight:600;color:#555}
code{background:#f1f1f1;padding:2px 5px;overflow-wrap:anywhere}p{margin:0 0 8px}
svg,video,img{max-width:100%;height:auto;display:block;margin-bottom:10px}
video{width:100%;max-width:720px}
details{border-top:1px solid #e4e4e4;padding:8px 0}summary{cursor:pointer}
@media(prefers-color-scheme:dark){body{background:#1b1c1f;color:#e4e4e4}.wide{--page:#1b1c1f}code{background:#303236}
td,th,details{border-color:#3a3c40}th{color:#aaa}svg{background:#fff;border-radius:4px}a{color:#7fb8e0}}
"""


@dataclass(frozen=True)
class Block:
    """A piece of an account: a heading, lines, a table or a picture."""

    kind: str
    """``h1``, ``h2``, ``p``, ``words``, ``list``, ``code``, ``table``, ``svg`` or ``raw``."""
    lines: Sequence[str] = ()
    """Text; of a table, its heads; of ``raw``, the text and the HTML."""
    rows: Sequence[Sequence[str]] = ()


def ending(
    how_to_read: Sequence[str], facts: Sequence[tuple[str, str]], command: str
) -> list[Block]:
    """The last blocks of every account; ``command`` makes it again."""
    return [
        Block("h2", ["How to read this"]),
        Block("list", how_to_read),
        Block("h2", ["What was measured"]),
        Block("table", ("", ""), facts),
        Block("h2", ["To make it again"]),
        Block("code", [command]),
    ]


def markdown(blocks: Sequence[Block]) -> str:
    """The account without its pictures."""
    return "\n\n".join(filter(None, map(_as_markdown, blocks))) + "\n"


def _as_markdown(block: Block) -> str:
    if block.kind == "table":
        rows = [[cell.replace("|", "/") for cell in row] for row in (block.lines, *block.rows)]
        return markdown_table(rows[0], rows[1:])
    if block.kind in ("words", "list"):
        return "\n".join(f"- {line}" for line in block.lines)
    text = block.lines[0] if block.kind == "raw" else " ".join(block.lines)
    marks = {"h1": "# {}", "h2": "## {}", "code": "```sh\n{}\n```", "svg": ""}
    return marks.get(block.kind, "{}").format(text)


def html(blocks: Sequence[Block]) -> str:
    """The account as a page; its first block is its title."""
    return whole_page(blocks[0].lines[0], _STYLE, "".join(map(_as_html, blocks)))


def whole_page(title: str, style: str, body: str) -> str:
    """HTML that loads nothing from elsewhere."""
    policy = "default-src 'none'; img-src data:; media-src data:; style-src 'unsafe-inline'"
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="viewport" content="width=device-width">'
        f"<title>{escape(title)}</title><style>{style}</style></head><body>{body}</body></html>\n"
    )


def _as_html(block: Block) -> str:
    if block.kind in ("svg", "raw"):
        return block.lines[-1]
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

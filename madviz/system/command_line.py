"""Words of a command line into a frozen dataclass, by tyro; the only place that imports it.

``check_options`` and ``check_words`` refuse what they can in one line, before tyro sees it. What
tyro sees is not the dataclass itself but one that is made from it: names from a table are choices,
docstrings are one line each, and the help leaves out groups of options that do not belong to what
was chosen.
"""

from __future__ import annotations

import sys
from collections.abc import Collection, Mapping, Sequence
from contextlib import redirect_stdout, suppress
from dataclasses import field, fields, is_dataclass, make_dataclass
from functools import reduce
from io import StringIO
from operator import or_
from textwrap import fill, indent
from typing import Annotated, Any, Literal, get_type_hints

from docstring_parser import parse_from_object

from madviz.errors import unknown
from madviz.system.numbers import check_words
from madviz.system.options import (
    Listed,
    OneOf,
    bare,
    check_options,
    foreign_groups,
    notes,
    options,
)
from madviz.system.streams import telling

SHELLS = ("bash", "fish", "zsh")


def read(
    config: type, words: Sequence[str], prog: str, summary: str, example: str, positional: bool
) -> Any:
    """A ``config`` filled from ``words``. ``positional``: what has no default is given without its
    name. Prints the help and leaves where it is asked for; leaves with code 2 if the words do not
    fit. Raises UserError for an unknown option or name, and for a number out of its range."""
    import tyro

    asked = bool({"-h", "--help"} & set(words))
    if not asked:
        check_options(config, words)
        check_words(config, words)
    with telling():
        try:
            filled = tyro.cli(
                _as_read(config, foreign_groups(config, words) if asked else ()),
                prog=prog,
                description=_above(config, summary, example) if asked else summary,
                args=list(words),
                config=(tyro.conf.PositionalRequiredArgs,) if positional else (),
            )
            return _plain(config, filled)
        finally:
            sys.stdout.flush()
    raise SystemExit(0)  # Whoever read the help has left.


def _plain(config: type, filled: Any) -> Any:
    """A ``config`` with what tyro has filled the type with that was made from it."""
    kinds, found = get_type_hints(config), {}
    for name, value in vars(filled).items():
        found[name] = _plain(kinds[name], value) if is_dataclass(value) else value
    return config(**found)


def _above(config: type, summary: str, example: str) -> str:
    """What stands above the options: summary, example, and names that may be given."""
    lists = {note.title: note for _, kind in options(config) for note in notes(kind, Listed)}
    parts = [summary, f"Example:\n  {example}"]
    for title, note in lists.items():
        names = fill(", ".join(note.find()) or "none found", 94, break_on_hyphens=False)
        parts.append(f"The {title} here:\n{indent(names, '  ')}")
    return "\n\n".join(parts)


def _as_read(config: type, hidden: Collection[str] = ()) -> Any:
    """``config`` as tyro reads it, without its groups that are ``hidden``; see the module."""
    import tyro

    hints, said, made = get_type_hints(config, include_extras=True), _helps(config), []
    for each in fields(config):
        kind: Any = hints[each.name]
        default, factory = each.default, each.default_factory
        names = [name for note in notes(kind, OneOf) for name in note.names]
        if is_dataclass(bare(kind)):
            kind = factory = _as_read(bare(kind))
        if each.name in hidden:
            kind = tyro.conf.Suppress[kind]
        elif default in names:
            kind = Literal[tuple(names)]
        elif names:
            kind = Annotated[kind, tyro.conf.arg(metavar=f"{{{','.join(names)}}}")]
        words = field(default=default, default_factory=factory, metadata={"help": said[each.name]})
        made.append((each.name, kind, words))
    about = {"__doc__": config.__doc__}
    return make_dataclass(config.__name__, made, namespace=about, frozen=True)


def _helps(config: type) -> dict[str, str]:
    """What the options of ``config`` are for, each in one line: shells complete line by line."""
    found = {}
    for kind in reversed(config.__mro__[:-1]):
        for each in parse_from_object(kind).params:
            found[each.arg_name] = " ".join((each.description or "").replace("``", "").split())
    return {name.name: found.get(name.name, "") for name in fields(config)}


Commands = Mapping[str, "type | Commands"]
"""Configurations by command; of a group of commands, its table."""


def completion(shell: str, prog: str, commands: Commands) -> str:
    """The script by which ``shell`` completes commands, options and names of ``prog``. Raises
    UserError for another shell than ``SHELLS``."""
    import tyro

    if shell not in SHELLS:
        raise unknown("shell", shell, list(SHELLS))
    printed, words = StringIO(), ["--tyro-print-completion", shell]
    with redirect_stdout(printed), suppress(SystemExit):
        tyro.cli(tyro.conf.OmitSubcommandPrefixes[_one_of(commands)], prog=prog, args=words)
    return printed.getvalue()


def _one_of(commands: Commands) -> Any:
    """A type for tyro: one of these commands."""
    import tyro

    kinds = {}
    for name, config in commands.items():
        if isinstance(config, Mapping):
            kinds[name] = make_dataclass(name, [("command", _one_of(config))])
        else:
            kinds[name] = _as_read(config)
    return reduce(
        or_, (Annotated[kind, tyro.conf.subcommand(name)] for name, kind in kinds.items())
    )

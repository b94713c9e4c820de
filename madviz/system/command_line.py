"""The command line of a frozen dataclass, which tyro reads as it is, in one pass.

What an option takes is in its annotation (``options``, ``numbers``), for tyro too. Ours are:

    _refusal     Every refusal is one line. tyro has a hook for this since 1.0.17, in a private
                 module: hence the exact version in pyproject.toml.
    _check_once  tyro takes the last of two options with the same name; madviz refuses them.
    _shown       A group of options that the chosen recipe ignores is not in the help: tyro hides
                 a group in every command line or in none.
    _explain     The help of an option is one line, as shells need it that complete line by line:
                 tyro keeps some of the line breaks of a docstring.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import redirect_stdout, suppress
from dataclasses import field, fields, is_dataclass, make_dataclass
from functools import reduce
from io import StringIO
from operator import or_
from textwrap import fill, indent
from types import MappingProxyType
from typing import Annotated, Any, get_type_hints

import tyro
from docstring_parser import parse_from_object
from tyro import _errors as refusals

from madviz.errors import UserError, perhaps, unknown
from madviz.system.numbers import Range
from madviz.system.options import Listed, OneOf, Only, notes, options
from madviz.system.streams import say, telling

SHELLS = ("bash", "fish", "zsh")


def read(
    config: type,
    words: Sequence[str],
    prog: str,
    description: str,
    positional: bool = False,
    default: Any = None,
) -> Any:
    """A ``config`` filled from ``words``. Prints the help and leaves where it is asked for.

    ``description`` stands above the options in the help. ``positional``: options without a default
    are given without their names. ``default``: a ``config`` with the values of options that are not
    among the words; a group annotated with a base class has the options of its instance's class.
    ``config.renamed_options()``, where there is one, maps older spellings of options to today's.
    Raises UserError for words that do not fit."""
    words = _renamed(config, words)
    kinds = {option: kind for option, kind, _ in options(default or config)}
    asked = bool({"-h", "--help"} & set(words))
    if asked:
        _explain(default or config)
    else:
        _check_once(words)

    def refuse(event: refusals.ParseErrorEvent) -> None:
        raise _refusal(event, kinds, words)

    with telling(), refusals.on_parse_error(refuse):
        try:
            return tyro.cli(
                _shown(config, words) if asked else config,
                prog=prog,
                description=_above(kinds, description) if asked else "",
                args=words,
                default=default or tyro.MISSING_NONPROP,
                config=(tyro.conf.PositionalRequiredArgs,) if positional else (),
            )
        finally:
            sys.stdout.flush()
    raise SystemExit(0)  # The reader of the help has left.


def _option(word: str) -> str:
    """The option in a word: ``--batch-size`` of ``--batch_size=64``; '' of a value."""
    return word.partition("=")[0].replace("_", "-") if word.startswith("--") else ""


def _renamed(config: type, words: Sequence[str]) -> list[str]:
    """``words`` with options as they are spelled today; prints a note for each that was not."""
    today = getattr(config, "renamed_options", dict)()
    result = []
    for word in words:
        old = _option(word)
        if old in today:
            say(f"madviz: {old} is now {today[old]}")
            word = today[old] + word[len(old) :]
        result.append(word)
    return result


def _check_once(words: Iterable[str]) -> None:
    """Raises UserError for an option that is there twice."""
    given = [option for option in map(_option, words) if option]
    for option in given:
        if given.count(option) > 1:
            raise UserError(
                f"expected {option:.60} once, found it twice; put all its values after one"
            )


def _shown(config: type, words: Sequence[str]) -> type:
    """``config`` without the groups of options that are ignored under what ``words`` choose."""
    chosen = {f"--{option.name}": option.default for option in fields(config)}
    pairs = " ".join(words).replace("=", " ").split()
    chosen |= dict(zip(pairs, pairs[1:], strict=False))
    hidden = [
        (name, tyro.conf.Suppress[kind], field(default_factory=kind.__origin__))
        for name, kind in get_type_hints(config, include_extras=True).items()
        for only in notes(kind, Only)
        if chosen[f"--{only.option}"] != only.value
    ]
    return make_dataclass(config.__name__, hidden, bases=(config,), frozen=True)


def _explain(config: Any) -> None:
    """Puts the docstrings of all options of ``config``, a class or an instance, where tyro looks
    for them first, each as one line."""
    cls = config if isinstance(config, type) else type(config)
    kinds = get_type_hints(cls)
    for parent in reversed(cls.__mro__[:-1]):
        helps = {option.arg_name: option.description for option in parse_from_object(parent).params}
        for option in fields(config):
            text = (helps.get(option.name) or "").replace("``", "")
            if text:
                option.metadata = MappingProxyType({"help": " ".join(text.split())})
    for option in fields(config):
        group = kinds[option.name] if config is cls else getattr(config, option.name)
        if is_dataclass(group):
            _explain(group)


def _above(kinds: Mapping[str, Any], description: str) -> str:
    """The text above the options: ``description``, and names that may be given."""
    parts = [description]
    for note in dict.fromkeys(note for kind in kinds.values() for note in notes(kind, Listed)):
        names = fill(", ".join(note.find()) or "none found", 94, break_on_hyphens=False)
        parts.append(f"The {note.title} here:\n{indent(names, '  ')}")
    return "\n\n".join(parts)


def _refusal(
    event: refusals.ParseErrorEvent, kinds: Mapping[str, Any], words: Sequence[str]
) -> UserError:
    """The line for ``words`` that tyro refuses, and why in ``event``. ``kinds`` has the annotated
    type of each option."""
    tokens = getattr(event, "tokens", None) or getattr(event, "unrecognized_tokens", None)
    if tokens:
        word = next((token for token in tokens if token.startswith("-")), tokens[0])
        option = _option(word) or word
        name = "unknown option" if word.startswith("-") else "unexpected word"
        return UserError(f"{name} {option:.60}{perhaps(option, list(kinds))}; --help lists all")
    if isinstance(event, refusals.MissingArgs):
        names = ", ".join(place.arg.display_name() for place in event.missing_arguments)
        return UserError(f"expected {names}, found nothing; --help explains")
    argument = getattr(event, "argument", None)
    option = argument.display_name() if argument else ""
    if isinstance(event, refusals.InvalidChoice):
        table = next(notes(kinds[option], OneOf), None)
        return unknown(
            table.kind if table else option.split(".")[-1].strip("-"), event.value, [*event.choices]
        )
    reason = getattr(event, "message", "expected a value after it; --help explains")
    given = " ".join(words).replace(f"{option}=", f"{option} ").partition(f"{option} ")[2].split()
    for allowed in notes(kinds.get(option), Range):
        # tyro does not say which of several values it refuses: the first that does not fit.
        refused = [value for value in given if not allowed.takes(value)]
        reason = allowed.refusal(refused[0]) if refused and hasattr(event, "message") else reason
    return UserError(f"{option}: {reason}" if option else reason)


Commands = Mapping[str, "type | Commands"]
"""Configurations by command; of a group of commands, its table."""


def completion(shell: str, prog: str, commands: Commands) -> str:
    """The script by which ``shell`` completes commands, options and names of ``prog``. Raises
    UserError for another shell than ``SHELLS``."""
    if shell not in SHELLS:
        raise unknown("shell", shell, list(SHELLS))
    words = ["--tyro-print-completion", shell]
    script = StringIO()
    with redirect_stdout(script), suppress(SystemExit):
        tyro.cli(tyro.conf.OmitSubcommandPrefixes[_one_of(commands)], prog=prog, args=words)
    return script.getvalue()


def _one_of(commands: Commands) -> Any:
    """A type for tyro: one of these commands."""
    kinds = []
    for name, config in commands.items():
        if isinstance(config, Mapping):
            config = make_dataclass(name, [("command", _one_of(config))])
        else:
            _explain(config)
        kinds.append(Annotated[config, tyro.conf.subcommand(name)])
    return reduce(or_, kinds)

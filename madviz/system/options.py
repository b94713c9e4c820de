"""What an option of a command takes, beside its type: said once, where the option is declared.

    method: Annotated[str, OneOf("method", METHODS)]       one of those in the table
    policy: Annotated[str, Listed("policies", found)]      any word; --help lists what was found
    light: Annotated[LightConfig, Only("recipe", "light")]       shown only with --recipe light

Ranges of numbers are in ``numbers``, on top of this.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from madviz.errors import UserError, perhaps, unknown


@dataclass(frozen=True, eq=False)  # tyro asks for a hash, which a table has not.
class OneOf:
    """A name from a table."""

    kind: str
    """What it is a name of."""
    names: Collection[str]


@dataclass(frozen=True)
class Listed:
    """Names that are worth a list; the option takes other words, too."""

    title: str
    find: Callable[[], Collection[str]]
    """Called for ``--help`` only: it may look for files."""


@dataclass(frozen=True)
class Only:
    """A group of options that one value of another option uses; others ignore it."""

    option: str
    value: str


def options(config: type, prefix: str = "--") -> Iterator[tuple[str, Any]]:
    """Every option that ``config``, a dataclass, has: ``--light.rounds`` and its type, with what
    annotates it."""
    for name, kind in get_type_hints(config, include_extras=True).items():
        option = prefix + name.replace("_", "-")
        if is_dataclass(bare(kind)):
            yield from options(bare(kind), f"{option}.")
        else:
            yield option, kind


def bare(kind: Any) -> Any:
    """A type without what annotates it."""
    return get_args(kind)[0] if get_origin(kind) is Annotated else kind


def notes(kind: Any, wanted: type) -> Iterator[Any]:
    """What annotates a type, or a part of it, and is a ``wanted``."""
    for part in get_args(kind):
        if isinstance(part, wanted):
            yield part
        yield from notes(part, wanted)


def given(words: Sequence[str]) -> Iterator[tuple[str, str]]:
    """The options among ``words``, as a user wrote them: (--batch-size, 64), and '' where no value
    follows."""
    for i, word in enumerate(words):
        option, joined, text = word.partition("=")
        if option.startswith("--"):
            yield option.replace("_", "-"), text if joined else "".join(words[i + 1 : i + 2])


def choices(option: str, kind: Any) -> tuple[str, tuple[str, ...]]:
    """What an option's word is a name of, and all names it may be; () where it may be any word."""
    for note in notes(kind, OneOf):
        return note.kind, tuple(note.names)
    for part in (kind, *get_args(kind)):
        if get_origin(part) is Literal:
            return option.split(".")[-1].strip("-"), get_args(part)
    return "", ()


def foreign_groups(config: type, words: Sequence[str]) -> list[str]:
    """The groups of options of ``config`` that are ignored under what ``words`` choose."""
    said, found = dict(given(words)), []
    for name, kind in get_type_hints(config, include_extras=True).items():
        for only in notes(kind, Only):
            default = next(f.default for f in fields(config) if f.name == only.option)
            if said.get(f"--{only.option.replace('_', '-')}", default) != only.value:
                found.append(name)
    return found


def check_options(config: type, words: Sequence[str]) -> None:
    """Raises UserError for an option among the ``words`` of a command that ``config`` does not
    have, or that is there twice, and for a name that is none of its."""
    known, said = dict(options(config)), list(given(words))
    for option, text in said:
        positive = option if option in known else option.replace("--no-", "--").replace(".no-", ".")
        if positive not in known:
            if option not in ("--help", "--help-verbose"):
                raise UserError(
                    f"unknown option {option:.60}{perhaps(option, list(known))}; --help lists all"
                )
            continue
        if [name for name, _ in said].count(option) > 1:
            raise UserError(
                f"expected {option:.60} once, found it twice; put all its values after one"
            )
        kind, names = choices(option, known[positive])
        if names and text not in (*names, "None"):
            raise unknown(kind, text, list(names))

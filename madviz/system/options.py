"""The values of an option of a command, beside its type: said once, where it is declared.

    method: Annotated[str, OneOf("method", METHODS)]       one of those in the table
    policy: Annotated[str, Listed("policies", found)]      any word; --help lists what was found
    light: Annotated[LightConfig, Only("recipe", "light")]       shown only with --recipe light

Ranges of numbers are in ``numbers``, on top of this.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, is_dataclass
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from tyro.constructors import PrimitiveConstructorSpec


class OneOf(PrimitiveConstructorSpec[str]):
    """A name from a table."""

    def __init__(self, kind: str, names: Collection[str]) -> None:
        """``kind`` says what the names are of."""
        super().__init__(
            nargs=1,
            metavar=f"{{{','.join(names)}}}",
            instance_from_str=lambda words: words[0],
            is_instance=lambda value: isinstance(value, str),
            str_from_instance=lambda value: [value],
            choices=tuple(names),
        )
        vars(self).update(kind=kind)

    kind: str


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


def options(config: Any, prefix: str = "--") -> Iterator[tuple[str, Any, Any]]:
    """Every option of ``config``, an instance of a dataclass or the class: ``--light.rounds``, its
    annotated type, and its value. A class has no values, and the options of the annotated groups;
    an instance has those of the groups that are in it, also if they are of a subclass."""
    is_class = isinstance(config, type)
    kinds = get_type_hints(config if is_class else type(config), include_extras=True)
    for name, kind in kinds.items():
        option = prefix + name.replace("_", "-")
        value = None if is_class else getattr(config, name)
        group = bare(kind) if is_class else value
        if is_dataclass(group):
            yield from options(group, f"{option}.")
        else:
            yield option, kind, value


def changed(config: Any, usual: Any) -> dict[str, Any]:
    """The options of ``config`` whose values are not those of ``usual``, of the same class:
    ``light.rounds`` and its value."""
    before = {name: value for name, _, value in options(usual, "")}
    return {name: value for name, _, value in options(config, "") if value != before[name]}


def words_for(values: Mapping[str, Any]) -> list[str]:
    """``{"a": 1, "b": True, "c.d": False, "e": ["x", 2]}`` -> ``--a 1 --b --c.no-d --e x 2``."""
    words: list[str] = []
    for name, value in values.items():
        if isinstance(value, bool):
            head, dot, tail = name.rpartition(".")
            words.append(f"--{name}" if value else f"--{head}{dot}no-{tail}")
        else:
            several = value if isinstance(value, list | tuple) else [value]
            words += [f"--{name}", *map(str, several)]
    return words


def bare(kind: Any) -> Any:
    """A type without what annotates it."""
    return get_args(kind)[0] if get_origin(kind) is Annotated else kind


def notes(kind: Any, wanted: type) -> Iterator[Any]:
    """Everything that annotates a type, or a part of it, and is a ``wanted``."""
    for part in get_args(kind):
        if isinstance(part, wanted):
            yield part
        yield from notes(part, wanted)

"""The content of a file as a type: msgspec checks it, and a mistake is one line.

config.json: expected 'cameras[0].fovy' to be a number, found 'wide'; restore the file or retrain
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import msgspec.inspect

from madviz.errors import UserError, unknown

T = TypeVar("T")

KINDS = {
    "int": "a whole number",
    "float": "a number",
    "str": "a text",
    "bool": "true or false",
    "array": "a list",
    "object": "a table of named values",
    "null": "nothing",
}
"""Words for the names that msgspec has for types."""


def typed(value: Any, kind: type[T], where: str | Path, fix: str) -> T:
    """``value``, as JSON or TOML has it, as ``kind``: a msgspec Struct, a dataclass, any type.

    Raises UserError: ``where``, what was expected, what was found, and ``fix``, the next move.
    """
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        raise UserError(f"{where}: {_mistake(str(error), value, kind)}; {fix}") from error
    except UnicodeEncodeError as error:  # JSON may name half of a character.
        raise UserError(f"{where}: expected text, found half of a character; {fix}") from error


def _mistake(message: str, value: Any, kind: type) -> str:
    """msgspec's message with the value that was found, in this program's words."""
    what, _, place = message.partition(" - at `$")
    place = place.removesuffix("`").lstrip(".")
    if missing := re.fullmatch(r"Object missing required field `(.*)`", what, re.S):
        return f"expected {_joined(place, missing[1])!r}, found none"
    if extra := re.fullmatch(r"Object contains unknown field `(.*)`", what, re.S):
        return str(unknown(f"word in {place}" if place else "word", extra[1], _known(kind, place)))
    if wrong := re.fullmatch(r"Expected `(.*?)`(.*?)(?:, got .*)?", what):
        words = " or ".join(KINDS.get(name, name) for name in wrong[1].split(" | ")) + wrong[2]
        named = f"{place!r} to be {words}" if place else words
        return f"expected {named}, found {_found(value, place)!r:.60}"
    if what.startswith("Invalid enum value"):
        here = [node for node in _at(kind, place) if isinstance(node, msgspec.inspect.LiteralType)]
        words = " or ".join(str(value) for node in here for value in node.values)
        return f"expected {place!r} to be {words}, found {_found(value, place)!r:.60}"
    return f"{what[0].lower()}{what[1:].replace('`', '')}" + (f" at {place!r}" if place else "")


def _joined(place: str, name: str) -> str:
    return f"{place}.{name}" if place else name


def _steps(place: str) -> list[tuple[str, str]]:
    """``cameras[0].fovy`` -> (cameras, ""), ("", 0), (fovy, "")."""
    return re.findall(r"([^.\[\]]+)|\[(\d+)\]", place)


def _known(kind: type, place: str) -> list[str]:
    """The names that the table at ``place`` may hold."""
    here = _at(kind, place)
    structs = [node for node in here if isinstance(node, msgspec.inspect.StructType)]
    return [field.encode_name for struct in structs for field in struct.fields]


def _at(kind: type, place: str) -> list[msgspec.inspect.Type]:
    """The type of what may stand at ``place``."""
    here = _choices(msgspec.inspect.type_info(kind))
    for name, _ in _steps(place):
        inner = [child for node in here for child in _inside(node, name)]
        here = [choice for node in inner for choice in _choices(node)]
    return here


def _choices(node: msgspec.inspect.Type) -> list[msgspec.inspect.Type]:
    return list(node.types) if isinstance(node, msgspec.inspect.UnionType) else [node]


def _inside(node: msgspec.inspect.Type, name: str) -> list[msgspec.inspect.Type]:
    if isinstance(node, msgspec.inspect.StructType):
        return [field.type for field in node.fields if field.encode_name == name]
    if isinstance(node, msgspec.inspect.ListType | msgspec.inspect.VarTupleType) and not name:
        return [node.item_type]
    return []


def _found(value: Any, place: str) -> Any:
    """The value at ``cameras[0].fovy``; the whole where the place has no such path."""
    try:
        for name, index in _steps(place):
            value = value[int(index)] if index else value[name]
        return value
    except (KeyError, IndexError, TypeError):
        return value

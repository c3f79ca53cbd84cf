"""Dataclasses of settings as files keep them: JSON text whose every value is checked against the field's type."""

from __future__ import annotations

import dataclasses
import json
from math import isfinite
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from dpcli.errors import DataError, DpcError
from dpcli.runtime.settings import value_types as kinds
from dpcli.runtime.settings.fields import LARGEST, shown
from dpcli.text_files import parse_json

T = TypeVar("T")
_LARGEST_INT = 2**31 - 1  # of a size


class StoredConfig:
    """Is the base of the dataclasses of sizes that weights files keep as JSON text."""

    def to_json(self) -> str:
        """Returns the text that a weights file keeps."""
        return json.dumps(dataclasses.asdict(self))  # type: ignore[call-overload]

    @classmethod
    def from_json(cls: type[T], text: str) -> T:
        """Returns the sizes that `to_json` wrote. Raises DataError as the function `from_json`."""
        return from_json(cls, text)


def from_json(cls: type[T], text: str) -> T:
    """Returns the instance of a dataclass that JSON text describes, as `dataclasses.asdict` would have it.

    Raises DataError for a field that is unknown, missing or of another type, so that a newer file isn't silently misread,
    for numbers that no size can be, and for values that the dataclass itself refuses.
    """
    return _instance(cls, json_value(text, dict, "the configuration"))


def json_value(text: str, kind: type[T], what: str) -> T:
    """Returns what JSON text says. Raises DataError, which calls the text `what`, where it is none or says another kind."""
    value = parse_json(text, what)
    if not isinstance(value, kind):
        raise DataError(f"{what} = {shown(repr(value))}: expected {'an object' if kind is dict else 'a list'} in JSON")
    return value


def _instance(cls: type[T], values: dict[str, Any]) -> T:
    hints, fields = get_type_hints(cls), dataclasses.fields(cls)
    unknown = sorted(set(values) - {field.name for field in fields})
    if unknown:
        raise DataError(f"the configuration has unknown keys {shown(', '.join(unknown))}; a newer dpc wrote it")
    for field in fields:
        if field.name not in values and field.default is dataclasses.MISSING:
            raise DataError(f"the configuration lacks {field.name}")
    try:
        return cls(**{name: _value(name, value, hints[name]) for name, value in values.items()})
    except DpcError as error:
        raise DataError(f"the configuration's {error}") from None


def _value(name: str, value: Any, hint: Any) -> Any:
    """Returns a value of JSON in the type of its field; tuples of dataclasses are lists of objects there."""
    if dataclasses.is_dataclass(hint) and isinstance(value, dict):
        return _instance(hint, value)
    if get_origin(hint) is tuple and isinstance(value, list) and not _is_plain(hint):
        return tuple(_value(name, one, get_args(hint)[0]) for one in value)
    try:
        accepted = kinds.accept(value, hint)
    except ValueError:
        raise DataError(f"{name} = {shown(repr(value))}: expected {_described(hint)}") from None
    for number in kinds.numbers_in(accepted):
        if not isfinite(number) or abs(number) > (_LARGEST_INT if isinstance(number, int) else LARGEST):
            raise DataError(f"{name} = {shown(repr(value))}: no size is so large")
    return accepted


def _is_plain(hint: Any) -> bool:
    """Returns whether a type is one that settings have, with no dataclass inside."""
    return not dataclasses.is_dataclass(hint) and all(map(_is_plain, get_args(hint)))


def _described(hint: Any) -> str:
    return kinds.describe(hint) if _is_plain(hint) else "objects"

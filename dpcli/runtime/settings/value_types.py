"""The types that a setting may have, and how their values are read from text and from TOML, and written as both.

A type is the annotation of a dataclass field: bool, int, float, str, a Literal of words, one of these or None, or a tuple
of them. As text a tuple is written with commas, and a tuple of tuples with slashes between: `256,128`, `64,128/128,256`.
None is written `none`, as text and in TOML, which has no word for it.
"""

from __future__ import annotations

import json
import types
from collections.abc import Iterator
from typing import Any, Literal, Union, get_args, get_origin

NONE = "none"
_DESCRIBED = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}
_MANY = {bool: "words true or false", int: "whole numbers", float: "numbers", str: "words"}
_METAVAR = {bool: "[true|false]", int: "<int>", float: "<float>", str: "<str>"}


def may_be_none(hint: Any) -> bool:
    """Returns whether None is a value of this type."""
    return get_origin(hint) in (Union, types.UnionType) and type(None) in get_args(hint)


def without_none(hint: Any) -> Any:
    """Returns the type of the values that are not None."""
    return next(one for one in get_args(hint) if one is not type(None)) if may_be_none(hint) else hint


def is_tuple(hint: Any) -> bool:
    """Returns whether values other than None are tuples."""
    return get_origin(without_none(hint)) is tuple


def check_hint(hint: Any) -> None:
    """Raises TypeError when the type is none of those a setting may have, or could not be told from None in writing."""
    if may_be_none(hint) and NONE in get_args(without_none(hint)):
        raise TypeError(f"{hint}: the word {NONE!r} and None would be written alike")
    inner = without_none(hint)
    if get_origin(inner) is tuple:
        for one in set(get_args(inner)) - {...}:
            check_hint(one)
    elif get_origin(inner) is not Literal and inner not in _DESCRIBED:
        raise TypeError(f"{hint}: expected bool, int, float, str, Literal, or a tuple of them, or one of them or None")


def accept(value: Any, hint: Any) -> Any:
    """Returns the value in the type's own form: lists become tuples, and whole numbers floats where floats are expected.

    Raises ValueError for a value of another type. A bool is no number, and `none` is no text where it stands for None.
    """
    if may_be_none(hint):
        if value == NONE:
            raise ValueError(value)
        return None if value is None else accept(value, without_none(hint))
    if get_origin(hint) is Literal:
        return _first(word for word in get_args(hint) if type(word) is type(value) and word == value)
    if get_origin(hint) is tuple and isinstance(value, (list, tuple)):
        return tuple(accept(one, inner) for one, inner in zip(value, _items(hint, len(value))))
    if hint is float and type(value) is int:
        return _as_float(value)
    if type(value) is not hint or (hint is str and not _is_unicode(value)):
        raise ValueError(value)
    return value


def read_text(text: str, hint: Any) -> Any:
    """Returns the value that the text of a command line stands for. Raises ValueError where it stands for none."""
    if may_be_none(hint):
        return None if text == NONE else read_text(text, without_none(hint))
    if get_origin(hint) is Literal:
        return _first(word for word in get_args(hint) if str(word) == text)
    if get_origin(hint) is tuple:
        words = text.split("/" if any(map(is_tuple, get_args(hint))) else ",") if text else []
        return tuple(read_text(word, inner) for word, inner in zip(words, _items(hint, len(words))))
    if hint is bool:
        return _first(value for value in (True, False) if write_text(value) == text)
    return hint(text)


def read_toml_value(value: Any, hint: Any) -> Any:
    """Returns the setting's value for one of a TOML file. Raises ValueError for a value of another type."""
    return None if may_be_none(hint) and value == NONE else accept(value, hint)


def write_text(value: Any) -> str:
    """Returns the text that `read_text` reads back."""
    if isinstance(value, (list, tuple)):
        return ("/" if any(isinstance(one, (list, tuple)) for one in value) else ",").join(map(write_text, value))
    return NONE if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def write_toml_value(value: Any) -> str:
    """Returns the value as TOML, which `read_toml_value` reads back."""
    if isinstance(value, tuple):
        return f"[{', '.join(map(write_toml_value, value))}]"
    if isinstance(value, str) or value is None:
        return json.dumps(NONE if value is None else value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return write_text(value)


def numbers_in(value: Any) -> Iterator[int | float]:
    """Yields the numbers of a value, those in tuples too."""
    if isinstance(value, (list, tuple)):
        for one in value:
            yield from numbers_in(one)
    elif type(value) in (int, float):
        yield value


def words_of(hint: Any) -> tuple[str, ...]:
    """Returns all texts that are legal, where they can be listed: of a Literal or a bool; else nothing."""
    inner = without_none(hint)
    values = get_args(inner) if get_origin(inner) is Literal else (True, False) if inner is bool else ()
    return tuple(write_text(value) for value in values) + ((NONE,) if values and may_be_none(hint) else ())


def describe(hint: Any) -> str:
    """Returns what an error message says was expected: `a whole number`, `one of a, b`, `2 numbers`."""
    if may_be_none(hint) and not words_of(hint):
        return f"{describe(without_none(hint))} or {NONE}"
    if get_origin(hint) is tuple:
        return _describe_tuple(get_args(hint))
    return _DESCRIBED.get(hint) or f"one of {', '.join(words_of(hint))}"


def metavar(hint: Any) -> str:
    """Returns what stands for the value in a list of options: `<int>`, `[a|b]`, `<float>,<float>`, as typer does."""
    if words_of(hint):
        return f"[{'|'.join(words_of(hint))}]"
    if may_be_none(hint):
        return f"{metavar(without_none(hint))}|{NONE}"
    if get_origin(hint) is tuple:
        between = "/" if any(map(is_tuple, get_args(hint))) else ","
        return between.join("..." if one is ... else metavar(one) for one in get_args(hint))
    return _METAVAR[hint]


def _describe_tuple(items: tuple[Any, ...]) -> str:
    first, *others = items
    if others and others[-1] is not ... and any(one != first for one in others):
        return " and ".join(map(describe, items))
    many = _MANY.get(first) or f"groups, each of {describe(first)}"
    return many if others and others[-1] is ... else f"{len(items)} {many}"


def _items(hint: Any, count: int) -> list[Any]:
    """Returns the type of each of so many items of a tuple. Raises ValueError for another count than the type's."""
    items = list(get_args(hint))
    if items[-1] is ...:
        return [items[0]] * count
    if len(items) != count:
        raise ValueError(count)
    return items


def _first(values: Iterator[Any]) -> Any:
    """Returns the first of the values. Raises ValueError when there is none."""
    for value in values:
        return value
    raise ValueError("no such word")


def _as_float(value: int) -> float:
    try:
        return float(value)
    except OverflowError:
        raise ValueError(value) from None


def _is_unicode(text: str) -> bool:
    """Returns whether the text can be written as UTF-8; a path with bytes of another encoding can't."""
    return not any("\ud800" <= letter <= "\udfff" for letter in text)

"""Settings written once, as fields of frozen dataclasses with help, legal values and default.

    @dataclass(frozen=True)
    class Schedule(Settings):
        batch: int = setting(16, "Clips per step.", least=1)

`runtime/settings/catalog.py` joins the dataclasses of one command and reads what a user changes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cache
from typing import Any, get_type_hints

from dpcli.errors import UsageError
from dpcli.runtime.settings import value_types as kinds

LARGEST = 1e30  # of any number: float32 ends soon after
WIDEST = 4096  # channels of a layer, by far: published networks for points have up to 1024
_LARGEST_INT = 10**7  # of a whole number without a bound of its own: no count or size here is larger
_SHOWN = 60  # letters of a value in a message


def setting(
    default: Any,
    help: str,
    *,
    least: float | None = None,
    most: float | None = None,
    above: float | None = None,
    below: float | None = None,
    name: str | None = None,
) -> Any:
    """Returns a dataclass field that users may set.

    default: the value without a preset. help: one or two sentences. least, most, above, below: bounds of the number, or of
    each number in a tuple; `least` and `most` are legal themselves. name: what users call it where not by the field's name.
    """
    words = {"help": " ".join(help.split()), "name": name, "least": least, "most": most, "above": above, "below": below}
    return field(default=default, metadata={"setting": words})


@dataclass(frozen=True)
class Setting:
    """Describes one setting as users see it: public name, field, type, default, help and bounds."""

    name: str
    field: str
    hint: Any
    default: Any
    help: str
    least: float | None = None
    most: float | None = None
    above: float | None = None
    below: float | None = None

    def parse(self, text: str) -> Any:
        """Returns the value that the text of a command line stands for. Raises UsageError when it is not legal."""
        try:
            value = kinds.read_text(text if self.hint is str else text.strip(), self.hint)
        except ValueError:
            raise self.refused(text) from None
        return self.checked(value, text)

    def from_toml(self, value: Any) -> Any:
        """Returns the value of a TOML file in the setting's type. Raises UsageError when it is not legal."""
        try:
            return self.checked(kinds.read_toml_value(value, self.hint))
        except ValueError:
            raise self.refused(value) from None

    def checked(self, value: Any, text: str | None = None) -> Any:
        """Returns the value, a whole number as float where one is expected. Raises UsageError when it is not legal.

        text: how the user wrote it, for the message.
        """
        try:
            accepted = kinds.accept(value, self.hint)
        except ValueError:
            raise self.refused(value) from None
        for number in kinds.numbers_in(accepted):
            problem = self._problem(number)
            if problem:
                raise UsageError(f"{self.name} = {shown(value if text is None else text)}: expected {problem}")
        return accepted

    @property
    def bounds(self) -> str:
        """Returns the legal range in words, such as `at least 0 and below 1`; nothing where every number is legal."""
        limits = {"at least": self.least, "above": self.above, "at most": self.most, "below": self.below}
        return " and ".join(
            f"{words} {kinds.write_text(limit)}" for words, limit in limits.items() if limit is not None
        )

    def _problem(self, number: float) -> str:
        """Returns what was expected instead of this number; nothing when it is legal."""
        legal = (
            (self.least is None or number >= self.least)
            and (self.most is None or number <= self.most)
            and (self.above is None or number > self.above)
            and (self.below is None or number < self.below)
        )
        if not legal:
            if kinds.is_tuple(self.hint):
                return f"numbers, each {self.bounds}"
            return self.bounds if self.least is not None else f"a number {self.bounds}"
        if isinstance(number, int):
            return "" if abs(number) <= _LARGEST_INT else f"a whole number up to {_LARGEST_INT}"
        return "" if abs(number) < LARGEST else f"a finite number below {LARGEST:g}"

    def refused(self, value: Any) -> UsageError:
        """Returns the error for a value of another type, with the nearest word or an example."""
        legal, more = kinds.words_of(self.hint), ""
        if isinstance(value, str) and (near := nearest(value, legal)):
            more = f"; did you mean {near}?"
        elif kinds.is_tuple(self.hint) and self.default:
            example = kinds.write_text(self.default), kinds.write_toml_value(self.default)
            more = ", as {} on the command line or {} in TOML".format(*example)
        return UsageError(f"{self.name} = {shown(value)}: expected {kinds.describe(self.hint)}{more}")


@cache
def settings_of(cls: type) -> tuple[Setting, ...]:
    """Returns the settings among the fields of a dataclass. Raises TypeError for a type that no setting may have."""
    hints, found = get_type_hints(cls), []
    for one in dataclasses.fields(cls):
        if "setting" in one.metadata:
            kinds.check_hint(hints[one.name])
            words = {**one.metadata["setting"], "name": one.metadata["setting"]["name"] or one.name}
            found.append(Setting(field=one.name, hint=hints[one.name], default=one.default, **words))
    return tuple(found)


class Settings:
    """Makes a dataclass that derives from it raise UsageError for a setting of a wrong type, word or range."""

    def __post_init__(self) -> None:
        for one in settings_of(type(self)):
            value = getattr(self, one.field)
            if one.checked(value) != value:  # a list, which a file may have for a tuple
                raise one.refused(value)


def nearest(word: str, legal: Iterable[str]) -> str | None:
    """Returns the legal word most like this one, or None when none is alike."""
    from difflib import get_close_matches

    return next(iter(get_close_matches(word[:_SHOWN], list(legal), 1, 0.5)), None)


def shown(value: Any) -> str:
    """Returns the value as a person wrote it, or as Python does where it would be hard to see; never long."""
    text = value if isinstance(value, str) else repr(value) if isinstance(value, dict) else kinds.write_text(value)
    text = text if text.strip() and text.isprintable() else repr(text)
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 3]}..."

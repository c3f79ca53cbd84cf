"""All settings of one command, and what a user says about them: `--set NAME=VALUE`, a TOML file, and flags.

A `Catalog` reads each of these, puts them over the settings of a preset, and writes the result as a TOML file that reads back.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dpcli import __version__
from dpcli.errors import UsageError
from dpcli.runtime.settings import value_types as kinds
from dpcli.runtime.settings.fields import Setting, nearest, settings_of, shown
from dpcli.text_files import read_toml


@dataclass(frozen=True)
class Given:
    """Holds what a user said about a command's settings: the preset's name, and values by public name from each source.

    Raises UsageError when a setting has both a flag and a `--set`.
    """

    preset: str | None = None
    config: Mapping[str, Any] = field(default_factory=dict)
    sets: Mapping[str, Any] = field(default_factory=dict)
    flags: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in self.flags:
            if name in self.sets:
                raise UsageError(f"{name} is given twice, by --{name.replace('_', '-')} and by --set; leave one out")

    @property
    def values(self) -> dict[str, Any]:
        """Returns all values by public name; those of `--set` and of flags take precedence over the file's."""
        return {**self.config, **self.sets, **self.flags}


class Catalog:
    """Holds the settings of one command in named groups, as in `Catalog(network=KinetConfig, schedule=Schedule)`.

    groups: name -> dataclass. settings: public name -> Setting. Raises ValueError when two settings, or a setting and a
    group, have one name.
    """

    def __init__(self, **groups: type) -> None:
        self.groups = groups
        self.settings: dict[str, Setting] = {}
        for cls in groups.values():
            for one in settings_of(cls):
                if one.name in self.settings or one.name in groups:
                    raise ValueError(f"{cls.__name__}.{one.field}: the name {one.name} is taken")
                self.settings[one.name] = one

    def find(self, name: str) -> Setting:
        """Returns the setting of that name, with dashes or underscores. Raises UsageError that names the nearest name."""
        found = self.settings.get(_plain(name))
        if found is None:
            near = self._nearest(name)
            more = f"did you mean {near}?" if near else "--help-all lists all settings"
            raise UsageError(f"unknown setting {shown(name)}; {more}")
        return found

    def parse_set(self, words: Sequence[str]) -> dict[str, Any]:
        """Returns values by public name from words NAME=VALUE. Raises UsageError for a word that is wrong or repeats."""
        said: dict[str, str] = {}
        values: dict[str, Any] = {}
        for word in words:
            name, equals, text = word.partition("=")
            if not equals or not name.strip():
                one = self.settings[self._nearest(name) or next(iter(self.settings))]
                example = f"{one.name}={kinds.write_text(one.default)}"
                raise UsageError(f"--set {shown(word)}: expected NAME=VALUE, such as --set {example}")
            one = self.find(name)
            if one.name in said:
                raise UsageError(
                    f"{one.name} is given twice, by --set {said[one.name]} and --set {word}; leave one out"
                )
            said[one.name], values[one.name] = word, one.parse(text)
        return values

    def read_config(self, path: str | Path) -> dict[str, Any]:
        """Returns values by public name from a TOML file, whose tables are groups; keys outside of tables are legal too.

        Raises DataError when there is no such file or it is not TOML, UsageError, which names it, when it says something illegal.
        """
        said: dict[str, str] = {}
        values: dict[str, Any] = {}
        try:
            for place, name, value in self._entries(read_toml(Path(path))):
                one = self.find(name)
                if one.name in said:
                    raise UsageError(f"{one.name} is given twice, as {said[one.name]} and {place}; leave one out")
                said[one.name], values[one.name] = place, one.from_toml(value)
        except UsageError as error:
            raise UsageError(f"{path}: {error}") from None
        return values

    def resolve(self, base: Mapping[str, Any], given: Given) -> dict[str, Any]:
        """Returns the base's instances, group -> instance, with what was given over them.

        base: instances of a preset. Raises UsageError from the dataclasses' own checks.
        """
        values = given.values
        changes = {
            group: {one.field: values[one.name] for one in settings_of(self.groups[group]) if one.name in values}
            for group in base
        }
        return {group: dataclasses.replace(instance, **changes[group]) for group, instance in base.items()}

    def to_toml(self, instances: Mapping[str, Any], command: str, helps: bool = True) -> str:
        """Returns the settings of the instances as TOML: one table a group, which `read_config` reads back.

        command: its words, such as `classify train`. helps: whether each setting's help stands above it as a comment.
        """
        lines = [f"# Settings of dpc {command}, written by dpc {__version__}; --config reads them."]
        for group, instance in instances.items():
            lines += ["", f"[{group}]"]
            for one in settings_of(type(instance)):
                value = one.checked(getattr(instance, one.field))
                lines += [f"# {one.help}"] if helps else []
                lines.append(f"{one.name} = {kinds.write_toml_value(value)}")
        return "\n".join(lines) + "\n"

    def _entries(self, table: dict[str, Any]) -> Iterator[tuple[str, str, Any]]:
        """Yields place, name and value of each entry, those of the groups' tables too."""
        for key, value in table.items():
            if not isinstance(value, dict) or _plain(key) in self.settings:
                yield key, key, value
            elif _plain(key) in self.groups:
                yield from ((f"{key}.{name}", name, inner) for name, inner in value.items())
            else:
                raise UsageError(f"unknown table [{shown(key)}]; expected one of {', '.join(self.groups)}")

    def _nearest(self, name: str) -> str | None:
        """Returns the public name most like this one, which may be meant for a field's name; None when none is alike."""
        public = {one.field: one.name for one in self.settings.values()} | {name: name for name in self.settings}
        return public.get(nearest(_plain(name), public) or "")


def _plain(name: str) -> str:
    return name.strip().replace("-", "_")

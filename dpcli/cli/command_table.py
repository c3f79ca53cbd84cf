"""Groups of commands as tables of names, so that of many commands only the one that is asked for is imported and set up."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import typer

from dpcli.cli.help_groups import SectionedCommand, SectionedGroup
from dpcli.cli.option_groups import with_option_groups


@dataclass(frozen=True)
class Group:
    """Holds the commands of a package, and groups below it.

    package: where the modules of the commands are. sections: heading in the help, "" for none -> commands, each as its
    module, whose last part is also the function, or as "module:function". groups: name -> group. heading, about: what the
    group itself stands under in the help above it, and with which sentence.
    """

    package: str
    sections: Mapping[str, Sequence[str]]
    groups: Mapping[str, Group] = field(default_factory=dict)
    heading: str = ""
    about: str = ""

    def application(self, path: Sequence[str] = ()) -> typer.Typer:
        """Returns the group with only the command that the path begins with, or with all where that names none.

        Groups have no options of their own, so the first word that is no option is a command's name.
        """
        places = {_name(place): place for each in self.sections.values() for place in each}
        alone = next((word for word in path[:1] if word in places or word in self.groups), None)
        made = typer.Typer(no_args_is_help=True, cls=SectionedGroup, help=self.about or None)
        for heading, each in self.sections.items():
            for place in each:
                if alone in (None, _name(place)):
                    given = with_option_groups(self._function(place))
                    made.command(_name(place), cls=SectionedCommand, rich_help_panel=heading or None)(given)
        for name, group in self.groups.items():
            if alone in (None, name):
                below = group.application(path[1:] if alone else ())
                made.add_typer(below, name=name, rich_help_panel=group.heading or None)
        return made

    def _function(self, place: str) -> Callable[..., Any]:
        module, _, function = place.partition(":")
        return getattr(import_module(f"{self.package}.{module}"), function or module.rpartition(".")[2])


def _name(place: str) -> str:
    function = place.replace(":", ".").rpartition(".")[2]
    return function.removesuffix("_command").replace("_", "-")

"""Options that belong together, written once as fields of a dataclass and taken by a command as one parameter."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any, get_type_hints


def with_option_groups(command: Callable[..., Any]) -> Callable[..., Any]:
    """Returns the command with an option for each field of its parameters that are dataclasses.

    A field's annotation says what the option is (`Annotated[float, typer.Option("--confidence", ...)]`), and its default
    is the option's. The options stand where the group stands in the command's signature.
    """
    own = inspect.signature(command, eval_str=True).parameters
    groups = {name: one.annotation for name, one in own.items() if is_dataclass(one.annotation)}

    @functools.wraps(command)
    def run(**values: Any) -> Any:
        for name, group in groups.items():
            values[name] = group(**{one.name: values.pop(one.name) for one in fields(group)})
        return command(**values)

    made = [two for name, one in own.items() for two in (_options(groups[name]) if name in groups else [one])]
    keywords = [one.replace(kind=inspect.Parameter.KEYWORD_ONLY) for one in made]
    run.__signature__ = inspect.Signature(keywords)  # type: ignore[attr-defined]
    run.__annotations__ = {one.name: one.annotation for one in keywords}
    del run.__wrapped__  # type: ignore[attr-defined]  # else typer may read the command's own parameters
    return run


def _options(group: type) -> list[inspect.Parameter]:
    hints = get_type_hints(group, include_extras=True)
    return [
        inspect.Parameter(one.name, inspect.Parameter.KEYWORD_ONLY, annotation=hints[one.name], default=one.default)
        for one in fields(group)
    ]

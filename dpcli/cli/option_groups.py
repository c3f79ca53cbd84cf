"""Options that belong together or that commands share, written once as the fields of a frozen dataclass.

@dataclass(frozen=True)
class Camera:
    HEADING: ClassVar[str] = "Camera"  # over these options in the help; without one they stand among the command's own
    size: Annotated[int, typer.Option("--size", help="Side of the pictures, pixels.")] = 512

@app.command()
@with_option_groups
def film(model: Model, camera: Camera, frames: Frames = 32) -> None: ...
"""

from __future__ import annotations

import copy
import functools
import inspect
from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass
from typing import Annotated, Any, get_args, get_type_hints


def with_option_groups(command: Callable[..., Any]) -> Callable[..., Any]:
    """Returns the command with one option for each field of the dataclasses among its parameters.

    The command is called with instances of these dataclasses. Raises ValueError when two options have one name.
    """
    own = inspect.signature(command, eval_str=True).parameters
    groups = {name: one.annotation for name, one in own.items() if is_dataclass(one.annotation)}
    options: list[inspect.Parameter] = []
    for name, one in own.items():
        options += _options_of(groups[name]) if name in groups else [one]
    names = [one.name for one in options]
    if len(set(names)) < len(names):
        raise ValueError(f"{command.__name__}: an option is there twice among {', '.join(names)}")

    @functools.wraps(command)
    def run(**values: Any) -> Any:
        made = {
            name: group(**{one.name: values.pop(one.name) for one in fields(group)}) for name, group in groups.items()
        }
        return command(**values, **made)

    return with_parameters(run, options)


def with_parameters(run: Callable[..., Any], parameters: Sequence[inspect.Parameter]) -> Callable[..., Any]:
    """Returns a function, wrapped around a command, as one of these parameters for typer, each given by its name."""
    keywords = [one.replace(kind=inspect.Parameter.KEYWORD_ONLY) for one in parameters]
    run.__signature__ = inspect.Signature(keywords)  # type: ignore[attr-defined]
    run.__annotations__ = {one.name: one.annotation for one in keywords}
    del run.__wrapped__  # type: ignore[attr-defined]  # else typer may read the command's own parameters
    return run


def _options_of(group: type) -> list[inspect.Parameter]:
    """Returns a keyword parameter for each field of a dataclass, with the field's annotation and default."""
    hints = get_type_hints(group, include_extras=True)
    heading = getattr(group, "HEADING", None)
    return [
        inspect.Parameter(
            one.name,
            inspect.Parameter.KEYWORD_ONLY,
            annotation=_under(heading, hints[one.name]) if heading else hints[one.name],
            default=one.default,
        )
        for one in fields(group)
    ]


def _under(heading: str, annotation: Any) -> Any:
    """Returns an option's annotation with the heading that the option stands under in the help."""
    kind, option = get_args(annotation)
    option = copy.copy(option)
    option.rich_help_panel = heading
    return Annotated[kind, option]

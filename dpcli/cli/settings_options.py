"""Options of a command made from its settings: `--preset`, everyday flags, `--config`, `--set` and `--help-all`.

`options_of` is a decorator, and the command finds what was said in its parameter of type `Given`:

    @app.command()
    @options_of(CATALOG, everyday=("frames", "batch"), presets=PRESETS, preset="quick")
    def train(data: Data, given: Given, seed: Seed = 0) -> None: ...
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from dpcli.cli.help_groups import SETTINGS
from dpcli.cli.option_groups import with_parameters
from dpcli.cli.options import completion
from dpcli.cli.out_of_memory import naming_large
from dpcli.runtime.settings.catalog import Catalog, Given
from dpcli.runtime.settings.fields import Setting, settings_of
from dpcli.runtime.settings.value_types import metavar, without_none, words_of, write_text

_SAID_NONE = object()  # the word none after a flag; None itself is a flag that was not given
Presets = Mapping[str, Mapping[str, Any]]  # preset -> group -> instance


def options_of(
    catalog: Catalog, everyday: Sequence[str] = (), *, presets: Presets | None = None, preset: str | None = None
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Returns a decorator that gives a command the options of its settings in place of its parameter of type `Given`.

    everyday: public names of the settings that get flags of their own; all others are reached by `--set` and `--config`.
    presets: the presets that `--preset` chooses from, with an instance for each group. preset: the name of the default one.
    Raises KeyError for an everyday name that is no setting, ValueError for one that is also a parameter of the command.
    """
    presets = presets or {}
    made = _preset_option(presets, preset) if presets else []
    made += [
        _flag(catalog.settings[name], _everyday_default(catalog.settings[name], catalog, presets)) for name in everyday
    ]
    made += _general_options(catalog, presets)

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        own = inspect.signature(command, eval_str=True).parameters
        receiver = next(name for name, one in own.items() if one.annotation is Given)

        @functools.wraps(command)
        def run(**values: Any) -> Any:
            given = _take(catalog, everyday, values)
            usual = {name: one.default for name, one in catalog.settings.items()}
            with naming_large(
                {f"{name} = {write_text(value)}": (value, usual[name]) for name, value in given.values.items()}
            ):
                return command(**{receiver: given}, **values)

        return with_parameters(run, [two for name, one in own.items() for two in (made if name == receiver else [one])])

    return decorate


def _take(catalog: Catalog, everyday: Sequence[str], values: dict[str, Any]) -> Given:
    """Takes the settings' options out of a command's values."""
    values.pop("help_all", None)
    preset, config, sets = values.pop("preset_name", None), values.pop("config_file"), values.pop("set_values")
    flags = {name: values.pop(name) for name in everyday}
    return Given(
        preset,
        catalog.read_config(config) if config is not None else {},
        catalog.parse_set(sets or []),
        {name: None if value is _SAID_NONE else value for name, value in flags.items() if value is not None},
    )


def _preset_option(presets: Presets, default: str | None) -> list[inspect.Parameter]:
    words = Setting("preset", "preset", Literal[tuple(presets)], default, "Settings that belong together.")
    option = typer.Option(
        "--preset",
        parser=words.parse,
        metavar=metavar(words.hint),
        help=words.help,
        autocompletion=completion(words_of(words.hint)),
    )
    return [_parameter("preset_name", Annotated[str, option], default)]


def _flag(one: Setting, default: str) -> inspect.Parameter:
    """Returns an option that is None unless given; a number or word is read by the setting itself, with its own errors."""
    option, inner = f"--{one.name.replace('_', '-')}", without_none(one.hint)
    extra = "; ".join(part for part in (f"default: {default}", one.bounds) if part)
    about = f"{one.help}  [{extra}]"
    if inner is bool:
        switch = typer.Option(f"{option}/--no-{option[2:]}", help=about)
        return _parameter(one.name, Annotated[bool | None, switch], None)

    def read(text: str) -> Any:
        value = one.parse(text)
        return _SAID_NONE if value is None else value

    info = typer.Option(
        option, parser=read, metavar=metavar(one.hint), help=about, autocompletion=completion(words_of(one.hint))
    )
    shape = inner if inner in (int, float) else str  # words and tuples are text to typer
    return _parameter(one.name, Annotated[shape | None, info], None)


def _general_options(catalog: Catalog, presets: Presets) -> list[inspect.Parameter]:
    config = typer.Option(
        "--config",
        metavar="FILE",
        rich_help_panel=SETTINGS,
        help="A TOML file of settings; --set and flags override it.",
    )
    words = tuple(f"{name}={word}" for name, one in catalog.settings.items() for word in words_of(one.hint) or ("",))
    sets = typer.Option(
        "--set",
        metavar="NAME=VALUE",
        rich_help_panel=SETTINGS,
        autocompletion=completion(words),
        help="Change any setting; may be repeated. --help-all lists them.",
    )

    def show(context: typer.Context, wanted: bool) -> None:
        if wanted:
            typer.echo(_help_all(context, catalog, presets))
            raise typer.Exit()

    everything = typer.Option(
        "--help-all", is_eager=True, callback=show, rich_help_panel=SETTINGS, help="List all settings and exit."
    )
    return [
        _parameter("config_file", Annotated[Path | None, config], None),
        _parameter("set_values", Annotated[list[str] | None, sets], None),
        _parameter("help_all", Annotated[bool, everything], False),
    ]


def _help_all(context: typer.Context, catalog: Catalog, presets: Presets) -> str:
    """Returns a table of each group's settings: name, type or legal words, help, range and defaults."""
    formatter = context.make_formatter()
    about = "Change a setting with --set NAME=VALUE, or in a file of lines NAME = VALUE (TOML) with --config FILE."
    context.command.format_usage(context, formatter)
    formatter.write_paragraph()
    formatter.write_text(about)
    for group, cls in catalog.groups.items():
        rows = []
        for one in settings_of(cls):
            extra = "".join(
                f"  [{part}]" for part in (one.bounds, f"default: {_defaults(one, group, presets)}") if part
            )
            rows.append((f"{one.name} {metavar(one.hint)}", one.help + extra))
        if rows:
            with formatter.section(group):
                formatter.write_dl(rows)
    return formatter.getvalue().rstrip("\n")


def _defaults(one: Setting, group: str, presets: Presets) -> str:
    """Returns the default in words, or each preset's where they differ: `thesis 16; quick, tiny 8`."""
    named: dict[str, list[str]] = {}
    for preset, instances in presets.items():
        named.setdefault(_written(getattr(instances[group], one.field)), []).append(preset)
    if len(named) < 2:
        return next(iter(named), _written(one.default))
    return "; ".join(f"{', '.join(names)} {value}" for value, names in named.items())


def _everyday_default(one: Setting, catalog: Catalog, presets: Presets) -> str:
    group = next(group for group, cls in catalog.groups.items() if one in settings_of(cls))
    values = {_written(getattr(instances[group], one.field)) for instances in presets.values()}
    return "the preset's" if len(values) > 1 else next(iter(values), _written(one.default))


def _written(value: Any) -> str:
    return write_text(value) or "empty"


def _parameter(name: str, annotation: Any, default: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, annotation=annotation, default=default)

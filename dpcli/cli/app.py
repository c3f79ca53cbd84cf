"""The `dpc` application: registers the subcommands and turns errors into messages and exit codes."""

from __future__ import annotations

import errno
import functools
import math
import os
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from importlib import import_module
from pathlib import Path
from typing import Any

import typer

from dpcli import __version__
from dpcli.cli.help_groups import SectionedCommand, SectionedGroup
from dpcli.cli.out_of_memory import memory_sentence, naming_large, out_of_memory
from dpcli.errors import DataError, DpcError, UsageError
from dpcli.regular_files import regular_files_only
from dpcli.runtime.tuning import tune_environment
from dpcli.signal_exit import INTERRUPTED, end_at_once, let_end, set_working, signal_outcome

tune_environment()  # before torch and numba load

# Options are many and take long to set up: only the command that is asked for is loaded; `dpc --help` loads none.
ROOMS = {
    "prepare": "Turn raw data into a file of point cloud sequences, or of views.",
    "classify": "Recognize actions and gestures (Kinet).",
    "segment": "Find rigid parts, their motions and joints, without labels.",
    "generate4d": "Fit, draw and export a 4D Gaussian scene with rigid parts, from one video.",
    "evaluate": "Compare what a model says with the truth.",
    "info": "Show what is in a file: kind, counts, lengths, classes, splits, ranges, provenance; also as a contact sheet or a page.",
}

_WRITTEN = ("output", "picture", "animation", "ply", "turntable", "page")  # options that name what a command writes
CLOSED_PIPE = 141  # what a shell reports for SIGPIPE
# What is wrong with a path that was given, rather than with the machine.
_PLACES = (
    errno.EROFS,
    errno.EACCES,
    errno.EPERM,
    errno.ELOOP,
    errno.ENAMETOOLONG,
    errno.ENOTDIR,
    errno.EISDIR,
    errno.ENXIO,
)
_LARGEST = 1e30  # of an option; torch ends with an error of its own where float32 overflows
_MOST = 10**7  # of a whole number that says how much: lists of more take gigabytes before any work begins


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"dpc {__version__}")
        raise typer.Exit()


def _root(
    version: bool = typer.Option(False, "--version", callback=_version, is_eager=True, help="Print the version."),
) -> None:
    pass


def application(words: Sequence[str] | None = None) -> typer.Typer:
    """Returns `dpc` with the command that the words name set up and the other groups by name only; with all of it for None."""
    dpc = typer.Typer(
        name="dpc",
        cls=SectionedGroup,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
        help="Dynamic point clouds: recognize actions, find rigid parts and their motions, rebuild a scene in 4D.",
        epilog="Anywhere on the line: -q (errors only), -v (more), --debug (traces).",
    )
    dpc.callback()(_root)
    path = None if words is None else [word for word in words if not word.startswith("-")]
    asked = None if path is None else next(iter(path), "")
    for name, about in ROOMS.items():
        if asked not in (None, name):
            dpc.command(name, help=about)(_not_loaded)
        elif name == "info":
            dpc.command(name, cls=SectionedCommand, help=about)(import_module("dpcli.cli.info").info)
        else:
            room = import_module(f"dpcli.cli.{name}.app").ROOM
            dpc.add_typer(room.application(path[1:] if path else ()), name=name, help=about)
    return dpc


def _words_to_complete() -> list[str] | None:
    """Returns the words after `dpc` that a shell asks to complete, or None in an ordinary run."""
    if "_DPC_COMPLETE" not in os.environ:
        return None
    words = os.environ.get("COMP_WORDS") or os.environ.get("_TYPER_COMPLETE_ARGS", "")  # bash; zsh and fish
    return words.split()[1:]


def _not_loaded() -> None:
    raise AssertionError("only the room that the first word names is ever run")


def __getattr__(name: str) -> typer.Typer:
    if name == "app":  # the whole of it, for those who import it
        return application()
    raise AttributeError(name)


def _global_flags(argv: list[str]) -> list[str]:
    """Takes -q, -v and --debug out of the arguments, wherever they stand (before a bare `--`)."""
    from dpcli.runtime.progress import log

    end = argv.index("--") if "--" in argv else len(argv)
    head, tail = argv[:end], argv[end:]
    if {"-q", "--quiet"} & set(head):
        log.level = 0
    if {"-v", "--verbose"} & set(head):
        log.level = 2
    log.debug = "--debug" in head
    return [word for word in head if word not in ("-q", "--quiet", "-v", "--verbose", "--debug")] + tail


def _explain(error: BaseException) -> int:
    """Prints a message for a person and returns the exit code."""
    from dpcli.runtime.progress import log

    if isinstance(error, BrokenPipeError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the interpreter flushes it once more at exit
        return CLOSED_PIPE
    if isinstance(error, KeyboardInterrupt) or type(error).__name__ == "Abort":
        return INTERRUPTED  # `main` says so, whatever way it learns of it
    if hasattr(error, "show") and hasattr(error, "exit_code"):  # wrong use, found by the option parser
        error.show(file=sys.stderr)
        return error.exit_code
    code, sentence = _what_went_wrong(error)
    if sentence is None:
        raise error
    log.error(sentence)
    return code


def _what_went_wrong(error: BaseException) -> tuple[int, str | None]:
    """Returns the exit code and a sentence; None for a fault of this program."""
    from dpcli.runtime.whole_file import disk_full

    if isinstance(error, DpcError):
        return error.exit_code, str(error)
    named = error.filename if isinstance(error, OSError) else None
    if isinstance(error, FileNotFoundError) and named is None and _current_folder_is_gone():
        gone = "the current folder was removed; change to one that exists (cd), then run the same command again"
        return DataError.exit_code, gone
    if isinstance(error, FileNotFoundError) and named is not None:
        return DataError.exit_code, f"{named}: no such file or folder"
    said = f"{named}: {error.strerror[0].lower()}{error.strerror[1:]}" if named is not None and error.strerror else None
    if isinstance(error, OSError) and error.errno in _PLACES and named:
        return DataError.exit_code, said
    if isinstance(error, OSError) and error.errno in (errno.EMFILE, errno.ENFILE):
        return 1, "too many open files; allow more (ulimit -n 1024), or use fewer --jobs"
    full = disk_full(named or "the output", error, place=named) if isinstance(error, OSError) else None
    if full is not None:
        return full.exit_code, str(full)
    return 1, memory_sentence(error) if out_of_memory(error) else said


def _current_folder_is_gone() -> bool:
    try:
        os.getcwd()
    except FileNotFoundError:
        return True
    return False


def _check_value(value: Any, option: Any) -> None:
    """Raises UsageError for NaN and for numbers too large for float32 or a count, DataError for a path without read permission."""
    if isinstance(value, float) and not abs(value) < _LARGEST and value != option.default:
        below = f" below {_LARGEST:g}" if math.isfinite(value) else ""
        raise UsageError(f"{option.opts[-1]} {value}: expected a finite number{below}")
    counts = type(value) is int and option.type_descriptor.parameter_info.parser is None  # no seed, which has a parser
    if counts and abs(value) > _MOST:
        raise UsageError(f"{option.opts[-1]} {value}: expected a whole number up to {_MOST}")
    if isinstance(value, Path) and option.name not in _WRITTEN and value.exists() and not os.access(value, os.R_OK):
        raise DataError(f"{value}: permission denied")


def _checking(command: Any) -> Any:
    """Makes the command, or all below it, refuse outputs that must not be written and values that no command can take.

    A value that is so by default passes. Where memory ends, options far above their defaults are named.
    """
    for below in getattr(command, "commands", {}).values():
        _checking(below)
    run = command.callback
    if run is None:
        return command
    options = {one.name: one for one in command.params}
    written = {name: one.opts[0] for name, one in options.items() if name in _WRITTEN}
    for one in command.params:
        one.type_descriptor.parameter_info.readable = False  # typer would call it wrong use

    @functools.wraps(run)
    def checked(*args: Any, **values: Any) -> Any:
        if written:
            _check_outputs(written, values)
        for name, value in values.items():
            for one in value if isinstance(value, (list, tuple)) else [value]:
                _check_value(one, options[name])
        given = {f"{options[name].opts[-1]} {value}": (value, options[name].default) for name, value in values.items()}
        with naming_large(given):
            return run(*args, **values)

    command.callback = checked
    return command


def _check_outputs(written: dict[str, str], values: dict[str, Any]) -> None:
    """Raises UsageError where an output would replace an input or what is no regular file, DataError without permission.

    written: parameter -> option of what the command writes. values: by parameter.
    """
    from dpcli.runtime.whole_file import check_regular, check_writable
    from dpcli.store.pipes import check_output

    inputs = [path for name, value in values.items() if name not in written for path in _paths_in(value)]
    for name, option in written.items():
        if name != "output" and str(values.get(name)) == "-":
            check_regular(Path("-"), option)
        if values.get(name) and str(values[name]) != "-":
            check_output(Path(values[name]), option, inputs)
            if name != "output" or values.get("force"):  # else it may be complete, and nothing is written
                check_writable(Path(values[name]), option)


def _paths_in(value: Any) -> list[str]:
    """Returns what may name files in an argument: of a text with commas its pieces, too."""
    if isinstance(value, (list, tuple)):
        return [path for one in value for path in _paths_in(one)]
    if isinstance(value, str):
        return [value, *value.split(",")]
    return [str(value)] if isinstance(value, Path) else []


def main(argv: list[str] | None = None) -> None:
    """Runs `dpc` and exits with one of the codes in docs/architecture.md."""
    arguments = _global_flags(list(sys.argv[1:] if argv is None else argv))
    command = _checking(typer.main.get_command(application(_words_to_complete() or arguments)))
    code = _run(command, arguments)
    let_end()
    ended = signal_outcome() or (INTERRUPTED, "interrupted")
    if code == INTERRUPTED or (code and signal_outcome()):  # a signal that came when all was done changes nothing
        from dpcli.runtime.progress import log

        code, said = ended
        log.error(said)
        end_at_once(code)
    sys.exit(code if isinstance(code, int) else 0)


def _run(command: Any, arguments: list[str]) -> Any:
    """Runs the command; returns its exit code, or None for 0. Says what went wrong, unless a signal did."""
    from dpcli.runtime.progress import log

    try:
        set_working(True)
        with nullcontext() if "--stream" in arguments else regular_files_only():  # a stream may come by a FIFO
            code = command.main(args=arguments, prog_name="dpc", standalone_mode=False)
        sys.stdout.flush()
        return code
    except SystemExit as ended:  # typer turns Ctrl-C and a closed pipe into this, silently
        return _explain(ended.__context__) if isinstance(ended.__context__, BrokenPipeError) else ended.code
    except (Exception, KeyboardInterrupt) as error:
        if log.debug and not isinstance(error, (BrokenPipeError, KeyboardInterrupt)):
            import traceback

            traceback.print_exc()
        if signal_outcome():  # libraries make other errors of an interrupt
            return INTERRUPTED
        try:
            return _explain(error)
        except Exception as unexpected:
            if not log.debug:
                log.error(
                    f"{type(unexpected).__name__}: {unexpected} (a bug, or an unusual machine; --debug shows where)"
                )
            return 1

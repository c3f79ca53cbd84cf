"""The `dpc` application: registers the subcommands and turns errors into messages and exit codes."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Sequence
from importlib import import_module

import typer

from dpcli import __version__
from dpcli.errors import DpcError

# Before torch and numba load: threads that wait by spinning keep the other library's threads off the cores.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# A room's options are many and take long to set up: only the room that is asked for is loaded, `dpc --help` loads none.
ROOMS = {
    "prepare": "Turn raw data into a file of point cloud sequences, or of views.",
    "classify": "Recognise actions and gestures (Kinet).",
    "segment": "Find rigid parts and their motions in a few frames, without labels.",
    "generate4d": "A 4D Gaussian scene with rigid parts, from one video.",
    "evaluate": "Compare what a model says with the truth.",
    "info": "Kind, counts, lengths, classes, splits, ranges and provenance of a file; a contact sheet of its frames.",
}

CLOSED_PIPE, INTERRUPTED = 141, 130  # what a shell reports for SIGPIPE and SIGINT


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"dpc {__version__}")
        raise typer.Exit()


def _root(
    version: bool = typer.Option(False, "--version", callback=_version, is_eager=True, help="Print the version."),
) -> None:
    pass


def application(words: Sequence[str] | None = None) -> typer.Typer:
    """`dpc` with the one room that the words name loaded and the others by name only; with all of them for None."""
    dpc = typer.Typer(
        name="dpc",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
        help="Dynamic point clouds: recognise actions, find rigid parts and their motions, rebuild a scene in 4D.",
        epilog="Anywhere on the line: -q (errors only), -v (more), --debug (traces).",
    )
    dpc.callback()(_root)
    asked = None if words is None else next((word for word in words if not word.startswith("-")), "")
    for name, about in ROOMS.items():
        if asked not in (None, name):
            dpc.command(name, help=about)(_not_loaded)
        elif name == "info":
            dpc.command(name, help=about)(import_module("dpcli.cli.info").info)
        else:
            dpc.add_typer(import_module(f"dpcli.cli.{name}").app, name=name, help=about)
    return dpc


def _not_loaded() -> None:
    raise AssertionError("only the room that the first word names is ever run")


def __getattr__(name: str) -> typer.Typer:
    if name == "app":  # the whole of it, for those who import it
        return application()
    raise AttributeError(name)


def _global_flags(argv: list[str]) -> list[str]:
    """Take -q, -v and --debug out of the arguments, wherever they stand (before a bare `--`)."""
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
    """Print a message for a person and return the exit code."""
    from dpcli.runtime.progress import log

    if isinstance(error, BrokenPipeError):
        os.dup2(
            os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno()
        )  # the interpreter flushes stdout once more at exit
        return CLOSED_PIPE
    if isinstance(error, KeyboardInterrupt) or type(error).__name__ == "Abort":
        log.error("interrupted")
        return INTERRUPTED
    if hasattr(error, "show") and hasattr(error, "exit_code"):  # wrong use, found by the option parser
        error.show(file=sys.stderr)
        return error.exit_code
    if isinstance(error, DpcError):
        log.error(str(error))
        return error.exit_code
    if isinstance(error, FileNotFoundError) and error.filename is not None:
        log.error(f"{error.filename}: no such file or folder")
        return 2
    if isinstance(error, OSError) and error.errno == errno.ENOSPC:
        log.error(
            f"no space left on the device while writing {error.filename or 'the output'}; free some and run again"
        )
        return 1
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        log.error(f"{error.filename}: {error.strerror[0].lower()}{error.strerror[1:]}")
        return 1
    raise error


def main(argv: list[str] | None = None) -> None:
    """Run `dpc`; exits with the code that design.md section 2 lists."""
    # torch's and numba's threads take turns: spinning while they wait, each pool would hold the cores the other needs
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    arguments = _global_flags(list(sys.argv[1:] if argv is None else argv))
    command = typer.main.get_command(application(arguments))
    from dpcli.runtime.progress import log

    try:
        code = command.main(args=arguments, prog_name="dpc", standalone_mode=False)
        sys.stdout.flush()
    except SystemExit as ended:  # typer turns Ctrl-C and a closed pipe into this, silently
        code = _explain(ended.__context__) if isinstance(ended.__context__, BrokenPipeError) else ended.code
        if code == INTERRUPTED:
            log.error("interrupted")
    except (Exception, KeyboardInterrupt) as error:
        if log.debug and not isinstance(error, (BrokenPipeError, KeyboardInterrupt)):
            import traceback

            traceback.print_exc()
        try:
            code = _explain(error)
        except Exception as unexpected:
            if not log.debug:
                log.error(
                    f"{type(unexpected).__name__}: {unexpected} (a bug, or an unusual machine; --debug shows where)"
                )
            code = 1
    sys.exit(code if isinstance(code, int) else 0)

"""`dpc`, `python -m dpcli` and `torchrun -m dpcli`: the same command. Worker processes import this, so it imports nothing."""

from __future__ import annotations


def main() -> None:
    """Run `dpc` with the words of the command line."""
    from dpcli.signal_exit import (
        INTERRUPTED,
        acknowledge_signal,
        end_at_once,
        signal_outcome,
        start_watchdog,
        watch_signals,
    )

    watch_signals()
    import gc
    import sys

    try:
        from dpcli.interpreter import settle_interpreter
        from dpcli.standard_streams import hush_warnings, quiet_libraries, ready_streams

        settle_interpreter()
        ready_streams()
        start_watchdog()
        if "--debug" not in sys.argv:
            hush_warnings()
            quiet_libraries()

        from dpcli.cli.app import main

        main()
    except KeyboardInterrupt:  # before or after the command's own work, which says what it keeps
        code, said = signal_outcome() or (INTERRUPTED, "interrupted")
        sys.stderr.write(f"dpc: error: {said}\n")
        end_at_once(code)
        sys.exit(code)
    finally:
        acknowledge_signal()
        gc.freeze()  # else Python searches all that libraries made for garbage, twice, before it ends


if __name__ == "__main__":
    main()

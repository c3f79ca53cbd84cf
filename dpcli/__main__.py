"""`python -m dpcli` and `torchrun -m dpcli` run the same command as `dpc`."""

from __future__ import annotations

from dpcli.cli.app import main

if __name__ == "__main__":
    main()

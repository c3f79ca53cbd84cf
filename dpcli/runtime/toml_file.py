"""Reading TOML on every Python; before 3.11 the reader is a package of its own."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from dpcli.errors import DataError, DpcError


def read_toml(path: Path) -> dict[str, Any]:
    """Returns the content of a TOML file; DataError when it is none."""
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        try:
            import tomli as tomllib
        except ImportError:
            raise DpcError("reading TOML on Python 3.10 needs a package: pip install tomli") from None
    try:
        return tomllib.loads(path.read_text("utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise DataError(f"{path}: not TOML ({error})") from None
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None

"""Settles what the program takes from its surroundings: encoding, docstrings, the current folder's modules, home, backend."""

from __future__ import annotations

import os
import sys


def settle_interpreter() -> None:
    """Starts this program again, once, where Python began with what spoils it; and keeps the current folder's modules out of workers.

    Names of files are UTF-8, and so the same texts on all machines. Else, in a locale of another encoding, a folder's class would
    have another name in a file than elsewhere, or a name in a file could be none of a folder. What is printed keeps the locale's
    encoding. Docstrings are kept, which -OO and the PYTHONOPTIMIZE=2 of some containers drop: they are the help.

    A process that Python starts for workers looks for its modules in the current folder first, where anybody's random.py or
    queue.py may lie; from Python 3.11 on it can be told not to. Later a worker gets the paths of this process.

    Who has neither HOME nor an entry among the system's users, as in some containers, has a home where nothing can be made:
    libraries would keep their caches in a folder called ~ beside the user's files.

    Matplotlib draws into files alone, whichever backend for windows MPLBACKEND names: one that it no longer has, such as
    Qt4Agg, would end each command that imports it.
    """
    bare = sys.flags.optimize > 1
    given = sys.orig_argv[1:]
    words = [word for word in given if not (bare and word == "-OO")]
    if sys.getfilesystemencoding() != "utf-8" and "utf8" not in sys._xoptions:
        if sys.__stdout__ is not None:
            os.environ.setdefault("PYTHONIOENCODING", sys.__stdout__.encoding)
        words = ["-X", "utf8", *words]
    asked = bare and os.environ.pop("PYTHONOPTIMIZE", "")
    if sys.executable and (words != given or asked):
        os.execv(sys.executable, [sys.executable, *words])
    os.environ.update(PYTHONSAFEPATH="1", MPLBACKEND="agg")
    if os.path.expanduser("~") == "~":
        os.environ["HOME"] = os.devnull

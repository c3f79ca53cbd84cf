"""Settles what Python itself takes from its surroundings: the locale's encoding, the current folder's modules, the home folder."""

from __future__ import annotations

import os
import sys


def settle_interpreter() -> None:
    """Starts this program again, once, where the locale isn't of UTF-8; and keeps the current folder's modules out of workers.

    Names of files are then the same texts on all machines. Else a folder's class would have another name in a file than
    elsewhere, or a name in a file could be none of a folder. What is printed keeps the locale's encoding.

    A process that Python starts for workers looks for its modules in the current folder first, where anybody's random.py or
    queue.py may lie; from Python 3.11 on it can be told not to. Later a worker gets the paths of this process.

    Who has neither HOME nor an entry among the system's users, as in some containers, has a home where nothing can be made:
    libraries would keep their caches in a folder called ~ beside the user's files.
    """
    if sys.getfilesystemencoding() != "utf-8" and "utf8" not in sys._xoptions and sys.executable:
        if sys.__stdout__ is not None:
            os.environ.setdefault("PYTHONIOENCODING", sys.__stdout__.encoding)
        os.execv(sys.executable, [sys.executable, "-X", "utf8", *sys.orig_argv[1:]])
    os.environ["PYTHONSAFEPATH"] = "1"
    if os.path.expanduser("~") == "~":
        os.environ["HOME"] = os.devnull

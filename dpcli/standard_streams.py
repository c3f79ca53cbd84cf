"""Standard streams under odd conditions: closed, or on a terminal that doesn't show every letter."""

from __future__ import annotations

import os
import re
import sys

# Control characters, the halves of letters that broken UTF-8 leaves, and what turns the direction of the text around.
_UNSEEN = re.compile("[\x00-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


def ready_streams() -> None:
    """Makes what is printed to a closed stream go nowhere, and spells a letter that can't be shown; before anything is opened.

    stdin stays None when it is closed, so that who wants it can tell. The number of a closed stream is taken, else the next
    file to be opened would get it, and with it all that is printed.
    """
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
    for name, number in (("stdout", 1), ("stderr", 2)):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(number, "w", closefd=False))
        else:
            stream.reconfigure(errors="backslashreplace")


def printable(text: str, kept: str = "") -> str:
    r"""Returns text from a file as a terminal may get it: a control character that is not `kept` is spelled, such as ``\x1b``."""
    return _UNSEEN.sub(lambda found: found[0] if found[0] in kept else found[0].encode("unicode_escape").decode(), text)

"""One writer at a time: a lock that the system releases by itself when its holder ends, however it ends."""

from __future__ import annotations

import errno
import fcntl
import os
from pathlib import Path

from dpcli.errors import DpcError

_NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS)  # file systems that know none


def open_alone(path: Path) -> int:
    """Opens and locks a file, made if absent; again if another process finished and removed the file in between.

    Closing the number releases it. Raises DpcError when another process holds the file.
    """
    while True:
        number = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.EACCES):
                os.close(number)
                raise DpcError(f"{path}: cannot write (another dpc is writing it)") from None
            if error.errno not in _NO_LOCKS:
                os.close(number)
                raise
        if path.exists() and os.path.samestat(os.fstat(number), os.stat(path)):
            return number
        os.close(number)

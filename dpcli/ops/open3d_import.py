"""Importing Open3D on machines without the system's libusb-1.0."""

from __future__ import annotations

import ctypes
from functools import lru_cache
from types import ModuleType

from dpcli.errors import DpcError


@lru_cache(maxsize=1)
def load_open3d() -> ModuleType:
    """Imports Open3D and returns it. Raises DpcError when it can't be imported.

    Its wheel links against libusb-1.0. The PyPI package ``libusb-package`` carries that library; loaded first and
    globally, it satisfies the link without root rights.
    """
    try:
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    except (ImportError, OSError, TypeError):
        pass  # the system may have its own
    try:
        import open3d
    except (ImportError, OSError) as error:
        lacking = (
            "the system lacks a library that Open3D asks for; of Debian and Ubuntu: apt install libegl1 libgl1 libx11-6"
        )
        advice = "pip install open3d libusb-package" if isinstance(error, ModuleNotFoundError) else lacking
        raise DpcError(
            f"Open3D, which casts rays and registers scans here, cannot be imported ({error}); {advice}"
        ) from None
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    return open3d

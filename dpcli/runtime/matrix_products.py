"""Which library multiplies float32 matrices on a CPU."""

from __future__ import annotations

import functools
from pathlib import Path

_SIDE = 256  # of the product that is tried
_CLOSE = 1e-5  # relative error of float32 sums of that length; of bfloat16 it is 2.4e-3


@functools.cache
def choose_products() -> bool:
    """Let oneDNN multiply float32 matrices where that is faster than torch's choice, as exactly; True where it does.

    torch asks MKL, which on AMD's processors uses half of the vector width (AVX2), where oneDNN uses all of it
    (AVX-512): 2.3 times as fast on Zen 5; Zen 4, whose units are half as wide, should gain little. torch's only way
    to oneDNN is its leave to round factors to bfloat16, which oneDNN makes use of where the processor has AMX. So a
    product is tried, and where its error isn't that of float32, MKL stays. The setting is the whole process's, and
    would concern a GPU, too: where there is one, nothing is changed.
    """
    import torch

    if torch.cuda.is_available() or not _wide_amd():
        return False
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium")
    if _error() < _CLOSE:
        return True
    torch.set_float32_matmul_precision(before)
    return False


def _wide_amd() -> bool:
    import torch

    try:
        amd = "AuthenticAMD" in Path("/proc/cpuinfo").read_text().partition("flags")[0]
    except OSError:  # not Linux
        return False
    return amd and torch.backends.cpu.get_cpu_capability() == "AVX512"


def _error() -> float:
    """Relative error of a product of float32 matrices, as this process computes it."""
    import torch

    left, right = torch.randn(2, _SIDE, _SIDE, generator=torch.Generator().manual_seed(0))
    exact = left.double() @ right.double()
    return float(((left @ right) - exact).norm() / exact.norm())

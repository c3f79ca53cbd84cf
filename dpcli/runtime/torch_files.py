"""Files of PyTorch (.pt, .pth, .bin) of anybody: tensors, numbers, texts and plain containers of them, and no more than they hold."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from dpcli.errors import DataError, first_line
from dpcli.npy_files import require_distinct


def load_plain(path: Path) -> Any:
    """Returns what a file of PyTorch holds, on the CPU, without running anything in it.

    Raises DataError when it is damaged, needs more than plain containers of tensors, or has members or tensors that claim
    more than is stored; also for sparse, quantized and nested tensors, as nothing checks their indices.
    """
    import torch

    try:
        check_members(path)
        found = torch.load(path, map_location="cpu", weights_only=True)
    except DataError:
        raise
    except Exception as error:  # pickle, zip and torch each have their own
        raise DataError(
            f"{path}: not a file of plain tensors, or not whole ({first_line(error)[:120]}); it was not loaded"
        ) from None
    for value in _leaves(found):
        if isinstance(value, torch.Tensor) and (fault := _fault(value)):
            raise DataError(f"{path}: holds {fault}; it was not loaded")
    return found


def check_members(path: Path) -> None:
    """Raises DataError when the members of the ZIP that such a file mostly is claim more bytes than it has.

    PyTorch packs none, and lets none share bytes with another. Raises BadZipFile for a damaged one.
    """
    with open(path, "rb") as file:
        if file.read(4) != b"PK\x03\x04":
            return
        with zipfile.ZipFile(file) as archive:
            require_distinct(path, archive.namelist())
            claimed = sum(one.file_size for one in archive.infolist())
    if claimed > path.stat().st_size:
        raise DataError(
            f"{path}: its members claim {claimed} bytes, a file of {path.stat().st_size} can't hold them unpacked, as"
            " PyTorch writes them; save it again with torch.save"
        )


def _leaves(value: Any) -> Iterator[Any]:
    """Yields all that is no container in nested containers; each container once, as they may hold themselves."""
    stack, seen = [value], set()
    while stack:
        one = stack.pop()
        if not isinstance(one, (Mapping, list, tuple, set)):
            yield one
        elif id(one) not in seen:
            seen.add(id(one))
            stack.extend(one.values() if isinstance(one, Mapping) else one)


def _fault(tensor: Any) -> str:
    """Returns what about a tensor is not plain, "" when nothing is."""
    import torch

    plain = type(tensor) in (torch.Tensor, torch.nn.Parameter) and tensor.layout is torch.strided
    if not plain or tensor.is_quantized or tensor.is_nested or tensor.device.type != "cpu":
        return "a sparse, quantized or empty tensor; expected plain ones, on the CPU"
    if tensor.numel() * tensor.element_size() > tensor.untyped_storage().nbytes():
        return f"a tensor that claims {tensor.numel()} numbers of {tensor.untyped_storage().nbytes()} bytes"
    return ""

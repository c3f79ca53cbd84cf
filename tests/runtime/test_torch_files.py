"""Files of PyTorch: honest ones load, forged ones take no memory that they don't hold, reach nothing and end as bad data."""

from __future__ import annotations

import os
import zipfile
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest
import torch

from dpcli.errors import DataError
from dpcli.runtime.run_folder import RunFolder
from dpcli.runtime.torch_files import load_plain


class Calls:
    """A pickle that calls a function."""

    def __init__(self, function, *given):
        self.function, self.given = function, given

    def __reduce__(self):
        return self.function, self.given


def repacked(path: Path, method: int) -> None:
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in members.items():
            archive.writestr(name, data)


def packed(path: Path) -> None:
    torch.save({"w": torch.zeros(1 << 20)}, path)
    repacked(path, zipfile.ZIP_DEFLATED)


def shared(path: Path) -> None:
    """Its directory names the same bytes many times."""
    torch.save({"w": torch.zeros(1 << 12)}, path)
    with zipfile.ZipFile(path, "a") as archive:
        data = next(one for one in archive.infolist() if one.filename.endswith("data/0"))
        archive.filelist += [data] * 50
        archive._didModify = True


def saved(make):
    return lambda path: torch.save(make(), path)


HOSTILE = {
    "a packed member": packed,
    "members that share bytes": shared,
    "a tensor as wide as a country": saved(lambda: {"w": torch.zeros(1).expand(1 << 40)}),
    "one deep in containers": saved(lambda: [{"a": ({"w": torch.zeros(2, 1).expand(2, 1 << 30)},)}]),
    "a sparse tensor": saved(lambda: torch.sparse_coo_tensor([[3]], [1.0], (1 << 40,))),
    "a sparse tensor with an index far outside": saved(
        lambda: Calls(
            torch._utils._rebuild_sparse_tensor,
            torch.sparse_coo,
            (torch.tensor([[1 << 40]]), torch.ones(1), torch.Size([3]), False),
        )
    ),
    "a quantized tensor": saved(lambda: torch.quantize_per_tensor(torch.ones(3), 0.1, 0, torch.qint8)),
    "a nested tensor": saved(lambda: torch.nested.nested_tensor([torch.ones(2), torch.ones(3)])),
    "a tensor without numbers": saved(lambda: torch.zeros(1 << 28, device="meta")),
    "a view past the end": saved(
        lambda: Calls(
            torch._utils._rebuild_tensor_v2, torch.zeros(4).untyped_storage(), 0, (1000,), (1,), False, OrderedDict()
        )
    ),
    "a command": saved(lambda: Calls(os.system, "true")),
    "a file of the system": saved(lambda: Calls(torch.from_file, "/etc/hostname", False, 4)),
    "a folder of an archive alone": lambda path: zipfile.ZipFile(path, "w").writestr("a/data.pkl", b"."),
    "half an archive": lambda path: path.write_bytes(b"PK\x03\x04" + bytes(100)),
    "nothing": lambda path: path.write_bytes(b""),
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", HOSTILE)
def test_a_forged_file_is_refused(kind, tmp_path):
    HOSTILE[kind](tmp_path / "x.pt")
    with pytest.raises(DataError, match="x.pt: ") as caught:
        load_plain(tmp_path / "x.pt")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("old", [True, False])
def test_honest_files_load(old, tmp_path):
    whole = torch.arange(12.0).reshape(3, 4)
    state = {
        "w": whole.T,
        "part": whole[1:, :2],
        "p": torch.nn.Parameter(whole),
        "n": [1, "a", None],
        "none": whole[:0],
    }
    torch.save(state, tmp_path / "x.pt", _use_new_zipfile_serialization=not old)
    found = load_plain(tmp_path / "x.pt")
    assert list(found) == list(state) and found["n"] == state["n"]
    for name in ("w", "part", "p", "none"):
        assert np.array_equal(found[name].detach(), state[name].detach())


@pytest.mark.parametrize("state", [{}, {"rows": []}, [1], {"rows": [], "step": "x", "model": {"w": torch.ones(2)}}])
def test_the_state_of_another_run_is_bad_data(state, tmp_path):
    model = torch.nn.Linear(1, 1)
    with RunFolder(tmp_path / "run", {"a": 1}, columns=("a",)) as folder:
        torch.save(state, folder.file("state.pt"))
        with pytest.raises(DataError, match="state.pt: the saved state is damaged .*--force starts over"):
            found = folder.load_state()
            with folder.restoring():
                model.load_state_dict(found["model"])

"""Damaged HDF5 files: every reader ends in DataError, whatever bytes, types, shapes or attributes were changed."""

import gc
import random
import time
from contextlib import suppress
from itertools import product

import h5py
import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter, ScoresReader, ViewsReader
from dpcli.store.embedding import EmbeddingReader
from dpcli.store.file import open_store
from dpcli.store.gaussians import read_scene
from dpcli.store.joints import no_joints
from dpcli.store.parts import PartsReader
from dpcli.store.schema import KINDS
from dpcli.store.statistics import StatisticsReader
from dpcli.store.summary import summary
from tests.store.test_schema import WRITERS, data_sets


@pytest.fixture
def clouds(tmp_path):
    path = tmp_path / "c.h5"
    rng = np.random.default_rng(0)
    with CloudsWriter(path, class_names=["a", "b"], length_unit="m", source="t", seed=0, provenance={}) as writer:
        for k in range(3):
            frames = [rng.random((20, 3), np.float32) for _ in range(4)]
            writer.write(CloudSequence.from_frames(f"s{k}", frames, split="train", label=k % 2))
    return path


def _read_all(path):
    summary(path)
    with CloudsReader(path) as reader:
        for index in range(len(reader)):
            reader.read(index)


def _read_or_data_error(path):
    try:
        _read_all(path)
    except DataError as error:
        assert str(path) in str(error)
        return True
    return False


def test_flipped_and_lost_bytes_are_bad_data(clouds):
    whole, draw, refused = clouds.read_bytes(), random.Random(5), 0
    for _ in range(60):
        bytes_ = bytearray(whole)
        for _ in range(draw.choice([1, 4])):
            bytes_[draw.randrange(len(bytes_))] ^= 1 << draw.randrange(8)
        kept = len(bytes_) if draw.random() < 0.7 else draw.randrange(1, len(bytes_))
        clouds.write_bytes(bytes_[:kept])
        refused += _read_or_data_error(clouds)
    assert refused > 5


def test_a_damaged_superblock_is_not_taken_for_a_lock(clouds):
    whole = clouds.read_bytes()
    clouds.write_bytes(whole[:8] + b"\1" + whole[9:])  # its version
    with pytest.raises(DataError, match="the HDF5 file is damaged .*superblock"):
        open_store(clouds)


@pytest.mark.parametrize("name", ["points", "name", "split", "label", "frame_offsets", "sequence_offsets"])
@pytest.mark.parametrize("value", [np.zeros((2, 2, 2)), np.zeros(1, "S3"), np.float64(7), b"text"])
def test_other_types_and_shapes_are_bad_data(clouds, name, value):
    with h5py.File(clouds, "a") as file:
        del file[name]
        file[name] = value
    with pytest.raises(DataError):
        _read_all(clouds)


@pytest.mark.parametrize(
    "name, value", [("seed", "x"), ("seed", np.zeros(2)), ("length_unit", 3), ("source", np.arange(3)), ("dpc_kind", 5)]
)
def test_attributes_of_other_types_are_bad_data(clouds, name, value):
    with h5py.File(clouds, "a") as file:
        file.attrs[name] = value
    with pytest.raises(DataError, match=name if name != "dpc_kind" else "holds"):
        open_store(clouds)


@pytest.mark.parametrize("shape", [(1 << 60,), (1 << 33, 3), (1 << 20, 1 << 20)])
def test_a_shape_that_the_file_cannot_hold_is_refused_at_once(clouds, shape):
    with h5py.File(clouds, "a") as file:
        del file["points"]
        file.create_dataset("points", shape, np.float32, chunks=(64, 3)[: len(shape)], compression="gzip")
    begun = time.process_time()
    with pytest.raises(DataError, match="claims .* can't hold them"):
        _read_all(clouds)
    assert time.process_time() - begun < 1


def _twice_each(file):
    for _ in range(40):  # 2 to the power of 40 ways down
        below = file.create_group("a")
        file["b"] = below
        file = below


def _in_itself(file):
    file["again"] = file["/"]


def _many(file):
    for number in range(4200):
        file.create_group(f"g{number}")


@pytest.mark.parametrize("change", [_twice_each, _in_itself, _many])
def test_groups_without_an_end_are_refused_at_once(clouds, change):
    with h5py.File(clouds, "a") as file:
        change(file)
    with pytest.raises(DataError, match="under another name, too|more than 4096 groups"):
        open_store(clouds)


def test_a_chunk_that_is_far_larger_than_its_data_set_is_refused(clouds):
    """HDF5 unpacks it whole for one value; from 200 KB to gigabytes."""
    with h5py.File(clouds, "a") as file:
        del file["name"]
        text, one = h5py.string_dtype(), (1 << 24,)
        made = file.create_dataset("name", (2,), text, maxshape=(None,), chunks=one, compression="gzip")
        made.id.write_direct_chunk((0,), b"packed" * 9)
    with pytest.raises(DataError, match="/name has . values, and claims 134217728 bytes for a chunk of them"):
        open_store(clouds)


def test_a_damaged_file_is_exit_3_of_the_command(clouds, dpc_here):
    clouds.write_bytes(clouds.read_bytes()[:900])
    ended = dpc_here("info", clouds)
    assert ended.returncode == 3 and b"a bug" not in ended.stderr and str(clouds).encode() in ended.stderr


READ = {
    "clouds": lambda path: [reader.given(k) for reader in [CloudsReader(path)] for k in range(len(reader))],
    "parts": lambda path: [reader.given(k) for reader in [PartsReader(path)] for k in range(len(reader))],
    "views": lambda path: [(reader.rgba(0, 0), reader.track, reader.part) for reader in [ViewsReader(path)]],
    "scores": ScoresReader,
    "gaussians": read_scene,
    "embedding": EmbeddingReader,
    "statistics": lambda path: [
        reader.given(k) for reader in [StatisticsReader(path)] for k in range(len(reader.names))
    ],
}


def _damage_chunk(path, name, values):
    """Lets a data set be compressed, and one byte in the middle of its first chunk be another."""
    with h5py.File(path, "a") as file:
        del file[name]
        made = file.create_dataset(name, data=values, chunks=values.shape, compression="gzip")
        chunk = made.id.get_chunk_info(0)
    bytes_ = bytearray(path.read_bytes())
    bytes_[chunk.byte_offset + chunk.size // 2] ^= 0x55
    path.write_bytes(bytes_)


def _damages(values, is_text):
    """Another type and shape, which are refused always, and odd values, which are refused or read."""
    if is_text:
        return [np.arange(len(values)), values[None]], [[b"\xff\xfe"] * len(values), [b"a"] * len(values)]
    kind = values.dtype.kind
    other = values.dtype.newbyteorder(">") if values.itemsize > 1 else "i2"
    narrow = [values[..., :-1]] if values.ndim > 1 and values.shape[-1] in (2, 3, 4, 9) else []
    odd = np.nan if kind == "f" else np.iinfo(values.dtype).min
    return [values.astype(other), values[None], *narrow], [np.full_like(values, odd), values[:-1]]


@pytest.mark.parametrize("kind", KINDS)
def test_no_field_of_any_kind_can_be_a_bug(kind, tmp_path):
    """Other types and shapes are refused by name; whatever values of the right ones are either refused by name or read."""
    WRITERS[kind](tmp_path / "whole.h5")
    whole, path = (tmp_path / "whole.h5").read_bytes(), tmp_path / "a.h5"
    READ[kind](tmp_path / "whole.h5")
    gc.freeze()  # what all the tests before have loaded needs no look at each collection
    with h5py.File(tmp_path / "whole.h5") as file:
        fields = {
            name: file[name][()] for name in data_sets(tmp_path / "whole.h5") if isinstance(file[name], h5py.Dataset)
        }
    for name, values in fields.items():
        wrong, odd = _damages(values, values.dtype.kind == "O")
        for must, made in [*((True, one) for one in wrong), *((False, one) for one in odd), (False, None)]:
            path.write_bytes(whole)
            with h5py.File(path, "a") as file:
                del file[name]
                if made is not None:
                    file.create_dataset(name, data=made, dtype=h5py.string_dtype() if isinstance(made, list) else None)
            refused = False
            try:
                READ[kind](path)
            except DataError as error:
                assert str(path) in str(error), (name, error)
                refused = True
            assert refused or not must, (name, made)
        if values.size and values.dtype.kind != "O":
            path.write_bytes(whole)
            _damage_chunk(path, name, values)
            for read in (READ[kind], summary):
                with suppress(DataError):
                    read(path)
            gc.collect()  # newer Pythons keep the file of a failed read until then
    gc.unfreeze()


@pytest.mark.parametrize("kind", KINDS)
def test_no_attribute_of_any_kind_can_be_a_bug(kind, tmp_path):
    WRITERS[kind](tmp_path / "whole.h5")
    whole, path = (tmp_path / "whole.h5").read_bytes(), tmp_path / "a.h5"
    with h5py.File(tmp_path / "whole.h5") as file:
        names = list(file.attrs)
    for name, value in product(
        names, ["x", 2**62, np.zeros((3, 3)), h5py.Empty("f4"), np.bytes_(b"\xff\xfe"), "[" * 5000]
    ):
        path.write_bytes(whole)
        with h5py.File(path, "a") as file:
            file.attrs[name] = value
        try:
            READ[kind](path)
        except DataError as error:
            assert str(path) in str(error), (name, error)


@pytest.mark.parametrize(
    "name, change, said",
    [
        ("name", lambda v: np.array([b"s0"] * len(v)).astype(object), "'s0' occurs twice"),
        ("label", lambda v: v - 2, "label -2 of 's0', expected -1"),
        ("frame_offsets", lambda v: -v, "must start at 0 and never fall"),
    ],
)
def test_values_that_no_index_has_are_refused(clouds, name, change, said):
    with h5py.File(clouds, "a") as file:
        values = change(file[name][()])
        del file[name]
        file.create_dataset(name, data=values, dtype=h5py.string_dtype() if values.dtype.kind == "O" else None)
    with pytest.raises(DataError, match=said):
        _read_all(clouds)


@pytest.mark.parametrize(
    "joint, said", [([7, 1], "parent 7"), ([-1, 9], "type 9"), ([0.5, 1], "parent 0.5"), ([np.nan, 1], "NaN")]
)
def test_joints_of_parts_that_are_not_there_are_refused(joint, said):
    joints = no_joints(2, 2)
    joints[1, 0, :2] = joint
    sequence = CloudSequence.from_frames("a", [np.zeros((1, 3))] * 2, joint=joints)
    with pytest.raises(DataError, match=said):
        sequence.validate()

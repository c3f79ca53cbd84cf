"""Damaged HDF5 files: every reader ends in DataError, whatever bytes, types, shapes or attributes were changed."""

import random
import subprocess
import sys
import time

import h5py
import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter
from dpcli.store.file import open_store
from dpcli.store.summary import summary


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
    begun = time.monotonic()
    with pytest.raises(DataError, match="claims .* can't hold them"):
        _read_all(clouds)
    assert time.monotonic() - begun < 1


def test_a_damaged_file_is_exit_3_of_the_command(clouds):
    clouds.write_bytes(clouds.read_bytes()[:900])
    ended = subprocess.run([sys.executable, "-m", "dpcli", "info", str(clouds)], capture_output=True, text=True)
    assert ended.returncode == 3 and "a bug" not in ended.stderr and str(clouds) in ended.stderr

"""Folders whose names are not UTF-8, as systems of before Unicode left them: they work, or one sentence says which library can't."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from dpcli.errors import DataError
from dpcli.path_names import as_utf8, file_names, utf8_path
from dpcli.prepare.articulated.urdf import read_skeleton
from dpcli.runtime.weights import load_weights, save_weights
from dpcli.store import CloudsReader, ViewsReader
from tests.support.commands import exit_code


@pytest.fixture
def latin1(tmp_path):
    """A folder called é in Latin-1."""
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9"))
    try:
        folder.mkdir()
    except OSError:
        pytest.skip("this file system takes only UTF-8")
    return folder


def test_other_bytes_are_spelled_and_the_rest_is_left_alone():
    assert as_utf8(os.fsdecode(b"caf\xe9/v1")) == r"caf\xe9/v1"
    assert as_utf8("café/走る") == "café/走る" == utf8_path(Path("café/走る"), "OpenCV")


def test_samples_and_classes_of_such_folders_have_names(latin1, dpc):
    for video in ("v1", "v2"):
        (latin1 / video).mkdir()
        for frame in range(3):
            np.save(latin1 / video / f"{frame}.npy", np.random.default_rng(frame).random((40, 3), np.float32))
    done = dpc("prepare", "clouds", latin1.parent, "--label-from-folder", "--points", 16, "-o", latin1 / "c.h5")
    assert done.returncode == 0, done.stderr
    with CloudsReader(latin1 / "c.h5") as clouds:
        assert clouds.class_names == [r"caf\xe9"] and list(clouds.names) == [r"caf\xe9/v1", r"caf\xe9/v2"]
    assert dpc("prepare", "clouds", latin1, "--points", 16, "-o", latin1 / "d.h5").returncode == 0
    with CloudsReader(latin1 / "d.h5") as clouds:
        assert list(clouds.names) == ["v1", "v2"] and r"caf\xe9" in clouds.attributes["command"]


def test_a_video_in_such_a_folder_ends_with_a_sentence_where_decoders_crash(latin1, dpc):
    plain = latin1.parent / "clip.mp4"
    writer = cv2.VideoWriter(str(plain), cv2.VideoWriter_fourcc(*"mp4v"), 5, (32, 32))
    for _ in range(3):
        writer.write(np.zeros((32, 32, 3), np.uint8))
    writer.release()
    (latin1 / "clip.mp4").write_bytes(plain.read_bytes())
    for kind in ("depth", "video"):
        done = dpc("prepare", kind, latin1 / "clip.mp4", "-o", latin1.parent / "c.h5")
        assert done.returncode == 3 and b"can't open it; rename it" in done.stderr


def test_weights_there_are_read_and_urdfs_end_with_a_sentence(latin1):
    save_weights(latin1 / "m.safetensors", {"w": torch.ones(2)}, {"format": "f"})
    assert load_weights(latin1 / "m.safetensors", "f", "dpc")[0]["w"].tolist() == [1, 1]
    (latin1 / "robot.urdf").write_text('<robot name="r"><link name="a"/></robot>')
    with pytest.raises(DataError, match="yourdfpy can't open it; rename it"):
        read_skeleton(latin1 / "robot.urdf")


def test_names_in_a_file_become_different_names_of_files():
    """Also where a number that tells two apart is the name of a third, and where capitals make no difference."""
    names = ["a_b_1", "a/b", "a:b", "..", "Walk", "walk", "𠀀" * 300, ""]
    found = file_names(names)
    assert found[:4] == ["a_b_1", "a_b_1_", "a_b_2", "object_3"]
    assert len({name.lower() for name in found}) == len(names)
    assert all(name and Path(name).name == name and name.strip(".") and len(os.fsencode(name)) < 250 for name in found)


def test_a_clip_whose_name_is_not_utf8_becomes_a_file_of_views(latin1, tmp_path):
    """Its folder names the object; HDF5 holds no byte of another encoding."""
    for frame in range(2):
        picture = np.zeros((24, 24, 4), np.uint8)
        picture[6:18, 4 + frame : 16 + frame] = 255
        Image.fromarray(picture).save(latin1 / f"{frame}.png")
    assert exit_code("prepare", "video", latin1, "-o", tmp_path / "v.h5", "--size", "32") == 0
    with ViewsReader(tmp_path / "v.h5") as reader:
        assert reader.header.name == r"caf\xe9"

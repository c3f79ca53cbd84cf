"""Recordings that the SDK of RealSense writes as .db3: what it tells in texts beside its messages counts."""

from __future__ import annotations

import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.prepare.actions.depth import DepthVideos
from dpcli.prepare.recordings.depth import read_recorded_depth
from tests.support.recording_helpers import START, Messages, write_recording

pytest.importorskip("rosbags")
SENSOR = "/device_0/sensor_0"


def record(tmp_path, model: str, lens: tuple[float, ...]):
    make = Messages("sqlite3")
    depth = np.full((12, 16), 800, np.uint16)

    def text(words):
        return make.make("std_msgs/msg/String", data=words)

    content = [
        (f"{SENSOR}/Depth_0/camera_info", START, text(f"width=16;height=12;fx=500;model={model};coeffs=0,0,0,0,0")),
        (f"{SENSOR}/option/Depth_Units/value", START, text("0.000250")),
        (f"{SENSOR}/Depth_0/image/data/compressedDepth", START + 1, make.compressed(depth)),
        (
            f"{SENSOR}/Depth_0/image/camera_info",
            START + 1,
            make.camera([500, 0, 8, 0, 510, 6, 0, 0, 1], 16, 12, d=lens),
        ),
    ]
    bag = write_recording(tmp_path / "run", "sqlite3", make, content)
    (file,) = bag.glob("*.db3")
    return file


@pytest.mark.parametrize(("model", "lens"), [("Brown Conrady", (0.1, 0, 0, 0, 0)), ("Inverse Brown Conrady", (0,) * 5)])
def test_the_lens_and_the_units_that_texts_tell(tmp_path, model, lens):
    read, camera, units = read_recorded_depth(record(tmp_path, model, lens))
    assert units == 4000 and (read.frames[0] == 800).all()
    assert getattr(camera.intrinsics, "distortion", ()) == (lens if any(lens) else ())


def test_a_lens_of_a_model_that_is_called_plumb_bob_and_is_none_is_named(tmp_path):
    with pytest.raises(DataError, match="its lens is of model inverse_brown_conrady with 5 coefficients"):
        read_recorded_depth(record(tmp_path, "Inverse Brown Conrady", (0.1, 0, 0, 0, 0)))


def test_a_camera_that_is_given_stands_in_for_one_that_is_refused(tmp_path):
    reader = DepthVideos(inputs=(record(tmp_path, "Inverse Brown Conrady", (0.1, 0, 0, 0, 0)),), fov=90.0)
    points = reader.read(reader.items()[0], np.random.default_rng(0)).sequence.points
    np.testing.assert_allclose(points[0], [-7.5 / 8 * 0.2, -5.5 / 8 * 0.2, 0.2], rtol=1e-6)

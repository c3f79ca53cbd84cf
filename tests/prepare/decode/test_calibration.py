"""Calibration files of every tool: what they declare is used, or refused by its name."""

from __future__ import annotations

import json
import re

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dpcli.errors import DataError
from dpcli.prepare.decode.calibration import read_calibration
from dpcli.prepare.decode.pinhole_camera import Calibration, Intrinsics, LensIntrinsics, pixel_rays

FX, FY, CX, CY = 610.0, 609.5, 325.25, 237.75
CAMERA = Intrinsics(FX, FY, CX, CY)
ROWS = [FX, 0, CX, 0, FY, CY, 0, 0, 1]
COLUMNS = [FX, 0, 0, 0, FY, 0, CX, CY, 1]
NESTED = [[FX, 0, CX], [0, FY, CY], [0, 0, 1]]
OPENCV = f"""%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: {ROWS}
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ 0., 0., 0., 0., 0. ]
"""
ROS = f"""image_width: 640
image_height: 480
camera_name: depth
camera_matrix:
  rows: 3
  cols: 3
  data: {ROWS}
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0, 0, 0, 0, 0]
"""
KALIBR = f"cam0:\n  camera_model: pinhole\n  intrinsics: [{FX}, {FY}, {CX}, {CY}]\n  resolution: [640, 480]\n"
SLAM = f"""%YAML:1.0
Camera.type: "PinHole"
Camera.fx: {FX}
Camera.fy: {FY}
Camera.cx: {CX}
Camera.cy: {CY}
Camera.k1: 0.0
Camera.k2: 0.0
Camera.width: 640
Camera.height: 480
Camera.bf: 40.0
"""
SCANNET = f"fx_depth = {FX}\nfy_depth = {FY}\nmx_depth = {CX}\nmy_depth = {CY}\ndepthWidth = 640\ndepthHeight = 480\n"
FOUR = f"{FX} 0 {CX} 0\n0 {FY} {CY} 0\n0 0 1 0\n0 0 0 1\n"
COLMAP = f"# Camera list\n1 PINHOLE 640 480 {FX} {FY} {CX + 0.5} {CY + 0.5}\n"
PLAIN = {"fx": FX, "fy": FY, "cx": CX, "cy": CY}
REALSENSE = {"width": 640, "height": 480, "ppx": CX, "ppy": CY, "fx": FX, "fy": FY, "model": "distortion.brown_conrady"}
REALSENSE["coeffs"] = [0, 0, 0, 0, 0]


FORMS = [
    ("k.json", PLAIN, (0, 0)),
    ("k.json", {"intrinsic_matrix": COLUMNS, "width": 640, "height": 480}, (640, 480)),
    ("k.json", {"intrinsic_matrix": ROWS}, (0, 0)),
    ("a.pincam", f"640 480 {FX} {FY} {CX} {CY}\n", (640, 480)),
    ("k.toml", f"fx = {FX}\nfy = {FY}\ncx = {CX}\ncy = {CY}\nwidth = 640\nheight = 480\n", (640, 480)),
    ("k.csv", f"fx,fy,cx,cy\n{FX},{FY},{CX},{CY}\n", (0, 0)),
    ("k.json", {"camera_matrix": NESTED, "dist_coeffs": [[0, 0, 0, 0, 0]]}, (0, 0)),
    ("k.json", {"K": COLUMNS, "w": 640, "h": 480}, (640, 480)),
    ("k.json", REALSENSE, (640, 480)),
    ("k.json", {"depth": REALSENSE, "color": {**REALSENSE, "fx": 900}}, (640, 480)),
    ("k.json", {"camera": {**PLAIN, "w": 640, "h": 480}}, (640, 480)),
    ("k.json", {"width": 640, "height": 480, "intrinsics": PLAIN}, (640, 480)),
    ("k.json", {"fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY, "w": 640, "h": 480, "frames": [{"a": 1}]}, (640, 480)),
    ("k.json", {**{k: str(v) for k, v in PLAIN.items()}, "width": "640", "height": "480"}, (640, 480)),
    (
        "k.json",
        {
            "parameters": [{"extrinsic": [1], "intrinsic": {"width": 640, "height": 480, "intrinsic_matrix": COLUMNS}}]
            * 2
        },
        (640, 480),
    ),
    (
        "k.json",
        {"cameraData": [[0, {"intrinsicMatrix": NESTED, "width": 640, "height": 480, "distortionCoeff": [0] * 14}]]},
        (640, 480),
    ),
    ("k.json", {str(t): {"cam_K": ROWS, "cam_t_w2c": [t]} for t in range(3)}, (0, 0)),
    ("k.yaml", ROS, (640, 480)),
    ("k.yml", OPENCV, (640, 480)),
    ("k.yaml", KALIBR, (640, 480)),
    ("k.yaml", SLAM, (640, 480)),
    ("k.yaml", SLAM.replace("Camera.f", "Camera1.f").replace("Camera.c", "Camera1.c"), (640, 480)),
    ("k.yaml", f"K: {ROWS}\nD: [0, 0, 0, 0, 0]\nwidth: 640\nheight: 480\n", (640, 480)),
    ("scene0000_00.txt", SCANNET, (640, 480)),
    ("intrinsic_depth.txt", FOUR, (0, 0)),
    ("k.txt", "[[610.0, 0, 325.25],\n [0, 609.5, 237.75],\n [0, 0, 1]]", (0, 0)),
    ("k.txt", f"{FX} {FY} {CX} {CY}", (0, 0)),
    ("cameras.txt", COLMAP, (640, 480)),
]


@pytest.mark.parametrize(("name", "content", "size"), FORMS)
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_every_form_of_one_camera(tmp_path, name, content, size, mark):
    path = tmp_path / name
    path.write_text(mark + (content if isinstance(content, str) else json.dumps(content)), encoding="utf-8")
    found = read_calibration(path)
    assert found.intrinsics == CAMERA and (found.width, found.height) == size and found.depth_scale is None


def test_matrices_of_numpy_and_opencv(tmp_path):
    for matrix in (np.array(NESTED), np.array(NESTED).T):
        np.save(tmp_path / "k.npy", matrix)
        assert read_calibration(tmp_path / "k.npy").intrinsics == CAMERA
    storage = cv2.FileStorage(str(tmp_path / "k.yml"), cv2.FILE_STORAGE_WRITE)
    storage.write("camera_matrix", np.array(NESTED))
    storage.release()
    assert read_calibration(tmp_path / "k.yml").intrinsics == CAMERA


@pytest.mark.parametrize(
    ("key", "value", "scale"),
    [
        ("depth_scale", 4000.0, 4000),
        ("depth_scale", 0.00025, 4000),
        ("depth_units", 0.001, 1000),
        ("depth_scale_in_mm", 0.1, 10000),
        ("scale", 6553.5, 6553.5),
        ("depth_unit", "mm", 1000),
        ("depthScaleFactor", 10000, 10000),
        ("Depth Scale", 0.0001, 10000),
        ("depthUnitsMeters", 0.0001, 10000),
        ("DepthScale(mm)", 0.1, 10000),
        ("depth_units_per_meter", 10000, 10000),
        ("depth_to_m", 0.0001, 10000),
    ],
)
def test_the_depth_scale_in_units_per_meter_or_meters_per_unit(tmp_path, key, value, scale):
    (tmp_path / "k.json").write_text(json.dumps({"camera": {**PLAIN, key: value}}))
    found = read_calibration(tmp_path / "k.json")
    assert found.depth_scale == pytest.approx(scale)
    found.require_clear_scale()


@pytest.mark.parametrize(
    "size",
    [
        {"imageWidth": 640, "imageHeight": 480},
        {"cols": 640, "rows": 480},
        {"resolution": "640x480"},
        {"image_size": [640, 480]},
        {"ImageSize": [480, 640]},  # rows first, as MATLAB has it
        {"image_dimensions": {"width": 640, "height": 480}},
        {"color_width": 640, "color_height": 480},
        {"color_width": 1280, "color_height": 960, "depth_width": 640, "depth_height": 480},
        {"resolution_width": 640, "resolution_height": 480, "max_width": 9},
    ],
)
def test_every_name_of_the_size_of_pictures(tmp_path, size):
    (tmp_path / "k.json").write_text(json.dumps({**PLAIN, **size}))
    found = read_calibration(tmp_path / "k.json")
    assert (found.width, found.height) == (640, 480) and found.intrinsics == CAMERA


@pytest.mark.parametrize(
    "text",
    [
        f"# fx cx fy cy\n{FX} {CX} {FY} {CY}\n",
        f"fx cx fy cy\n{FX} {CX} {FY} {CY}\n",
        f"#fx,fy,cx,cy,width,height\n{FX},{FY},{CX},{CY},640,480\n",
        f"fx = {FX};\nfy = {FY};\ncx = {CX};\ncy = {CY};\n",
    ],
)
def test_names_tell_the_order_of_numbers(tmp_path, text):
    (tmp_path / "k.txt").write_text(text)
    assert read_calibration(tmp_path / "k.txt").intrinsics == CAMERA
    (tmp_path / "k.txt").write_text(f"{FX} {CX} {FY} {CY}\n")
    with pytest.raises(DataError, match="focal lengths 610 and 325.25; expected fx fy cx cy, in this order"):
        read_calibration(tmp_path / "k.txt")


@pytest.mark.parametrize("factor", [0.5, 2])
def test_a_principal_point_of_another_size_is_refused(factor):
    camera = Intrinsics(300, 300, 320 * factor - 0.5, 240 * factor - 0.5)
    with pytest.raises(DataError, match="seems to be of another size than these 640x480 pictures"):
        Calibration(camera).of_pictures(640, 480)
    assert Calibration(camera, 640, 480).of_pictures(640, 480) == camera  # such as of a cut-out
    assert Calibration(Intrinsics(300, 300, 500, 240)).of_pictures(640, 480)


@pytest.mark.parametrize("focal", [3.6, 1e6])
def test_focal_lengths_that_are_no_pixels_are_refused(focal):
    with pytest.raises(DataError, match="expected pixels, not millimeters"):
        Calibration(Intrinsics(focal, focal, 320, 240), 640, 480).of_pictures(640, 480)


def test_what_only_sounds_like_a_depth_scale_is_none_and_two_that_differ_are_refused(tmp_path):
    (tmp_path / "k.json").write_text(json.dumps({**PLAIN, "depth_max": 4, "depth_to_color": [1], "unit": 2}))
    assert read_calibration(tmp_path / "k.json").depth_scale is None
    (tmp_path / "k.json").write_text(json.dumps({**PLAIN, "depth_scale": 1000, "depthUnits": 0.0001}))
    with pytest.raises(DataError, match="depth_scale and depthunits give different depth scales .1000, 10000 raw"):
        read_calibration(tmp_path / "k.json")


@pytest.mark.parametrize(
    "content",
    [
        {"depthIntrinsic": PLAIN, "depthDistortion": {"k1": 0.2, "k2": 0.0}, "rgbDistortion": {"k1": 0.9}},
        {"intrinsics": PLAIN, "distortion": {"model": "plumb_bob", "k1": 0.2}},
        {"depth": {"intrinsics": PLAIN, "distortion_coefficients": [0.2, 0, 0, 0, 0]}},
        {"projection_parameters": PLAIN, "distortion_parameters": {"k1": 0.2, "k2": 0.0}},  # of VINS
        {"intrinsics": PLAIN, "dist": {"k1": 0.2}},
        {"intrinsics": {**PLAIN, "distortion": {"model": "plumb_bob", "coefficients": [0.2, 0, 0, 0, 0]}}},
        {"distortion_coefficients": [9, 0, 0, 0, 0], "depth": {**PLAIN, "coeffs": [0.2, 0, 0, 0, 0]}},
    ],
)
def test_the_lens_may_stand_beside_the_camera(tmp_path, content):
    (tmp_path / "k.json").write_text(json.dumps(content))
    found = read_calibration(tmp_path / "k.json").intrinsics
    assert isinstance(found, LensIntrinsics) and found.distortion[0] == 0.2
    (tmp_path / "k.json").write_text(json.dumps(content).replace("plumb_bob", "kannala_brandt4"))
    if "model" in str(content):
        with pytest.raises(DataError, match="model kannala_brandt4"):
            read_calibration(tmp_path / "k.json")


def test_a_lens_that_a_text_names_and_numbers_of_a_german_table(tmp_path):
    lines = "PPX: 325\nPPY: 237\nFx: 600\nFy: 601\nDistortion: {}\nCoeffs: 0.1 0 0 0 0\n"
    (tmp_path / "k.txt").write_text(lines.format("Brown Conrady"))
    assert read_calibration(tmp_path / "k.txt").intrinsics.distortion[0] == 0.1
    (tmp_path / "k.txt").write_text(lines.format("Inverse Brown Conrady"))
    with pytest.raises(DataError, match="model inverse_brown_conrady"):
        read_calibration(tmp_path / "k.txt")
    (tmp_path / "k.csv").write_text("fx;fy;cx;cy\n" + ";".join(str(PLAIN[k]) for k in PLAIN).replace(".", ","))
    assert read_calibration(tmp_path / "k.csv").intrinsics == CAMERA


def test_a_depth_scale_that_may_mean_two_things_is_refused_where_it_counts(tmp_path):
    (tmp_path / "k.json").write_text(json.dumps({**PLAIN, "depth_scale": 0.1}))
    with pytest.raises(DataError, match="10 raw units per meter, which is hardly meant.*--depth-scale"):
        read_calibration(tmp_path / "k.json").require_clear_scale()


@given(st.integers(1, 8), st.integers(2, 40), st.integers(2, 40))
@settings(max_examples=30, derandomize=True)
def test_a_calibration_of_larger_pictures_is_scaled(factor, width, height):
    camera = Intrinsics(50.0 * factor, 60.0 * factor, width * factor / 2 - 0.5, 1.0)
    large = Calibration(camera, width * factor, height * factor)
    small = large.of_pictures(width, height)
    assert small.fx == pytest.approx(50) and small.fy == pytest.approx(60)
    assert small.cx == pytest.approx(width / 2 - 0.5) and small.cy == pytest.approx(1.5 / factor - 0.5)


def test_a_scene_of_bop_multiplies_raw_depths_to_millimeters(tmp_path):
    frames = {str(t): {"cam_K": ROWS, "depth_scale": 0.1} for t in range(2)}
    (tmp_path / "scene_camera.json").write_text(json.dumps(frames))
    assert read_calibration(tmp_path / "scene_camera.json").depth_scale == 10_000
    frames["1"] = {"cam_K": [700.0, *ROWS[1:]], "depth_scale": 0.1}
    (tmp_path / "scene_camera.json").write_text(json.dumps(frames))
    with pytest.raises(DataError, match=r"holds several cameras \(0, 1\)"):
        read_calibration(tmp_path / "scene_camera.json")


def test_another_shape_and_a_center_outside_are_refused(tmp_path):
    (tmp_path / "k.json").write_text(json.dumps(REALSENSE))
    with pytest.raises(DataError, match="is of 640x480 pictures, these have 640x360, which is another shape"):
        read_calibration(tmp_path / "k.json").of_pictures(640, 360)
    (tmp_path / "k.json").write_text(json.dumps(PLAIN))
    with pytest.raises(DataError, match=r"principal point \(325.25, 237.75\) lies outside of these 320x240 pictures"):
        read_calibration(tmp_path / "k.json").of_pictures(320, 240)


def test_the_camera_of_pictures_that_were_turned_is_refused():
    """As where a phone's depth was turned upright: 4:3 pictures hold the principal point of either."""
    wide = Calibration(Intrinsics(610.0, 612.0, 322.0, 236.0), source="k.json")
    with pytest.raises(DataError, match=r"turned by a quarter into these 480x640 ones.*fx and fy exchanged"):
        wide.of_pictures(480, 640)
    assert wide.of_pictures(640, 480) == wide.intrinsics
    off = Intrinsics(610.0, 612.0, 380.0, 120.0)  # of a picture cut below
    assert Calibration(off).of_pictures(640, 480) == off


def test_fractions_of_a_picture_are_no_pixels():
    with pytest.raises(DataError, match="seems to be a fraction of the picture; expected pixels of these 640x480"):
        Calibration(Intrinsics(0.9, 1.2, 0.5, 0.5), source="k.json").of_pictures(640, 480)


def test_a_lens_that_is_called_no_fisheye_is_one_of_brown(tmp_path):
    (tmp_path / "k.yml").write_text(OPENCV.replace("0., 0., 0., 0., 0.", "0.1, 0., 0., 0., 0.") + "fisheye_model: 0\n")
    assert read_calibration(tmp_path / "k.yml").intrinsics == LensIntrinsics(FX, FY, CX, CY, (0.1, 0, 0, 0, 0))


def test_the_depth_factor_and_the_lens_that_a_slam_declares(tmp_path):
    (tmp_path / "k.yaml").write_text(SLAM + "RGBD.DepthMapFactor: 5000.0\n")
    assert read_calibration(tmp_path / "k.yaml").depth_scale == 5000
    (tmp_path / "k.yaml").write_text(SLAM.replace("PinHole", "KannalaBrandt8").replace("k1: 0.0", "k1: 0.1"))
    with pytest.raises(DataError, match="its lens is of model KannalaBrandt8"):
        read_calibration(tmp_path / "k.yaml")


OMNI = "  camera_model: omni\n  distortion_model: radtan\n  distortion_coeffs: [0, 0, 0, 0]\n"
MEI = "model_type: MEI\nmirror_parameters: {xi: 1.9}\nprojection_parameters: {gamma1: 670, gamma2: 669, u0: 378, v0: 280}\n"
KB4 = {"camera_type": "kb4", "k1": 0.007, "k2": -0.001, "k3": 0.0004, "k4": -0.0001}


@pytest.mark.parametrize(
    ("name", "content", "what"),
    [
        ("k.yml", OPENCV + "xi: 1.2\n", "xi 1.2"),  # OpenCV's omnidirectional and fisheye calibrations
        ("k.yml", OPENCV + "xi: !!opencv-matrix\n   rows: 1\n   cols: 1\n   dt: d\n   data: [ 1.2 ]\n", r"xi \[1.2\]"),
        ("k.yml", OPENCV.replace("0., 0., 0., 0., 0.", "0.1, 0., 0., 0.1") + "fisheye_model: 1\n", "fisheye_model 1"),
        ("c.yaml", f"cam0:\n{OMNI}  intrinsics: [1.2, {FX}, {FY}, {CX}, {CY}]\n", "model omni"),  # Kalibr
        (
            "c.yaml",
            KALIBR + "  distortion_model: equidistant\n  distortion_coeffs: [0, 0, 0, 0]\n",
            "model equidistant",
        ),
        ("c.yaml", MEI, "model MEI"),  # CamOdoCal
        ("k.json", {"intrinsics": {**PLAIN, **KB4}}, "model kb4"),  # Basalt
        ("k.json", {**PLAIN, "xi": -0.24, "alpha": 0.57}, "xi -0.24"),
        (
            "transforms.json",
            {"fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY, "k1": 0.1, "is_fisheye": True},
            "is_fisheye True",
        ),
    ],
)
def test_lenses_of_no_pinhole_are_refused_by_name(tmp_path, name, content, what):
    (tmp_path / name).write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(DataError, match=f"its lens is of {what}, of a fisheye or the like.*undistort"):
        read_calibration(tmp_path / name)


@pytest.mark.parametrize(
    "said",
    [
        {"coeffs": "0.1 -0.05 0.001 -0.002 0.01"},
        {"distortion": {"k1": 0.1, "k2": -0.05, "p1": 0.001, "p2": -0.002, "k3": 0.01}},
        {"k1": "0.1", "k2": -0.05, "p1": 0.001, "p2": -0.002, "k3": 0.01},
        {"RadialDistortion": [0.1, -0.05, 0.01], "TangentialDistortion": [0.001, -0.002]},
    ],
)
def test_a_lens_is_read_however_it_is_written(tmp_path, said):
    (tmp_path / "k.json").write_text(json.dumps({**PLAIN, **said}))
    assert read_calibration(tmp_path / "k.json").intrinsics.distortion == (0.1, -0.05, 0.001, -0.002, 0.01)


@pytest.mark.parametrize("binning", [0, 2])
def test_what_ros_cuts_out_of_a_picture_is_taken_off(tmp_path, binning):
    roi = {"x_offset": 100, "y_offset": 40, "width": 320, "height": 240, "do_rectify": False}
    told = {"width": 640, "height": 480, "K": ROWS, "D": [0] * 5, "binning_x": binning, "binning_y": binning}
    (tmp_path / "k.yaml").write_text(json.dumps({**told, "roi": roi}))
    found = read_calibration(tmp_path / "k.yaml")
    assert found.of_pictures(320, 240) == Intrinsics(FX, FY, CX - 100, CY - 40)
    assert found.of_pictures(160, 120).fx == FX / 2
    (tmp_path / "k.yaml").write_text(json.dumps({**told, "roi": dict.fromkeys(roi, 0)}))
    assert read_calibration(tmp_path / "k.yaml").of_pictures(640, 480) == CAMERA


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "latin-1"])
@pytest.mark.parametrize("text", [f"# für Räume\nK: {ROWS}\n", f"%YAML:1.0\n# für Räume\n---\nK: {ROWS}\n"])
def test_calibrations_in_other_encodings(tmp_path, encoding, text):
    (tmp_path / "k.yaml").write_bytes(text.encode(encoding))
    assert read_calibration(tmp_path / "k.yaml").intrinsics == CAMERA


def test_lists_as_opencv_5_writes_them(tmp_path):
    more = "imageSize: !!opencv-nd-matrix\n   sizes: [ 2 ]\n   dt: i\n   data: [ 640, 480 ]\n"
    (tmp_path / "k.yml").write_text(OPENCV.replace("image_width: 640\nimage_height: 480\n", more))
    found = read_calibration(tmp_path / "k.yml")
    assert (found.intrinsics, found.width, found.height) == (CAMERA, 640, 480)


def test_the_info_of_scannets_recordings(tmp_path):
    matrices = f"m_calibrationColorIntrinsic = 900 {FOUR[5:]}".replace("\n", " ")
    text = f"m_depthWidth = 640\nm_depthHeight = 480\nm_depthShift = 1000\n{matrices}\n"
    (tmp_path / "_info.txt").write_text(text + f"m_calibrationDepthIntrinsic = {FOUR}".replace("\n", " ") + "\n")
    found = read_calibration(tmp_path / "_info.txt")
    assert (found.intrinsics, found.width, found.depth_scale) == (CAMERA, 640, 1000)


def test_a_lens_is_straightened(tmp_path):
    bent = (0.1, -0.05, 0.001, -0.002, 0.01)
    (tmp_path / "k.json").write_text(json.dumps({**REALSENSE, "coeffs": bent}))
    camera = read_calibration(tmp_path / "k.json").intrinsics
    assert isinstance(camera, LensIntrinsics) and camera.distortion == bent
    rays = pixel_rays(480, 640, camera).astype(np.float64)[::997]
    matrix = np.array(NESTED)
    pixels = cv2.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), matrix, np.array(bent))[0].reshape(-1, 2)
    places = np.arange(480 * 640)[::997]
    np.testing.assert_allclose(pixels, np.stack([places % 640, places // 640], axis=1), atol=2e-3)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("k.json", "{", "is not JSON"),
        ("k.json", "[]", "expected"),
        ("k.json", '{"fx": 1}', "expected"),
        ("k.json", '{"fx": "a", "fy": 2, "cx": 3, "cy": 4}', "expected"),
        ("k.json", '{"intrinsic_matrix": [1]}', "its matrix is not of 3x3"),
        ("k.json", json.dumps({**PLAIN, "fx": -1}), "positive focal lengths"),
        ("k.json", json.dumps({"K": [1, 0.5, 3, 0, 1, 3, 0, 0, 1]}), "a skew of 0.5"),
        ("k.json", json.dumps({**PLAIN, "skew": 2}), "a skew of 2"),
        ("k.json", json.dumps({**PLAIN, "distortion": {"k1": 0, "xi": 0.9}}), "a coefficient xi"),
        ("k.json", json.dumps({"a": PLAIN, "b": {**PLAIN, "fx": 2}}), r"holds several cameras \(a, b\)"),
        ("k.json", json.dumps({**REALSENSE, "model": "kannala_brandt4", "coeffs": [0.1, 0, 0, 0]}), "kannala_brandt4"),
        (
            "k.json",
            json.dumps({**REALSENSE, "model": "distortion.inverse_brown_conrady", "coeffs": [0.1] * 5}),
            "inverse_brown",
        ),
        ("k.json", json.dumps({"CalibrationInformation": {}}), "raw calibration of an Azure Kinect"),
        ("k.json", json.dumps({**PLAIN, "depth_scale": 0}), "its depth scale is 0"),
        ("cameras.txt", "1 OPENCV_FISHEYE 640 480 1 2 3 4 5 6 7 8\n", "camera model OPENCV_FISHEYE"),
        ("cameras.txt", COLMAP + "2 PINHOLE 640 480 1 2 3 4\n", "holds 2 different cameras"),
        ("k.yaml", "a: [1,", "is not YAML"),
        ("k.ini", "[vga]\nfx=1\nfy=1\ncx=1\ncy=1\n[hd]\nfx=2\nfy=2\ncx=2\ncy=2\n", "says fx twice, with different"),
        (
            "k.yaml",
            "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9 if n else ['1'] * 9)}]\n" for n in range(9)),
            "places",
        ),
        ("k.json", '{"fx":' + "[" * 600 + "]" * 600 + "}", "nested more than 100 deep"),
    ],
)
def test_what_cannot_be_used_is_named(tmp_path, name, content, message):
    (tmp_path / name).write_text(content)
    with pytest.raises(DataError, match=f"{name}: .*{message}"):
        read_calibration(tmp_path / name)


@pytest.mark.parametrize(("name", "content", "size"), FORMS)
def test_numbers_that_no_camera_has_are_refused_or_not_used(tmp_path, name, content, size):
    text = content if isinstance(content, str) else json.dumps(content)
    for place in re.finditer(r"(?<![\w.%])\d+\.?\d*", text):
        for odd in ("1e999", "-1e999", "9" * 400, ".nan" if name.endswith(("yaml", "yml")) else "NaN", "1e200"):
            (tmp_path / name).write_text(text[: place.start()] + odd + text[place.end() :])
            try:
                found = read_calibration(tmp_path / name)
            except DataError as error:
                assert str(tmp_path / name) in str(error)
            else:
                lens = getattr(found.intrinsics, "distortion", ())
                camera = (found.intrinsics.fx, found.intrinsics.fy, found.intrinsics.cx, found.intrinsics.cy)
                assert np.isfinite([*camera, *lens, found.depth_scale or 1.0]).all() and found.width <= 1e6


def test_a_file_that_is_missing_or_no_text(tmp_path):
    (tmp_path / "k.json").write_bytes(bytes(range(256)))
    for name, message in (("none.json", "cannot be read"), ("k.json", "is not text")):
        with pytest.raises(DataError, match=message):
            read_calibration(tmp_path / name)


MATLAB = {"ImageSize": [480, 640], "RadialDistortion": [0, 0], "TangentialDistortion": [0, 0], "Skew": 0}
OF_ONE = [[FX, 0, CX + 1], [0, FY, CY + 1], [0, 0, 1]]  # as MATLAB counts pixels


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("c.json", json.dumps(MATLAB | {"K": OF_ONE})),
        ("c.json", json.dumps(MATLAB | {"IntrinsicMatrix": np.transpose(OF_ONE).tolist()})),
        ("c.json", json.dumps(MATLAB | {"FocalLength": [FX, FY], "PrincipalPoint": [CX + 1, CY + 1]})),
        (
            "Calib_Results.m",
            f"% of Bouguet's toolbox\nfc = [ {FX} ; {FY} ];\ncc = [ {CX} ; {CY} ];\nalpha_c = 0.0;\n"
            "kc = [ 0 ; 0 ; 0 ; 0 ; 0 ];\nfc_error = [ 1 ; 1 ];\nnx = 640;\nny = 480;\n",
        ),
        (
            "ost.ini",
            f"# oST version 5.0 parameters\n\n[image]\n\nwidth\n640\n\nheight\n480\n\n[narrow_stereo]\n\ncamera matrix\n"
            f"{FX} 0.0 {CX}\n0.0 {FY} {CY}\n0.0 0.0 1.0\n\ndistortion\n0.0 0.0 0.0 0.0 0.0\n",
        ),
    ],
)
def test_calibrations_of_matlab_and_of_ros_as_ini(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    found = read_calibration(tmp_path / name)
    assert (found.width, found.height) == (640, 480)
    for side in ("fx", "fy", "cx", "cy"):
        assert getattr(found.intrinsics, side) == pytest.approx(getattr(CAMERA, side))


@pytest.mark.parametrize(
    ("matrix", "lens"),
    [
        *((name, "distortion_coefficients") for name in ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K")),
        ("cameraMatrix", "distortionCoefficients"),  # of iai_kinect2
        *(("K", name) for name in ("dist", "dist_coefs", "distCoeff", "distortion_params", "kc", "lens_distortion")),
    ],
)
@pytest.mark.parametrize("suffix", ["xml", "yml", "json"])
def test_every_form_of_opencvs_storage_tells_the_same(tmp_path, matrix, lens, suffix):
    path = tmp_path / f"c.{suffix}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Tue Mar  5 14:30:00 2024")
    storage.write(matrix, np.array(NESTED))
    storage.write(lens, np.array([[0.1, -0.2, 0.001, 0.002, 0.03]]))
    for side, pixels in (("image_width", 640), ("image_height", 480)):
        storage.write(side, pixels)
    storage.release()
    found = read_calibration(path)
    assert (found.intrinsics.fx, found.intrinsics.cy, found.width, found.height) == (FX, CY, 640, 480)
    assert found.intrinsics.distortion == pytest.approx((0.1, -0.2, 0.001, 0.002, 0.03))


@pytest.mark.parametrize("suffix", ["xml", "yml", "json"])
def test_the_depth_camera_beside_another_in_opencvs_files(tmp_path, suffix):
    storage = cv2.FileStorage(str(tmp_path / f"c.{suffix}"), cv2.FILE_STORAGE_WRITE)
    for name, scale in (("depth", 1.0), ("color", 2.0)):
        storage.startWriteStruct(name, cv2.FileNode_MAP)
        storage.write("camera_matrix", scale * np.array(NESTED))
        storage.write("distortion_coefficients", np.array([0.1, -0.2, 0.001, 0.002, 0.03]))
        storage.endWriteStruct()
    storage.release()
    found = read_calibration(tmp_path / f"c.{suffix}").intrinsics
    assert found == LensIntrinsics(FX, FY, CX, CY, (0.1, -0.2, 0.001, 0.002, 0.03))


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"])
def test_lenses_of_colmap_send_rays_back_to_their_pixels(tmp_path, model):
    """What COLMAP does with a ray: x (1 + k1 r^2 + ...) / (1 + k4 r^2 + ...) + 2 p1 x y + p2 (r^2 + 2 x^2), and so y."""
    given = {"SIMPLE_RADIAL": 1, "RADIAL": 2, "OPENCV": 4, "FULL_OPENCV": 8}[model]
    lens = [0.08, -0.05, 0.002, -0.001, 0.02, 0.01, -0.02, 0.004][:given]
    focal = [FX] if given < 4 else [FX, FY]
    words = [1, model, 640, 480, *focal, CX + 0.5, CY + 0.5, *lens]
    (tmp_path / "cameras.txt").write_text("# COLMAP\n" + " ".join(map(str, words)) + "\n")
    rays = pixel_rays(480, 640, read_calibration(tmp_path / "cameras.txt").intrinsics).astype(np.float64)
    x, y = rays[:, 0], rays[:, 1]
    k1, k2, p1, p2, k3, k4, k5, k6 = [*lens, *[0.0] * 8][:8]
    r2 = x**2 + y**2
    factor = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    u = FX * (x * factor + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)) + CX
    v = focal[-1] * (y * factor + 2 * p2 * x * y + p1 * (r2 + 2 * y**2)) + CY
    rows, columns = np.divmod(np.arange(480 * 640), 640)
    np.testing.assert_allclose(np.stack([u, v]), np.stack([columns, rows]), atol=1e-3)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("<opencv_storage><a></opencv_storage>", "is not XML"),
        ("<calibration><fx>1</fx></calibration>", "expected <opencv_storage>"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><opencv_storage>&b;</opencv_storage>', "declares entities"),
        ("<opencv_storage>" + "<a>" * 50_000 + "</a>" * 50_000 + "</opencv_storage>", "expected"),
        ("<opencv_storage><K><data>a b c</data></K></opencv_storage>", "matrix"),
    ],
)
def test_other_xml_is_refused_by_what_it_is(tmp_path, text, why):
    (tmp_path / "c.xml").write_text(text)
    with pytest.raises(DataError, match=why):
        read_calibration(tmp_path / "c.xml")


def test_matlabs_own_files_are_refused_with_what_to_do(tmp_path):
    (tmp_path / "c.mat").write_bytes(b"MATLAB 5.0 MAT-file")
    with pytest.raises(DataError, match="writematrix"):
        read_calibration(tmp_path / "c.mat")

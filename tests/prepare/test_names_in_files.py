"""Names that stand in files: whoever reads them, none leads out of the folder, and what lies outside isn't opened on the way."""

from __future__ import annotations

import io
import json
import os
import re
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest
from imageio_ffmpeg import get_ffmpeg_exe

from dpcli.errors import DataError
from dpcli.path_names import path_inside
from dpcli.prepare.actions.nvgesture import NvGesture
from dpcli.prepare.articulated.ogc import OgcRooms
from dpcli.prepare.articulated.ogc_meshes import load_shape
from dpcli.prepare.articulated.sapien import Sapien
from dpcli.prepare.decode.cloud_files import read_cloud
from dpcli.prepare.decode.depth_files import read_array, read_timed_video, read_video
from dpcli.prepare.decode.npz_frames import read_frames
from dpcli.prepare.decode.video_streams import video_streams
from dpcli.prepare.decode.zip_folders import list_folders, read_files
from dpcli.prepare.meshes.gltf import read_gltf
from dpcli.prepare.recordings.recording import open_recording
from dpcli.prepare.views.transforms_json import transforms_clip
from dpcli.prepare.views.video import VideoOptions
from dpcli.prepare.views.views_check import ArtemisIndex
from dpcli.runtime.clips.video_frames import look_at_video
from dpcli.runtime.torch_files import check_members

_opened: list[str] = []


def _note(event: str, given: tuple) -> None:
    if event == "open" and isinstance(given[0], (str, bytes)):
        _opened.append(os.fsdecode(given[0]))


sys.addaudithook(_note)  # every file that Python opens; what C libraries open is told by what comes out


CUBE = "mtllib {}\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nusemtl m\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"
DAE = """<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="1"/><up_axis>Y_UP</up_axis></asset>
<library_images><image id="i"><init_from>{}</init_from></image></library_images>
<library_effects><effect id="e"><profile_COMMON>
<newparam sid="s"><surface type="2D"><init_from>i</init_from></surface></newparam>
<newparam sid="t"><sampler2D><source>s</source></sampler2D></newparam>
<technique sid="c"><lambert><diffuse><texture texture="t" texcoord="UV"/></diffuse></lambert></technique>
</profile_COMMON></effect></library_effects>
<library_materials><material id="m"><instance_effect url="#e"/></material></library_materials>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="f" count="9">0 0 0 1 0 0 0 1 0</float_array><technique_common>
<accessor source="#f" count="3" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="1" material="m"><input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2</p></triangles>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="w"><node><instance_geometry url="#g"><bind_material><technique_common>
<instance_material symbol="m" target="#m"/></technique_common></bind_material></instance_geometry></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#w"/></scene></COLLADA>"""
NAMES = {
    "up": "../{up}secret",
    "absolute": "{outside}/secret",
    "address": "file://{outside}/secret",
    "address with one slash": "file:{outside}/secret",
    "loud address": "FILE://{outside}/secret",
    "web": "http://127.0.0.1:9/secret",
    "drive": "C:/secret",
    "drive of Windows": "C:\\secret",
    "share of Windows": "\\\\server\\secret",
    "up, of Windows": "..\\{up}secret",
    "down and up": "x/../../{up}secret",
    "NUL": "secret\0.png",
    "too long a name": "s" * 300,
    "too long a path": "s/" * 3000 + "secret",
    "white space before": " {outside}/secret",
    "link": "link",
    "link to a folder": "folder_link/secret",
}


def urdf(name: str) -> str:
    shape = f'<link name="a"><visual><geometry><mesh filename="{name}"/></geometry></visual></link>'
    other = '<link name="b"><visual><geometry><box size="1 1 1"/></geometry></visual></link>'
    joint = '<joint name="j" type="continuous"><parent link="a"/><child link="b"/></joint>'
    return f'<robot name="r">{shape}{other}{joint}</robot>'


def gltf(name: str, **more: object) -> str:
    tree = {
        "asset": {"version": "2.0"},
        "buffers": [{"uri": name, "byteLength": 36}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        **more,
    }
    return json.dumps(tree)


def mesh_text(kind: str, name: str) -> bytes:
    if kind == "obj":
        return CUBE.format(name).encode()
    if kind == "gltf":
        return gltf(name).encode()
    if kind == "dae":
        return DAE.format(name).encode()
    if kind == "ply":
        head = "ply\nformat ascii 1.0\ncomment TextureFile {}\nelement vertex 3\nproperty float x\nproperty float y\n"
        return (
            head.format(name)
            + "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
        ).encode()
    raise ValueError(kind)


def read_urdf(raw: Path, name: str) -> Iterable[str]:
    (raw / "r.urdf").write_text(urdf(name))
    return [item.problem for item in Sapien(raw).items()]


def read_mesh_of_urdf(kind: str) -> Callable[[Path, str], None]:
    def read(raw: Path, name: str) -> None:
        (raw / f"m.{kind}").write_bytes(mesh_text(kind, name))
        (raw / "r.urdf").write_text(urdf(f"m.{kind}"))
        sapien = Sapien(raw)
        sapien.read(sapien.items()[0], np.random.default_rng(0))

    return read


def read_mesh_of_room(kind: str) -> Callable[[Path, str], None]:
    def read(raw: Path, name: str) -> None:
        (raw / f"m.{kind}").write_bytes(mesh_text(kind, name))
        load_shape(raw / f"m.{kind}", "y")

    return read


def read_animation(raw: Path, name: str) -> None:
    (raw / "m.gltf").write_text(gltf(name))
    read_gltf(raw / "m.gltf").view_bytes(0)


def read_ogc(raw: Path, name: str) -> Iterable[str]:
    (raw / "data").mkdir()
    for link in ("link", "folder_link"):
        (raw / link).rename(raw / "data" / link)
    (raw / "data" / "train.lst").write_text(name + "\n")
    return [item.problem for item in OgcRooms(raw).items()]


def read_nvgesture(raw: Path, name: str) -> Iterable[str]:
    line = f"path:./{name} depth:sk_depth:1:3 color:sk_color:1:3 label:1"
    line = line.replace("./" + name, name) if re.match(r"[/\\]|\w+:", name) else line
    (raw / "nvgesture_train_correct_cvpr2016_v2.lst").write_text(line + "\n")
    return [item.problem for item in NvGesture(raw).items()]


def read_transforms(key: str) -> Callable[[Path, str], None]:
    def read(raw: Path, name: str) -> None:
        (raw / "a.png").write_bytes(b"")
        frame = {"file_path": "a.png", "time": 0.0, "transform_matrix": np.eye(4).tolist(), key: name}
        (raw / "transforms_train.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": [frame]}))
        transforms_clip(raw, VideoOptions(size=16))

    return read


def read_artemis(raw: Path, name: str) -> Iterable[str]:
    (raw / "img").mkdir()
    for link in ("link", "folder_link"):
        (raw / link).rename(raw / "img" / link)
    (raw / "CamPose.inf").write_text("0 0 1 1 0 0 0 1 0 0 0 0\n")
    (raw / "Intrinsic.inf").write_text("0\n1 0 0\n0 1 0\n0 0 1\n")
    (raw / "sequences").write_text(f"{name} 3\n")
    items = {item.name: item for item in ArtemisIndex(raw).items()}
    return [items[name.strip()].problem]


READERS = {
    "urdf": (read_urdf, True),
    "gltf of a urdf": (read_mesh_of_urdf("gltf"), True),
    "mtllib of an obj of a urdf": (read_mesh_of_urdf("obj"), False),
    "texture of a ply of a urdf": (read_mesh_of_urdf("ply"), False),
    "gltf of a room": (read_mesh_of_room("gltf"), True),
    "picture of a dae of a urdf": (read_mesh_of_urdf("dae"), False),
    "mtllib of an obj of a room": (read_mesh_of_room("obj"), False),
    "texture of a ply of a room": (read_mesh_of_room("ply"), False),
    "buffer of a gltf": (read_animation, True),
    "ogc list": (read_ogc, True),
    "nvgesture list": (read_nvgesture, True),
    "file_path of transforms.json": (read_transforms("file_path"), True),
    "mask_path of transforms.json": (read_transforms("mask_path"), True),
    "sequences of an animal": (read_artemis, True),
}  # name -> how it is read, and whether that needs the file


@pytest.mark.parametrize("kind", NAMES)
@pytest.mark.parametrize("reader", READERS)
def test_no_reader_leaves_the_folder(reader, kind, tmp_path):
    read, needed = READERS[reader]
    outside, raw = tmp_path / "outside", tmp_path / "deep" / "raw"
    raw.mkdir(parents=True)
    outside.mkdir()
    for place in (outside / "secret", tmp_path / "secret", tmp_path / "deep" / "secret"):
        place.write_bytes(np.zeros(9, "f4").tobytes())
    (raw / "link").symlink_to(outside / "secret")
    (raw / "folder_link").symlink_to(outside)
    name = NAMES[kind].format(outside=outside, up="../" * (1 if "ogc" in reader else 0))
    _opened.clear()
    try:
        problems = list(read(raw, name) or [])
    except DataError as error:
        problems = [str(error)]
    assert not [path for path in _opened if Path(path).name == "secret" or os.path.realpath(path).endswith("/secret")]
    assert not needed or (problems and all(problems)), problems
    assert not needed or kind in ("web", "drive") or any("outside" in one or "expected" in one for one in problems), (
        problems
    )


@pytest.mark.parametrize("name", ["a/b.png", "a\\b.png", "./a/b.png", "a/../a/b.png", "odd:name.png", "a b/ü.png"])
def test_names_within_stay(tmp_path, name):
    assert path_inside(tmp_path, tmp_path, name).resolve().is_relative_to(tmp_path.resolve())


@pytest.mark.parametrize("name", ["a\0.png", "\ud800", "a/\udfff", "s" * 256, "s/" * 2048 + "s"])
@pytest.mark.parametrize("inside", [True, False])
def test_what_no_file_is_called_is_said(inside, name, tmp_path):
    with pytest.raises(DataError, match="cannot be a file's"):
        path_inside(tmp_path if inside else None, tmp_path, name)


@pytest.mark.parametrize("name", ["/etc/hostname", "file:///etc/hostname", "../x", "..\\x"])
def test_without_a_root_names_may_lead_anywhere(tmp_path, name):
    assert path_inside(None, tmp_path, name) in (Path("/etc/hostname"), tmp_path / "../x")


@pytest.fixture(scope="module")
def secret_clip(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("outside") / "secret.ts"
    source = ["-f", "lavfi", "-i", "testsrc=size=32x32:rate=5:duration=1", "-c:v", "mpeg2video", "-f", "mpegts"]
    subprocess.run([get_ffmpeg_exe(), "-v", "error", *source, str(path)], check=True)
    return path


@pytest.mark.parametrize("ending", ["avi", "mp4", "mkv", "ts"])
@pytest.mark.parametrize("playlist", ["hls", "concat", "concat list"])
def test_a_playlist_is_no_video(playlist, ending, secret_clip, tmp_path):
    """FFmpeg tells formats by content: a list of other files under a video's name would open them."""
    text = {
        "hls": "#EXTM3U\n#EXT-X-VERSION:3\n#EXT-X-TARGETDURATION:1\n#EXTINF:1.0,\nfile://{0}\n#EXT-X-ENDLIST\n",
        "concat": "ffconcat version 1.0\nfile inside.ts\n",
        "concat list": "ffconcat version 1.0\nfile '{0}'\n",
    }[playlist]
    (tmp_path / "inside.ts").write_bytes(secret_clip.read_bytes())
    path = tmp_path / f"clip.{ending}"
    path.write_text(text.format(secret_clip))
    for read in (look_at_video, read_video, read_timed_video):
        with pytest.raises(DataError):
            read(path)
    assert video_streams(path) == []
    assert look_at_video(secret_clip).count == 5 and len(video_streams(secret_clip)) == 1  # a video itself is one


def test_files_of_a_bag_are_in_its_folder(tmp_path):
    bag = tmp_path / "bag"
    bag.mkdir()
    (tmp_path / "secret.db3").write_bytes(b"")
    (bag / "metadata.yaml").write_text("rosbag2_bagfile_information:\n  version: 5\n")
    (bag / "a.db3").symlink_to(tmp_path / "secret.db3")
    with pytest.raises(DataError, match="'a.db3' is outside the folder"):
        with open_recording(bag):
            pass


def test_members_of_a_zip_are_names_not_places(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        for name in ("../../x/MDepth-00000001.png", "/etc/y/MDepth-00000001.png"):
            archive.writestr(name, b"data")
    before = sorted(tmp_path.rglob("*"))
    assert set(list_folders(tmp_path / "a.zip")) == {"../../x", "/etc/y"}
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_two_members_of_one_name_in_an_archive_are_refused(tmp_path):
    """zipfile and NumPy read the last of them and say nothing."""
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as archive:
        for value in (1.0, 2.0):
            stream = io.BytesIO()
            np.save(stream, np.full((1, 4, 3), value))
            archive.writestr("data.npy", stream.getvalue())
    reads = [read_cloud, read_array, lambda one: read_frames(one, "data"), check_members]
    reads.append(lambda one: list(read_files(one, list_folders(one)[""])))
    for read in reads:
        with pytest.raises(DataError, match=r"a\.npz: two members of the archive are named 'data.npy'; unpack it"):
            read(path)

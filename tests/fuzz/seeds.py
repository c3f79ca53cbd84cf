"""Tiny inputs of every format that the project reads, and the commands that read them; the mutators damage copies.

A command names its inputs as in/NAME: those files and folders are what it is given, and what is damaged.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

# Made by commands of the project, each from what stands above it.
MADE = """
prepare synthetic gestures -o gestures.h5 --videos-per-class 1 --subjects 2 --frames 18 --points 60 --size 40 --jobs 1
prepare synthetic articulated -o objects.h5 --objects 2 --sequences-per-object 1 --frames 2 --points 48 --jobs 1
prepare animation arm.glb -o film.h5 --size 16 --frames 2 --azimuths 60 --tracks 8 --samples 1 --jobs 1
classify train gestures.h5 -o model --preset tiny --epochs 1 --set epochs_dynamic=1
classify predict gestures.h5 --model model -o scores.h5 --clips-per-video 1 --split all
classify explain pac gestures.h5 --model model -o pac.h5
segment predict objects.h5 -o parts.h5 --method ward --parts 2 --split all
segment joints parts.h5 -o joints.h5
segment train drawers.h5 -o partnet --flow nearest --points 48 --batch 2 --epochs 1 --set pairs_per_epoch=2
"""

CASES = """
info in/gestures.h5
info in/parts.h5
info in/scores.h5
info in/views.h5
info in/scene.h5
info in/pac.h5
info in/joints.h5
info in/model
info in/objects.h5 --page out/page.html --picture out/sheet.png --samples 2 --frames 2
prepare depth in/depth_npy -o out/o.h5 --fov 60 --jobs 1
prepare depth in/depth_png -o out/o.h5 --fov 60 --jobs 1
prepare depth in/depth_avi -o out/o.h5 --fov 60 --jobs 1
prepare depth in/depth_tiff -o out/o.h5 --fov 60 --jobs 1
prepare depth in/depth_npy -o out/o.h5 --fov 60 --jobs 1 --labels in/labels.csv
prepare depth in/depth_npy -o out/o.h5 --jobs 1 --intrinsics in/intrinsics.json
prepare depth in/depth_npy -o out/o.h5 --jobs 1 --intrinsics in/camera.yaml
prepare clouds in/clouds_npy -o out/o.h5 --jobs 1
prepare clouds in/clouds_npz -o out/o.h5 --jobs 1
prepare clouds in/clouds_ply -o out/o.h5 --jobs 1
prepare clouds in/clouds_pcd -o out/o.h5 --jobs 1
prepare clouds in/clouds_las -o out/o.h5 --jobs 1
prepare clouds in/clouds_laz -o out/o.h5 --jobs 1
prepare clouds in/clouds_xyz -o out/o.h5 --jobs 1
prepare clouds in/clouds_csv -o out/o.h5 --jobs 1
prepare clouds in/clouds_bin -o out/o.h5 --jobs 1 --bin-columns 4
prepare clouds in/clouds_parquet -o out/o.h5 --jobs 1
prepare clouds in/table.csv -o out/o.h5 --jobs 1 --frame-column frame
prepare clouds in/run.bag -o out/o.h5 --jobs 1
prepare clouds in/run_mcap -o out/o.h5 --jobs 1
prepare clouds in/run_sqlite3 -o out/o.h5 --jobs 1
prepare msraction3d in/msr -o out/o.h5 --jobs 1
prepare msraction3d in/msr_mat -o out/o.h5 --jobs 1
prepare nvgesture in/nvgesture -o out/o.h5 --jobs 1
prepare shrec17 in/shrec17 -o out/o.h5 --jobs 1
prepare ntu60 in/ntu60 -o out/o.h5 --jobs 1
prepare preprocessed in/pts_label -o out/o.h5 --jobs 1
prepare preprocessed in/preprocessed -o out/o.h5 --jobs 1
prepare modelnet40 in/modelnet40 -o out/o.h5 --jobs 1
prepare kitti-sf in/kitti_sf -o out/o.h5 --jobs 1
prepare kitti-det in/kitti_det -o out/o.h5 --jobs 1
prepare semantickitti in/semantickitti -o out/o.h5 --jobs 1
prepare sapien in/sapien -o out/o.h5 --jobs 1 --pairs-per-object 1 --points 32 --frames 2
prepare mbs in/mbs -o out/o.h5 --jobs 1
prepare ogc-dr in/ogc -o out/o.h5 --jobs 1
prepare ogc-drsv in/ogc_drsv -o out/o.h5 --jobs 1
prepare video in/frames -o out/o.h5 --size 16 --frames 3
prepare video in/clip.gif -o out/o.h5 --size 16 --frames 3
prepare video in/clip.mp4 -o out/o.h5 --size 16 --frames 3
prepare animation in/arm.glb -o out/o.h5 --size 16 --frames 2 --azimuths 60 --tracks 8 --samples 1 --jobs 1
prepare animation in/arm.gltf -o out/o.h5 --size 16 --frames 2 --azimuths 60 --tracks 8 --samples 1 --jobs 1
prepare artemis in/animal --motion walk -o out/o.h5 --size 16 --frames 2 --tracks 8
prepare merge in/gestures.h5 in/drawers.h5 -o out/o.h5 --labels in/map.toml
prepare split in/gestures.h5 -o out/split --list in/split.csv
classify train in/gestures.h5 -o out/model --preset tiny --config in/classify.toml
classify predict in/gestures.h5 --model in/model -o out/o.h5 --clips-per-video 1 --split all
classify predict in/clouds_npy --stream --json --model in/model
classify fuse in/scores.h5 -o out/o.h5
classify explain pac in/gestures.h5 --model in/model -o out/o.h5
classify explain tsne in/gestures.h5 --model in/model -o out/o.h5 --clips-per-video 1
segment train in/drawers.h5 -o out/partnet --config in/segment.toml --flow nearest --points 48 --batch 2
segment predict in/drawers.h5 --model in/partnet -o out/o.h5 --split all
segment predict in/objects.h5 -o out/o.h5 --method ward --parts 2 --split all
segment estimate-flow in/objects.h5 -o out/o.h5 --flow nearest
segment joints in/parts.h5 -o out/joints.json
segment joints in/parts.h5 -o out/urdf
segment flow in/drawers.h5 -o out/flow --steps 2 --batch 2 --config in/flow.toml
generate4d fit in/views.h5 -o out/o.h5 --preset tiny --config in/fit.toml --size 16
generate4d render in/scene.h5 -o out/r.png --size 16
generate4d export in/scene.h5 --as ply -o out/o.ply
generate4d view in/scene.h5 -o out/v.html
evaluate classification in/scores.h5 --split all --resamples 0
evaluate segmentation in/parts.h5 --truth in/objects.h5 --split all --resamples 0
evaluate motion in/parts.h5 --truth in/objects.h5 --split all --resamples 0
evaluate joints in/joints.h5 --truth in/objects.h5 --split all --resamples 0
evaluate video in/clip.mp4 --truth in/clip.mp4 --metrics psnr --resamples 0
evaluate video in/scene.h5 --truth in/views.h5 --metrics psnr --resamples 0
evaluate video in/frames --truth in/frames --metrics psnr --resamples 0
evaluate compare in/scores.h5 in/scores2.h5 --resamples 100 --split all
evaluate compare in/parts.h5 in/parts2.h5 --truth in/objects.h5 --resamples 100 --split all
evaluate runs in/scores.h5 in/scores2.h5 --split all
evaluate report in/result.json in/scores.h5 -o out/r.html --no-pictures
"""


def cases() -> list[list[str]]:
    """The words of each command; those that would read samples in a process of their own read them in the fork.

    So what takes a process down is found, and no second process has to start.
    """
    words = [line.split() for line in CASES.strip().splitlines()]
    return [[*one, "--item-seconds", "0"] if "--jobs" in one and "animation" not in one else one for one in words]


def inputs_of(words: list[str]) -> list[str]:
    """The names below in/ that a command is given."""
    return list(dict.fromkeys(word.removeprefix("in/") for word in words if word.startswith("in/")))


def made_for(all_words: list[list[str]]) -> list[str]:
    """The lines of MADE whose files these commands are given, or whose files those lines are given."""
    needed = {
        name.replace("2.h5", ".h5").replace("result.json", "scores.h5")
        for words in all_words
        for name in inputs_of(words)
    }
    lines = []
    for line in reversed(MADE.strip().splitlines()):
        words = line.split()
        if words[words.index("-o") + 1] in needed:
            lines.insert(0, line)
            needed.update(words)
    return lines


def write_raw(base: Path) -> None:
    """Everything that no command of the project makes."""
    rng = np.random.default_rng(0)
    for make in (_depth, _clouds, _laser, _texts, _pictures):
        make(base, rng)
    for make in (_actions, _shapes, _scans, _articulated, _recordings, _models):
        make(base)


def _depth(base: Path, rng: np.random.Generator) -> None:
    from PIL import Image

    from tests.support.prepare_helpers import write_video

    depth = rng.integers(1000, 2000, (5, 12, 16)).astype(np.uint16)
    (base / "depth_npy").mkdir(parents=True)
    np.save(base / "depth_npy" / "a.npy", depth)
    np.save(base / "depth_npy" / "b.npy", depth[:3])
    frames = [Image.fromarray(frame) for frame in depth]
    for name, kind in (("a", "png"), ("b", "png"), ("a", "tiff")):
        place = base / f"depth_{kind}" / name
        place.mkdir(parents=True)
        for number, frame in enumerate(frames):
            frame.save(place / f"{number:03d}.{kind}")
    write_video(base / "depth_avi" / "a.avi", depth)


def _clouds(base: Path, rng: np.random.Generator) -> None:
    import pyarrow
    import pyarrow.parquet

    from dpcli.ops.open3d_import import load_open3d

    open3d = load_open3d()
    for frame in range(3):
        points = rng.random((20, 3))
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
        for kind in ("npy", "npz", "ply", "pcd", "xyz", "csv", "bin", "parquet"):
            (base / f"clouds_{kind}").mkdir(exist_ok=True)
        np.save(base / f"clouds_npy/{frame}.npy", points.astype(np.float32))
        np.savez(base / f"clouds_npz/{frame}.npz", points=points)
        for kind in ("ply", "pcd"):
            options = {"write_ascii": frame == 0, "compressed": frame == 1}
            open3d.io.write_point_cloud(str(base / f"clouds_{kind}/{frame}.{kind}"), cloud, **options)
        np.savetxt(base / f"clouds_xyz/{frame}.xyz", points, fmt="%.4f")
        np.savetxt(base / f"clouds_csv/{frame}.csv", points, "%.4f", ",", header="x,y,z", comments="")
        np.column_stack([points, points[:, 0]]).astype("<f4").tofile(base / f"clouds_bin/{frame}.bin")
        columns = pyarrow.table({name: points[:, k] for k, name in enumerate("xyz")})
        pyarrow.parquet.write_table(columns, base / f"clouds_parquet/{frame}.parquet")
    rows = np.column_stack([np.repeat(np.arange(3), 10), rng.random((30, 3))])
    np.savetxt(base / "table.csv", rows, "%.4f", ",", header="frame,x,y,z", comments="")


def _laser(base: Path, rng: np.random.Generator) -> None:
    import laspy

    for kind, form in (("las", 0), ("laz", 6)):
        (base / f"clouds_{kind}").mkdir()
        for frame in range(2):
            las = laspy.create(point_format=form, file_version="1.4" if form else "1.2")
            las.x, las.y, las.z = rng.random((3, 20))
            las.write(str(base / f"clouds_{kind}/{frame}.{kind}"))


def _texts(base: Path, _rng: np.random.Generator) -> None:
    camera = {"width": 16, "height": 12, "fx": 20.0, "fy": 20.0, "ppx": 8.0, "ppy": 6.0, "cx": 8.0, "cy": 6.0}
    (base / "intrinsics.json").write_text(json.dumps(camera))
    (base / "camera.yaml").write_text(
        "image_width: 16\nimage_height: 12\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
        "  data: [20.0, 0, 8, 0, 20.0, 6, 0, 0, 1]\n"
    )
    (base / "labels.csv").write_text("name,label,split,subject\na.npy,0,train,1\nb.npy,1,test,2\n")
    (base / "map.toml").write_text('[labels]\ndrawer = "all"\n')
    (base / "split.csv").write_text("name,split\ng01_s01_v0001,test\n")
    (base / "classify.toml").write_text("epochs = 1\nepochs_dynamic = 1\n")
    (base / "segment.toml").write_text("epochs = 1\npairs_per_epoch = 2\n")
    (base / "flow.toml").write_text("iterations = 2\npoints = 32\n")
    (base / "fit.toml").write_text("dense_steps = 1\nsparse_steps = 1\n")


def _pictures(base: Path, _rng: np.random.Generator) -> None:
    import imageio.v3 as imageio
    from PIL import Image

    from tests.support.video_clips import clip, write_folder

    rgba = clip(views=1)[0]
    write_folder(base / "frames", rgba, "{:03d}.png")
    white = (rgba[..., :3] * (rgba[..., 3:] > 0) + 255 * (rgba[..., 3:] == 0)).astype(np.uint8)
    pictures = [Image.fromarray(frame) for frame in white]
    pictures[0].save(base / "clip.gif", save_all=True, append_images=pictures[1:], duration=100)
    imageio.imwrite(
        base / "clip.mp4", np.repeat(white, 2, axis=1).repeat(2, axis=2), fps=10, plugin="pyav", codec="h264"
    )


def _actions(base: Path) -> None:
    from scipy.io import savemat

    from tests.prepare.actions.test_nvgesture import line, make_raw
    from tests.support.depth_png_helpers import hand_depth, ntu_files, person, write_files, write_gesture, write_lists
    from tests.support.prepare_helpers import make_depth, write_msr

    write_msr(base / "msr", ["a01_s01_e01", "a02_s02_e01"])
    (base / "msr_mat").mkdir()
    savemat(base / "msr_mat" / "a01_s01_e01_sdepth.mat", {"depth": make_depth(0)}, do_compression=True)
    make_raw(base / "nvgesture", [line()])
    write_gesture(base / "shrec17", "gesture_1/finger_1/subject_2/essai_1", hand_depth(0, 2))
    write_lists(base / "shrec17", ["1 1 2 1 1 1 2"])
    write_files(base / "ntu60", ntu_files("S001C002P003R001A060", person(0)))


def _shapes(base: Path) -> None:
    from tests.prepare.actions.test_preprocessed import peer_clouds, write_shapes
    from tests.support.prepare_helpers import make_depth

    write_shapes(base / "modelnet40", {"ply_data_train0.h5": [3, 0], "ply_data_test0.h5": [5]})
    (base / "preprocessed").mkdir()
    clouds = peer_clouds(make_depth(0), 8, 6)
    np.savez(base / "preprocessed" / "a01_s01_e01_sdepth.npz", point_clouds=clouds)
    place = base / "pts_label" / "train" / "gesture_1" / "finger_1" / "subject_2" / "essai_1"
    place.mkdir(parents=True)
    np.save(place / "pts_label.npy", np.random.default_rng(0).random((4, 16, 8)).astype(np.float32))


def _scans(base: Path) -> None:
    from tests.prepare.scans.test_kitti import make_scene, write_scenes
    from tests.prepare.scans.test_semantickitti import LABELS, visible, write_scans
    from tests.support.kitti_helpers import P2, velodyne_to_camera, write_calibration, write_png, write_scan

    write_scenes(base / "kitti_sf", {"000000": make_scene(0)})
    drive = base / "semantickitti" / "dataset" / "sequences" / "00"
    write_scans(drive, {f"{n:06d}": visible(len(LABELS), n) for n in range(2)}, {"000000": LABELS, "000001": LABELS})
    (drive / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 2)
    det = base / "kitti_det" / "training"
    write_scan(det / "velodyne" / "000000.bin", _scanned(visible(30)))
    write_calibration(det / "calib" / "000000.txt", P2=P2, R0_rect=np.eye(3), Tr_velo_to_cam=velodyne_to_camera()[:3])
    (det / "label_2").mkdir()
    (det / "label_2" / "000000.txt").write_text("Car 0 0 0 0 0 9 9 1.5 1.6 4 0 1 12 0\n")
    write_png(det / "image_2" / "000000.png", np.zeros((375, 1242), np.uint8))


def _scanned(points: np.ndarray) -> np.ndarray:
    """Points of the camera in the scanner's axes."""
    from tests.support.kitti_helpers import velodyne_to_camera

    back = np.linalg.inv(velodyne_to_camera())
    return points @ back[:3, :3].T + back[:3, 3]


def _articulated(base: Path) -> None:
    from tests.prepare.articulated.test_mbs import make_sample, write
    from tests.prepare.articulated.test_ogc import make_room, write_raw
    from tests.support.articulated_helpers import cabinet

    cabinet(base / "sapien" / "Cabinet" / "1" / "mobility.urdf")
    (base / "sapien" / "Cabinet" / "1" / "meta.json").write_text('{"model_cat": "Cabinet"}')
    write(base / "mbs", {0: make_sample(0)[0], 1: make_sample(1)[0]}, {"train": [0], "test": [1]})
    for name in ("ogc", "ogc_drsv"):
        write_raw(base / name, {"3_000001": make_room(0)[0]}, train=["3_000001"])


def _recordings(base: Path) -> None:
    from tests.prepare.recordings.test_recordings import points_of
    from tests.support.recording_helpers import START, Messages, write_recording

    for kind in ("bag", "mcap", "sqlite3"):
        make = Messages(kind)
        content = [("/lidar", START + t * 10**8, make.cloud(points_of(6, seed=t), START + t * 10**8)) for t in range(3)]
        write_recording(base / ("run" if kind == "bag" else f"run_{kind}"), kind, make, content)


def _models(base: Path) -> None:
    from dpcli.store.gaussians import write_scene
    from tests.generate4d.test_fit import toy_views
    from tests.prepare.views.test_artemis import write_animal
    from tests.support.drawers import drawers
    from tests.support.gltf_files import arm
    from tests.support.scenes import toy_scene

    arm().write(base / "arm.glb")
    arm().write(base / "arm.gltf")
    write_animal(base / "animal")
    drawers(base / "drawers.h5", 3)
    toy_views(base / "views.h5", train=1)
    write_scene(
        base / "scene.h5", toy_scene(per_part=20, frames=3, size=16), source="toy", provenance={"command": "toy"}
    )

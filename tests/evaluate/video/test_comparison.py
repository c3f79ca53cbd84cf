"""`dpc evaluate video`: sources, views, protocols, roles, mismatches, output forms, scenes."""

from __future__ import annotations

import json
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dpcli.errors import DataError, UsageError
from dpcli.evaluate.choices import parse_video_metrics
from dpcli.evaluate.report import arrange, collect
from dpcli.evaluate.video.comparison import VideoReport, evaluate_video
from dpcli.evaluate.video.picture_statistics import PSNR_CAP
from dpcli.evaluate.video.protocol import PROTOCOLS, video_protocol
from dpcli.store.gaussians import write_scene
from dpcli.store.views import ViewsHeader, ViewsWriter
from tests.support.commands import told
from tests.support.evaluating import evaluate
from tests.support.picture_metrics import psnr, ssim, ssim_reference
from tests.support.scenes import toy_scene
from tests.support.video_clips import FRAMES, HEIGHT, ROLES, WIDTH, clip, header, white, write, write_folder


def run(*arguments: object):
    return evaluate("video", *arguments)


def numbers(report: VideoReport, name: str) -> list[float]:
    return [getattr(view.metrics, name) for view in report.views]


@pytest.mark.parametrize("background", ["white", "black"])
def test_the_numbers_of_every_view_by_hand(said: Path, truth: Path, background: str) -> None:
    report = evaluate_video(said, truth, protocol=video_protocol("dpc", background))
    ours, theirs = (white(c, background == "white") for c in (clip(1, noise=6), clip()))
    for v in range(4):
        errors = ((ours[v] - theirs[v]) ** 2).mean((1, 2, 3))
        assert numbers(report, "psnr")[v] == pytest.approx(np.mean(-10 * np.log10(errors)), abs=1e-4)
        masks = clip()[v, ..., 3] >= 128
        inside = [((ours[v, t] - theirs[v, t]) ** 2)[masks[t]].mean() for t in range(FRAMES)]
        assert numbers(report, "psnr_foreground")[v] == pytest.approx(np.mean(-10 * np.log10(inside)), abs=1e-4)
        expected = np.mean([ssim_reference(ours[v, t], theirs[v, t]) for t in range(FRAMES)])
        assert numbers(report, "ssim")[v] == pytest.approx(expected, abs=5e-6)
    assert numbers(report, "psnr") == sorted(numbers(report, "psnr"), reverse=True)


def test_means_of_roles_and_of_all(said: Path, truth: Path) -> None:
    found = json.loads(run(said, "--truth", truth, "--json").stdout)
    views = found["metrics"]["per_view"]
    assert [(view["view"], view["role"]) for view in views] == list(zip("0123", ROLES))
    each = np.array([view["psnr"] for view in views])
    assert found["metrics"]["psnr"] == pytest.approx(each.mean())
    roles = found["metrics"]["per_role"]
    assert {role: own["psnr"] for role, own in roles.items()} == pytest.approx(
        {"reference": each[0], "test": each[2:].mean(), "train": each[1]}
    )
    assert found["denominators"] == {"views": 4, "frames": 12, "pixels": WIDTH * HEIGHT}
    assert found["protocol"]["background"] == "white" and found["protocol"]["data_range"] == 1.0
    assert found["units"]["psnr"] == "dB" and found["left_out"] == []


def test_equal_videos_are_capped_and_counted(truth: Path) -> None:
    result = run(truth, "--truth", truth)
    assert "12 frames equal to the truth, counted as 100 dB" in result.stdout
    report = evaluate_video(truth, truth)
    assert set(numbers(report, "psnr")) == {PSNR_CAP} and set(numbers(report, "ssim")) == {1.0}
    assert [view.metrics.worst for view in report.views] == [-1] * 4


def test_thesis_rounds_and_takes_the_reference_only(said: Path, truth: Path) -> None:
    report = evaluate_video(said, truth, protocol="thesis")
    assert [(view.title, view.role) for view in report.views] == [("0", "reference")]
    ours, theirs = (np.floor(white(c[0]) * 255 + 0.5) for c in (clip(1, noise=6), clip()))
    each = [psnr(ours[t], theirs[t], data_range=255) for t in range(FRAMES)]
    assert numbers(report, "psnr") == pytest.approx([np.mean(each)], abs=1e-3)


def test_consistent4d_resizes_and_takes_the_range_of_each_frame(said: Path, truth: Path) -> None:
    report = evaluate_video(said, truth, protocol="consistent4d", metrics=("psnr", "ssim"))
    assert [view.role for view in report.views] == ["test", "test"]
    pairs = []
    for t in range(FRAMES):
        eight = [np.floor(white(c[2, t]) * 255 + 0.5).astype(np.uint8) for c in (clip(1, noise=6), clip())]
        pairs.append([np.asarray(Image.fromarray(picture).resize((512, 512))) for picture in eight])
    by_hand = [psnr(a.astype(float), b.astype(float), data_range=float(np.ptp(b))) for a, b in pairs]
    assert report.views[0].metrics.psnr == pytest.approx(np.mean(by_hand), abs=0.02)
    ranges = [float(max(np.ptp(a), np.ptp(b))) for a, b in pairs]
    similar = [ssim(a, b, data_range=r, border="reflect") for (a, b), r in zip(pairs, ranges)]
    assert report.views[0].metrics.ssim == pytest.approx(np.mean(similar), abs=1e-4)
    fixed = np.mean([psnr(a, b, data_range=255) for a, b in pairs])
    assert fixed > report.views[0].metrics.psnr + 0.1  # the truth's own range is smaller


def test_consistent4d_compares_sizes_that_differ_and_a_blank_truth_has_no_psnr(tmp_path: Path, truth: Path) -> None:
    large = [np.asarray(Image.fromarray(frame).resize((64, 48))) for frame in clip()[0]]
    flat, larger = write_folder(tmp_path / "flat", clip()[0]), write_folder(tmp_path / "large", np.stack(large))
    with pytest.raises(DataError, match="is 64x48, but 32x24"):
        evaluate_video(larger, flat)
    assert evaluate_video(larger, flat, protocol="consistent4d").views[0].metrics.psnr > 25
    blank = clip()
    blank[..., 3] = 0
    nothing = write(tmp_path / "blank.h5", blank)
    found = json.loads(
        run(truth, "--truth", nothing, "--protocol", "consistent4d", "--metrics", "psnr,ssim", "--json").stdout
    )
    assert found["metrics"]["psnr"] is None and 0 < found["metrics"]["ssim"] < 1


def test_protocols_differ_where_they_say(said: Path, truth: Path) -> None:
    found = {name: json.loads(run(said, "--truth", truth, "--protocol", name, "--json").stdout) for name in PROTOCOLS}
    assert len({json.dumps(one["protocol"]) for one in found.values()}) == len(PROTOCOLS)
    assert found["dpc"]["metrics"]["psnr"] == found["torchmetrics"]["metrics"]["psnr"]
    assert found["dpc"]["metrics"]["ssim"] != found["torchmetrics"]["metrics"]["ssim"]
    with pytest.raises(UsageError, match="--protocol svd: expected dpc, thesis, consistent4d, disco, torchmetrics"):
        evaluate_video(said, truth, protocol="svd")
    with pytest.raises(UsageError, match="--background red"):
        evaluate_video(said, truth, protocol=video_protocol("dpc", "red"))


def test_views_are_matched_by_camera(tmp_path: Path, truth: Path, said: Path) -> None:
    other = write(tmp_path / "other.h5", clip(), header(turn=0.1))
    with pytest.raises(DataError, match="no camera of its 4 views stands, looks and sees as one of .*truth.h5"):
        evaluate_video(other, truth)
    head, order = header(), [2, 0]
    head.intrinsics, head.world_to_camera = head.intrinsics[order], head.world_to_camera[order]
    head.role, head.reference = ["test", "reference"], 1
    some = write(tmp_path / "some.h5", clip(1, noise=6)[order], head)
    report = evaluate_video(some, truth, intersect=True)
    assert [view.title for view in report.views] == ["0", "2"]
    clean = clip()[order]
    again = evaluate_video(write(tmp_path / "clean.h5", clean, head), truth, intersect=True)
    assert numbers(again, "psnr") == [PSNR_CAP, PSNR_CAP]  # the right pictures were put together
    with pytest.raises(DataError, match="another camera"):
        lone = [write(tmp_path / f"{turn}.h5", clip(views=1), header(("reference",), turn=turn)) for turn in (0.0, 0.3)]
        evaluate_video(*lone)


def test_the_first_difference_is_named(tmp_path: Path, truth: Path) -> None:
    short = write(tmp_path / "short.h5", clip(frames=2), header(frames=2))
    with pytest.raises(DataError, match="view '0' has 2 frames, 3 in .*the first without a partner is frame 2"):
        evaluate_video(short, truth)
    report = evaluate_video(short, truth, intersect=True)
    assert [view.metrics.frames for view in report.views] == [2] * 4
    assert [(entry.reason, entry.names) for entry in report.left_out][0] == (
        "frames of view '0' that one side lacks",
        ["2"],
    )
    for view in range(4):
        write_folder(tmp_path / "f" / str(view), clip()[view])
    Image.fromarray(clip()[1, 2, :20]).save(tmp_path / "f" / "1" / "2.png")
    with pytest.raises(DataError, match="view '1', frame 2 is 32x20, but 32x24"):
        evaluate_video(tmp_path / "f", truth)


def test_colors_saved_in_0_to_1_are_noticed(tmp_path: Path, truth: Path) -> None:
    dim = clip()
    dim[..., :3] = np.round(dim[..., :3] / 255)
    path = write(tmp_path / "dim.h5", dim)
    for metrics in (None, ("warping",)):
        with pytest.raises(DataError, match="no value above 1; colors in 0..1 were saved"):
            evaluate_video(path, truth, metrics=metrics)
    np.save(tmp_path / "loud.npy", clip().astype(np.float32))
    with pytest.raises(DataError, match="frame 0 has values up to 255; floats are taken as 0..1"):
        evaluate_video(tmp_path / "loud.npy", truth)


@pytest.mark.parametrize("kind", ["views", "folder", "bytes.npy", "floats.npy"])
def test_colors_that_were_multiplied_by_alpha_are_noticed(kind, tmp_path: Path) -> None:
    """Of either side, in every kind of source; not where both agree, nor of straight colors that differ."""
    straight, other = clip(views=1), clip(views=1)
    slope = np.linspace(0, 255, WIDTH).round()
    straight[..., 3] = other[..., 3] = slope
    straight[..., 0], other[..., 0] = 200, 120
    faded = straight.copy()
    faded[..., :3] = np.rint(straight[..., :3] * (straight[..., 3:] / 255.0))
    head = header(("reference",))

    def source(name: str, pictures: np.ndarray) -> Path:
        if kind == "views":
            return write(tmp_path / f"{name}.h5", pictures, head)
        if kind == "folder":
            return write_folder(tmp_path / name, pictures[0])
        np.save(tmp_path / f"{name}.npy", pictures if kind == "bytes.npy" else (pictures / 255).astype(np.float32))
        return tmp_path / f"{name}.npy"

    paths = {name: source(name, pictures) for name, pictures in (("a", straight), ("b", faded), ("c", other))}
    for pair, side in (("ba", "prediction"), ("ab", "truth"), ("aa", ""), ("bb", ""), ("ca", ""), ("ac", "")):
        notes = " ".join(evaluate_video(*(paths[name] for name in pair), metrics=("psnr",)).notes)
        assert (f"multiplied by alpha in the {side} (" in notes) if side else "multiplied" not in notes, pair
    learned_alone = evaluate_video(paths["b"], paths["a"], metrics=("warping",)).notes
    assert any("multiplied by alpha in the prediction (" in note for note in learned_alone)


def test_nan_predictions_are_counted_and_named(tmp_path: Path, truth: Path) -> None:
    values = (clip(1, noise=6) / 255).astype(np.float32)
    whole = tmp_path / "whole.npy"
    np.save(whole, values)
    values[2, 1, 3, 4:6] = np.nan
    values[3, 0, 3, 4, 1] = np.inf
    np.save(tmp_path / "nan.npy", values)
    with pytest.raises(DataError, match=r"2 frames with NaN or infinite pixels, the first view 2 frame 1 \(2 pixels\)"):
        evaluate_video(tmp_path / "nan.npy", truth)
    result = run(tmp_path / "nan.npy", "--truth", truth, "--json", "--intersect")
    found = json.loads(result.stdout)  # NaN would be refused
    assert found["left_out"] == [
        {
            "reason": "frames in which the prediction has NaN or infinite pixels",
            "count": 2,
            "names": ["view 2 frame 1 (2 pixels)", "view 3 frame 0 (1 pixel)"],
        }
    ]
    assert found["denominators"]["frames"] == 10
    assert (
        numbers(evaluate_video(tmp_path / "nan.npy", truth, intersect=True), "psnr")[:2]
        == numbers(evaluate_video(whole, truth), "psnr")[:2]
    )
    np.save(tmp_path / "all.npy", np.full_like(values, np.nan))
    with pytest.raises(DataError, match="every frame has NaN"):
        evaluate_video(tmp_path / "all.npy", truth, intersect=True)
    with pytest.raises(DataError, match="nan.npy: view '2', frame 1: 2 pixels that are NaN"):
        evaluate_video(whole, tmp_path / "nan.npy")


def test_masks_without_an_object(tmp_path: Path, truth: Path) -> None:
    some = clip()
    some[0, 1, ..., 3] = 0
    part = write(tmp_path / "part.h5", some)
    result = run(truth, "--truth", part)
    assert "1 frame without an object in the truth" in result.stdout
    for metrics in (("psnr",), ("warping",), ("psnr", "warping")):
        told_of = evaluate_video(part, truth, metrics=metrics).notes
        assert "Predicted pictures without an object (alpha 0 everywhere): 1." in told_of
    some[..., 3] = 0
    none = write(tmp_path / "none.h5", some)
    with pytest.raises(DataError, match="no frame has an object"):
        evaluate_video(truth, none)
    assert len(evaluate_video(truth, none, metrics=("psnr", "ssim")).views) == 4


def test_small_pictures_and_wrong_metrics_are_said(said: Path, truth: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="32x24; ms_ssim needs at least 176 pixels"):
        evaluate_video(said, truth, metrics=("ms_ssim",))
    for view, side in (("0", 16), ("1", 10)):
        write_folder(tmp_path / "views" / view, np.full((1, side, side, 4), 99, np.uint8))
    with pytest.raises(DataError, match="10x10; ssim needs at least 11 pixels"):  # of a later view, too
        evaluate_video(tmp_path / "views", tmp_path / "views", metrics=("ssim",))
    assert parse_video_metrics("ssim, psnr") == ("psnr", "ssim") and parse_video_metrics(None) is None
    for wrong in ("psnr,lpip", "", ","):
        with pytest.raises(
            UsageError,
            match="expected some of psnr,psnr_foreground,ssim,ms_ssim,silhouette_iou,lpips,.*,parts,tracks,surface",
        ):
            parse_video_metrics(wrong)
    with pytest.raises(DataError, match="--metrics parts needs a gaussians file and a views file, not a views file"):
        evaluate_video(said, truth, metrics=("parts",))


def test_two_videos_are_compared_view_by_view(said: Path, truth: Path, tmp_path: Path) -> None:
    worse = write(tmp_path / "worse.h5", clip(2, noise=12))
    command = ["compare", said, worse, "--truth", truth, "--metrics", "psnr,ssim", "--json"]
    found = json.loads(evaluate(*command).stdout)
    expected = [np.mean(numbers(evaluate_video(path, truth), "psnr")) for path in (said, worse)]
    change = found["metrics"]["psnr"]
    assert [change["a"], change["b"]] == pytest.approx(expected) and change["a_better"] == 4
    with pytest.raises(UsageError, match="--metrics fvd: protocol disco takes it of all views at once"):
        pooled = [*command[:5], "--metrics", "psnr,fvd", "--protocol", "disco"]
        evaluate(*pooled, raising=True)
    with pytest.raises(UsageError, match="a video holds no truth"):
        evaluate("compare", said, worse, raising=True)
    runs = evaluate("runs", said, worse, "--truth", truth, "--json")
    assert json.loads(runs.stdout)["metrics"]["psnr"]["mean"] == pytest.approx(np.mean(expected))


def test_what_a_video_is_said_to_be_compared_as_is_said_of_two_and_of_many(tmp_path: Path, truth: Path) -> None:
    """A clip without alpha of other moments, one without times, and the first one's JSON object."""
    Image.fromarray(clip()[0, 0]).save(
        first := tmp_path / "a.webp",
        save_all=True,
        append_images=[Image.fromarray(frame) for frame in clip()[0, 1:]],
        duration=[30, 170, 100],
        lossless=True,
    )
    np.save(second := tmp_path / "b.npy", white(clip()[0]).astype(np.float32))
    lone = write(tmp_path / "lone.h5", clip(views=1), header(ROLES[:1]))
    single = json.loads(run(first, "--truth", lone, "--metrics", "psnr", "--json").stdout)
    assert any("filmed at other moments" in note for note in single["notes"])
    (tmp_path / "c.json").write_text(json.dumps(single))
    shared = ["--truth", lone, "--metrics", "psnr", "--json"]

    def invoke(*words: object) -> dict:
        return json.loads(evaluate(*words).stdout)

    notes = invoke("compare", first, second, *shared)["notes"]
    assert [note for note in notes if note.startswith("A: ")] == [f"A: {note}" for note in single["notes"]]
    assert any(note.startswith("B: ") and "no alpha" in note for note in notes)
    notes = invoke("runs", first, second, *shared)["notes"]
    assert [note for note in notes if note.startswith("a: ")] == [f"a: {note}" for note in single["notes"]]
    notes = invoke("runs", tmp_path / "c.json", "--json")["notes"]
    assert notes == [f"a: {note}" for note in single["notes"]]


def test_the_command_prints_tables_markdown_and_a_strip(said: Path, truth: Path, tmp_path: Path) -> None:
    strip = tmp_path / "strip.png"
    result = run(said, "--truth", truth, "--markdown", "--picture", strip)
    assert result.exit_code == 0
    rows = [line for line in result.stdout.splitlines() if line.startswith("|")]
    assert any(row.startswith("| mean of 2 | test | 6 |") for row in rows)
    intervals = [row for row in rows if row.startswith("| PSNR (dB) |")]
    low, high = (float(end) for end in intervals[0].split("|")[3].split(" - "))
    each = numbers(evaluate_video(said, truth), "psnr")
    assert min(each) <= low < np.mean(each) < high <= max(each)  # four views, resampled
    assert "over white" in result.stdout and "data range 1.0" in result.stdout
    with Image.open(strip) as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    first = pixels[22 : 22 + 120 : 5, 4 : 4 + 160 : 5]  # truth of view 0, frame 0: 5 pixels for each, to fill the cell
    assert np.abs(first / 255 - white(clip()[0, 0]))[10:, 10:].max() < 0.01  # but for the frame's number
    assert pixels.shape[:2] == (4 + 4 * (18 + 3 * 120 + 4), 4 + 3 * (160 + 4))  # nothing between the three pictures
    assert isinstance(run(said, "--truth", truth, "--picture", tmp_path / "no" / "x.png").exception, DataError)
    assert isinstance(run(said, "--truth", truth, "--metrics", "parts", "--picture", strip).exception, UsageError)


def test_a_pipe_is_read(said: Path, truth: Path) -> None:
    piped = evaluate("video", "-", "--truth", truth, "--json", stdin=said.read_bytes())
    assert json.loads(piped.stdout)["metrics"] == json.loads(run(said, "--truth", truth, "--json").stdout)["metrics"]
    wrong = told("evaluate", "video", said, "--truth", truth, "--protocol", "svd")
    assert (wrong.returncode, wrong.stdout) == (2, "") and "--protocol svd" in wrong.stderr


def scene_views(folder: Path, size: int = 64) -> tuple[Path, Path]:
    """A scene file, and the views file it renders to, with true tracks and parts on its Gaussians."""
    import torch

    from dpcli.ops.splatting.rasterization import rasterization

    scene = toy_scene(size=size)
    write_scene(folder / "scene.h5", scene)
    cameras = scene.camera_world_to_camera, scene.camera_intrinsics
    head = ViewsHeader("toy", cameras[1], cameras[0], scene.time, ["reference", "test"], 0, (size, size))
    with ViewsWriter(folder / "views.h5", head, track=scene.frame_mean, part=scene.part) as writer:
        for v, t in np.ndindex(2, scene.num_frames):
            given = (
                scene.frame_mean[t],
                scene.frame_quaternion[t],
                scene.scale,
                scene.opacity,
                scene.sh,
                cameras[0][v : v + 1],
                cameras[1][v : v + 1],
            )
            tensors = [torch.from_numpy(np.ascontiguousarray(array, np.float32)) for array in given]
            color, alpha, _ = rasterization(*tensors, size, size, sh_degree=scene.sh_degree)
            straight = torch.cat([color / alpha.clamp_min(1e-6), alpha], -1)[0].clamp(0, 1)
            writer.add(v, t, (straight * 255 + 0.5).to(torch.uint8).numpy())
    return folder / "scene.h5", folder / "views.h5"


def test_parts_and_tracks_need_no_pictures(tmp_path: Path) -> None:
    scene, path = toy_scene(size=24), tmp_path / "scene.h5"
    write_scene(path, scene)
    head = ViewsHeader(
        "toy",
        scene.camera_intrinsics,
        scene.camera_world_to_camera,
        scene.time,
        ["reference", "test"],
        0,
        (24, 24),
        "m",
    )
    views = write(
        tmp_path / "v.h5", np.zeros((2, 5, 24, 24, 4), np.uint8), head, track=scene.frame_mean, part=scene.part
    )
    found = json.loads(run(path, "--truth", views, "--metrics", "tracks,parts", "--json").stdout)
    assert found["metrics"]["parts"]["adjusted_rand_index"] > 0.97 and "psnr" not in found["metrics"]
    assert found["metrics"]["tracks"]["epe"] < 1e-5 < 0.05 < found["metrics"]["tracks"]["epe_no_motion"]
    assert found["units"]["epe"] == "m" and found["denominators"]["tracks"] == {"points": 300, "frames": 4}
    text = run(path, "--truth", views, "--metrics", "parts,tracks").stdout
    assert "k-means on positions" in text and "no motion" in text and "EPE (m)" in text and "PSNR" not in text


@pytest.mark.parametrize(
    "points, known, names",
    [(50, False, {"tracks", "surface"}), (0, True, set()), (50, True, {"parts", "tracks", "surface"})],
)
def test_a_truth_whose_points_tell_nothing_costs_no_other_metric(points, known, names, tmp_path: Path, capsys) -> None:
    scene = toy_scene(frames=3)
    write_scene(tmp_path / "scene.h5", scene, source="toy")
    lens, pose = scene.camera_intrinsics[:1], scene.camera_world_to_camera[:1]
    header = ViewsHeader("toy", lens, pose, scene.time, ["reference"], 0, scene.size)
    part = scene.part[:points] if known else np.full(points, -1, np.int16)
    with ViewsWriter(tmp_path / "truth.h5", header, track=scene.frame_mean[:, :points], part=part) as writer:
        for frame in range(3):
            writer.add(0, frame, np.full((64, 64, 4), 255, np.uint8))
    report = evaluate_video(tmp_path / "scene.h5", tmp_path / "truth.h5")
    assert {"psnr", "ssim"} < set(report.names) and set(report.scene) == names
    said = capsys.readouterr().err
    assert all((f"{name} is left out" in said) == (name not in names) for name in ("parts", "tracks", "surface"))
    if "parts" not in names:
        with pytest.raises(DataError, match="parts: no surface point"):
            evaluate_video(tmp_path / "scene.h5", tmp_path / "truth.h5", metrics=("parts",))


def test_a_scene_is_rendered_at_the_truths_cameras_and_times(tmp_path: Path) -> None:
    scene, views = scene_views(tmp_path)
    found = json.loads(run(scene, "--truth", views, "--json").stdout)
    assert all(view["psnr"] > 45 and view["ssim"] > 0.99 for view in found["metrics"]["per_view"])  # 8-bit rounding
    assert found["metrics"]["parts"]["adjusted_rand_index"] > 0.97 and found["metrics"]["tracks"]["epe"] < 1e-5
    assert all(view["silhouette_iou"] > 0.98 for view in found["metrics"]["per_view"])
    assert found["denominators"]["surface"] == {"points": 300, "unseen": 0, "frames": 5}
    surface = found["metrics"]["surface"]
    low, high = found["surface_intervals"]["metrics"]["f_score_2"]
    assert 0 < low <= surface["f_score_2"] <= high <= 1 and surface["f_score_1"] <= surface["f_score_2"]
    assert surface["chamfer_of_diameter"] == pytest.approx(surface["chamfer"] / surface["diameter"])
    words = json.dumps(found).encode()
    metrics = arrange(collect(["-"], stdin=BytesIO(words), pictures=False)).sections[0].blocks[0]
    shown = {row[0].text: row[2].text for row in metrics.rows}
    assert shown["surface f score 2"] == f"{100 * low:.1f} to {100 * high:.1f} %"
    assert "Of the surface: 95 %, bootstrap, BCa, 2000 resamples of 5 frames." in metrics.note
    text = run(scene, "--truth", views, "--metrics", "surface").stdout
    assert "F-score at 2 %" in text and "300 true points" in text


def test_a_scene_that_stands_still_or_belongs_to_another_clip(tmp_path: Path) -> None:
    from dataclasses import replace

    scene, views = scene_views(tmp_path)
    toy = toy_scene()
    still = replace(toy, frame_mean=np.tile(toy.frame_mean[:1], (5, 1, 1)))
    write_scene(tmp_path / "still.h5", still)
    right, wrong = (evaluate_video(path, views, metrics=("psnr",)) for path in (scene, tmp_path / "still.h5"))
    assert wrong.mean()["psnr"] < right.mean()["psnr"] - 15 and wrong.views[0].metrics.worst == 4
    write_scene(tmp_path / "long.h5", replace(toy, time=toy.time * 0.5))
    with pytest.raises(DataError, match="holds 0 to 0.5 s, but .* has frames from 0 to 1 s"):
        evaluate_video(tmp_path / "long.h5", views)
    bare = write(tmp_path / "bare.h5", clip(views=1), header(("reference",)))
    with pytest.raises(DataError, match="bare.h5: no surface parts in it"):
        evaluate_video(scene, bare, metrics=("parts",))


def test_real_frames_against_themselves_made_worse(shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "video" / "consistent4d" / "roaring_t-rex"
    if not folder.is_dir():
        pytest.skip(f"no {folder}")
    images = sorted(folder.rglob("*.png"))[:2]
    frames = [np.asarray(Image.open(path).convert("RGBA")) for path in images]
    write_folder(tmp_path / "truth", np.stack(frames))
    write_folder(tmp_path / "said", np.stack([np.roll(frame, 1, axis=1) for frame in frames]))
    report = evaluate_video(tmp_path / "said", tmp_path / "truth", protocol="consistent4d")
    assert (
        20 < report.views[0].metrics.psnr < 45
        and report.views[0].metrics.psnr_foreground < report.views[0].metrics.psnr
    )

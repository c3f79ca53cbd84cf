"""Learned metrics in `dpc evaluate video`: fed the right pictures in the right order, whatever network; absent weights."""

from __future__ import annotations

import json
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from dpcli.errors import DataError, UsageError
from dpcli.evaluate.networks.clip import Clip
from dpcli.evaluate.networks.lpips import Lpips
from dpcli.evaluate.report import arrange, collect
from dpcli.evaluate.video.comparison import evaluate_video
from dpcli.evaluate.video.frechet.clip_features import FeatureNetwork
from dpcli.evaluate.video.frechet.distance import feature_update, frechet_distance
from dpcli.evaluate.video.frechet.frame_inputs import prepare_frame
from dpcli.evaluate.video.frechet.variants import feature_variant
from dpcli.evaluate.video.learned.warping import WarpingError, warping_compute
from dpcli.evaluate.video.protocol import PROTOCOLS, video_protocol
from tests.evaluate.video.test_comparison import FRAMES, clip, header, white, write
from tests.support.evaluating import evaluate
from tests.support.picture_metrics import ssim_reference

ROLES = ("reference", "test", "test")


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("learned")
    made = [
        write(folder / f"{name}.h5", clip(seed, noise=noise, views=3), header(ROLES))
        for name, seed, noise in (("said", 1, 9), ("truth", 0, 0))
    ]
    return made[0], made[1]


def pictures(which: int) -> np.ndarray:
    """f32 (V,T,3,H,W) in 0..1 over white, as the protocol dpc sees them."""
    rgba = clip(1, noise=9, views=3) if which == 0 else clip(views=3)
    return np.moveaxis(white(rgba), -1, 2).astype(np.float32)


class FakeClip:
    """Embeds a picture as its mean colors in four quarters; keeps the real class's interface."""

    def embed(self, batch: np.ndarray, *, bgr: bool = False) -> np.ndarray:
        batch = batch[..., ::-1] if bgr else batch
        height, width = batch.shape[1] // 2, batch.shape[2] // 2
        quarters = [batch[:, y : y + height, x : x + width].mean((1, 2)) for y in (0, height) for x in (0, width)]
        found = np.concatenate(quarters, -1) - 0.5
        return (found / np.linalg.norm(found, axis=-1, keepdims=True)).astype(np.float32)


@pytest.fixture
def no_weights(monkeypatch, tmp_path: Path) -> Path:
    monkeypatch.setenv("DPC_WEIGHTS", str(tmp_path / "none"))
    return tmp_path / "none"


@pytest.fixture
def fake_networks(monkeypatch, no_weights: Path) -> None:
    torch.manual_seed(0)
    lpips = Lpips("squeeze")
    monkeypatch.setattr(Lpips, "load", classmethod(lambda cls, net, folder: lpips))
    monkeypatch.setattr(Clip, "load", classmethod(lambda cls, folder, variant, device: FakeClip()))
    pooled = nn.Sequential(nn.Flatten(), nn.AdaptiveAvgPool1d(20))

    def load(cls, name, folder, device="cpu"):
        return FeatureNetwork(feature_variant(name), pooled, device)

    monkeypatch.setattr(FeatureNetwork, "load", classmethod(load))


def mean_of_view_pairs(rows: np.ndarray) -> float:
    """The mean cosine over pairs of views at one time, of unit rows (V,T,D)."""
    views, frames = rows.shape[:2]
    return float(np.mean([rows[v, t] @ rows[w, t] for t in range(frames) for v in range(views) for w in range(v)]))


def test_each_metric_is_that_of_its_own_function(files, fake_networks) -> None:
    report = evaluate_video(
        *files, metrics=("lpips", "clip", "clip_spherical", "clip_views", "clip_temporal", "warping")
    )
    assert report.missing == {} and report.views == []
    ours, theirs = pictures(0), pictures(1)
    value = {name: score.value for name, score in report.learned.items()}

    network = Lpips.load("alex", Path())
    each = [network.distance(torch.from_numpy(o), torch.from_numpy(t)).mean().item() for o, t in zip(ours, theirs)]
    assert value["lpips"] == pytest.approx(np.mean(each), rel=1e-4)
    assert list(report.learned["lpips"].per_view.values()) == pytest.approx(each, rel=1e-4)

    rows = [np.stack([FakeClip().embed(np.moveaxis(view, 1, -1)) for view in video]) for video in (ours, theirs)]
    swapped = [np.stack([FakeClip().embed(np.moveaxis(v, 1, -1), bgr=True) for v in video]) for video in (ours, theirs)]
    angles = np.arccos(np.clip((swapped[0] * swapped[1]).sum(-1), -1, 1))
    assert value["clip"] == pytest.approx((rows[0] * rows[1]).sum(-1).mean(), abs=1e-6)
    assert value["clip_spherical"] == pytest.approx((angles**2 / 2).mean(), abs=1e-5)
    for name, of in (
        ("clip_views", mean_of_view_pairs),
        ("clip_temporal", lambda own: (own[:, 1:] * own[:, :-1]).sum(-1).mean()),
    ):
        assert value[name] == pytest.approx(of(rows[0]), abs=1e-6)
        assert report.learned[name].truth == pytest.approx(of(rows[1]), abs=1e-6)

    parts = []
    for video, truth in zip(ours, theirs):
        warping = WarpingError()
        for pair in zip(video, truth):
            warping.add(*pair)
        parts.append(warping_compute(warping.result()))
    assert value["warping"] == pytest.approx(np.mean([part.squared for part in parts]), rel=1e-5)
    assert report.learned["warping"].truth == pytest.approx(np.mean([part.truth_squared for part in parts]), rel=1e-5)
    assert report.learned["warping"].counts == {"views": 3, "pairs": 3 * (FRAMES - 1)}


def test_frechet_distances_by_hand(files, fake_networks) -> None:
    """The closed form of one video against one, a view being a video: computed here from the network's own features."""
    report = evaluate_video(*files, metrics=("fvd", "fid_vid_inception", "fid_vid_r3d50"))
    network = FeatureNetwork.load("consistent4d", Path())
    each = []
    for video, truth in zip(pictures(0), pictures(1)):
        f, g = (network.features([prepare_frame(network.variant, frame) for frame in v]) for v in (video, truth))
        each.append(((f - g) ** 2).sum() + (f.std(ddof=1) - g.std(ddof=1)) ** 2)
    assert report.learned["fvd"].value == pytest.approx(np.mean(each), rel=1e-4)
    assert report.learned["fid_vid_inception"].counts == {"videos": 3, "clips": 3 * FRAMES, "frames": 3 * FRAMES}
    assert "needs at least 16" in report.missing["fid_vid_r3d50"]  # three frames: said, the others are there


def test_warping_is_one_number_in_video_compare_and_runs(tmp_path: Path) -> None:
    """Of views that show unlike shares of their pixels twice, a mean over pixels isn't the mean over views."""
    rng = np.random.default_rng(0)
    made = clip(views=2, frames=5)
    made[..., 3] = 255
    made[1, ..., :3] = rng.integers(0, 255, made[1, ..., :3].shape)  # nothing to follow: mostly occluded
    head = header(("reference", "test"), frames=5)
    truth = write(tmp_path / "truth.h5", made, head)
    noisy = made.copy()
    noisy[..., :3] = np.clip(made[..., :3] + rng.normal(0, 30, made[..., :3].shape), 0, 255)
    said, other = write(tmp_path / "said.h5", noisy, head), write(tmp_path / "other.h5", noisy[:, ::-1].copy(), head)

    def run(*arguments: object) -> dict:
        given = [*arguments, "--truth", truth, "--metrics", "warping", "--json"]
        return json.loads(evaluate(*given, raising=True).stdout)

    alone = [run("video", path)["metrics"]["warping"] for path in (said, other)]
    found = run("video", said)
    each = list(found["metrics"]["per_view_learned"]["warping"].values())
    assert alone[0] == pytest.approx(np.mean(each)) and max(each) > 1.5 * min(each)
    interval = found["intervals"]["metrics"]["warping"]
    assert min(each) <= interval[0] <= alone[0] <= interval[1] <= max(each)
    compared = run("compare", said, other)["metrics"]["warping"]
    assert [compared["a"], compared["b"]] == pytest.approx(alone)
    assert run("runs", said, other)["metrics"]["warping"]["mean"] == pytest.approx(np.mean(alone))
    (tmp_path / "video.json").write_text(json.dumps(found))
    told = evaluate("runs", tmp_path / "video.json", "--json", raising=True)
    assert json.loads(told.stdout)["metrics"]["warping"]["mean"] == pytest.approx(alone[0])


def with_gaps(folder: Path, frames: int, lost: dict[int, tuple[int, ...]]) -> tuple[Path, Path, np.ndarray, np.ndarray]:
    """A noisy video with NaN in frames `lost` of views, its truth, and both f32 (V,T,3,H,W) without the NaN."""
    views = len(lost)
    ours, theirs = (white(clip(seed, noise, views, frames)).astype(np.float32) for seed, noise in ((1, 9), (0, 0)))
    np.save(folder / "truth.npy", theirs)
    damaged = ours.copy()
    for view, missing in lost.items():
        damaged[view, list(missing), 5, 5] = np.nan
    np.save(folder / "said.npy", damaged)
    return folder / "said.npy", folder / "truth.npy", *(np.moveaxis(one, -1, 2) for one in (ours, theirs))  # type: ignore


def test_a_frame_left_out_leaves_no_neighbors(tmp_path: Path, fake_networks) -> None:
    """Frames 3-5 of 8 are lost: 2 and 6 are no pair, 3 pairs of true neighbors remain."""
    said, truth, ours, theirs = with_gaps(tmp_path, 8, {0: (3, 4, 5)})
    found = evaluate_video(said, truth, metrics=("lpips", "warping", "clip_temporal"), intersect=True).learned
    assert found["lpips"].counts == {"views": 1, "frames": 5}
    assert found["warping"].counts == found["clip_temporal"].counts == {"views": 1, "pairs": 3}
    pairs, warping = [(0, 1), (1, 2), (6, 7)], WarpingError()
    for pair in pairs:
        warping.restart()
        for frame in pair:
            warping.add(ours[0, frame], theirs[0, frame])
    assert found["warping"].value == pytest.approx(warping_compute(warping.result()).squared, rel=1e-5)
    rows = FakeClip().embed(np.moveaxis(ours[0], 1, -1))
    assert found["clip_temporal"].value == pytest.approx(np.mean([rows[a] @ rows[b] for a, b in pairs]), abs=1e-6)


def test_views_are_compared_at_the_same_time_whatever_each_lost(tmp_path: Path, fake_networks) -> None:
    said, truth, ours, theirs = with_gaps(tmp_path, 6, {0: (1,), 1: (4,), 2: ()})
    found = evaluate_video(said, truth, metrics=("clip_views",), intersect=True).learned["clip_views"]
    assert found.counts == {"views": 3, "frames": 4} and found.choices["frames left out"].startswith("2,")
    for value, video in ((found.value, ours), (found.truth, theirs)):
        rows = np.stack([FakeClip().embed(np.moveaxis(view[[0, 2, 3, 5]], 1, -1)) for view in video])
        assert value == pytest.approx(mean_of_view_pairs(rows), abs=1e-6)


def test_views_without_a_common_frame_or_a_pair_say_so(tmp_path: Path, fake_networks) -> None:
    said, truth, *_ = with_gaps(tmp_path, 4, {0: (0, 2), 1: (1, 3)})
    missing = evaluate_video(said, truth, metrics=("clip_views", "clip_temporal", "warping"), intersect=True).missing
    assert "no frame is there in all of them" in missing["clip_views"]
    assert "no two frames in a row" in missing["clip_temporal"] and "2 in a row" in missing["warping"]


def test_windows_do_not_reach_across_a_gap(tmp_path: Path, fake_networks) -> None:
    """Frames 2 and 20 of 40 are lost: 17 frames in a row, then 19, are 2 + 4 windows of 16; the first two are in none."""
    said, truth, ours, theirs = with_gaps(tmp_path, 40, {0: (2, 20)})
    names = ("fid_vid_r3d50", "fid_vid_inception", "fvd")
    report = evaluate_video(said, truth, metrics=names, intersect=True)
    assert report.learned["fid_vid_r3d50"].counts == {"videos": 1, "clips": 6, "frames": 36}
    assert report.learned["fid_vid_inception"].counts == {"videos": 1, "clips": 38, "frames": 38}  # single frames
    assert "takes a whole video at once" in report.missing["fvd"]

    network = FeatureNetwork.load("r3d50", Path())
    sides = []
    for video in (ours[0], theirs[0]):
        windows = [range(start, start + 16) for start in (3, 4, 21, 22, 23, 24)]
        rows = [
            network.features([prepare_frame(network.variant, video[frame]) for frame in window]) for window in windows
        ]
        sides.append(feature_update(np.stack(rows)))
    assert report.learned["fid_vid_r3d50"].value == pytest.approx(frechet_distance(*sides), rel=1e-4, abs=1e-6)


def test_a_video_in_pieces_says_how_long_they_are(tmp_path: Path, fake_networks) -> None:
    said, truth, *_ = with_gaps(tmp_path, 20, {0: (12,)})
    found = evaluate_video(said, truth, metrics=("fid_vid_r3d50",), intersect=True)
    assert "12 frames in a row: " in found.missing["fid_vid_r3d50"]
    (tmp_path / "end").mkdir()  # frames lost at the ends leave no gap
    said, truth, *_ = with_gaps(tmp_path / "end", 6, {0: (0, 5)})
    found = evaluate_video(said, truth, metrics=("fvd",), intersect=True)
    assert found.learned["fvd"].counts == {"videos": 1, "clips": 1, "frames": 4}


def test_equal_videos_score_perfectly(files, fake_networks) -> None:
    found = evaluate_video(files[1], files[1], metrics=("lpips", "clip", "fvd", "fid_vid_inception", "warping")).learned
    assert [found[name].value for name in ("lpips", "fvd")] == [0, 0] and found["clip"].value == pytest.approx(1)
    assert found["fid_vid_inception"].value == pytest.approx(0, abs=1e-6)
    assert found["warping"].value == found["warping"].truth


def test_absent_weights_cost_only_their_own_metric(files, no_weights: Path) -> None:
    said, truth = map(str, files)
    command = ["video", said, "--truth", truth, "--metrics", "psnr,lpips,fvd,warping", "--protocol", "thesis", "--json"]
    result = evaluate(*command)
    assert isinstance(result.exception, DataError)
    message = str(result.exception)
    assert message.startswith("lpips not computed (fvd neither): ") and "\n" not in message
    assert (
        "vgg16-397923af.pth" in message and str(no_weights) in message and "dpc evaluate weights fetch vgg16" in message
    )
    found = json.loads(result.stdout)
    assert found["metrics"]["psnr"] > 20 and found["metrics"]["warping"] > 0
    assert found["metrics"]["lpips"] is None and set(found["not_computed"]) == {"lpips", "fvd"}
    (section,) = arrange(collect(["-"], stdin=BytesIO(result.stdout.encode()), pictures=False)).sections
    assert any(note.startswith("LPIPS not computed: ") and "fetch vgg16" in note for note in section.notes)


def test_a_wrong_folder_of_weights_is_said_before_the_work(files) -> None:
    seen: list = []
    with pytest.raises(DataError, match="--weights nowhere: no such folder"):
        evaluate_video(*files, metrics=("psnr", "lpips"), weights=Path("nowhere"), watch=lambda *own: seen.append(own))
    assert not seen


def test_the_thesis_compares_pixels_of_the_reference_and_features_of_all_views(files, fake_networks) -> None:
    report = evaluate_video(*files, metrics=("psnr", "lpips"), protocol="thesis")
    assert [view.title for view in report.views] == ["0"]
    assert list(report.learned["lpips"].per_view) == ["0", "1", "2"]


def test_options_replace_a_protocols_networks() -> None:
    chosen = video_protocol("consistent4d", lpips="squeeze", fvd="videogpt", hop=4)
    assert (chosen.networks.lpips, chosen.networks.fvd, chosen.networks.hop) == ("squeeze", "videogpt", 4)
    assert chosen.size == 512 and PROTOCOLS["disco"].networks.lpips_range01
    for wrong in ({"lpips": "resnet"}, {"fvd": "i3d"}):
        with pytest.raises(UsageError, match="expected"):
            video_protocol("dpc", **wrong)


def test_disco_takes_ssim_of_luminance(files) -> None:
    protocol = replace(PROTOCOLS["disco"], size=None)
    found = evaluate_video(*files, metrics=("psnr", "ssim"), protocol=protocol)
    gray = [np.tensordot(np.rint(pictures(which) * 255), [0.2125, 0.7154, 0.0721], (2, 0)) for which in (0, 1)]
    each = [np.mean([ssim_reference(o, t, data_range=255) for o, t in zip(*view)]) for view in zip(*gray)]
    assert [view.metrics.ssim for view in found.views] == pytest.approx(each, abs=1e-4)
    color = evaluate_video(*files, metrics=("psnr", "ssim"), protocol=replace(protocol, gray=False))
    assert color.mean()["psnr"] == found.mean()["psnr"] and color.mean()["ssim"] != found.mean()["ssim"]


def test_red_and_blue_swapped_are_noticed(tmp_path: Path, files) -> None:
    wrong = clip(views=3)
    wrong[..., :3] = wrong[..., 2::-1]
    path = write(tmp_path / "bgr.h5", wrong, header(ROLES))
    for metrics in (("psnr",), ("warping",), ("psnr", "warping")):
        notes = evaluate_video(path, files[1], metrics=metrics).notes
        assert sum("Red and blue look swapped" in note for note in notes) == 1
    assert not any("swapped" in note for note in evaluate_video(*files).notes)

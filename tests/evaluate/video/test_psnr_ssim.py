"""PSNR, SSIM and MS-SSIM: by hand, against torchmetrics and scikit-image, against the float64 reference, in shards."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dpcli.evaluate.results import merge_statistics
from dpcli.evaluate.video import ssim as ssim_module
from dpcli.evaluate.video.picture_statistics import PSNR_CAP, picture_compute, picture_update
from tests.support.picture_metrics import ms_ssim, planar, psnr, ssim, ssim_reference


def waves(side: int = 192) -> tuple[np.ndarray, np.ndarray]:
    """Prediction and truth f64 (side,side+8,3) in 0..1 by a formula: half waves, half flat white."""
    y, x, c = np.mgrid[:side, : side + 8, :3] / side
    truth = np.where(x + 0.3 * y < 0.7, 0.5 + 0.45 * np.sin(23 * x + 9 * y * y + c * 40), 1.0)
    return np.clip(truth + 0.08 * np.cos(61 * x * y + 31 * x) * np.sin(47 * y), 0, 1), truth


# On `waves()` as float64 tensors (1,3,H,W), data_range=1.0, with torchmetrics 1.9.0 and scikit-image 0.26.0:
#   structural_similarity(t, p, channel_axis=-1, gaussian_weights=True, sigma=1.5, use_sample_covariance=False)
#   peak_signal_noise_ratio, structural_similarity_index_measure, multiscale_structural_similarity_index_measure
GOLDEN = {
    "psnr": 29.145654693675745,
    "valid": 0.8561728158430938,
    "reflect": 0.8554731048833761,
    "ms_ssim": 0.8998734468328717,
}
SINGLE = 5e-6  # float32 against float64: 3e-6 measured on faint noise over white, 3e-8 on ordinary pictures


def test_psnr_by_hand() -> None:
    truth = np.full((4, 5, 3), 0.5)
    assert psnr(truth + 0.1, truth) == pytest.approx(20, abs=1e-4)  # 10 log10(1 / 0.01)
    assert psnr(255 * truth + 25.5, 255 * truth, data_range=255) == pytest.approx(20, abs=1e-4)
    one = truth.copy()
    one[0, 0, 0] += 0.5  # 0.25 / 60 values
    assert psnr(one, truth) == pytest.approx(10 * np.log10(60 / 0.25), abs=1e-4)
    mask = np.zeros((4, 5), bool)
    mask[0, :2] = True
    assert psnr(one, truth, mask=mask) == pytest.approx(10 * np.log10(6 / 0.25), abs=1e-4)
    assert psnr(truth, truth) == PSNR_CAP and np.isnan(psnr(one, truth, mask=np.zeros((4, 5), bool)))


def test_psnr_of_eight_bit_pictures_is_exact() -> None:
    rng = np.random.default_rng(0)
    predicted, truth = (rng.integers(0, 256, (33, 47, 3), dtype=np.uint8) for _ in range(2))
    errors = (predicted.astype(int) - truth.astype(int)) ** 2
    assert psnr(predicted, truth, data_range=255) == pytest.approx(10 * np.log10(255**2 / errors.mean()), abs=1e-12)


def test_ssim_of_flat_pictures_by_hand() -> None:
    a, b, c1 = 0.25, 0.75, 0.01**2
    expected = (2 * a * b + c1) / (a * a + b * b + c1)  # no variance: the contrast-structure factor is 1
    for border in ssim_module.BORDERS:
        assert ssim(np.full((16, 20), a), np.full((16, 20), b), border=border) == pytest.approx(expected, abs=1e-7)


def test_ssim_of_one_window_by_hand() -> None:
    rng = np.random.default_rng(1)
    p, t = rng.random((2, 11, 11))
    g = np.exp(-((np.arange(11) - 5) ** 2) / (2 * 1.5**2))
    w = np.outer(g, g) / np.outer(g, g).sum()
    mp, mt = (w * p).sum(), (w * t).sum()
    vp, vt, cov = (w * (p - mp) ** 2).sum(), (w * (t - mt) ** 2).sum(), (w * (p - mp) * (t - mt)).sum()
    expected = (2 * mp * mt + 1e-4) * (2 * cov + 9e-4) / ((mp**2 + mt**2 + 1e-4) * (vp + vt + 9e-4))
    assert ssim(p, t) == pytest.approx(expected, abs=SINGLE)


def test_equal_pictures_score_exactly_one() -> None:
    _, truth = waves()
    assert ssim(truth, truth) == 1 and ssim(truth, truth, border="reflect") == 1 and ms_ssim(truth, truth) == 1


@settings(max_examples=40, deadline=None)
@given(
    st.integers(11, 40),
    st.integers(11, 40),
    st.sampled_from([1, 3]),
    st.integers(0, 2**31),
    st.sampled_from([1.0, 255.0]),
    st.sampled_from(ssim_module.BORDERS),
    st.sampled_from(["noise", "flat", "binary", "faint"]),
)
def test_the_kernel_equals_the_reference(
    height: int, width: int, channels: int, seed: int, data_range: float, border: str, kind: str
) -> None:
    rng = np.random.default_rng(seed)
    truth = {
        "noise": rng.random((height, width, channels)),
        "flat": np.ones((height, width, channels)),
        "binary": np.round(rng.random((height, width, channels))),
        "faint": 0.999 + 0.001 * rng.random((height, width, channels)),  # where float32 variances are worst
    }[kind]
    predicted = np.clip(truth + rng.normal(0, rng.choice([1e-4, 0.01, 0.3]), truth.shape), 0, 1)
    pair = (data_range * predicted).astype(np.float32), (data_range * truth).astype(np.float32)
    found, expected = (of(*pair, data_range=data_range, border=border) for of in (ssim, ssim_reference))
    assert found == pytest.approx(expected, abs=SINGLE)


@pytest.mark.parametrize("broken", ["sigma", "range", "border"])
def test_the_comparison_rejects_a_broken_twin(broken: str, monkeypatch: pytest.MonkeyPatch) -> None:
    predicted, truth = waves()
    expected = ssim(predicted, truth)
    if broken == "sigma":
        monkeypatch.setattr(ssim_module, "SIGMA", 1.4)
    other = {"range": {"data_range": 1.05}, "border": {"border": "reflect"}}.get(broken, {})
    assert abs(ssim_reference(predicted, truth, **other) - expected) > 100 * SINGLE


def test_stored_numbers_of_other_libraries() -> None:
    predicted, truth = waves()
    assert psnr(predicted, truth) == pytest.approx(GOLDEN["psnr"], abs=1e-5)
    assert ssim(predicted, truth) == pytest.approx(GOLDEN["valid"], abs=SINGLE)
    assert ssim(predicted, truth, border="reflect") == pytest.approx(GOLDEN["reflect"], abs=SINGLE)
    assert ms_ssim(predicted, truth, border="reflect") == pytest.approx(GOLDEN["ms_ssim"], abs=SINGLE)
    assert ms_ssim(predicted, truth) != pytest.approx(GOLDEN["ms_ssim"], abs=1e-4)  # the other border is another number


@pytest.mark.parametrize("shape", [(177, 201, 3)])
def test_against_torchmetrics(shape: tuple[int, ...], one_thread: None) -> None:
    functional = pytest.importorskip("torchmetrics.functional.image")
    import torch

    rng = np.random.default_rng(shape[0])
    truth = rng.random(shape).cumsum(0) % 1
    predicted = np.clip(truth + rng.normal(0, 0.1, shape), 0, 1)
    tensors = [torch.from_numpy(np.moveaxis(a, -1, 0))[None] for a in (predicted, truth)]
    for name, own in (
        ("peak_signal_noise_ratio", psnr(predicted, truth)),
        ("structural_similarity_index_measure", ssim(predicted, truth, border="reflect")),
        ("multiscale_structural_similarity_index_measure", ms_ssim(predicted, truth, border="reflect")),
    ):
        assert own == pytest.approx(float(getattr(functional, name)(*tensors, data_range=1.0)), abs=1e-5), name


def test_against_scikit_image() -> None:
    metrics = pytest.importorskip("skimage.metrics")
    rng = np.random.default_rng(3)
    predicted, truth = (rng.integers(0, 256, (60, 71, 3), dtype=np.uint8) for _ in range(2))
    how = {
        "gaussian_weights": True,
        "sigma": 1.5,
        "use_sample_covariance": False,
        "channel_axis": -1,
        "data_range": 255,
    }
    assert ssim(predicted, truth, data_range=255) == pytest.approx(
        metrics.structural_similarity(truth, predicted, **how), abs=SINGLE
    )
    assert psnr(predicted, truth, data_range=255) == pytest.approx(
        metrics.peak_signal_noise_ratio(truth, predicted, data_range=255), abs=1e-9
    )


def test_shards_merge_to_the_whole() -> None:
    rng = np.random.default_rng(5)
    frames = [planar(rng.random((20, 24, 3))) for _ in range(14)]
    mask = (rng.random((20, 24)) < 0.4).astype(np.uint8)
    mask_of = [mask, np.zeros_like(mask), *[mask] * 5]
    rows = [picture_update(i, frames[2 * i], frames[2 * i + 1], mask=mask_of[i]) for i in range(7)]
    whole = picture_compute(merge_statistics(rows))
    shards = picture_compute(merge_statistics([merge_statistics(rows[:3]), merge_statistics(rows[3:])]))
    assert replace(shards, ms_ssim=0, silhouette_iou=0) == replace(whole, ms_ssim=0, silhouette_iou=0)
    each = [psnr(*(np.moveaxis(f, 0, -1) for f in frames[2 * i : 2 * i + 2])) for i in range(7)]
    assert whole.psnr == pytest.approx(np.mean(each)) and whole.worst == int(np.argmin(each))
    assert whole.without_object == 1 and whole.object_pixels == 6 * int(mask.sum()) and whole.frames == 7
    objects = [psnr(*(np.moveaxis(f, 0, -1) for f in frames[2 * i : 2 * i + 2]), mask=mask) for i in range(7) if i != 1]
    assert whole.psnr_foreground == pytest.approx(np.mean(objects)) and np.isnan(whole.ms_ssim)


def test_pictures_too_small_and_other_borders_are_said() -> None:
    good = np.full((16, 16, 3), 0.5)
    with pytest.raises(ValueError, match="at least 11 x 11"):
        ssim(good[:10], good[:10])
    with pytest.raises(ValueError, match="at least 176 pixels"):
        ms_ssim(good, good)
    with pytest.raises(ValueError, match="valid or reflect"):
        ssim(good, good, border="same")


def test_silhouettes_overlap_by_hand_and_empty_frames_do_not_count():
    truth, said = np.zeros((3, 4, 4), np.uint8), np.zeros((3, 4, 4), np.uint8)
    truth[0, :2], said[0, 1:3] = 1, 1  # rows 0, 1 and rows 1, 2: a third
    truth[1, :, :1] = 1  # nothing predicted: 0; the last frame is empty in both
    blank = np.zeros((3, 4, 4), np.float32)
    rows = [picture_update(i, blank, blank, mask=truth[i], predicted_mask=said[i], metrics=("psnr",)) for i in range(3)]
    assert picture_compute(merge_statistics(rows)).silhouette_iou == pytest.approx((1 / 3 + 0) / 2)
    unasked = picture_compute(picture_update(0, blank, blank, mask=truth[0], metrics=("psnr",)))
    assert np.isnan(unasked.silhouette_iou)

"""Temporal consistency on textures whose motion, flicker and occlusion are known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.evaluate.results import merge_statistics
from dpcli.evaluate.video.learned.warping import WarpingError, warping_compute
from dpcli.ops.optical_flow import optical_flow, seen_in_both, warped
from dpcli.runtime.seeds import generator

FRAMES, SIDE = 6, 96
STEP = (2, 1)  # pixels per frame, x and y


def texture(height: int, width: int, key: int = 0) -> np.ndarray:
    """f32 (3,H,W) in 0.2..0.8, smooth enough that a flow can be followed."""
    noise = generator(0, 30, key).random((height, width, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2)
    smooth = (smooth - smooth.min()) / np.ptp(smooth)
    return (0.2 + 0.6 * smooth).transpose(2, 0, 1)


@pytest.fixture(scope="module")
def moving() -> np.ndarray:
    """(T,3,H,W): a window that glides over a large texture."""
    large = texture(SIDE + 2 * FRAMES, SIDE + 2 * FRAMES)
    return np.stack([large[:, t * STEP[1] :, t * STEP[0] :][:, :SIDE, :SIDE] for t in range(FRAMES)])


def measured(predicted: np.ndarray, truth: np.ndarray | None = None):
    warping = WarpingError()
    for frame, true in zip(predicted, predicted if truth is None else truth, strict=True):
        warping.add(frame, true)
    return warping_compute(warping.result())


def test_a_constant_video_is_perfect():
    found = measured(np.repeat(texture(32, 48)[None], 4, 0))
    assert found.squared == found.absolute == found.occluded == 0
    assert found.pairs == 3


def test_flow_has_the_known_motion(moving):
    gray = [(frame.mean(0) * 255).astype(np.uint8) for frame in moving[:2]]
    flow = optical_flow(gray[1], gray[0])  # the window goes right and down, so what it shows goes left and up
    inner = flow[16:-16, 16:-16]
    np.testing.assert_allclose(inner.mean((0, 1)), STEP, atol=0.05)


def test_steady_motion_costs_little_and_standing_still_would_cost_much(moving):
    found = measured(moving, moving)
    still = np.square(moving[1:] - moving[:-1]).mean()
    assert found.squared < 0.01 * still
    assert (found.squared, found.absolute) == (found.truth_squared, found.truth_absolute)
    assert 0 < found.occluded < 0.1  # what came in at two edges


def test_flicker_adds_its_own_square(moving):
    swing = 0.05
    flicker = moving + swing * (-1.0) ** np.arange(FRAMES)[:, None, None, None]
    steady, found = measured(moving, moving), measured(flicker.astype(np.float32), moving)
    # each pair differs by 2 swing on top of the error that is there, which has no preferred sign
    assert found.squared == pytest.approx(steady.squared + (2 * swing) ** 2, rel=0.01)
    assert found.absolute == pytest.approx(2 * swing, rel=0.01)
    assert found.truth_squared == steady.squared


def test_the_wrong_motion_is_seen_with_the_truths_flow_only(moving):
    backwards = moving[::-1].copy()
    assert measured(backwards, moving).squared > 20 * measured(backwards).squared


def test_what_a_moving_square_uncovers_is_left_out():
    behind, front, frames = texture(128, 128, 1), texture(48, 48, 2), []
    for t in range(2):
        frame = behind.copy()
        frame[:, 32:80, 30 + 8 * t : 78 + 8 * t] = front
        frames.append(frame)
    gray = [(frame.mean(0) * 255).astype(np.uint8) for frame in frames]
    back, forth = optical_flow(gray[1], gray[0]), optical_flow(gray[0], gray[1])
    seen = seen_in_both(back, forth)
    assert 0.5 < (~seen).sum() / (48 * 8) < 2  # about the area that nobody has seen before, and mostly there
    assert seen[36:76, 31:37].mean() < 0.5 and seen[40:72, 48:76].mean() > 0.95 and seen[:24].mean() > 0.99
    everything = np.square(frames[1].transpose(1, 2, 0) - warped(frames[0].transpose(1, 2, 0), back)).mean()
    assert measured(np.stack(frames)).squared < 0.5 * everything


def test_a_known_loop_decides_by_the_published_rule():
    back = np.zeros((4, 5, 2), np.float32)
    back[..., 0] = 1  # every partner one to the right: outside for the last column
    forth = -back
    np.testing.assert_array_equal(seen_in_both(back, forth), np.arange(5) < 4 + np.zeros((4, 1)))
    for miss, seen in ((0.70, True), (0.74, False)):  # 0.49 and 0.55 against 0.01 * (1 + about 1) + 0.5
        off = forth.copy()
        off[..., 1] = miss
        assert seen_in_both(back, off)[:, :4].all() == seen


def test_moved_is_bilinear_and_repeats_edges():
    ramp = np.tile(np.arange(6, dtype=np.float32), (4, 1))[..., None]
    flow = np.zeros((4, 6, 2), np.float32)
    flow[..., 0] = 0.5
    np.testing.assert_allclose(warped(ramp, flow)[0].ravel(), [0.5, 1.5, 2.5, 3.5, 4.5, 5], atol=1e-6)


def test_videos_merge_as_their_pixels(moving):
    parts = []
    for video in (moving[:3], moving[2:]):
        warping = WarpingError()
        for frame in video:
            warping.add(frame, frame)
        parts.append(warping.result())
    merged, whole = warping_compute(merge_statistics(parts)), measured(moving, moving)
    assert merged.pairs == whole.pairs == FRAMES - 1
    assert merged.squared == pytest.approx(whole.squared, rel=1e-12)
    assert merged.occluded == pytest.approx(whole.occluded, rel=1e-12)


def test_bad_frames_are_refused(moving):
    with pytest.raises(DataError, match="at least 2"):
        measured(moving[:1])
    with pytest.raises(DataError, match="divide by 255"):
        measured(moving * 255)
    with pytest.raises(DataError, match="NaN"):
        measured(np.full((2, 3, 32, 32), np.nan, np.float32))
    with pytest.raises(DataError, match="12x32: optical flow needs 16"):
        measured(np.zeros((2, 3, 32, 12), np.float32))
    with pytest.raises(ValueError, match="shapes"):
        measured(moving, moving[:, :, :-1])

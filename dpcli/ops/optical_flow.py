"""Optical flow between two pictures, warping along it, and which pixels both pictures show."""

from __future__ import annotations

import numpy as np

SLOPE, OFFSET = 0.01, 0.5  # of the tolerated loop, in squared pixels (Sundaram et al. 2010, eq. 5)


def optical_flow(gray: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Returns the flow f32 (H,W,2), x and y in pixels, with other(p + f(p)) = gray(p); u8 (H,W). OpenCV's DIS, preset medium."""
    import cv2

    return cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(gray, other, None)


def warped(picture: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """Returns picture(p + flow(p)), bilinear: (H,W,C) of C <= 4 with flow (H,W,2) in pixels -> f32 (H,W,C); edges repeat."""
    import cv2

    where = _partners(flow)
    source = np.ascontiguousarray(picture, np.float32)
    return cv2.remap(source, where[..., 0], where[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def seen_in_both(back: np.ndarray, forth: np.ndarray) -> np.ndarray:
    """Returns bool (H,W): pixels whose partner lies inside, and whose loop back (H,W,2) and forth (H,W,2) closes.

    Inside is half a pixel wider than the outermost centers: a flow near 0 doesn't push the edge out.
    """
    height, width = back.shape[:2]
    where = _partners(back)
    inside = (where >= -0.5).all(-1) & (where[..., 0] <= width - 0.5) & (where[..., 1] <= height - 0.5)
    returned = warped(forth, back)
    lengths = np.square(back).sum(-1) + np.square(returned).sum(-1)
    return inside & (np.square(back + returned).sum(-1) <= SLOPE * lengths + OFFSET)


def _partners(flow: np.ndarray) -> np.ndarray:
    height, width = flow.shape[:2]
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1)
    return (grid + flow).astype(np.float32)

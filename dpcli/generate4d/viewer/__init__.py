"""One HTML file that shows a scene: page, scripts and quantized data in it; no server, no network."""

from __future__ import annotations

import html
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dpcli import __version__
from dpcli.draw.page import assemble
from dpcli.draw.page.assemble import SHARED, STYLE, as_base64, as_json, filled, script_text, source_text
from dpcli.draw.palette import part_colors
from dpcli.generate4d.out.camera_paths import clip_rate, home, own_rate, pivot
from dpcli.generate4d.out.picture_colors import WEIGHTS
from dpcli.generate4d.viewer.input_sheet import input_sheet
from dpcli.standard_streams import printable
from dpcli.store.gaussians import GaussianScene

SCRIPTS = ("scene.js", "webgl.js", "canvas.js", "trails.js", "app.js")
_POSITIONS, _TURNS, _BYTE = 65535, 127, 255  # steps of a coordinate in the box, of a quaternion's number, of a fraction


def write_page(
    scene: GaussianScene,
    path: Path,
    *,
    title: str,
    history: Sequence[dict] = (),
    fps: float | None = None,
    clip: Path | None = None,
) -> int:
    """Writes the page and returns its size in bytes. Raises DataError if it can't be written. fps: frames of the clip per second,
    None = as videos play it (`clip_rate`). clip: the views file whose pictures the page shows beside the scene.

    Positions are rounded to 1/65535 of the box around all frames, quaternions to 1/127, colors, opacities and weights
    to 1/255; color terms that depend on the direction are left out. Equal scenes give equal bytes.
    """
    arrays = packed(scene)
    blob = b"".join(values.tobytes() for values in arrays.values())
    header = describe(scene, arrays, title=title, history=history, fps=fps or clip_rate(scene))
    header["input"] = input_sheet(clip, scene) if clip else None
    page = filled(
        source_text("page.html", __package__),
        {
            "TITLE": html.escape(printable(title)),
            "STYLE": source_text(STYLE),
            "HEADER": as_json(header),
            "DATA": as_base64(blob),
            "SCRIPT": f"{script_text(SHARED)}\n{script_text(SCRIPTS, __package__)}",
        },
    )
    return assemble.write_page(page, path)


def _box(scene: GaussianScene) -> tuple[np.ndarray, np.ndarray]:
    """Returns the lowest corner and the extent (3) of all means of all frames; an extent is never 0."""
    low, high = scene.frame_mean.min((0, 1)).astype(np.float64), scene.frame_mean.max((0, 1)).astype(np.float64)
    return low, np.maximum(high - low, 1e-9)


def packed(scene: GaussianScene) -> dict[str, np.ndarray]:
    """Packs what the page reads, in its order. Moving things are differences to the frame before, which compress better;
    bytes of 16-bit numbers lie apart, low bytes first: position u8 (2,T,3,N), turn u8 (T,4,N), weight u8 (T,N), scale
    f32 (3,N), color u8 (4,N) with opacity, part u8 (2,N) = id + 1."""
    low, extent = _box(scene)
    steps = np.rint((scene.frame_mean - low) / extent * _POSITIONS).astype(np.uint16).transpose(0, 2, 1)
    change = _differences(steps)
    turns = np.rint(_continuous(scene.frame_quaternion) * _TURNS).astype(np.int8).view(np.uint8).transpose(0, 2, 1)
    weight = np.rint(np.clip(scene.rigid_weight, 0, 1) * _BYTE).astype(np.uint8)
    rgba = np.concatenate([scene.color.T, np.rint(scene.opacity * _BYTE).astype(np.uint8)[None]])
    return {
        "position": _bytes_apart(change),
        "turn": _differences(turns),
        "weight": _differences(weight),
        "scale": scene.scale.T.astype("<f4"),
        "color": rgba,
        "part": _bytes_apart((scene.part + 1).astype(np.uint16)),
    }


def _bytes_apart(values: np.ndarray) -> np.ndarray:
    """Returns u8 (2,...): the low bytes of u16 numbers, then the high ones."""
    return np.stack([(values & 255).astype(np.uint8), (values >> 8).astype(np.uint8)])


def _differences(values: np.ndarray) -> np.ndarray:
    """Returns each frame minus the one before, modulo the type; the first as it is. The result is contiguous."""
    return np.concatenate([values[:1], values[1:] - values[:-1]])


def _continuous(quaternions: np.ndarray) -> np.ndarray:
    """Returns quaternions (T,N,4) with signs such that no Gaussian jumps from q to -q between frames."""
    flips = np.where((quaternions[1:] * quaternions[:-1]).sum(-1, keepdims=True) < 0, -1.0, 1.0)
    return quaternions * np.concatenate([np.ones_like(quaternions[:1, :, :1]), np.cumprod(flips, 0)])


def describe(
    scene: GaussianScene, arrays: dict[str, np.ndarray], *, title: str, history: Sequence[dict], fps: float
) -> dict[str, Any]:
    """Returns the page's header: counts, where each array begins, camera, parts, provenance."""
    low, extent = _box(scene)
    lens, (azimuth, elevation, radius) = scene.camera_intrinsics[scene.reference], home(scene)
    starts = np.cumsum([0, *(values.nbytes for values in arrays.values())]).tolist()
    ids, counts = np.unique(scene.part, return_counts=True)
    return {
        "title": title,
        "version": __version__,
        "count": scene.num_gaussians,
        "frames": scene.num_frames,
        "time": scene.time.tolist(),
        "rate": fps / own_rate(scene),
        "tail": 1 / own_rate(scene),
        "low": low.tolist(),
        "extent": extent.tolist(),
        "starts": dict(zip(arrays, starts)),
        "bytes": starts[-1],
        "camera": {
            "azimuth": azimuth,
            "elevation": elevation,
            "radius": radius,
            "target": pivot(scene).tolist(),
            "near": scene.near,
            "half": [float(side / 2 / focal) for side, focal in zip(scene.size, (lens[0, 0], lens[1, 1]))],
        },
        "parts": [
            {"id": int(i), "count": int(c), "color": part_colors(np.array([i]))[0].tolist()}
            for i, c in zip(ids, counts)
        ],
        "weights": WEIGHTS.tolist(),
        "metrics": scene.metrics,
        "sh_degree": scene.sh_degree,
        "control_points": len(scene.control_point),
        "history": [{key: entry.get(key) for key in ("command", "version", "seed")} for entry in history],
    }

"""Linear blend skinning and animation curves, as glTF 2.0 defines them (sections 3.7.3.3 and appendix C)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dpcli.ops.rotations import motion_matrix, quaternion_to_matrix

_ROUNDING = 2e-6  # of the latest time: what 32 bits make of keys at k / 24


@dataclass(frozen=True)
class Curve:
    """Holds a property over time. times: f64 (K) seconds, rising; at equal ones the value jumps to the last.

    values: f64 (K,D), CUBICSPLINE (K,3,D): in-tangent, value, out-tangent. interpolation: LINEAR | STEP |
    CUBICSPLINE. rotation: values are quaternions x y z w.
    """

    times: np.ndarray
    values: np.ndarray
    interpolation: str = "LINEAR"
    rotation: bool = False

    def at(self, time: np.ndarray) -> np.ndarray:
        """Returns values f64 (T,D) at `time` (T); before the first and after the last key they stay.

        A time that misses a key by rounding alone is at it: a step would show what was before.
        """
        cubic = self.interpolation == "CUBICSPLINE"
        time = np.clip(np.asarray(time, np.float64), self.times[0], self.times[-1])
        at_key = np.searchsorted(self.times, time + _ROUNDING * np.abs(self.times).max(), side="right") - 1
        if len(self.times) == 1 or self.interpolation == "STEP":
            found = (self.values[:, 1] if cubic else self.values)[at_key]
            return normalize(found) if self.rotation else found
        k = np.clip(at_key, 0, len(self.times) - 2)
        first, last, step = self.values[k], self.values[k + 1], self.times[k + 1] - self.times[k]
        s = np.where(step > 0, (time - self.times[k]) / np.where(step > 0, step, 1), 1).clip(0)[:, None]
        if cubic:
            found = _hermite(first, last, step[:, None], s)
            return normalize(found) if self.rotation else found
        return slerp(first, last, s) if self.rotation else first + s * (last - first)


def _hermite(first: np.ndarray, last: np.ndarray, step: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Interpolates between keys (T,3,D) by a cubic Hermite spline, tangents per second."""
    s2, s3 = s * s, s * s * s
    leaving, arriving = step * first[:, 2], step * last[:, 0]
    return (
        (2 * s3 - 3 * s2 + 1) * first[:, 1]
        + (s3 - 2 * s2 + s) * leaving
        + (3 * s2 - 2 * s3) * last[:, 1]
        + (s3 - s2) * arriving
    )


def normalize(quaternions: np.ndarray) -> np.ndarray:
    """Returns unit quaternions (x y z w); a zero one becomes zero rotation."""
    length = np.linalg.norm(quaternions, axis=-1, keepdims=True)
    return np.where(length > 1e-12, quaternions / np.maximum(length, 1e-12), [0.0, 0.0, 0.0, 1.0])


def slerp(first: np.ndarray, last: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Interpolates quaternions (...,4) spherically the short way round, at s (...,1) in 0..1."""
    first, last = normalize(first), normalize(last)
    cosine = (first * last).sum(-1, keepdims=True)
    last, cosine = np.where(cosine < 0, -last, last), np.abs(cosine)
    angle = np.arccos(np.minimum(cosine, 1))
    sine = np.sin(angle)
    near = sine < 1e-6  # the limit is a straight line
    safe = np.where(near, 1, sine)
    a = np.where(near, 1 - s, np.sin((1 - s) * angle) / safe)
    b = np.where(near, s, np.sin(s * angle) / safe)
    return normalize(a * first + b * last)


def matrices(translation: np.ndarray, rotation: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Returns transforms f64 (T,4,4) = translation (T,3) x rotation (T,4, x y z w) x scale (T,3)."""
    turned = quaternion_to_matrix(normalize(rotation)[..., [3, 0, 1, 2]])
    return motion_matrix(turned * scale[:, None, :], translation)


def skin(
    positions: np.ndarray,  # (V,3), or (T,V,3) when morphed
    normals: np.ndarray,  # the same
    bones: np.ndarray,  # i64 (V,J)
    weights: np.ndarray,  # (V,J), sums 1
    motion: np.ndarray,  # (T,B,4,4) rest pose -> frame
) -> tuple[np.ndarray, np.ndarray]:
    """Computes positions and unit normals f32 (T,V,3) by linear blend skinning; normals follow the inverse transpose.

    The cofactor matrix is used for it: that is det times the inverse transpose, and exists when a bone is scaled to 0.
    """
    frames, vertices = len(motion), positions.shape[-2]
    moved = np.empty((frames, vertices, 3), np.float32)
    turned = np.empty_like(moved)
    for t in range(frames):
        blend = np.einsum("vj,vjab->vab", weights, motion[t][:, :3][bones], optimize=True)
        x, n = (a[t] if a.ndim == 3 else a for a in (positions, normals))
        moved[t] = np.einsum("vab,vb->va", blend[..., :3], x) + blend[..., 3]
        rows = blend[..., :3]
        cofactor = np.stack([np.cross(rows[:, (i + 1) % 3], rows[:, (i + 2) % 3]) for i in range(3)], axis=1)
        sign = np.sign(np.einsum("va,va->v", rows[:, 0], cofactor[:, 0]))[:, None]
        direction = np.einsum("vab,vb->va", cofactor, n) * np.where(sign == 0, 1, sign)
        turned[t] = direction / np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-300)
    return moved, turned


def vertex_normals(positions: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Returns area-weighted unit normals f32 (V,3) of one frame (V,3)."""
    a, b, c = (positions[triangles[:, k]].astype(np.float64) for k in range(3))
    across = np.cross(b - a, c - a)
    total = np.stack(
        [
            np.bincount(triangles.reshape(-1), np.repeat(across[:, axis], 3), minlength=len(positions))
            for axis in range(3)
        ],
        axis=1,
    )
    return (total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)).astype(np.float32)

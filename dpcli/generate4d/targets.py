"""The pictures that a fit has to match, as tensors at any fraction of their size."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dpcli.errors import DataError
from dpcli.runtime.progress import log
from dpcli.store.views import ViewsReader

_OBJECT_RADIUS = 0.75  # of the sphere around the origin that an object fits, as `docs/format.md` says
_LARGE = 3 * _OBJECT_RADIUS  # an object that reaches farther from the origin is fitted visibly worse
_SMALL = 0.05  # half a picture's width at the object, world units: below it pixels are smaller than Gaussians can be


@dataclass
class Targets:
    """Holds pictures of V views by T frames, their cameras and times; color is multiplied by alpha.

    pictures: f16 (V,T,S,S',4); intrinsics f64 (V,3,3) for that size; reference: the index of the input view among them.
    """

    name: str
    pictures: Tensor
    intrinsics: np.ndarray
    world_to_camera: np.ndarray
    seconds: np.ndarray
    reference: int
    length_unit: str = ""
    history: list[dict] = field(default_factory=list)  # provenance of the file

    @property
    def num_views(self) -> int:
        """Returns the number of views, V."""
        return self.pictures.shape[0]

    @property
    def num_frames(self) -> int:
        """Returns the number of frames, T."""
        return self.pictures.shape[1]

    @property
    def size(self) -> tuple[int, int]:
        """Returns width and height of the pictures, pixels."""
        return self.pictures.shape[3], self.pictures.shape[2]

    def times(self) -> Tensor:
        """Returns the frames' times f32 (T) in 0..1, as the networks take them."""
        return torch.linspace(0, 1, self.num_frames) if self.num_frames > 1 else torch.zeros(1)

    def widest_frame(self) -> int:
        """Returns the frame in which most of the object is seen, over all views.

        There limbs hide each other least, so that parts which only touch in passing don't start as one.
        """
        return int(self.pictures[..., 3].float().sum((0, 2, 3)).argmax())

    def at(self, views: list[int], frames: list[int], shrink: int = 1) -> tuple[Tensor, Tensor, Tensor]:
        """Returns pictures f32 (C,H,W,4), intrinsics (C,3,3) and world_to_camera (C,4,4) of (view, frame) pairs, 1/shrink the size.

        They keep at least two pixels each way, as few as a slope needs.
        """
        chosen = self.pictures[views, frames].float()
        matrices = torch.from_numpy(self.intrinsics[views]).float()
        shrink = min(shrink, min(self.size) // 2)
        if shrink > 1:
            chosen = torch.nn.functional.avg_pool2d(chosen.permute(0, 3, 1, 2), shrink).permute(0, 2, 3, 1).contiguous()
            matrices = matrices.clone()
            matrices[:, :2] /= shrink
        return chosen, matrices, torch.from_numpy(self.world_to_camera[views]).float()

    def object_reach(self) -> tuple[float, float]:
        """Returns how far the object seems to reach from the world's origin, and half the picture's longer side: world units.

        Both are those of the reference view at the origin's depth, which is negative behind the camera; the first is of
        all frames together.
        """
        lens, pose = self.intrinsics[self.reference], self.world_to_camera[self.reference]
        alpha, depth = self.pictures[self.reference, ..., 3].amax(0).float().numpy(), float(pose[2, 3])
        rows, columns = np.nonzero(alpha > min(0.5, 0.5 * float(alpha.max())))
        low, high = np.array([columns.min(), rows.min()]), np.array([columns.max(), rows.max()]) + 1
        focal = lens[[0, 1], [0, 1]]
        middle = ((low + high) / 2 - lens[:2, 2]) / focal * depth - pose[:2, 3]
        reach = np.linalg.norm(middle) + (abs(depth) * (high - low) / 2 / focal).max()
        return float(reach), float((depth * np.array(self.size) / 2 / focal).max())

    def check_world(self, where: object) -> None:
        """Warns of a world in another unit, or with its origin elsewhere, than the rates, sizes and new cameras of a fit expect.

        Raises DataError, starting with `where`, when the origin isn't in front of the reference camera.
        """
        reach, half = self.object_reach()
        advice = f"scale and shift the world, so that the object fits a sphere of radius {_OBJECT_RADIUS:g} around its origin"
        if half <= 0:
            raise DataError(f"{where}: the world's origin is not in front of the reference camera; {advice}")
        if reach > _LARGE or half < _SMALL:
            found = f"reach {reach:.2g} from the world's origin" if reach > _LARGE else "be tiny"
            log.warn(
                f"{where}: at the origin's distance the picture is {2 * half:.2g} units wide, and the object seems to {found}:"
                f" the fit will suffer; {advice} (for a clip, --radius and --fovy of `dpc prepare video` say where the camera is)"
            )

    def check_cut_out(self, where: object) -> None:
        """Warns of a reference view that is opaque all over in every frame: a fit knows the object by its alpha alone."""
        if self.pictures[self.reference, ..., 3].amin() > 0.5:
            log.warn(
                f"{where}: alpha is full all over every picture of the reference view, so the background is fitted as part of"
                " the object; cut the object out (`dpc prepare video` does), unless this is meant"
            )

    def picture(self, view: int, frame: int) -> np.ndarray:
        """Returns a picture f32 (H,W,4) with straight color, 0..1."""
        value = self.pictures[view, frame].float().numpy().copy()
        value[..., :3] /= np.maximum(value[..., 3:], 1e-3)
        return value.clip(0, 1)


def load_targets(path: Path, size: int, roles: tuple[str, ...]) -> Targets:
    """Returns the reference view and those of these roles, resized to a longer side of `size` pixels (never enlarged).

    Raises DataError when one of them is empty in every frame, and for pictures that are a single row or column then.
    """
    with ViewsReader(path) as reader:
        header = reader.header
        chosen = [view for view, role in enumerate(header.role) if role in roles or view == header.reference]
        scale = min(1.0, size / max(header.size))
        width, height = (max(int(round(side * scale)), 1) for side in header.size)
        if min(width, height) < 2:
            raise DataError(
                f"{path}: pictures of {header.size[0]} x {header.size[1]} pixels, {width} x {height} at --size {size}, are too"
                " narrow; expected at least 2 each way, give a larger --size or prepare the clip again"
            )
        pictures = torch.empty(len(chosen), reader.num_frames, height, width, 4, dtype=torch.float16)
        for row, view in enumerate(chosen):
            for frame in range(reader.num_frames):
                pictures[row, frame] = _resize(reader.rgba(view, frame), width, height)
        factor = np.array([width / header.size[0], height / header.size[1], 1.0])[:, None]
        reference = chosen.index(header.reference)
        for row in (reference, *range(len(chosen))):
            if not pictures[row, :, :, :, 3].any():
                which = "the reference view" if row == reference else f"view {chosen[row]} ({header.role[chosen[row]]})"
                raise DataError(f"{path}: {which} shows nothing in any frame (alpha is zero); prepare the clip again")
        return Targets(
            header.name,
            pictures,
            np.asarray(header.intrinsics)[chosen] * factor,
            np.asarray(header.world_to_camera)[chosen],
            np.asarray(header.time),
            reference,
            header.length_unit,
            list(reader.provenance),
        )


def _resize(rgba: np.ndarray, width: int, height: int) -> Tensor:  # [H, W, 4]
    """Returns color times alpha, and alpha, area-averaged to the size."""
    value = torch.from_numpy(rgba).float() / 255
    value[..., :3] *= value[..., 3:]
    if rgba.shape[:2] == (height, width):
        return value
    stacked = value.permute(2, 0, 1)[None]
    return torch.nn.functional.interpolate(stacked, (height, width), mode="area")[0].permute(1, 2, 0)

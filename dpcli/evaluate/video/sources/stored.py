"""Videos in files of this program: views as they are stored, and Gaussian scenes, rendered at the truth's cameras."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dpcli.evaluate.video.sources.source import Picture, Source, View
from dpcli.store.views import ViewsHeader, ViewsReader

if TYPE_CHECKING:
    from dpcli.store.gaussians import GaussianScene


def _views_of(roles: Sequence[str]) -> list[View]:
    """Returns views of these roles; they are also called by their place among those of their role. `eval_k`: Consistent4D's name."""
    views = []
    for index, role in enumerate(roles):
        of_role = roles[:index].count(role)
        extra = ("reference",) if role == "reference" else (f"{role}_{of_role}",)
        views.append(View((str(index), *extra, *((f"eval_{of_role}",) if role == "test" else ())), role))
    return views


def draw_scene(
    scene: GaussianScene, time: float, poses: np.ndarray, lenses: np.ndarray, size: tuple[int, int], mode: str = "RGB"
) -> tuple[np.ndarray, np.ndarray]:  # [C, H, W, 3 or 1], [C, H, W, 1]
    """Returns what cameras (C,4,4), (C,3,3) see of a scene, f32: premultiplied colors, or as `mode` says, and alpha."""
    import torch

    from dpcli.ops.splatting.rasterization import rasterization

    arrays = (*scene.at(time), scene.scale, scene.opacity, scene.sh, poses, lenses)
    tensors = (torch.from_numpy(np.ascontiguousarray(array, np.float32)) for array in arrays)
    options = {"near_plane": scene.near, "sh_degree": scene.sh_degree, "render_mode": mode}
    with torch.no_grad():
        drawn, alpha, _ = rasterization(*tensors, *size, **options)
    return drawn.numpy(), alpha.numpy()


class ViewsSource(Source):
    """Reads the pictures of a `views` file."""

    kind = "views file"

    def __init__(self, path: Path) -> None:
        self.path, self.reader = path, ViewsReader(path)
        self.header, self.provenance = self.reader.header, self.reader.provenance
        self.views, self.times = _views_of(self.header.role), self.header.time
        self.frames = [self.header.num_frames] * len(self.views)

    def pictures(self, view: int, frames: Sequence[int]) -> Iterator[Picture]:
        for frame in frames:
            yield Picture(rgba=self.reader.rgba(view, frame))

    def close(self) -> None:
        self.reader.close()


class SceneSource(Source):
    """Renders a `gaussians` file at the cameras and times of a views file, in float32, never rounded to 8 bits.

    Raises DataError when the truth's times lie more than half a frame outside the scene's.
    """

    kind, frames = "gaussians file", None

    def __init__(self, path: Path, header: ViewsHeader, truth: Path) -> None:
        from dpcli.store.gaussians import read_scene, scene_origin

        self.path, self.header, self.scene, self.provenance = path, header, read_scene(path), scene_origin(path)[1]
        self.views, asked = _views_of(header.role), header.time
        span = f"{truth} has frames from {asked[0]:.4g} to {asked[-1]:.4g} s; was it fitted to another clip?"
        self.scene.require_times(asked, self.path, span)

    def pictures(self, view: int, frames: Sequence[int]) -> Iterator[Picture]:
        head = self.header
        cameras = (head.world_to_camera[view, None], head.intrinsics[view, None], head.size)
        for frame in frames:
            color, alpha = draw_scene(self.scene, float(head.time[frame]), *cameras)
            yield Picture(values=np.concatenate([color[0, ..., :3], alpha[0]], -1))

"""Videos in files of this program: views as they are stored, and Gaussian scenes, rendered at the truth's cameras."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from dpcli.evaluate.video.sources.source import Picture, Source, View
from dpcli.store.views import ViewsHeader, ViewsReader


def _view_names(index: int, role: str, of_role: int) -> tuple[str, ...]:
    """Returns the names of view `index`; of_role: how many views of its role come before. `eval_k` is Consistent4D's name."""
    extra = ("reference",) if role == "reference" else (f"{role}_{of_role}",)
    return (str(index), *extra, *((f"eval_{of_role}",) if role == "test" else ()))


class ViewsSource(Source):
    """Reads the pictures of a `views` file."""

    kind = "views file"

    def __init__(self, path: Path) -> None:
        self.path, self.reader = path, ViewsReader(path)
        self.header, self.provenance = self.reader.header, self.reader.provenance
        roles, self.times = self.header.role, self.header.time
        self.views = [View(_view_names(i, role, roles[:i].count(role)), role) for i, role in enumerate(roles)]
        self.frames = [self.header.num_frames] * len(self.views)

    def pictures(self, view: int, frames: Sequence[int]) -> Iterator[Picture]:
        """Yields the frames of a view, as stored."""
        for frame in frames:
            yield Picture(rgba=self.reader.rgba(view, frame))

    def close(self) -> None:
        """Closes the file."""
        self.reader.close()


class SceneSource(Source):
    """Renders a `gaussians` file at the cameras and times of a views file, in float32, never rounded to 8 bits.

    Raises DataError when the truth's times lie more than half a frame outside the scene's.
    """

    kind, frames = "gaussians file", None

    def __init__(self, path: Path, header: ViewsHeader, truth: Path) -> None:
        from dpcli.store.gaussians import read_scene, scene_origin

        self.path, self.header, self.scene, self.provenance = path, header, read_scene(path), scene_origin(path)[1]
        roles = header.role
        self.views = [View(_view_names(i, role, roles[:i].count(role)), role) for i, role in enumerate(roles)]
        self._check_times(truth)

    def _check_times(self, truth: Path) -> None:
        asked = self.header.time
        span = f"{truth} has frames from {asked[0]:.4g} to {asked[-1]:.4g} s; was it fitted to another clip?"
        self.scene.require_times(asked, self.path, span)

    def pictures(self, view: int, frames: Sequence[int]) -> Iterator[Picture]:
        """Yields the frames of a view, rendered."""
        for frame in frames:
            yield Picture(values=self._render(view, float(self.header.time[frame])))

    def _render(self, view: int, time: float) -> np.ndarray:
        """Returns premultiplied colors and alpha f32 (H,W,4)."""
        import torch

        from dpcli.ops.splatting.rasterization import rasterization

        scene, (width, height) = self.scene, self.header.size
        cameras = (self.header.world_to_camera[view, None], self.header.intrinsics[view, None])
        arrays = (*scene.at(time), scene.scale, scene.opacity, scene.sh, *cameras)
        with torch.no_grad():
            tensors = (torch.from_numpy(np.ascontiguousarray(array, np.float32)) for array in arrays)
            colors, alphas, _ = rasterization(*tensors, width, height, near_plane=scene.near, sh_degree=scene.sh_degree)
        return torch.cat([colors[0, ..., :3], alphas[0]], -1).numpy()

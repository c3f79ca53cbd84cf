"""The settings of `dpc generate4d render`: where the camera goes, when, and what is drawn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from dpcli.runtime.settings.catalog import Catalog
from dpcli.runtime.settings.fields import Settings, setting

CameraPath = Literal["turntable", "orbit", "swing", "fixed", "reference"]
Color = Literal["appearance", "part", "rigid", "depth"]


@dataclass(frozen=True)
class RenderSettings(Settings):
    """Holds how a scene is drawn. None stands for the reference camera's own. Raises UsageError for a value that is not legal."""

    path: CameraPath = setting(
        "turntable",
        "Path of the camera: turntable (once around), orbit (also up and down), swing, fixed, or reference (the input's own camera).",
    )
    azimuth: float | None = setting(
        None, "Azimuth of the camera, degrees; 0 is at +z, positive toward +x; none: the reference camera's."
    )
    elevation: float | None = setting(
        None, "Elevation of the camera above the horizon, degrees; none: the reference camera's.", least=-90, most=90
    )
    radius: float | None = setting(
        None, "Distance of the camera from what it turns around, scene units; none: the reference camera's.", above=0
    )
    fovy: float | None = setting(
        None, "Vertical field of view, degrees; none: the reference camera's.", above=0, below=180
    )
    size: int | None = setting(None, "Longer side of a picture, pixels; none: that of the fit.", least=8, most=8192)
    frames: int | None = setting(
        None, "Number of pictures; none: whole loops of the clip, about 4 seconds.", least=1, most=100_000
    )
    fps: float | None = setting(
        None, "Pictures per second; none: the clip's own rate, or a multiple of it.", least=1, most=120
    )
    time: float | None = setting(None, "Second at which the clip is frozen; none: it plays in a loop.")
    color: Color = setting(
        "appearance", "What the colors show: the object's own, its parts, the rigid weight, or depth."
    )
    background: str = setting(
        "white", "Background: white, black, r,g,b (0 to 255), or none: transparent, for .png and folders."
    )
    trajectories: bool = setting(False, "Draw the trails of control points, or of Gaussians where there are none.")
    columns: int = setting(8, "Instants of the clip on the contact sheet of --picture.", least=1, most=60)

    def changed(self, *names: str) -> list[str]:
        """Returns those of the named settings that differ from their defaults."""
        return [name for name in names if getattr(self, name) != getattr(RenderSettings, name)]


CATALOG = Catalog(render=RenderSettings)

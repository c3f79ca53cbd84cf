"""Does the work of `dpc generate4d view`; the options are in `cli/generate4d/view.py`."""

from __future__ import annotations

from pathlib import Path

from dpcli.counted import counted
from dpcli.errors import UsageError
from dpcli.generate4d.out.export import keep_opaque
from dpcli.generate4d.viewer import write_page
from dpcli.runtime.progress import log
from dpcli.runtime.provenance import file_digest
from dpcli.runtime.whole_file import refuse_existing
from dpcli.store import input_file
from dpcli.store.gaussians import read_scene, scene_origin


def view_scene(
    scene_file: str,
    output: Path,
    *,
    clip: Path | None,
    title: str | None,
    min_opacity: float,
    fps: float | None,
    force: bool,
) -> None:
    """Writes one self-contained HTML page of a scene, with the pictures of the clip it was fitted to where that is given.

    Raises UsageError for a name that isn't .html or that exists, DataError for a clip of another length.
    """
    if output.suffix.lower() not in (".html", ".htm"):
        raise UsageError(f"-o {output}: expected a name that ends in .html")
    refuse_existing(output, force)
    with input_file(scene_file) as place:
        scene, (root, history) = read_scene(place), scene_origin(place)
    if clip is not None:
        _tell_other_clip(clip, history)
    scene = keep_opaque(scene, min_opacity)
    size = write_page(scene, output, title=title or str(root["source"]) or "scene", history=history, fps=fps, clip=clip)
    log.info(
        f"{output}: {counted(scene.num_gaussians, 'Gaussian')}, {counted(scene.num_frames, 'frame')}, {size / 2**20:.1f} MiB"
    )


def _tell_other_clip(clip: Path, history: list[dict]) -> None:
    """Warns of a clip that isn't the file which was fitted: as many frames as the scene's don't make it the same object."""
    inputs = [entry["inputs"] for entry in history if isinstance(entry.get("inputs"), dict)]
    fitted = next((files["views"] for files in reversed(inputs) if "views" in files), None)
    if fitted is not None and clip.is_file() and file_digest(clip) != fitted:
        log.warn(
            f"--input {clip}: is another file than the one that was fitted; its pictures are shown beside the scene all the same,"
            " check that they show the same clip"
        )

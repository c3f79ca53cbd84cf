"""Does the work of `dpc generate4d export`; the options are in `cli/generate4d/export.py`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpcli.counted import counted
from dpcli.errors import UsageError
from dpcli.generate4d.out.export import (
    POINT_OPACITY,
    as_sequence,
    export_file,
    export_sequence,
    keep_opaque,
    tables_beside,
    write_json,
)
from dpcli.generate4d.out.formats import Axes, Format
from dpcli.generate4d.out.splat_files import camera_list
from dpcli.runtime import provenance
from dpcli.runtime.progress import log
from dpcli.runtime.seeds import generator
from dpcli.runtime.whole_file import refuse_existing
from dpcli.store import CloudSequence, CloudsWriter, input_file, output_file
from dpcli.store.gaussians import GaussianScene, read_scene, scene_origin

_SPLATS = ("ply", "splat", "compressed.ply", "spz")  # one file for a file's name, one a frame for a folder's
_TABLES = ("cameras", "metrics")  # one .json each


def export_scene(
    scene_file: str,
    output: str,
    *,
    form: Format,
    time: float | None,
    axes: Axes,
    min_opacity: float | None,
    points: int | None,
    seed: int,
    force: bool,
) -> None:
    """Writes a scene in another format. Raises UsageError where the options or the name of `output` don't fit the format."""
    if output == "-" and form != "clouds":
        raise UsageError(f"-o -: only --as clouds goes through a pipe; name a file or folder for {form}")
    if time is not None and not _is_single(form, Path(output)):
        kind = form.partition("-")[0] if form.startswith(_SPLATS) else _SPLATS[0]
        raise UsageError(f"--time is of one file: name it with --as {kind} -o FILE.{kind}")
    if points is not None and form != "clouds":
        raise UsageError(f"--points is of --as clouds; leave it out for {form}")
    if min_opacity is not None and form in _TABLES:
        raise UsageError(f"--min-opacity is of Gaussians and clouds; leave it out for {form}")
    with input_file(scene_file) as place:
        scene, (root, history) = read_scene(place), scene_origin(place)
        config = {"as": form, "axes": axes, "min_opacity": min_opacity, "points": points}
        entry = provenance.record(config, seed, {"gaussians": place}) if form == "clouds" else {}
    if time is not None:
        scene.require_times(np.array([time]), scene_file, f"--time is {time:g}")
    if form == "clouds":
        name, least = str(root["source"]) or "scene", POINT_OPACITY if min_opacity is None else min_opacity
        sequence = as_sequence(scene, name, min_opacity=least, points=points, rng=generator(seed), axes=axes)
        _export_clouds(sequence, output, root, [*history, entry], seed, force)
    else:
        _export_files(keep_opaque(scene, min_opacity or 0.0), Path(output), form, time, axes, force)


def _export_clouds(
    sequence: CloudSequence, output: str, root: dict, history: list[dict], seed: int, force: bool
) -> None:
    fields = ["time", "color", "part", "track", *(["pose"] if sequence.pose is not None else [])]
    origin = {"source": str(root["source"]), "length_unit": str(root["length_unit"]), "provenance": history}
    with output_file(output) as target, CloudsWriter(target, fields=fields, seed=seed, force=force, **origin) as writer:
        writer.write(sequence)
    log.info(f"{counted(sequence.num_frames, 'frame')} of {counted(len(sequence.frame(0)), 'point')}")


def _is_single(form: Format, output: Path) -> bool:
    """Returns whether that is one file for players, or was meant to be: such a suffix makes no folder."""
    return form in _SPLATS and output.suffix.lower() in (".ply", ".splat", ".spz", ".json")


def _export_files(
    scene: GaussianScene, output: Path, form: Format, time: float | None, axes: Axes, force: bool
) -> None:
    kind, single = form.partition("-")[0], _is_single(form, output)
    if form in _TABLES and output.suffix.lower() != ".json":
        raise UsageError(f"-o {output}: expected a name that ends in .json")
    if single and not output.name.lower().endswith(f".{kind}"):
        raise UsageError(f"-o {output}: expected a name that ends in .{kind}, or a folder for one file a frame")
    if form in _TABLES or single:
        refuse_existing(output, force)
    if form in _TABLES:
        write_json(output, camera_list(scene, axes) if form == "cameras" else scene.metrics)
    elif single:
        export_file(scene, output, kind, time=time, axes=axes)
    else:
        paths = export_sequence(scene, output, kind, axes=axes, force=force)
        beside = ", ".join(path.name for path in tables_beside(output))
        log.info(f"{output}: {paths[0].name} to {paths[-1].name}; beside it {beside}")

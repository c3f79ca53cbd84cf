"""`dpc generate4d fit` of many clips: each one's scene in a folder, in processes, shards or on a cluster."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dpcli.counted import counted
from dpcli.errors import DpcError, Stopped, UsageError
from dpcli.generate4d.commands.fit import fit_scene
from dpcli.generate4d.config import FitConfig, Supervision
from dpcli.path_names import short_names
from dpcli.runtime.machines.shards import WHOLE
from dpcli.runtime.machines.spread import ALONE, Spread
from dpcli.runtime.pool import ordered_map
from dpcli.runtime.progress import log
from dpcli.runtime.signals import stop_requested
from dpcli.runtime.whole_file import make_folder


@dataclass(frozen=True)
class FitClip:
    """Fits one clip; picklable, for worker processes."""

    config: FitConfig
    supervision: Supervision
    options: dict[str, Any]

    def __call__(self, clip: tuple[Path, Path]) -> Path:
        """Fits the views of the first path, or continues, and returns the second, where the scene is then."""
        views, output = clip
        fit_scene(str(views), str(output), self.config, self.supervision, run=None, picture=None, **self.options)
        return output


@dataclass
class FittedClips:
    """Holds the scenes that are there, and the clips that have none, (views, reason)."""

    scenes: list[Path] = field(default_factory=list)
    failed: list[tuple[str, str]] = field(default_factory=list)


def fit_clips(
    views: Sequence[str],
    folder: Path,
    config: FitConfig,
    supervision: Supervision,
    *,
    seed: int,
    device: str,
    force: bool,
    spread: Spread = ALONE,
) -> FittedClips:
    """Fits each views file to a scene in `folder`, under the views file's name; clips that are finished are left as they are.

    A clip that can't be fitted, or whose process dies, is named, and the others go on. Nothing is merged: the
    scenes of all shards lie in one folder. Raises UsageError for `-` and for an output that is no folder, Stopped after a
    stop signal.
    """
    clips = _name_scenes(views, folder)
    mine = [clips[place] for place in (spread.shard or WHOLE).places(len(clips))]
    work, fitted = FitClip(config, supervision, {"seed": seed, "device": device, "force": force}), FittedClips()
    with (
        spread.workers() as workers,
        stop_requested() as stop,
        closing(ordered_map(work, mine, min(workers.slots, len(mine)), workers.executor)) as results,
    ):
        for (clip, scene), result in results:
            if isinstance(result, DpcError) and not isinstance(result, (UsageError, Stopped)):
                fitted.failed.append((str(clip), str(result)))
                log.warn(f"{clip}: {result}")
            elif isinstance(result, Exception):
                raise result
            else:
                fitted.scenes.append(scene)
            done = f"fitted: {len(fitted.scenes)} of {counted(len(mine), 'clip')}"
            log.info(done)
            stop.check(done)
    return fitted


def _name_scenes(views: Sequence[str], folder: Path) -> list[tuple[Path, Path]]:
    """Returns (views, scene) of each clip, in the order of their names. Raises UsageError where that can't be."""
    if "-" in views or str(folder) == "-":
        raise UsageError("-: a pipe holds one clip; name files, and a folder with -o, to fit several")
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"-o {folder}: is a file; several clips need a folder for their scenes")
    make_folder(folder)
    paths = sorted(map(Path, views))
    names = [name.removesuffix(".h5").replace("/", "-") for name in short_names(paths)]
    if len(set(names)) < len(names):
        raise UsageError(f"{len(names)} clips have {len(set(names))} names; each scene needs a name of its own")
    return [(path.resolve(), (folder / f"{name}.h5").resolve()) for path, name in zip(paths, names)]

"""The worker processes of `dpc prepare` get ready while this process still loads its parser: half a second of each run.

Imports next to nothing, because `dpc` calls it first of all.
"""

from __future__ import annotations

from collections.abc import Sequence

_VIDEO = "dpcli.prepare.warm_video"
NEEDED = {
    "msraction3d": ("dpcli.prepare.actions.msraction3d",),
    "nvgesture": ("dpcli.prepare.actions.nvgesture", _VIDEO),
    "depth": ("dpcli.prepare.actions.depth", _VIDEO),
    "clouds": ("dpcli.prepare.scans.clouds",),
    "shrec17": ("dpcli.prepare.actions.shrec17", _VIDEO),
    "ntu60": ("dpcli.prepare.actions.ntu60", _VIDEO),
    "kitti-sf": ("dpcli.prepare.scans.kitti_sf",),
    "kitti-det": ("dpcli.prepare.scans.kitti_det",),
    "semantickitti": ("dpcli.prepare.scans.semantickitti",),
}  # command -> modules that its workers import


def head_start(words: Sequence[str]) -> None:
    """Start the server of worker processes that a command line will want.

    words: those after ``dpc``, not parsed yet. A wrong guess costs only time: the pool has what it needs either way.
    """
    words = [part for word in words for part in word.split("=", 1)]
    names = [word for word in words if not word.startswith("-")]
    modules = NEEDED.get(names[1], ()) if names[:1] == ["prepare"] and len(names) > 1 else ()
    if not modules or not {"-o", "--output"} & set(words) or {"-h", "--help", "--check", "--dask"} & set(words):
        return
    from dpcli.runtime.device import cpu_count

    said = dict(zip(words, words[1:]))
    jobs = said.get("--jobs", "")
    if (int(jobs) if jobs.isdigit() else cpu_count()) < 2:
        return
    from dpcli.runtime.worker_server import start_early

    sampling = ["dpcli.prepare.warm_fps"] if said.get("--sampling") == "fps" else []
    start_early([*modules, "dpcli.prepare.one_item", *sampling])

"""Imported once by the server of worker processes: OpenCV, silenced. See `worker_server.start_early`."""

from __future__ import annotations

try:
    from dpcli.prepare.decode.depth_files import load_cv2

    load_cv2()
except Exception:  # a worker that needs it will say what is wrong
    pass

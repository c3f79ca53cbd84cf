"""OpenCV, imported when it is needed and set up for worker processes."""

from __future__ import annotations

import os

from dpcli.runtime.clips.container_ends import VIDEO_FORMATS


def load_cv2():  # -> module
    """Imports OpenCV and returns it, with one thread and without its own lines on stderr about damaged files.

    Our messages name the file and say what to do. A video that names further files is not opened.
    """
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    os.environ.setdefault("OPENCV_FFMPEG_CAPTURE_OPTIONS", f"format_whitelist;{VIDEO_FORMATS}")
    import cv2

    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    cv2.setNumThreads(1)  # one process per core is the parallelism
    return cv2

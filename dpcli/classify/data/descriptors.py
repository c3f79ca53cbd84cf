"""Hand-made descriptors of a video: what a forest of decision trees classifies by, and every network should beat.

All of them are quantiles and slopes, so that a few points far off, or frames without any, change little.
"""

from __future__ import annotations

import numpy as np

from dpcli.classify.network.descriptors import SLOTS, described
from dpcli.store import CloudSequence, CloudsReader
from dpcli.store.schema import kept_name

_LARGEST = 1e30  # a forest takes float32


def descriptor(sequence: CloudSequence, fields: tuple[str, ...]) -> np.ndarray:
    """Returns the descriptor f64 (D) of a video; D depends on the number of fields alone.

    fields: kept columns, such as `field_doppler`. It holds the place and extent of the whole cloud, and for each of six
    slots of time the number of points, quantiles of position (about the video's median) and fields, and their shift
    since the slot before. A slot without points repeats the one before; a video without any is a point at the origin.
    """
    if not len(sequence.points):
        sequence = CloudSequence.from_frames(sequence.name, [np.zeros((1, 3), np.float32)])
    times = np.repeat(np.arange(sequence.num_frames), np.diff(sequence.frame_offsets))
    middle = np.median(sequence.points, 0)
    columns = [sequence.extra.get(name, np.zeros(len(times))) for name in fields]
    values = np.column_stack([sequence.points - middle, *columns]).astype(np.float64)
    place = middle if sequence.shift is None else middle + sequence.shift  # of other videos nothing may be taken off
    size = [sequence.num_frames, len(times) / max(sequence.num_frames, 1), *place]
    found = np.concatenate([size, described(values, times * SLOTS // max(sequence.num_frames, 1))])
    return np.nan_to_num(found).clip(-_LARGEST, _LARGEST)


def descriptors(reader: CloudsReader, sequences: list[int], columns: tuple[str, ...]) -> np.ndarray:
    """Returns the descriptors f64 (N,D) of some videos of a file, with some of the columns that it keeps."""
    fields = tuple(map(kept_name, columns))
    return np.stack([descriptor(reader.read(i, fields=fields), fields) for i in sequences])

"""Samples that take their process down, or loop in C forever, cost themselves alone, also with one process."""

from __future__ import annotations

import itertools
import os
import signal
import time
import zlib
from dataclasses import dataclass
from pathlib import Path

import pytest

from dpcli.errors import DataError
from dpcli.prepare.pipeline import Conversion, convert
from tests.support.prepare_helpers import ToyReader


@dataclass(frozen=True)
class Deadly(ToyReader):
    """Ends or blocks the process that reads item 1, as C code does."""

    how: str = "dies"
    raw: Path = Path()

    def read(self, item, rng):
        if item.extra["k"] == 1:
            if self.how == "dies":
                os.kill(os.getpid(), signal.SIGSEGV)
            sum(itertools.repeat(0))  # holds the interpreter: no signal handler of Python's runs
        return super().read(item, rng)


@pytest.mark.parametrize("how, words", [("dies", "by SIGSEGV"), ("loops", "--item-seconds allows")])
def test_one_process_loses_one_sample_by_name(how, words, tmp_path):
    reader = Deadly(count=3, how=how, raw=tmp_path)
    report = convert(reader, tmp_path / "o.h5", Conversion(jobs=1, item_seconds=0.3))
    assert report.written == 2
    [(name, reason)] = report.skipped
    assert name == "toy001" and words in reason


def test_stop_at_a_sample_that_takes_its_process_down(tmp_path):
    with pytest.raises(DataError, match="toy001.*by SIGSEGV"):
        convert(Deadly(count=2, raw=tmp_path), tmp_path / "o.h5", Conversion(jobs=1, item_seconds=5, on_error="stop"))
    assert not (tmp_path / "o.h5").exists()


def test_what_c_libraries_print_is_shown_to_debug_alone(tmp_path, dpc):
    import numpy as np
    from PIL import Image

    (tmp_path / "raw" / "a").mkdir(parents=True)
    for frame in range(2):
        depth = np.random.default_rng(frame).integers(1000, 2000, (12, 16)).astype(np.uint16)
        Image.fromarray(depth).save(tmp_path / "raw" / "a" / f"{frame}.png")
    data = bytearray((tmp_path / "raw" / "a" / "1.png").read_bytes())
    start, end = data.index(b"IDAT"), data.index(b"IEND") - 8
    data[start + 30 : start + 40] = bytes(10)  # nothing to be unpacked, but the checksum of the chunk is right
    data[end : end + 4] = zlib.crc32(data[start:end]).to_bytes(4, "big")
    (tmp_path / "raw" / "a" / "1.png").write_bytes(data)
    words = ("prepare", "depth", tmp_path / "raw", "--fov", 60, "-o", tmp_path / "o.h5")
    quiet, loud = dpc(*words), dpc(*words, "--debug")
    assert quiet.returncode == loud.returncode == 3
    assert b"libpng" not in quiet.stderr and b"1.png" in quiet.stderr and b"libpng error" in loud.stderr


def test_larger_files_may_take_longer(tmp_path):
    from dpcli.prepare.convert_item import _megabytes

    (tmp_path / "a" / "b").mkdir(parents=True)
    for name, size in (("a/1", 1000), ("a/b/2", 2000)):
        (tmp_path / name).write_bytes(bytes(size))
    (tmp_path / "a" / "above").symlink_to("..")
    (tmp_path / "a" / "gone").symlink_to("nowhere")
    assert _megabytes(tmp_path / "a") == pytest.approx(0.003, abs=1e-4)
    assert _megabytes(tmp_path / "none") == _megabytes(Path("a\0")) == 0


def test_how_a_process_ended_is_read_by_one_thread(tmp_path, monkeypatch):
    """The pipe that holds it can be read once: a second reader at the same time takes it for the code 255."""
    from multiprocessing import forkserver

    read = forkserver.read_signed

    def slowly(pipe):
        time.sleep(0.2)
        return read(pipe)

    monkeypatch.setattr(forkserver, "read_signed", slowly)
    reader = Deadly(count=2, raw=tmp_path)
    report = convert(reader, tmp_path / "o.h5", Conversion(jobs=1, item_seconds=5))
    assert "by SIGSEGV" in report.skipped[0][1]

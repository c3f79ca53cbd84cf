"""What was read from a file is kept for as long as the file stays as it was, and no longer."""

import os

import numpy as np
import pytest

from dpcli.file_cache import cached_by_file, file_state
from dpcli.prepare.articulated.ogc_meshes import load_shape


def test_a_file_is_read_again_when_it_changed_or_another_took_its_place(tmp_path):
    path, calls = tmp_path / "a.txt", []

    @cached_by_file(2)
    def read(path, end):
        calls.append(end)
        return path.read_text() + end

    with pytest.raises(FileNotFoundError):
        read(path, "!")
    assert file_state(path) is None and calls == ["!"]
    path.write_text("one")
    assert [read(path, "!"), read(path, "!"), read(path, "?")] == ["one!", "one!", "one?"]
    assert calls == ["!", "!", "?"]
    path.write_text("longer")
    assert read(path, "!") == "longer!"
    other = tmp_path / "b.txt"
    other.write_text("LONGER")
    os.utime(other, ns=(path.stat().st_atime_ns, path.stat().st_mtime_ns))
    os.replace(other, path)
    assert read(path, "!") == "LONGER!"


def test_a_mesh_that_was_replaced_is_another_shape(tmp_path):
    path = tmp_path / "a.obj"
    faces = "f 1 2 3\nf 1 3 4\nf 1 4 2\nf 2 4 3\n"
    path.write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n{faces}")
    before = load_shape(path, "y")
    path.write_text(f"v 0 0 0\nv 1 0 0\nv 0 0.25 0\nv 0 0 1\n{faces}")
    after = load_shape(path, "y")
    assert np.ptp(before.hull, axis=0).tolist() == [1, 1, 1] and np.ptp(after.hull, axis=0).tolist() == [1, 0.25, 1]

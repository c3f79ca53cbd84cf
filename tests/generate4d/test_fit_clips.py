"""Many clips, each fitted to a scene of its own: in processes and in shards the same scenes, and a bad clip is named."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

from tests.generate4d.test_fit import steps, toy_views

OPTIONS = ("--preset", "tiny", "--size", "16", *steps(4, 2), "--device", "cpu")


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clips")
    toy_views(folder / "a.h5", train=1)
    toy_views(folder / "b.h5")
    (folder / "c.h5").write_bytes(b"no HDF5")
    return folder


def content(path) -> dict[str, np.ndarray]:
    """All data sets of a scene; its attributes tell how many seconds it took."""
    found: dict[str, np.ndarray] = {}
    with h5py.File(path) as file:
        file.visititems(lambda name, item: found.update({name: item[()]}) if isinstance(item, h5py.Dataset) else None)
    return found


def test_processes_and_shards_fit_the_same_scenes(clips, tmp_path, dpc, dpc_here):
    good = [clips / "a.h5", clips / "b.h5"]
    for path in good:
        assert dpc_here("generate4d", "fit", path, "-o", tmp_path / path.name, *OPTIONS).returncode == 0
    together = dpc("generate4d", "fit", *good, "-o", tmp_path / "jobs", *OPTIONS, "--jobs", 2)
    assert together.returncode == 0 and together.stdout.decode() == f"{tmp_path / 'jobs'}: 2 scenes\n", together.stderr
    for k in range(2):
        words = ("generate4d", "fit", *reversed(good), "-o", f"{tmp_path / 'shards'}/", *OPTIONS, "--shard", f"{k}/2")
        assert dpc_here(*words).stdout == f"{tmp_path / 'shards'}: 1 scene\n".encode()
    for name in ("a.h5", "b.h5"):
        alone = content(tmp_path / name)
        for folder in ("jobs", "shards"):
            other = content(tmp_path / folder / name)
            for key in alone.keys() - {"provenance"}:
                np.testing.assert_array_equal(alone[key], other[key], err_msg=f"{folder} {name} {key}")
    again = dpc_here("generate4d", "fit", *good, "-o", tmp_path / "jobs", *OPTIONS)
    assert again.returncode == 0 and again.stderr.count(b"already complete") == 2


def test_a_bad_clip_is_named_and_the_others_are_fitted(clips, tmp_path, dpc_here):
    done = dpc_here("generate4d", "fit", clips / "c.h5", clips / "a.h5", "-o", tmp_path / "out", *OPTIONS)
    assert done.returncode == 3 and done.stdout == f"{tmp_path / 'out'}: 1 scene\n".encode()
    assert b"no scene of 1 clip: " in done.stderr and b"c.h5" in done.stderr
    assert (tmp_path / "out" / "a.h5").exists() and not (tmp_path / "out" / "c.h5").exists()


def test_what_is_wrong_is_said(clips, tmp_path, dpc_here):
    a, b = clips / "a.h5", clips / "b.h5"
    (tmp_path / "file").touch()
    for words, said in (
        ((a, "-", "-o", tmp_path / "x"), "a pipe holds one clip"),
        ((a, b, "-o", tmp_path / "file"), "is a file; several clips need a folder"),
        ((a, b, "-o", tmp_path / "x", "--run", tmp_path / "y"), "--run and --picture are for one clip"),
        ((a, "-o", tmp_path / "x.h5", "--shard", "0/2"), "one is fitted as a whole"),
    ):
        done = dpc_here("generate4d", "fit", *words, *OPTIONS)
        assert done.returncode == 2 and said in done.stderr.decode(), done.stderr

"""MultiBodySync's files: poses that satisfy the published flow formula, damaged files, pickles that would run code."""

from __future__ import annotations

import io
import json
import pickle
import zipfile

import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.prepare.articulated.articulated_sequence import random_rotation
from dpcli.prepare.articulated.mbs import MultiBodySync, read_views
from dpcli.store import CloudsReader
from tests.support.commands import told as dpc

FAR = np.array([[1, 0, 0, np.inf], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])  # shifts without end


def motion(rng):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = random_rotation(rng), rng.normal(size=3)
    return matrix


def make_sample(seed, parts=3, points=40):
    """A sample as distributed, and the points of all views in the frames of their parts."""
    rng = np.random.default_rng(seed)
    trans = {"cam": [motion(rng) for _ in range(4)], **{s + 1: [motion(rng) for _ in range(4)] for s in range(parts)}}
    segm = np.stack([1 + rng.permutation(points) % parts for _ in range(4)])
    body = rng.normal(size=(4, points, 3))
    pc = np.empty((4, points, 3))
    for v in range(4):
        for n in range(points):
            world = trans[segm[v, n]][v] @ [*body[v, n], 1]
            pc[v, n] = (np.linalg.inv(trans["cam"][v]) @ world)[:3]
    return {"pc": pc.astype(np.float32), "segm": segm, "trans": trans}, body


def write(raw, samples, meta):
    (raw / "data").mkdir(parents=True)
    (raw / "meta.json").write_text(json.dumps(meta))
    for number, sample in samples.items():
        np.savez_compressed(raw / "data" / f"{number:06d}.npz", **sample)
    return raw


def test_poses_take_body_points_to_the_views(tmp_path):
    sample, body = make_sample(0)
    raw = write(tmp_path / "raw", {7: sample}, {"test": [7]})
    points, part, pose = read_views(raw / "data" / "000007.npz")
    assert part.min() == 0 and pose.shape == (4, 3, 4, 4)
    for v in range(4):
        m = pose[v, part[v]]
        np.testing.assert_allclose((m[:, :3, :3] @ body[v][..., None])[..., 0] + m[:, :3, 3], points[v], atol=1e-5)


def test_flow_is_the_published_formula(tmp_path):
    sample, _ = make_sample(1)
    raw = write(tmp_path / "raw", {0: sample}, {"train": [0]})
    points, part, pose = read_views(raw / "data" / "000000.npz")
    trans, inverse = sample["trans"], np.linalg.inv
    for n in range(10):
        s = int(sample["segm"][1, n])
        p = np.array([*points[1, n], 1])
        expected = inverse(trans["cam"][3]) @ trans[s][3] @ inverse(trans[s][1]) @ trans["cam"][1] @ p
        np.testing.assert_allclose(pose[3, part[1, n]] @ inverse(pose[1, part[1, n]]) @ p, expected, atol=1e-9)
        wrong = trans["cam"][3] @ trans[s][3] @ inverse(trans[s][1]) @ inverse(trans["cam"][1]) @ p
        assert np.abs(wrong - expected).max() > 1e-2


def test_the_command(tmp_path):
    samples = {0: make_sample(0, 2)[0], 1: make_sample(1, 5)[0], 12: make_sample(2, 3)[0]}
    raw = write(tmp_path / "raw", samples, {"train": [0, 3], "val": [12], "test": [1]})
    done = dpc("prepare", "mbs", raw, "-o", tmp_path / "x.h5", "--item-seconds", 0, "--jobs", 1)
    assert done.returncode == 0, done.stderr
    assert "000003.npz: listed under 'train' in meta.json, but not there" in done.stderr
    with CloudsReader(tmp_path / "x.h5") as reader:
        assert reader.names == ["000000", "000012", "000001"] and reader.splits == ["train", "validation", "test"]
        first = reader.read(0)
        assert first.pose.shape == (4, 5, 4, 4)  # padded to the largest
        np.testing.assert_array_equal(first.pose[:, 2:], np.tile(np.eye(4), (4, 3, 1, 1)))
        np.testing.assert_array_equal(first.points, samples[0]["pc"].reshape(-1, 3))
        np.testing.assert_array_equal(first.part, samples[0]["segm"].ravel() - 1)


def old_pickle(value) -> bytes:
    """An object array saved by NumPy before 2.0 under Python 2: protocol 2, modules under numpy.core."""
    array = np.empty((), object)
    array[()] = value
    data = pickle.dumps(array, protocol=2).replace(b"numpy._core.", b"numpy.core.")
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "|O", "fortran_order": False, "shape": ()})
    return stream.getvalue() + data


def replace_trans(path, data: bytes):
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members["trans.npy"] = data
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)


def test_old_pickles_are_read(tmp_path):
    sample, _ = make_sample(0)
    path = write(tmp_path / "raw", {0: sample}, {"train": [0]}) / "data" / "000000.npz"
    expected = read_views(path)[2]
    replace_trans(path, old_pickle(sample["trans"]))
    np.testing.assert_array_equal(read_views(path)[2], expected)


class _Evil:
    def __init__(self, function, argument):
        self.call = function, (argument,)

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("name", ["os.mkdir", "builtins.eval", "numpy.load"])
def test_pickles_that_call_functions_are_refused(name, tmp_path):
    import os

    function = {"os.mkdir": os.mkdir, "builtins.eval": eval, "numpy.load": np.load}[name]
    mark = tmp_path / "mark"
    argument = {"builtins.eval": f"__import__('os').mkdir({str(mark)!r})"}.get(name, str(mark))
    sample, _ = make_sample(0)
    path = write(tmp_path / "raw", {0: sample}, {"train": [0]}) / "data" / "000000.npz"
    evil = old_pickle({**sample["trans"], "x": _Evil(function, argument)})
    replace_trans(path, evil)
    with pytest.raises(DataError, match="trans is a pickle that is not of plain arrays: it asks for"):
        read_views(path)
    assert not mark.exists()
    if name == "os.mkdir":  # the attack itself works: an ordinary unpickler makes the folder
        np.load(path, allow_pickle=True)["trans"]
        assert mark.exists()


@pytest.mark.parametrize(
    "change, words",
    [
        ({"pc": np.zeros((4, 5))}, r"pc is float64 \(4, 5\); expected floats \(views, points, 3\)"),
        ({"pc": np.full((4, 40, 3), np.nan)}, "pc holds NaN"),
        ({"segm": np.zeros((4, 40), int)}, "segm holds ids from 0 to 0; expected 1"),
        ({"segm": np.zeros((4, 0), int)}, r"segm is int64 \(4, 0\); expected whole numbers"),
        ({"segm": np.full((4, 40), np.nan)}, r"segm is float64 \(4, 40\); expected whole numbers"),
        ({"segm": np.full((4, 40), 10**9)}, "segm holds ids from 1000000000 to"),
        ({"segm": np.ones((4, 39), int)}, r"segm is int64 \(4, 39\); expected whole numbers \(4, 40\)"),
        ({"segm": np.full((4, 40), 9)}, "trans has no 4; found 'cam', 1, 2, 3"),
        ({"trans": {1: []}}, "trans has no 'cam'"),
        ({"trans": [1, 2]}, "trans"),
        ({"trans": {"cam": [np.eye(4)] * 3, 1: [], 2: [], 3: []}}, r"trans\['cam'\] has shape \(3, 4, 4\)"),
        ({"trans": {"cam": [2 * np.eye(4)] * 4, 1: [], 2: [], 3: []}}, r"trans\['cam'\] is not a rigid motion"),
        ({"trans": {"cam": [np.nan * np.eye(4)] * 4, 1: [], 2: [], 3: []}}, "is not a rigid motion"),
        ({"trans": {"cam": [FAR] * 4, 1: [], 2: [], 3: []}}, "is not a rigid motion"),
        ({"trans": {"cam": [np.diag([1.0, 1, 1, 2])] * 4, 1: [], 2: [], 3: []}}, "is not a rigid motion"),
    ],
)
def test_damaged_samples(change, words, tmp_path):
    """They are refused, and the other samples keep the number of parts that they have."""
    sample, _ = make_sample(0)
    raw = write(tmp_path / "raw", {0: {**sample, **change}, 1: make_sample(1, 2)[0]}, {"train": [0, 1]})
    with pytest.raises(DataError, match=words):
        read_views(raw / "data" / "000000.npz")
    assert {item.extra["parts"] for item in MultiBodySync(raw).items()} <= {2, 3, 9}


def test_missing_arrays_and_files(tmp_path):
    sample, _ = make_sample(0)
    del sample["trans"]
    raw = write(tmp_path / "raw", {0: sample}, {"train": [0]})
    with pytest.raises(DataError, match="no array 'trans' in it; found: pc, segm"):
        read_views(raw / "data" / "000000.npz")
    (raw / "data" / "000000.npz").write_bytes(b"PK nonsense")
    with pytest.raises(DataError, match="not a .npz file, perhaps truncated"):
        read_views(raw / "data" / "000000.npz")


@pytest.mark.parametrize(
    "keys", [("train", "val", "test"), ("Training", "validation", "test_set"), ("0", "valid", "x")]
)
def test_splits_of_meta_json_in_other_words_and_samples_in_none(tmp_path, keys):
    raw = write(tmp_path / "raw", {k: make_sample(k)[0] for k in range(4)}, {key: [k] for k, key in enumerate(keys)})
    reader = MultiBodySync(raw)
    known = [1] if keys[0] == "0" else [0, 1, 2]
    items = reader.items()
    assert [(i.name, i.split) for i in items] == [(f"{k:06d}", ("train", "validation", "test")[k]) for k in known]
    left = ", ".join(f"{k:06d}" for k in range(4) if k not in known)
    assert reader.summary(items)[-1] == f"not read, in no split of meta.json: {left}"
    (raw / "meta.json").write_text('{"train": [3]}')  # what comes later in the same process is found, too
    assert [item.name for item in MultiBodySync(raw).items()] == ["000003"]


@pytest.mark.parametrize(
    "text, words",
    [
        (None, "not found; expected meta.json"),
        ("{", "not JSON"),
        ("[1]", "expected"),
        ('{"train": ["a"]}', "expected"),
        ('{"train": [1, 1]}', "1 number listed twice"),
    ],
)
def test_meta_json(text, words, tmp_path):
    if text is not None:
        (tmp_path / "meta.json").write_text(text)
    with pytest.raises(DataError, match=words):
        MultiBodySync(tmp_path).items()

"""The one list of fields: every writer writes what it says, and the tables of docs/format.md are made of it."""

from __future__ import annotations

import re
from pathlib import Path

import h5py
import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.ops.cameras import DEFAULT_FOVY, orbit_pose, pinhole
from dpcli.store import CloudsReader, CloudsWriter, ScoresWriter, ViewsHeader, ViewsWriter
from dpcli.store.embedding import StreamEmbedding, write_embedding
from dpcli.store.file import open_store
from dpcli.store.gaussians import write_scene
from dpcli.store.schema import KINDS, TABLES, fields_of, fill_tables, table
from dpcli.store.statistics import StatisticsWriter
from tests.support.parts_helpers import CHAIN, perfect, truth_sequence, write_parts
from tests.support.scenes import toy_scene

PAGE = Path(__file__).parents[2] / "docs" / "format.md"


def write_clouds(path: Path) -> None:
    sequence, rng = truth_sequence("s0", seed=0), np.random.default_rng(0)
    count = len(sequence.points)
    sequence.color, sequence.track = rng.integers(0, 255, (count, 3), np.uint8), np.arange(count)
    sequence.scene_flow, sequence.time = np.zeros((count, 3), np.float32), np.arange(sequence.num_frames) / 10
    sequence.pose = np.tile(np.eye(4), (sequence.num_frames, 4, 1, 1))
    sequence.joint = np.zeros((sequence.num_frames, 4, 9))
    sequence.shift, sequence.extra = np.ones(3), {"field_NAME": np.zeros(count, np.float32)}
    fields = ["time", "color", "part", "track", "scene_flow", "pose", "joint", "field_NAME"]
    with CloudsWriter(path, class_names=["a", "b"], fields=fields, provenance={"command": "dpc"}) as writer:
        writer.write(sequence)
        writer.skipped, writer.positions = [("bad", "why")], ([0], [1])


def write_views(path: Path) -> None:
    size, poses = (6, 5), np.stack([orbit_pose(0.0, 0.0), orbit_pose(0.5, 0.1)])
    lens = np.stack([pinhole(DEFAULT_FOVY, *size)] * 2)
    header = ViewsHeader("toy", lens, poses, np.zeros(1), ["reference", "test"], 0, size, "m")
    truth = {"track": np.zeros((1, 4, 3), np.float32), "part": np.zeros(4, np.int16)}
    with ViewsWriter(path, header, provenance={"command": "dpc"}, **truth) as writer:
        for view in range(2):
            writer.add(view, 0, np.zeros((5, 6, 4), np.uint8))


def write_scores(path: Path) -> None:
    with ScoresWriter(path, class_names=["a", "b"], streams=("static",), provenance={"command": "dpc"}) as writer:
        writer.write("v", np.array([0.5, 0.5]), streams={"static": np.array([0.5, 0.5])})


def write_vectors(path: Path) -> None:
    stream = StreamEmbedding(np.zeros((2, 5), np.float32), np.zeros((2, 2), np.float32))
    labels = np.zeros(2, np.int32)
    write_embedding(path, ["a", "b"], labels, ["", ""], {"static": stream}, class_names=["x"], provenance=[{}])


def write_statistics(path: Path) -> None:
    with StatisticsWriter(path, class_names=["a"], provenance=[{"command": "dpc"}]) as writer:
        writer.write("v", {"count": 1})


WRITERS = {
    "clouds": write_clouds,
    "views": write_views,
    "scores": write_scores,
    "parts": lambda path: write_parts(path, [perfect(truth_sequence("s0", seed=0), 4, CHAIN)]),
    "gaussians": lambda path: write_scene(path, toy_scene(), provenance={"command": "dpc fit"}),
    "embedding": write_vectors,
    "statistics": write_statistics,
}


def data_sets(path: Path) -> dict[str, h5py.Dataset]:
    """The data sets of a file by the name of their field: those of a group under the group's name."""
    found: dict[str, tuple[np.dtype, int]] = {}
    with open_store(path) as file:
        file.visititems(
            lambda name, item: (
                found.update({name.split("/")[0]: (item.dtype, item.shape)}) if isinstance(item, h5py.Dataset) else None
            )
        )
    return found


@pytest.mark.parametrize("kind", KINDS)
def test_a_writer_writes_what_the_list_says(kind, tmp_path):
    WRITERS[kind](tmp_path / "a.h5")
    found, fields = data_sets(tmp_path / "a.h5"), fields_of(kind)
    assert set(found) <= set(fields)
    assert {name for name, field in fields.items() if not field.optional} <= set(found)
    for name, (dtype, shape) in found.items():
        field = fields[name]
        assert dtype == (h5py.string_dtype() if field.kind == "str" else field.dtype), name
        assert len(shape) == len(field.shape), name
        assert all(size == said for size, said in zip(shape, field.shape) if isinstance(said, int)), name


def test_a_clouds_file_has_every_field_but_the_activation(tmp_path):
    write_clouds(tmp_path / "a.h5")
    assert set(fields_of("clouds")) - set(data_sets(tmp_path / "a.h5")) == {"activation"}


@pytest.mark.parametrize("kind, name", [(kind, name) for kind in KINDS for name in fields_of(kind)])
def test_values_of_another_sort_are_refused(kind, name, tmp_path):
    path, field = tmp_path / "a.h5", fields_of(kind)[name]
    WRITERS[kind](path)
    with h5py.File(path, "r+") as file:
        if name in file:
            del file[name]
        file[name] = np.arange(3) if field.kind == "str" or field.group else ["no", "numbers"]
    expected = ("a group of " if field.group else "") + field.in_words()
    with pytest.raises(DataError, match=f"'{name}' holds something else .*expected {re.escape(expected)}"):
        open_store(path)


def test_the_page_has_the_tables_that_the_list_makes():
    text = PAGE.read_text()
    assert [kind for kind in TABLES if f"<!-- fields: {kind} -->" not in text] == []
    assert fill_tables(text) == text, "run: python -m dpcli.store.schema docs/format.md"


def test_a_table_has_a_line_for_each_field():
    lines = table("scores").splitlines()
    assert len(lines) == 2 + len(TABLES["scores"])
    assert "| `streams/STREAM` | f32 (S,C), optional | the same of one stream of the network |" in lines
    page = "before\n<!-- fields: scores -->\nold\n<!-- end of fields -->\nafter\n"
    assert fill_tables(page) == page.replace("old\n", table("scores"))


def test_a_file_of_another_program_may_have_more(tmp_path):
    write_clouds(tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        file["theirs"] = np.ones(3)
    assert len(CloudsReader(tmp_path / "a.h5")) == 1


def test_the_page_s_example_writes_a_file_of_tracks(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tracks = np.random.default_rng(0).normal(size=(4, 6, 3))
    np.save("tracks.npy", tracks)
    (example,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    exec(example, {})
    with CloudsReader("tracks.h5") as reader:
        sequence = reader.read(0)
    assert np.array_equal(sequence.points.reshape(4, 6, 3), tracks.astype(np.float32))
    assert sequence.track.reshape(4, 6).tolist() == [[0, 1, 2, 3, 4, 5]] * 4

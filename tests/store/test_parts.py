"""The parts contract: what is written comes back; what doesn't fit is refused; still a clouds file."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from dpcli.cli.app import app
from dpcli.errors import DataError, Stopped, UsageError
from dpcli.runtime.provenance import file_digest
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter, PartsReader, PartsWriter, file_kind
from dpcli.store.summary import summary
from tests.support.hdf5_edits import edit, replacing
from tests.support.parts_helpers import CHAIN, perfect, rigid, truth_sequence, write_parts

K = 4


@pytest.fixture
def samples() -> list[tuple]:
    """Three sequences with three, no, and one pair."""
    pairs = [CHAIN, np.zeros((0, 2), np.int32), CHAIN[:1]]
    return [perfect(truth_sequence(f"s{i}", seed=i, label=i % 2), K, pairs[i]) for i in range(3)]


def assert_holds(path: Path, samples: list[tuple]) -> None:
    with PartsReader(path) as reader:
        assert reader.names == [sample[0].name for sample in samples]
        for index, (sequence, probability, pairs, motion, flow) in enumerate(samples):
            said, back = reader.read_parts(index), reader.read(index)
            assert np.array_equal(back.points, sequence.points) and np.array_equal(back.part, sequence.part)
            for found, given_ in ((said.probability, probability), (said.pairs, pairs), (said.motion, motion)):
                assert found.dtype == given_.dtype and np.array_equal(found, given_)
            assert len(said.flow) == len(flow) and all(map(np.array_equal, said.flow, flow))


def test_round_trip(tmp_path, samples):
    path = write_parts(tmp_path / "a.h5", samples)
    assert_holds(path, samples)
    reader = PartsReader(path)
    assert reader.num_parts == K and reader.pair_counts.tolist() == [3, 0, 1]
    assert file_kind(path) == "parts"
    with pytest.raises(AssertionError):  # the checker sees a changed number
        samples[2][4][0][0, 0] += 1
        assert_holds(path, samples)


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    sizes=st.lists(st.lists(st.integers(0, 5), min_size=1, max_size=4).filter(any), min_size=1, max_size=4),
    num_parts=st.integers(1, 5),
    data=st.data(),
)
def test_any_ragged_file(tmp_path, sizes, num_parts, data):
    rng = np.random.default_rng(1)
    samples = []
    for number, frames in enumerate(sizes):
        frame = st.integers(0, len(frames) - 1)
        pairs = np.array(data.draw(st.lists(st.tuples(frame, frame), max_size=3)), np.int32).reshape(-1, 2)
        clouds = [rng.normal(size=(n, 3)) for n in frames]
        part = [rng.integers(-1, num_parts, n) for n in frames]
        motion = np.array([rigid(rng) for _ in range(len(pairs) * num_parts)], np.float32)
        samples.append(
            (
                CloudSequence.from_frames(f"n{number}", clouds, part=part),
                rng.dirichlet(np.ones(num_parts), sum(frames)).astype(np.float32),
                pairs,
                motion.reshape(len(pairs), num_parts, 4, 4),
                [rng.normal(size=(frames[i], 3)).astype(np.float32) for i, _ in pairs],
            )
        )
    assert_holds(write_parts(tmp_path / "ragged.h5", samples, num_parts, force=True), samples)


def test_a_parts_file_is_a_clouds_file(tmp_path, samples):
    path = write_parts(tmp_path / "a.h5", samples)
    with CloudsReader(path) as reader:
        assert np.array_equal(reader.read(1).part, samples[1][0].part)
        assert reader.fields == ("part",)
    with CloudsWriter(tmp_path / "b.h5") as writer:
        writer.write(truth_sequence("x", label=-1))
    with pytest.raises(DataError, match="holds 'clouds', expected 'parts'"):
        PartsReader(tmp_path / "b.h5")


def test_a_reader_travels_to_another_process(tmp_path, samples):
    reader = PartsReader(write_parts(tmp_path / "a.h5", samples))
    reader.read_parts(0)
    assert np.array_equal(pickle.loads(pickle.dumps(reader)).read_parts(0).motion, samples[0][3])


def test_equal_work_gives_equal_bytes(tmp_path, samples):
    assert file_digest(write_parts(tmp_path / "a.h5", samples)) == file_digest(write_parts(tmp_path / "b.h5", samples))


@pytest.mark.parametrize("stop", [Stopped("now"), KeyboardInterrupt()])
def test_stopped_part_continues_to_identical_bytes(tmp_path, samples, stop):
    options = {"provenance": {"command": "x", "config": {"k": 1}}, "resume": True}
    whole = write_parts(tmp_path / "whole.h5", samples, **options)
    path = tmp_path / "stopped.h5"
    with pytest.raises(type(stop)), PartsWriter(path, num_parts=K, **options) as writer:
        writer.write(*samples[0])
        raise stop
    with PartsWriter(path, num_parts=K, class_names=("door", "lamp"), length_unit="m", **options) as writer:
        assert writer.written_names == ["s0"]
        for sample in samples[1:]:
            writer.write(*sample)
    assert file_digest(path) == file_digest(whole)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["stopped.h5", "whole.h5"]


@pytest.mark.parametrize("reached", ["part_motion", "flow", "points", "sequence_offsets", "name", "camera"])
def test_a_sample_cut_short_is_written_again(tmp_path, samples, monkeypatch, reached):
    """Ctrl-C between two appends of a sample must not shift what follows."""
    options = {"provenance": {"command": "x"}, "resume": True}
    whole = write_parts(tmp_path / "whole.h5", samples, **options)
    path = tmp_path / "stopped.h5"
    append = PartsWriter._append

    def interrupted(self, name, values):
        append(self, name, values)
        if name == reached and len(self) == 1:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(PartsWriter, "_append", interrupted)
        write_parts(path, samples, **options)
    with PartsWriter(path, num_parts=K, class_names=("door", "lamp"), length_unit="m", **options) as writer:
        assert writer.written_names == ["s0"]
        for sample in samples[1:]:
            writer.write(*sample)
    assert file_digest(path) == file_digest(whole)


def test_a_part_with_another_number_of_parts_stays_and_force_starts_over(tmp_path, samples):
    with pytest.raises(Stopped), PartsWriter(tmp_path / "a.h5", num_parts=K, resume=True) as writer:
        writer.write(*samples[0])
        raise Stopped("now")
    more = perfect(truth_sequence("s0"), K + 1)
    with pytest.raises(UsageError, match=f"with other settings or inputs .num_parts {K}, now {K + 1}"):
        PartsWriter(tmp_path / "a.h5", num_parts=K + 1, resume=True)
    with PartsWriter(tmp_path / "a.h5", num_parts=K + 1, resume=True, force=True) as writer:
        assert writer.written_names == []
        writer.write(*more)
    assert PartsReader(tmp_path / "a.h5").num_parts == K + 1


def changed(sample: tuple, row: int, value: object) -> tuple:
    return (*sample[:row], value, *sample[row + 1 :])


def _with(array: np.ndarray, place: object, value: float) -> np.ndarray:
    made = array.copy()
    made[place] = value
    return made


BAD = {
    "probability has shape": lambda s: changed(s, 1, s[1][:, :3]),
    "probability holds 1.5, expected 0..1": lambda s: changed(s, 1, _with(s[1], (3, 1), 1.5)),
    "1 of 123 points with NaN or infinite probability, the first is point 3": lambda s: changed(
        s, 1, _with(s[1], (3, 1), np.nan)
    ),
    "2 of 123 points with NaN or infinite probability, the first is point 7": lambda s: changed(
        s, 1, _with(s[1], ([9, 7], 1), np.inf)
    ),
    "pairs holds 3, expected 0..2": lambda s: changed(s, 2, _with(s[2], (1, 0), 3)),
    "motion has shape": lambda s: changed(s, 3, s[3][:2]),
    "motion of part 2 in pair 1 is not a rigid one": lambda s: changed(s, 3, _with(s[3], (1, 2, 0, 0), 2)),
    "motion of part 0 in pair 0 is not": lambda s: changed(s, 3, _with(s[3], (0, 0, 3, 0), 0.1)),
    "motion of part 3 in pair 0 is not": lambda s: changed(s, 3, _with(s[3], (0, 3, 0, 0), -1)),  # a mirror
    "motion of part 1 in pair 2 is not": lambda s: changed(s, 3, _with(s[3], (2, 1, 0, 3), np.inf)),
    "flow of 2 pairs, expected 3": lambda s: changed(s, 4, s[4][:2]),
    "flow 1 -> 2 has shape": lambda s: changed(s, 4, [s[4][0], s[4][0], s[4][2]]),
    "42 of 123 points with NaN or infinite flow, the first is point 0 of flow 2 -> 1": lambda s: changed(
        s, 4, [*s[4][:2], s[4][2] * np.nan]
    ),
    "3 of 123 points with NaN or infinite flow, the first is point 5 of flow 1 -> 2": lambda s: changed(
        s, 4, [s[4][0], _with(s[4][1], ([5, 8], 2), np.inf), _with(s[4][2], 0, np.nan)]
    ),
    "no part, though": lambda s: changed(s, 0, CloudSequence("s0", s[0].points, s[0].frame_offsets)),
}


@pytest.mark.parametrize("said", BAD)
def test_what_does_not_fit_is_refused_and_nothing_of_it_stays(tmp_path, samples, said):
    with PartsWriter(tmp_path / "a.h5", num_parts=K) as writer:
        with pytest.raises(DataError, match="'s0'") as error:
            writer.write(*BAD[said](samples[0]))
        assert said in str(error.value)
        for sample in samples:
            writer.write(*sample)
    assert_holds(tmp_path / "a.h5", samples)


def test_ids_beyond_the_slots_and_no_slots_are_refused(tmp_path, samples):
    samples[0][0].part[5] = K
    with (
        pytest.raises(DataError, match=f"part holds {K}, expected -1..{K - 1}"),
        PartsWriter(tmp_path / "a.h5", num_parts=K) as writer,
    ):
        writer.write(*samples[0])
    with pytest.raises(UsageError, match="at least one"):
        PartsWriter(tmp_path / "a.h5", num_parts=0)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda f: f.__delitem__("part_probability"), "part_probability is missing"),
        (lambda f: f.__delitem__("part"), "'part' is missing"),
        (lambda f: f.__delitem__("flow_offsets"), "'flow_offsets' is missing"),
        (replacing("part_probability", np.zeros((5, K), np.float32)), r"has shape \(5, 4\)"),
        (replacing("pair_offsets", np.array([0, 3, 2, 4])), "never fall"),
        (replacing("pair_offsets", np.array([0, 4])), "has 2 rows ending at 4, expected 4"),
        (replacing("part_motion", np.zeros((1, K, 4, 4), np.float32)), "part_motion has 1 rows for 4 pairs"),
    ],
)
def test_a_damaged_layout_is_said_on_opening(tmp_path, samples, change, said):
    path = write_parts(tmp_path / "a.h5", samples)
    edit(path, change)
    with pytest.raises(DataError, match=said) as error:
        PartsReader(path)
    assert str(path) in str(error.value)


def test_damaged_values_are_said_when_read(tmp_path, samples):
    path = write_parts(tmp_path / "a.h5", samples)
    edit(path, lambda file: file["flow"].__setitem__(0, np.nan))
    reader = PartsReader(path)
    with pytest.raises(DataError, match=r"a\.h5: sample 's0': 1 of 123 points with NaN or infinite flow, the first"):
        reader.read_parts(0)
    reader.read_parts(2)


def test_info_counts_parts_and_pairs(tmp_path, samples):
    samples[1][0].part[:] = -1
    path = write_parts(tmp_path / "a.h5", samples)
    found = summary(path)
    assert found["kind"] == "parts"
    assert found["counts"]["part_slots"] == K and found["counts"]["frame_pairs"] == 4
    assert found["parts_per_sequence"] == {"min": 0, "median": 3.0, "max": 3}
    result = CliRunner().invoke(app, ["info", str(path)])
    assert "parts per sequence   0 / 3 / 3 (min / median / max)" in result.stdout
    assert json.loads(CliRunner().invoke(app, ["info", str(path), "--json"]).stdout)["pairs_per_sequence"]["max"] == 3

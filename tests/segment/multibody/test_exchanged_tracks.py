"""Tracks that exchange their identities, as trackers do where points pass each other: parts come out as without."""

from __future__ import annotations

import numpy as np
import pytest

from dpcli.segment.multibody.settings import MultibodySettings
from dpcli.segment.multibody.tracks import follow_tracks, parts_of_tracks, undo_exchanges
from tests.segment.multibody.test_multibody import agreement, chest, predicted


def exchanged(sequence, lasting: bool, count: int = 8) -> None:
    """Exchanges pairs of tracks where a frame shows both, in one frame each or from one frame on."""
    rng = np.random.default_rng(1)
    tracks = np.split(sequence.track, sequence.frame_offsets[1:-1])
    pairs, begins = rng.permutation(320)[: 2 * count].reshape(-1, 2), rng.integers(1, sequence.num_frames, count)
    for t, own in enumerate(tracks):
        for (a, b), begin in zip(pairs, begins):
            first, second = own == a, own == b
            if first.any() and second.any() and (t >= begin if lasting else t == begin):
                own[first], own[second] = b, a
    sequence.track = np.concatenate(tracks)


@pytest.mark.parametrize("lasting", [False, True])
def test_exchanges_of_tracks_change_no_part_and_are_told(lasting, capsys):
    sequence = chest(keep=True, frames=6)
    labels, _ = predicted(sequence)
    assert not capsys.readouterr().err
    exchanged(sequence, lasting)
    again, _ = predicted(sequence)
    told = capsys.readouterr().err
    assert "chest: tracks seem to exchange their identities" in told and f" of {len(labels)} points" in told
    assert agreement(again, sequence) > 0.99
    np.testing.assert_array_equal(again, labels)


def test_what_moves_on_its_own_is_no_exchange():
    """A bead that runs to and fro on a rod, particles that go anywhere, a belt, a sheet that bends."""
    rng, line = np.random.default_rng(0), np.linspace(0, 1, 200)
    rod = np.c_[line, 0 * line, 0 * line]
    belt = [2 * np.pi * (line + t * 3 / 200) for t in range(8)]
    for clouds in (
        [np.r_[rod, [[0.2 + 0.5 * (t % 3 == 1), 0.01, 0]]] for t in range(8)],
        list(rng.random((8, 150, 3))),
        [np.c_[np.cos(angle), np.sin(angle), 0 * angle] / 2 for angle in belt],
        [np.c_[line, np.cos(40 * line) / 4, 0.1 * np.sin(6 * line + t)] for t in range(8)],
    ):
        tracks = follow_tracks(clouds, [np.arange(len(clouds[0]))] * len(clouds))
        index, undone = undo_exchanges(tracks, parts_of_tracks(tracks, MultibodySettings()))
        assert undone == 0 and all(map(np.array_equal, index, tracks.index))

"""One explanation of all frames: parts and motions of made objects, exact tracks, the kernels, and poor input."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from dpcli.segment.multibody.explanation import Explanation, body_of, label_points
from dpcli.segment.multibody.frames import Frames, choose_partners, relative_motion
from dpcli.segment.multibody.hypotheses import Hypothesis
from dpcli.segment.multibody.joint_motions import simplify_motions
from dpcli.segment.multibody.least_turn import turn_least
from dpcli.segment.multibody.search import Search, explain_sequence, fill_in
from dpcli.segment.multibody.segmenter import MultibodySegmenter, masks_of
from dpcli.segment.multibody.settings import MultibodySettings
from dpcli.segment.multibody.tracks import follow_tracks, parts_of_tracks
from dpcli.segment.prediction import predict_parts
from dpcli.segment.prediction_settings import Refinement
from dpcli.segment.rigid_motions import fit_motions, move
from dpcli.segment.training.trainer import rand_index
from dpcli.store import CloudSequence


def box_surface(rng, count, low, size):
    """Points on the surface of a box, by area."""
    size = np.asarray(size, float)
    area = np.array([size[1] * size[2], size[0] * size[2], size[0] * size[1]])
    points, axis = rng.random((count, 3)), rng.choice(3, count, p=area / area.sum())
    points[np.arange(count), axis] = rng.integers(0, 2, count)
    return np.asarray(low) + points * size


def turn(angle, axis, at):
    """The motion (4,4) that turns about an axis through a point."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]], float)
    motion = np.eye(4)
    motion[:3, :3] = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    motion[:3, 3] = np.asarray(at) - motion[:3, :3] @ at
    return motion


def chest(seed=0, frames=4, points=320, unit=1.0, place=(0, 0, 0), keep=False):
    """A chest whose lid opens by 17 degrees a frame, never closed, while all turns; drawn anew in each frame, or tracked (keep)."""
    rng, clouds, parts, poses, tracks = np.random.default_rng(seed), [], [], [], []
    few = points // 3
    drawn = None
    for t in range(frames):
        whole = turn(0.1 * t, (0.0, 0.6, 0.8), (0.2, 0.1, 0.0))
        lid = whole @ turn(-0.3 * (t + 1), (0.0, 1.0, 0.0), (0.0, 0.0, 0.3))
        if drawn is None or not keep:
            drawn = [
                box_surface(rng, points - few, (0, 0, 0), (0.5, 0.6, 0.29)),
                box_surface(rng, few, (0, 0, 0.3), (0.5, 0.6, 0.04)),
            ]
        moved = [p @ m[:3, :3].T + m[:3, 3] for p, m in zip(drawn, (whole, lid))]
        order = rng.permutation(points)[: points - 20 * (t % 2 if keep else 0)]
        clouds.append(np.float32(np.concatenate(moved)[order] * unit + place))
        parts.append(np.repeat([0, 1], [points - few, few])[order])
        tracks.append(order)
        poses.append(np.stack([whole, lid]))
    fields = {"track": tracks} if keep else {}
    return CloudSequence.from_frames("chest", clouds, part=parts, pose=np.stack(poses), **fields)


def predicted(sequence, **options):
    """Labels and sample of a sequence."""
    return predict_parts(sequence, MultibodySegmenter(MultibodySettings()), None, Refinement(**options), 0)


def agreement(labels, sequence):
    """The Rand index."""
    return rand_index(torch.tensor(labels), torch.tensor(np.int64(sequence.part)))


def test_parts_and_motions_of_a_chest_from_points_drawn_anew():
    sequence = chest()
    labels, sample = predicted(sequence, pairs="all")
    assert agreement(labels, sequence) > 0.9
    assert np.sort(np.bincount(labels))[-2:].sum() > 0.95 * len(labels)
    for (i, j), motion in zip(sample.pairs, sample.motion):
        truth = sequence.pose[j] @ np.linalg.inv(sequence.pose[i])
        for part in range(2):
            own = np.bincount(labels[sequence.part == part]).argmax()
            points = sequence.frame(i)[np.split(sequence.part, sequence.frame_offsets[1:-1])[i] == part]
            gap = points @ (motion[own] - truth[part])[:3, :3].T + (motion[own] - truth[part])[:3, 3]
            # the lid is a thin plate of about 100 points a frame, which slides in its plane by up to two of their distances
            assert np.linalg.norm(gap, axis=1).mean() < (0.025, 0.12)[part]


def test_a_tilted_motion_that_fits_beats_one_that_slides_in_its_own_plane():
    sequence = chest()
    clouds, part = [sequence.frame(t) for t in range(4)], np.split(sequence.part, sequence.frame_offsets[1:-1])
    body, lid = np.ascontiguousarray(sequence.pose[:, :2, :3, :4].swapaxes(0, 1), np.float64)
    slid, tilted = lid.copy(), lid.copy()
    for t in (1, 3):
        slid[t, :, 3] += lid[t, :, 0] * 0.075  # no ICP brings a plate back that slid: it lies in its plane
        tilted[t] = lid[t] @ turn(0.05, (0.0, 1.0, 0.0), (0.0, 0.0, 0.3))
    pool = [Hypothesis(0, clouds[0], trajectory) for trajectory in (body, slid, tilted)]
    search = Search(Frames(clouds), MultibodySettings(regrow=0), pool)
    found = search.improve(search.begin())
    both = [[relative_motion(one, t, t + 1) for one in (found.bodies[-1].trajectory, lid)] for t in range(3)]
    gaps = [np.linalg.norm(move(one - two, clouds[t][part[t] == 1]), axis=1) for t, (one, two) in enumerate(both)]
    assert len(found.bodies) == 2
    assert np.concatenate(gaps).mean() < 0.045


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_two_frames_are_not_explained_by_many_small_bodies(seed):
    """One other frame alone judges every point then, and each patch finds a place that fits it by chance."""
    rng, clouds, part = np.random.default_rng(seed), [], np.repeat([0, 0, 1], [120, 60, 60])
    swing = turn(1.1, (0.0, 0.0, 1.0), (0.04, 0.04, 0.5))
    for motion in (np.eye(4), swing):  # the jib of a crane
        base, post = (
            box_surface(rng, 120, (0, 0, 0), (0.6, 0.4, 0.05)),
            box_surface(rng, 60, (0, 0, 0.05), (0.05, 0.05, 0.5)),
        )
        jib = box_surface(rng, 60, (0, 0, 0.5), (0.6, 0.08, 0.04)) @ motion[:3, :3].T + motion[:3, 3]
        clouds.append(np.float32(np.concatenate([base, post, jib]) - 0.3))
    found = explain_sequence(clouds, MultibodySettings())  # 9, 16 and 10 bodies where each cost next to nothing
    assert len(found.bodies) == 2
    assert rand_index(torch.tensor(found.label), torch.tensor(np.tile(part, 2))) > 0.85


@pytest.mark.parametrize(("unit", "place"), [(1e-3, (0, 0, 0)), (40.0, (5e4, -3e4, 100))])
def test_units_and_places_change_nothing_much(unit, place):
    labels, _ = predicted(chest(unit=unit, place=place))
    assert agreement(labels, chest()) > 0.9


@pytest.mark.parametrize(("strays", "keep", "away"), [(1, False, 1e5), (4, False, 3.0), (4, True, 3.0)])
def test_stray_points_do_not_make_the_object_tiny(strays, keep, away):
    """Such as flying pixels of a depth camera; as the farthest points, they once said how large the object is."""
    sequence = chest(keep=keep)
    far = np.random.default_rng(strays).normal(size=(strays, 3)) * 0.3 * away + away
    clouds, parts = [sequence.frame(t) for t in range(4)], np.split(sequence.part, sequence.frame_offsets[1:-1])
    tracks = np.split(sequence.track, sequence.frame_offsets[1:-1]) if keep else None
    for t in (1, 2):
        clouds[t], parts[t] = np.float32(np.concatenate([clouds[t], far + t])), np.append(parts[t], np.full(strays, -1))
        if keep:
            tracks[t] = np.append(tracks[t], 1000 + 10 * t + np.arange(strays))
    given = CloudSequence.from_frames("chest", clouds, part=parts, **({"track": tracks} if keep else {}))
    labels, _ = predicted(given)
    known = given.part >= 0
    assert rand_index(torch.tensor(labels[known]), torch.tensor(np.int64(given.part[known]))) > 0.9


def test_one_motion_stays_one_part():
    rng = np.random.default_rng(1)
    clouds = []
    for t in range(3):
        motion = turn(0.15 * t, (0.6, 0.0, 0.8), (0, 0, 0))
        clouds.append(np.float32(box_surface(rng, 300, (0, 0, 0), (0.5, 0.3, 0.4)) @ motion[:3, :3].T))
    labels, _ = predicted(CloudSequence.from_frames("box", clouds))
    assert len(np.unique(labels)) == 1


@pytest.mark.parametrize("seed", [2, 3, 4, 7])
def test_hardly_any_side_that_comes_into_view_is_a_further_body(seed):
    """A box with a knob turns before a camera, which sees a little of another side in every frame."""
    rng, clouds = np.random.default_rng(seed), []
    for t in range(4):
        drawn = (
            box_surface(rng, 1600, (-0.5, -0.3, -0.2), (1, 0.6, 0.4)),
            box_surface(rng, 400, (0.1, -0.1, 0.2), [0.2] * 3),
        )
        motion = turn(0.1 * t, (0.0, 1.0, 0.0), (0, 0, 0))
        points = np.concatenate(drawn) @ motion[:3, :3].T
        pixel = np.unique(np.floor(points[:, :2] / 0.06), axis=0, return_inverse=True)[1].ravel()
        nearest = np.full(pixel.max() + 1, -np.inf)
        np.maximum.at(nearest, pixel, points[:, 2])
        seen = rng.permutation(np.flatnonzero(points[:, 2] > nearest[pixel] - 0.08))[:400]
        clouds.append(np.float32(points[seen]))
    labels, _ = predicted(CloudSequence.from_frames("box", clouds))
    assert len(np.unique(labels)) <= 2  # 4 or 5 if bodies that other frames don't show were kept


def test_tracks_are_exact_and_may_begin_and_end():
    sequence = chest(keep=True, frames=5)
    labels, sample = predicted(sequence, pairs="all")
    assert agreement(labels, sequence) > 0.99
    by_track = [set(labels[sequence.track == track]) for track in np.unique(sequence.track)]
    assert all(len(own) == 1 for own in by_track)
    lid = int(np.bincount(labels[sequence.part == 1]).argmax())
    for pair, motion in zip(sample.pairs, sample.motion):
        true = sequence.pose[pair[1], 1] @ np.linalg.inv(sequence.pose[pair[0], 1])
        assert np.abs(motion[lid] - true).max() < 1e-3


@lru_cache(maxsize=1)
def searched():
    """Labels and sample of the tracked chest without its tracks."""
    sequence = chest(keep=True)
    sequence.track = None
    return predicted(sequence)


@pytest.mark.parametrize("broken", ["twice", "restart", "unknown"])
def test_tracks_that_do_not_tell_how_all_points_move_are_not_used(broken, capsys):
    sequence = chest(keep=True)
    frame = np.repeat(np.arange(4), np.diff(sequence.frame_offsets))
    track = sequence.track.copy()
    if broken == "twice":
        track //= 4
    elif broken == "restart":
        track[frame >= 2] += 1000
    else:
        track[::3] = -1
    sequence.track = track
    labels, sample = predicted(sequence)
    warned = capsys.readouterr().err
    assert "chest: its tracks are not used, and motions are searched: frame" in warned and warned.count("warning") == 1
    same, plain = searched()
    assert (labels == same).all() and all(map(np.array_equal, sample.flow, plain.flow))
    assert not capsys.readouterr().err


def test_tracks_are_used_across_frames_without_points_and_where_points_occur_twice(capsys):
    whole = chest(keep=True, frames=3)
    frames, tracks = [whole.frame(t) for t in range(3)], np.split(whole.track, whole.frame_offsets[1:-1])
    frames[1], tracks[1] = np.repeat(frames[1], 2, axis=0), np.repeat(tracks[1], 2)
    none = np.zeros((0, 3), np.float32)
    holed = [frames[0], none, frames[1], none, frames[2]]
    sequence = CloudSequence.from_frames("holed", holed, track=[tracks[0], [], tracks[1], [], tracks[2]])
    labels, sample = predicted(sequence, pairs="all")
    places = {track: point for track, point in zip(tracks[2], frames[2])}
    row = next(q for q, pair in enumerate(sample.pairs.tolist()) if pair == [0, 4])
    apart = [frames[0][n] + sample.flow[row][n] - places[k] for n, k in enumerate(tracks[0]) if k in places]
    assert np.abs(apart).max() < 1e-3 and not capsys.readouterr().err


@pytest.mark.parametrize("noise", [0.0, 0.003])
def test_small_moving_parts_of_tracks_are_found_and_nothing_else(noise):
    """A box with a knob of 12 of 500 points that turns in place, seen in six frames, each of which lacks every fifth track."""
    rng = np.random.default_rng(3)
    body, knob = (
        box_surface(rng, 488, (0, 0, 0), (0.6, 0.4, 0.3)),
        box_surface(rng, 12, (0.6, 0.15, 0.1), (0.08, 0.1, 0.1)),
    )
    clouds, tracks, truth = [], [], np.repeat([0, 1], [488, 12])
    for t in range(6):
        whole = turn(0.1 * t, (0.0, 0.6, 0.8), (0.2, 0.1, 0.0))
        own = whole @ turn(0.4 * t, (1.0, 0.0, 0.0), (0.6, 0.2, 0.15))
        cloud = np.concatenate([p @ m[:3, :3].T + m[:3, 3] for p, m in ((body, whole), (knob, own))])
        tracks.append(rng.permutation(500)[:400])
        clouds.append(np.float32(cloud + noise * rng.standard_normal(cloud.shape))[tracks[-1]])
    sequence = CloudSequence.from_frames("box", clouds, track=tracks)
    labels, _ = predicted(sequence)
    right = labels == (truth[sequence.track] > 0)
    assert set(np.unique(labels)) == {0, 1} and right.mean() > 0.995
    still = CloudSequence.from_frames("box", [clouds[0], clouds[0]], track=[tracks[0], tracks[0]])
    assert not predicted(still)[0].any()


@pytest.mark.parametrize("seed", [0, 1])
def test_a_long_soft_trunk_stays_one_part_beside_a_limb(seed):
    """A trunk five times as long as thick, with waves of 0.003 in its skin, and a limb that swings at its end."""
    rng = np.random.default_rng(seed)
    trunk = rng.uniform([-0.6, -0.12, -0.12], [0.6, 0.12, 0.12], (900, 3))
    whole = np.concatenate([trunk, rng.uniform([0.6, -0.06, -0.06], [1.0, 0.06, 0.06], (225, 3))])
    limb = np.arange(len(whole)) >= 900
    waves, phase, along = rng.normal(0, 7, (6, 3)), rng.uniform(0, 6, 6), rng.normal(0, 0.01 / 6, (6, 3))
    clouds = []
    for t in range(12):
        swung = turn(0.6 * np.sin(0.9 * t), (0.0, 0.0, 1.0), (0.6, 0.0, 0.0))
        cloud = np.where(limb[:, None], whole @ swung[:3, :3].T + swung[:3, 3], whole)
        clouds.append(cloud + np.sin(whole @ waves.T + phase + t) @ along + [0.05 * t, 0.0, 0.0])
    tracks = follow_tracks(clouds, [np.arange(len(whole))] * 12)
    part = parts_of_tracks(tracks, MultibodySettings())
    assert part.max() == 1 and (part == limb).mean() > 0.99


def test_tracks_go_on_where_no_frame_shows_them():
    rng = np.random.default_rng(2)
    cloud, motions = rng.random((60, 3)), [turn(0.3 * t, (0, 0, 1), (0.5, 0.5, 0.5)) for t in range(4)]
    tracks = [np.arange(40), 10 + rng.permutation(50), np.arange(50), np.arange(20, 60)]
    clouds = [cloud[own] @ m[:3, :3].T + m[:3, 3] for own, m in zip(tracks, motions)]
    found = follow_tracks(clouds, tracks)
    for t, motion in enumerate(motions):
        np.testing.assert_allclose(found.places[t], cloud @ motion[:3, :3].T + motion[:3, 3], atol=1e-9)
        assert found.shown[t].sum() == len(tracks[t]) and (found.index[t] == tracks[t]).all()
    every = np.ones(60, bool)
    np.testing.assert_allclose(found.motion(every, 0, 3), (motions[3] @ np.linalg.inv(motions[0]))[:3], atol=1e-9)
    apart = follow_tracks([cloud[:9], cloud[9:]], [np.arange(9), np.arange(9, 60)])  # no track in common
    assert np.isfinite(apart.places).all() and apart.shown.sum() == 60
    for count in (1, 5, 9):  # fewer than the neighbors of a track
        few = follow_tracks([cloud[:count], cloud[:count] + 1.0], [np.arange(count)] * 2)
        assert (parts_of_tracks(few, MultibodySettings()) == 0).all()
    few = fit_motions(cloud[None, :2], cloud[None, :2] + [0.0, 0.0, 2.0])
    np.testing.assert_allclose(few[0], np.eye(3, 4) + [[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 2]], atol=1e-12)


@pytest.mark.parametrize(
    "sizes", [(0, 0), (1, 1), (3, 200), (200, 5, 200), (0, 150, 150), (40, 40), (200,)], ids=lambda sizes: str(sizes)
)
def test_poor_input_gets_an_answer(sizes):
    rng = np.random.default_rng(3)
    sequence = CloudSequence.from_frames("poor", [np.float32(rng.random((n, 3))) for n in sizes])
    labels, sample = predicted(sequence)
    assert len(labels) == sum(sizes) and (labels >= 0).all() and np.isfinite(sample.motion).all()
    assert [len(flow) for flow in sample.flow] == list(sizes[:-1])


def test_points_in_one_place_and_far_apart_frames():
    same = CloudSequence.from_frames("same", [np.zeros((50, 3), np.float32)] * 2)
    assert set(predicted(same)[0]) == {0}
    rng = np.random.default_rng(4)
    apart = CloudSequence.from_frames("apart", [np.float32(rng.random((60, 3)) + 100 * t) for t in range(2)])
    assert np.isfinite(predicted(apart)[1].motion).all()


def test_the_most_bodies_are_kept_to_and_one_thread_and_two_give_the_same_answer():
    clouds = [np.float32(chest().frame(t)) for t in range(3)]
    one = explain_sequence(clouds, MultibodySettings(max_bodies=1))
    assert len(one.bodies) == 1
    first, second = (explain_sequence(clouds, MultibodySettings(), threads=threads) for threads in (1, 2))
    assert first.energy == second.energy and (first.label == second.label).all() and first.energy < one.energy


def test_the_true_motion_explains_a_point_and_a_wrong_one_does_not():
    sequence = chest()
    frames = Frames([sequence.frame(t) for t in range(4)])
    lid = sequence.part == 1
    own, wrong = (frames.explain(sequence.pose[:, k, :3])[0][lid].mean() for k in (1, 0))
    assert own < 0.75 * wrong
    step = relative_motion(sequence.pose[:, 0, :3], 1, 3)
    assert np.allclose(step, (sequence.pose[3, 0] @ np.linalg.inv(sequence.pose[1, 0]))[:3])


def bottle(rng, count):
    """Points on a cone with a closed end, alike around z."""
    angle, height = 2 * np.pi * rng.random(count), 0.9 * np.sqrt(rng.random(count))
    radius = np.where(rng.random(count) < 0.85, 0.1 + 0.1 * height, 0.19 * rng.random(count))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.where(radius < 0.1, 0.9, height)], 1)


@pytest.mark.parametrize(
    "thing, about, lost",
    [
        (bottle, 0.0, True),  # said to turn about the axis around which it is alike: turned back
        (lambda rng, count: box_surface(rng, count, (0, 0, 0), (0.3, 0.5, 0.9)), 0.5, False),  # what turns is left so
    ],
)
def test_a_body_turns_about_its_own_axis_only_as_far_as_its_points_demand(thing, about, lost):
    rng = np.random.default_rng(0)
    swing = [turn(0.15 * t, (1.0, 0.0, 0.0), (0.0, 0.0, 0.4)) for t in range(4)]
    true = np.stack([m @ turn(about * t, (0.0, 0.0, 1.0), (0.1, 0.2, 0.0)) for t, m in enumerate(swing)])
    frames = Frames([np.float32(thing(rng, 400) @ m[:3, :3].T + m[:3, 3]) for m in true])
    spun = np.stack([m @ turn(a, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)) for m, a in zip(true, (0, 0.9, -0.6, 0.3))])
    said = (spun if lost else true)[:, :3]
    found = label_points(frames, [body_of(frames, said)], MultibodySettings())
    after = turn_least(frames, found).bodies[0].trajectory
    assert degrees_between(after, true[:, :3]).max() < 6
    assert (after is found.bodies[0].trajectory) == (not lost)


def degrees_between(one, other):
    """The angles in degrees by which the relative motions of two trajectories, since frame 0, differ."""
    turns = [relative_motion(one, 0, t)[:, :3].T @ relative_motion(other, 0, t)[:, :3] for t in range(1, len(one))]
    return np.degrees([np.arccos(np.clip((np.trace(r) - 1) / 2, -1, 1)) for r in turns])


def test_a_lid_moves_by_its_hinge_and_what_no_joint_explains_stays_free():
    sequence = chest(points=200)
    frames = Frames(np.split(sequence.points, sequence.frame_offsets[1:-1]))
    whole, lid = (np.ascontiguousarray(sequence.pose[:, k, :3], np.float64) for k in (0, 1))
    fitted = frames.fit(lid, sequence.part == 1, False, 0.5)  # six numbers a frame take noise along
    found = label_points(frames, [body_of(frames, m) for m in (whole, fitted)], MultibodySettings(), sequence.part)
    found.label = sequence.part.astype(np.int64)
    hinged = simplify_motions(frames, found).bodies[1].trajectory
    assert degrees_between(hinged, lid).mean() < 0.6 * degrees_between(fitted, lid).mean()
    relative = np.stack([m[:, :3] for m in map(relative_motion, [whole] * 3, [0] * 3, [1, 2, 3])])
    against = np.stack([r.T @ relative_motion(hinged, 0, t)[:, :3] for t, r in enumerate(relative, 1)])
    axes = np.stack([[r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]] for r in against])
    assert np.linalg.svd(axes)[1][1] < 1e-6  # one axis for all frames

    stray = [
        turn(0.0, (0, 0, 1.0), (0, 0, 0)),
        turn(0.5, (1.0, 0, 0), (0.1, 0, 0.9)),
        turn(0.4, (0, 1.0, 0), (0, 0.3, 0)),
    ]
    rng = np.random.default_rng(1)
    clouds = [
        np.concatenate([box_surface(rng, 200, (0, 0, 0), (0.5, 0.6, 0.3)), b @ m[:3, :3].T + m[:3, 3]])
        for m, b in ((m, box_surface(rng, 120, (0.1, 0.1, 0.5), (0.15, 0.3, 0.4))) for m in stray)
    ]
    frames = Frames([np.float32(cloud) for cloud in clouds])
    motions = [np.tile(np.eye(3, 4), (3, 1, 1)), np.stack(stray)[:, :3]]
    found = label_points(frames, [body_of(frames, m) for m in motions], MultibodySettings())
    assert simplify_motions(frames, found).bodies[1] is found.bodies[1]


def test_partners_are_equally_many_and_never_the_frame_itself():
    for frames in (2, 3, 9, 40):
        partners = [choose_partners(t, frames) for t in range(frames)]
        assert {len(set(own)) for own in partners} == {min(6, frames - 1)}
        assert all(t not in own for t, own in enumerate(partners))


def test_masks_are_shares_and_trust_a_body_that_every_frame_holds():
    label = np.array([0, 0, 1, 1, 0, 0, 0, 1])  # of two frames of 4 points
    field = np.float32(np.where(np.eye(2)[label] > 0, 0.0, 0.4))
    found = Explanation([None, None], label, 0.0, field, field)
    masks = masks_of(found, [4, 4], 5)
    assert np.allclose(masks.sum(1), 1) and (masks.argmax(1) == label).all()
    # two, then three of four points
    assert masks[0, 0] == pytest.approx(2 / 3 * 1 / (1 + np.exp(-2)) + 1 / 15, rel=1e-5)
    assert masks[2, 1] < masks[0, 0]


def test_a_body_that_some_frame_does_not_show_keeps_its_points_in_the_others():
    label = np.array([0, 0, 1, 1, 0, 0, 0, 0])  # of two frames of 4 points
    field = np.float32(np.where(np.eye(2)[label] > 0, 0.0, 0.4))
    masks = masks_of(Explanation([None, None], label, 0.0, field, field), [4, 4], 5)
    assert (masks.argmax(1) == label).all() and np.allclose(masks.sum(1), 1)


@pytest.mark.parametrize(("turn", "parts"), [(0.9, 2), (0.0, 1)])
def test_motion_that_only_distant_frames_show_makes_parts(turn, parts):
    """A lid that opens in 40 frames, by a fraction of the distance between points from one to the next."""
    rng, clouds = np.random.default_rng(0), []
    for angle in np.linspace(0, turn, 40):
        base, lid = rng.uniform([-0.5, -0.3], [0, 0.3], (60, 2)), rng.uniform([0, -0.3], [0.5, 0.3], (60, 2))
        raised = np.stack([lid[:, 0] * np.cos(angle), lid[:, 1], lid[:, 0] * np.sin(angle)], 1)
        clouds.append(np.float32(np.concatenate([np.pad(base, ((0, 0), (0, 1))), raised])))
    found = explain_sequence(clouds, MultibodySettings(regrow=0))
    assert len(found.bodies) == parts
    lid = np.tile(np.repeat([False, True], 60), 40)
    assert parts == 1 or (found.label == found.label[-1])[lid].mean() > 0.85


def test_a_trajectory_is_filled_in_evenly():
    turns = Rotation.from_rotvec(np.outer([0, 0.3, 0.9], [0, 0, 1])).as_matrix()
    known = np.concatenate(
        [turns, (np.array([5.0, 0, 0]) - turns @ [5.0, 0, 0])[..., None]], 2
    )  # about a point at x = 5
    filled = fill_in(known, np.array([0, 2, 4]), 5, np.array([5.0, 0, 0]))
    assert np.allclose(filled[[0, 2, 4]], known)
    assert np.allclose(Rotation.from_matrix(filled[:, :, :3]).magnitude(), [0, 0.15, 0.3, 0.6, 0.9])
    assert np.allclose(filled[:, :, :3] @ [5.0, 0, 0] + filled[:, :, 3], [5, 0, 0])

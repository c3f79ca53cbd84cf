"""Streets: moving objects, their motions and the sensor's own, found in scans of a made street; and poor input."""

from __future__ import annotations

import contextlib
import copy
import io
import json
import re
from functools import lru_cache

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from dpcli.errors import DataError
from dpcli.prepare.synthetic.spinning_lidar import Lidar, scan
from dpcli.prepare.synthetic.street_world import Mover, car, person, planar_pose, standing_street
from dpcli.segment.scene.clusters import cluster
from dpcli.segment.scene.ego_motion import OVERLAP, register_frames
from dpcli.segment.scene.ground import find_up, height_above_ground, level
from dpcli.segment.scene.line_of_sight import LineOfSight, range_jumps
from dpcli.segment.scene.report import _speed, picture_of_scene
from dpcli.segment.scene.segmenter import SceneSegmenter
from dpcli.segment.scene.settings import SceneSettings
from dpcli.segment.scene.tracking import extended
from dpcli.segment.scene.world import UNSEEN, Frame
from dpcli.store import CloudSequence, CloudsWriter, PartsSample

LIDAR = Lidar(tuple(np.linspace(2, -22, 32)), 700, 60.0)
PAIRS = [(0, 1), (1, 2)]


@lru_cache(maxsize=1)
def street() -> CloudSequence:
    """A street of three frames, a tenth of a second apart: the sensor drives at 8 m/s, a car comes, a person walks."""
    rng = np.random.default_rng(3)
    standing = standing_street(rng)
    movers = [
        Mover(car(rng), np.array([14.0, 1.75]), np.pi, 9.0),
        Mover(person(rng), np.array([6.0, -4.6]), 0.0, 1.8, legs=2),
    ]
    return scanned(standing, movers, rng, LIDAR)


def scanned(standing, movers, rng, lidar) -> CloudSequence:
    clouds, parts, poses = [], [], []
    for time in (0.0, 0.1, 0.2):
        to_lidar = np.linalg.inv(planar_pose(np.array([0, -1.75]), 0.0, 8.0, 0.1, time))
        to_lidar[2, 3] -= lidar.height
        world = [standing, *(mover.surface(time) for mover in movers)]
        owner = np.repeat(np.arange(len(world)), [len(one) for one in world])
        seen, triangle = scan(np.concatenate(world) @ to_lidar[:3, :3].T + to_lidar[:3, 3], lidar, 0.02, 0.05, rng)
        clouds.append(seen)
        parts.append(owner[triangle])
        poses.append(np.stack([to_lidar, *(to_lidar @ mover.pose(time) for mover in movers)]))
    time = np.array([0.0, 0.1, 0.2])
    return CloudSequence.from_frames("street", clouds, part=parts, pose=np.stack(poses), time=time)


def explained(sequence, pairs=PAIRS, unit="m", **settings):
    """The labels of each frame, and what else is said."""
    label, said = SceneSegmenter(SceneSettings(**settings)).explain(sequence, pairs, unit)
    sequence.part, truth = label, sequence.part
    said.validate(sequence, said.probability.shape[1])
    sequence.part = truth
    return np.split(label, sequence.frame_offsets[1:-1]), said


def changed(frames, **fields) -> CloudSequence:
    return CloudSequence.from_frames("changed", [np.float32(frame) for frame in frames], **fields)


def frames_of(sequence):
    return [sequence.frame(t) for t in range(sequence.num_frames)]


@lru_cache(maxsize=1)
def answer():
    """What is found in the street, for which nothing has to be guessed."""
    with contextlib.redirect_stderr(io.StringIO()) as warned:
        found = explained(street())
    assert not warned.getvalue()
    return found


def test_what_moves_is_found_and_the_rest_stands():
    labels, _ = answer()
    truth = np.split(street().part, street().frame_offsets[1:-1])
    label, true = np.concatenate(labels), np.concatenate(truth)
    assert (label[true > 0] > 0).mean() > 0.9
    assert (label[true == 0] > 0).mean() < 0.002
    for k in (1, 2):
        ids, counts = np.unique(label[true == k], return_counts=True)
        assert counts.max() > 0.9 * counts.sum() and ids[counts.argmax()] > 0
        assert all((own[part == k] == ids[counts.argmax()]).any() for own, part in zip(labels, truth))


def test_the_side_of_a_car_that_comes_near_is_no_object_of_its_own():
    rng = np.random.default_rng(2)
    standing, lidar = standing_street(rng), Lidar(tuple(np.linspace(2, -22, 48)), 900, 60.0)
    sequence = scanned(standing, [Mover(car(rng), np.array([15.0, 1.75]), np.pi, 9.0)], rng, lidar)
    label = np.concatenate(explained(sequence)[0])
    assert len(np.unique(label[sequence.part > 0])) == 2 and (label[sequence.part > 0] == 1).mean() > 0.9


def test_the_flow_is_that_of_the_true_poses_and_agrees_with_the_motions():
    sequence, (labels, said) = street(), answer()
    for (i, j), flow, motions in zip(PAIRS, said.flow, said.motion):
        points = sequence.frame(i).astype(np.float64)
        part = np.split(sequence.part, sequence.frame_offsets[1:-1])[i]
        truth = np.stack([sequence.pose[j, k] @ np.linalg.inv(sequence.pose[i, k]) for k in range(3)])[part]
        true = np.einsum("nij,nj->ni", truth[:, :3, :3], points) + truth[:, :3, 3] - points
        error = np.linalg.norm(flow - true, axis=1)
        assert error[part == 0].mean() < 0.03 and error[part > 0].mean() < 0.15
        own = motions[labels[i]]
        again = np.einsum("nij,nj->ni", own[:, :3, :3], points) + own[:, :3, 3] - points
        assert np.allclose(again, flow, atol=2e-3)


def turned(frames):
    """Axes with y up and z ahead, as of KITTI scene flow."""
    return [frame @ np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]], float) for frame in frames]


SAME = {  # input that must be answered as the plain street is
    "y up in millimeters": (lambda frames: [1000 * frame for frame in turned(frames)], {}, "mm"),
    "kilometers away in wrong time order": (
        lambda f: [f[2], f[0], f[1]],
        {"time": np.array([0.2, 0.0, 0.1]), "shift": np.array([4.5e5, 5.4e6, 120.0])},
        "m",
    ),
    "duplicates": (lambda frames: [np.concatenate([frame, frame[::2]]) for frame in frames], {}, "m"),
    "sizes differ in inches": (lambda f: [f[0] / 0.0254, f[1][::3] / 0.0254, f[2] / 0.0254], {}, "in"),
}


@pytest.mark.parametrize("what", SAME)
def test_other_axes_places_units_and_orders_say_the_same(what):
    change, fields, unit = SAME[what]
    truth = np.split(street().part, street().frame_offsets[1:-1])
    number = {"kilometers away in wrong time order": [2, 0, 1]}.get(what, [0, 1, 2])
    every = {"sizes differ in inches": [1, 3, 1]}.get(what, [1, 1, 1])
    true = np.concatenate(
        [np.append(truth[t][:: every[n]], truth[t][::2] if what == "duplicates" else []) for n, t in enumerate(number)]
    )
    pairs = [(number.index(t), number.index(u)) for t, u in PAIRS]
    labels, said = explained(changed(change(frames_of(street())), **fields), pairs, unit)
    label = np.concatenate(labels)
    assert (label[true > 0] > 0).mean() > 0.8
    assert (label[true == 0] > 0).mean() < 0.005
    if "time" in fields:  # which objects there are hardly depends on the order of frames; how they move does
        np.testing.assert_allclose(said.motion, answer()[1].motion, atol=1e-5)


def wall(rng, t):
    """A depth image of a wall with a picture frame, two meters away, seen by a camera that stands (z ahead)."""
    x, y = rng.uniform(-1.2, 1.2, (2, 4000))
    z = 2.0 - 0.05 * ((np.abs(x) < 0.3) & (np.abs(y) < 0.3)) + rng.normal(0, 0.003, 4000)
    return np.stack([x, y, z], 1)


def test_a_wall_without_ground_and_a_scene_at_rest_stand():
    rng = np.random.default_rng(0)
    labels, said = explained(changed([wall(rng, t) for t in range(3)]))
    assert not np.concatenate(labels).any()
    assert np.abs(np.concatenate(said.flow)).max() < 0.05
    frame = street().frame(0)
    still = [frame[rng.random(len(frame)) > 0.1] for _ in range(3)]
    labels, said = explained(changed(still))
    assert not np.concatenate(labels).any()
    assert np.abs(np.concatenate(said.flow)).max() < 1e-9  # a sensor that stands stands exactly


POOR = {
    "one frame": (lambda f: f[:1], 0),
    "one-point frame": (lambda f: [f[0], f[1][:1], f[2]], 2),
    "empty frame": (lambda f: [f[0], f[1][:0], f[2]], 2),
    "one point": (lambda f: [f[0][:1], f[1][:1], f[2][:1]], 2),
    "all points alike": (lambda f: [np.ones((500, 3))] * 3, 2),
    "no overlap": (lambda f: [f[0], f[0][:, [1, 0, 2]] * 0.2 + [900, 0, 0], f[1] + [0, 5000, 0]], 2),
}


@pytest.mark.parametrize("what", POOR)
def test_poor_input_is_answered(what):
    change, pairs = POOR[what]
    frames = change(frames_of(street()))
    labels, said = explained(changed(frames), PAIRS[:pairs])
    assert [len(own) for own in labels] == [len(frame) for frame in frames]
    assert all(np.isfinite(flow).all() for flow in said.flow)
    if what not in ("one-point frame", "empty frame"):
        assert not np.concatenate(labels).any()


def test_frames_that_show_no_common_place_are_named(capsys):
    frames = frames_of(street())
    explained(changed([frames[0][::4], frames[1][:200] + 300, frames[1][:9], frames[2][::4]]))
    assert "changed: frame 1, 3: too little in common" in capsys.readouterr().err


def test_frames_that_repeat_the_one_before_are_looked_at_once(capsys):
    truth, (labels, said) = street(), answer()
    twice = [frame for frame in frames_of(truth) for _ in range(2)]
    sequence = changed(twice, time=np.arange(6) / 20)
    again, more = explained(sequence, [(t, t + 1) for t in range(5)])
    assert "changed: 3 frames looked at once" in capsys.readouterr().err
    for t, own in enumerate(again):
        np.testing.assert_array_equal(own, labels[t // 2])
    assert max(np.abs(flow).max() for flow in more.flow[::2]) < 1e-6
    for flow, once in zip(more.flow[1::2], said.flow):
        np.testing.assert_allclose(flow, once, atol=1e-6)
    sequence.part = np.concatenate(again)
    assert _speed(sequence, more, 0, "m") == _speed(with_part(truth, labels), said, 0, "m")


@pytest.mark.parametrize("place", [(0, 0, 0), (450, -540, 3)])
def test_the_speed_of_a_sensor_that_turns_is_its_own_and_not_that_of_what_it_sees(place):
    """It looks ahead, at things 20 m away, and drives 0.8 m a frame around a bend; its place is known by `shift`."""
    step, away = np.eye(4), np.eye(4)
    step[:3, :3], step[0, 3] = Rotation.from_rotvec([0, 0, 0.05]).as_matrix(), 0.8
    away[:3, 3] = place
    points = np.random.default_rng(0).normal([20, 0, 0], 3, (100, 3)) + place
    shift = -np.array(place, float) if any(place) else None
    sequence = CloudSequence.from_frames("bend", [points] * 2, part=[np.zeros(100, int)] * 2, shift=shift)
    sequence.points[100:] += 1  # another frame
    motion = away @ np.linalg.inv(step) @ np.linalg.inv(away)
    said = PartsSample(np.ones((200, 1)), np.array([[0, 1]]), motion[None, None], [])
    assert _speed(sequence, said, 0, "m") == "0.80 m a frame"


def with_part(sequence, labels):
    sequence = copy.copy(sequence)
    sequence.part = np.concatenate(labels)
    return sequence


@pytest.mark.parametrize(
    ("change", "unit", "warned"),
    [
        (lambda f: f + [900, 400, 30], "m", "don't fit a sensor at the origin"),
        (lambda f: f, "mm", "lie within 0.0"),
        (lambda f: 1000 * f, "m", "expected a street or a room"),
        (lambda f: wall(np.random.default_rng(len(f)), 0), "m", "no ground plane was found"),
    ],
)
def test_what_had_to_be_guessed_is_told(change, unit, warned, capsys):
    explained(changed([change(frame[::9]) for frame in frames_of(street())]), unit=unit)
    assert warned in capsys.readouterr().err


def box_room(length, width, rng):
    """A frame inside four walls, a floor and a ceiling, seen from the middle by a lidar of 16 rows."""
    turn, rise = np.meshgrid(np.linspace(-np.pi, np.pi, 900, endpoint=False), np.radians(np.linspace(-15, 15, 16)))
    rays = np.stack([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)], -1).reshape(-1, 3)
    with np.errstate(divide="ignore"):
        reach = (np.array([length, width, 2.5]) / 2 / np.abs(rays)).min(1)
    return rays * (reach + rng.normal(0, 0.01, len(rays)))[:, None]


@pytest.mark.parametrize(("length", "told"), [(300.0, True), (8.0, False)])
def test_a_corridor_that_does_not_show_how_far_the_sensor_went_is_told(length, told, capsys):
    rng = np.random.default_rng(0)
    explained(changed([box_room(length, 4.0, rng) for _ in range(3)]))
    assert ("how far it went is uncertain" in capsys.readouterr().err) == told


def test_one_frame_of_a_map_that_fits_the_sensor_does_not_speak_for_all(capsys):
    first, second, last = frames_of(street())
    explained(changed([first[::9] + [7, 30, 0], second[::9], np.concatenate([last, last])]), [(0, 1)])
    assert "in all frames (are they in one map's coordinates?)" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("step", "travel", "warned"),
    [(0.2, 4, ""), (0.5, 4, "faster than 8 m/s is missed, or gets a lower speed; --set travel=10 looks"), (0.5, 10, "")]
    + [(100, 4, "is time in seconds?")],
)
def test_frames_too_far_apart_in_time_for_the_search_are_told(step, travel, warned, capsys):
    thin = [frame[::9] for frame in frames_of(street())]
    explained(changed([*thin, thin[-1]], time=step * np.arange(4)), travel=travel)
    said = capsys.readouterr().err
    assert warned in said and ("things are sought" in said) == bool(warned)


def test_the_least_objects_are_left_out_beyond_the_limit(capsys):
    labels, said = explained(street(), max_objects=1)
    assert "street: 1 moving objects besides the largest 1" in capsys.readouterr().err
    assert said.probability.shape[1] == 2 and set(np.unique(np.concatenate(labels))) == {0, 1}
    ids, counts = np.unique(street().part[np.concatenate(labels) == 1], return_counts=True)
    assert ids[counts.argmax()] == 1  # the car, which has more points than the person


def test_the_command_writes_a_parts_file_and_a_line_to_check(dpc_here, tmp_path):
    data, parts, picture = tmp_path / "street.h5", tmp_path / "parts.h5", tmp_path / "street.png"
    with CloudsWriter(data, fields=["part", "pose", "time"]) as writer:
        writer.write(street())
    done = dpc_here("segment", "predict", data, "-o", parts, "--scene", "--picture", picture)
    assert done.returncode == 0, done.stderr
    line = done.stdout.decode().splitlines()[1]
    sensor, objects = re.match(r"street: the sensor moves ([\d.]+) m a frame .*; (\d) moving objects", line).groups()
    assert abs(float(sensor) - 0.8) < 0.05 and int(objects) == 2
    assert re.search(r"1: 0\.\d\d m a frame \((8|9)\.\d m/s\)", line)  # the car drives at 9 m/s
    assert picture.stat().st_size > 1000
    done = dpc_here("evaluate", "segmentation", parts, "--truth", data, "--split", "all", "--json")
    assert json.loads(done.stdout)["metrics"]["f1"] > 0.9


def test_points_farther_apart_than_on_earth_are_no_scene():
    far = CloudSequence.from_frames("f", [np.random.default_rng(t).random((50, 3)) * 1e11 for t in range(2)])
    with pytest.raises(DataError, match=r"m apart, .* --unit \(the file's is m\)"):
        SceneSegmenter(SceneSettings()).explain(far, [(0, 1)], "m")


def test_a_scene_whose_first_frame_is_empty_is_drawn_upright():
    cloud = street().frame(0)
    sequence = CloudSequence.from_frames("s", [cloud[:0], cloud], part=[np.zeros(0, int), np.zeros(len(cloud), int)])
    count = len(picture_of_scene(copy.copy(sequence), "m")[0].points)
    sequence.points = 1000 * sequence.points
    shown, look = picture_of_scene(sequence, "mm")
    assert look.up == "z" and look.gray == "0, stands" and shown.frame_offsets[1] == 0 < len(shown.points) == count


def test_a_picture_tells_which_objects_are_too_far_away_for_it(capsys):
    cloud = np.concatenate([street().frame(0), [[80, 0, 1], [3, 0, 1], [0, 90, 1]]])
    part = np.zeros(len(cloud), int)
    part[-3:] = 1, 2, 7
    shown, _ = picture_of_scene(CloudSequence.from_frames("s", [cloud], part=[part]), "m")
    assert np.unique(shown.part).tolist() == [-1, 2]
    assert "s: the picture shows 30 m around the middle, and so not objects 1, 7" in capsys.readouterr().err


def test_up_is_the_normal_of_the_ground_and_heights_follow_a_hill():
    frame = street().frame(0).astype(np.float64)
    tilt = level(np.array([0.17, 0.0, np.sqrt(1 - 0.17**2)]))
    up, seen = find_up(frame @ tilt, np.zeros(3))
    assert seen and up @ (tilt.T @ [0, 0, 1.0]) > 0.999
    x, y = np.random.default_rng(1).uniform(-30, 30, (2, 20000))
    hill = np.stack([x, y, 0.1 * x + 0.02 * np.sin(9 * y)], 1)
    pole = np.stack([np.full(30, 5.0), np.full(30, 5.0), 0.5 + np.linspace(0.3, 3, 30)], 1)
    height = height_above_ground(np.concatenate([hill, pole]))
    assert np.percentile(height[:20000], 99) < 0.2 and (height[20000:] > 0.2).all()


@pytest.mark.parametrize("turn", [0, 20, 45, 70])
def test_up_is_along_the_axis_of_the_beams_whatever_walls_stand_beside(turn):
    frame = street().frame(0).astype(np.float64)
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    yaw, pitch = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    up, seen = find_up(frame @ (pitch @ yaw).T, np.zeros(3))
    assert seen and up @ pitch[:, 2] > 0.99
    bare = frame[height_above_ground(frame) > 0.3] @ yaw.T  # as of data sets whose ground was removed
    assert find_up(bare, np.zeros(3))[0][2] > 0.99
    turns, rises = np.meshgrid(np.linspace(0, 2 * np.pi, 900), np.radians(np.linspace(-22, 2, 32)))
    beams = np.stack([np.cos(turns) * np.cos(rises), np.sin(turns) * np.cos(rises), np.sin(rises)], -1).reshape(-1, 3)
    between_buses = beams / np.abs(beams / [12, 1.2, 1.4]).max(1, keepdims=True)
    assert find_up(between_buses @ yaw.T, np.zeros(3))[0][2] > 0.99


def test_the_sensors_motion_is_found_from_far_off_starts():
    frames = [street().frame(t).astype(np.float64) for t in (0, 2)]
    ground = [height_above_ground(frame) < 0.2 for frame in frames]
    true = street().pose[0, 0] @ np.linalg.inv(street().pose[2, 0])
    poses, overlap = register_frames(frames, ground)
    assert np.linalg.norm(poses[1][:3, 3] - true[:3, 3]) < 0.05 and overlap[0] > 0.5


@pytest.mark.parametrize("rows", [16, 32])
@pytest.mark.parametrize("way", [0.0, 0.05, 0.2, 0.5])
def test_a_sensor_that_creeps_does_not_stand(way, rows):
    """The rings of its beams on ground and walls go with it, and lie nearest to one another where it is taken to stand."""
    lidar, frames = Lidar(tuple(np.linspace(2, -22, rows)), 700, 60.0), []
    standing = standing_street(np.random.default_rng(3))
    for at in (0.0, way):
        seen, _ = scan(standing - [at, -1.75, lidar.height], lidar, 0.02, 0.05, np.random.default_rng(int(100 * at)))
        frames.append(seen.astype(np.float64))
    poses, overlap = register_frames(frames, [height_above_ground(frame) < 0.2 for frame in frames])
    assert np.linalg.norm(poses[1][:3, 3] - [way, 0, 0]) < 0.015 and overlap[0] > 0.5
    assert way or np.array_equal(poses[1], np.eye(4))


def prisms(count, start):
    """Returns the beams f64 (count,3) of a solid-state lidar: two turning prisms, whose curves differ from frame to frame."""
    first, second = np.pi / 30 * np.array([[7294.0], [-4664.0]]) * (start + np.arange(0.5, count) / 240_000)
    y, z = np.radians(17.5) * np.array([np.cos(first) + np.cos(second), np.sin(first) + np.sin(second)])
    ahead = np.hypot(y, z)
    return np.stack([np.cos(ahead), np.sinc(ahead / np.pi) * y, np.sinc(ahead / np.pi) * z], 1)


def among_boxes(beams, x):
    """Returns where beams (N,3) end that start 1.8 m above flat ground, x m along a street of boxes, and which are on the ground."""
    rng, low = np.random.default_rng(1), np.where(beams[:, 2] < 0, -1.8 / beams[:, 2], np.inf)
    reach = low
    for i in range(24):  # houses with gaps between them, and cars before them
        house, side = i % 2, (-1, 1)[i // 2 % 2]
        place = np.array([6.0 + 4 * i + rng.uniform(-2, 2), side * (13 if house else 5.5), 5 * house + 0.7])
        middle = place - [x, 0, 1.8]
        half = np.array([3, 3, 5.7]) if house else np.array([2.2, 0.9, 0.7])
        a, b = (middle - half) / beams, (middle + half) / beams
        enter, leave = np.minimum(a, b).max(1), np.maximum(a, b).min(1)
        reach = np.where((enter < leave) & (enter > 0), np.minimum(reach, enter), reach)
    far = reach > 80
    ends = (reach + rng.normal(0, 0.015, len(beams)))[~far, None] * beams[~far]
    return ends, (reach == low)[~far]


def test_beams_that_never_repeat_show_the_motion_of_a_solid_state_lidar():
    frames, ground = zip(*(among_boxes(prisms(24_000, 0.1 * t), 0.8 * t) for t in range(2)))
    poses, overlap = register_frames(list(frames), list(ground))
    assert np.linalg.norm(poses[1][:3, 3] - [0.8, 0, 0]) < 0.2 and overlap[0] > OVERLAP


def test_curves_of_beams_are_no_dense_rows():
    """Along the curves beams are 0.05 degrees apart; the median distance of another frame's beams is an upper bound."""
    first, second = prisms(24_000, 0.0), prisms(24_000, 0.1)
    seen, away = LineOfSight(10 * first, np.zeros(3)), np.median(cKDTree(first).query(second)[0])
    assert np.radians(0.2) < seen.across == seen.along < away


def test_a_frame_of_an_unknown_sensor_contradicts_what_is_farther_than_twice_the_tolerance():
    rng = np.random.default_rng(0)
    frame = Frame(rng.uniform(-5, 5, (300, 3)), np.ones(300), None, 0.2)
    places = np.concatenate([frame.points + rng.normal(0, s, (300, 3)) for s in (0.05, 0.1, 0.3)])
    distance = np.linalg.norm(places[:, None] - frame.points, axis=2).min(1)
    tolerance = frame.tolerance(places)
    cost, free = frame.cost(places)
    np.testing.assert_array_equal(free, distance > 2 * tolerance)
    met, between = distance < tolerance, (distance > tolerance) & ~free
    assert min(met.sum(), between.sum(), free.sum()) > 30
    np.testing.assert_allclose(cost[met], (distance / tolerance)[met] ** 2)
    assert (cost[between] == UNSEEN).all() and (cost[free] == 1).all()


def test_an_object_goes_on_at_the_speed_of_its_frames_though_one_between_them_is_missing():
    turn = np.eye(4)
    turn[:3, :3], turn[:3, 3] = Rotation.from_rotvec([0, 0, 0.1]).as_matrix(), [1.0, 0.2, 0.0]
    true = [np.linalg.matrix_power(turn, t) for t in range(8)]
    for known in ([1, 3], [1, 2, 4], [0, 3, 4], [2, 3]):
        for t in range(8):
            np.testing.assert_allclose(extended({k: true[k] for k in known}, t), true[t], atol=1e-9)


def test_beams_end_behind_what_is_free_and_before_what_is_hidden():
    angle = np.linspace(-0.5, 0.5, 400)
    rows = [np.stack([10 * np.cos(angle), 10 * np.sin(angle), np.full(400, z)], 1) for z in np.linspace(-1, 1, 20)]
    sight = LineOfSight(np.concatenate(rows), np.zeros(3))
    places = np.array([[5.0, 0.1, 0.2], [15.0, 0.1, 0.2], [9.95, 0.1, 0.2], [-5.0, 0.1, 0.2]])
    assert sight.look(places, np.full(4, 0.2)).tolist() == [True, False, False, False]
    assert range_jumps(np.concatenate(rows), np.zeros(3)) < 0.01


def test_what_one_row_alone_sees_past_is_not_free():
    angle = np.linspace(-0.5, 0.5, 400)
    beams = np.stack([np.stack([np.cos(angle), np.sin(angle), np.full(400, z)], 1) for z in np.linspace(-0.1, 0.1, 20)])
    far = LineOfSight(10 * beams.reshape(-1, 3), np.zeros(3))
    near = np.repeat(np.where(np.arange(20) < 10, 4.0, 10.0), 400)[:, None]  # a hood below a roof that is seen flat
    edge = LineOfSight(near * beams.reshape(-1, 3), np.zeros(3))
    between = np.array([[6.0, 0.1, 6 * z] for z in np.linspace(-0.0045, 0.0045, 10)])
    assert far.look(between, np.full(10, 0.1)).all()
    assert not edge.look(between, np.full(10, 0.1)).any()
    outside = np.array([[5.0, 0.1, 0.525], [5.0, 0.1, -0.525]])  # half a row above the uppermost, and below the lowest
    assert not far.look(outside, np.full(2, 0.1)).any()
    assert far.look(outside * [1, 1, 0.95], np.full(2, 0.1)).all()


def test_gaps_between_clusters_grow_with_distance_and_with_the_rows_of_beams():
    pair = np.array([[0, 0, 0], [0, 0.6, 0.0]], float)
    near, far = pair + [5, 0, 0], pair + [50, 0, 0]
    assert cluster(near, np.full(2, 5.0), 0.007).tolist() == [0, 1]
    assert cluster(far, np.full(2, 50.0), 0.007).tolist() == [0, 0]
    high = pair[:, [0, 2, 1]] + [15, 0, 0]
    assert cluster(high, np.full(2, 15.0), 0.007).tolist() == [0, 1]
    assert cluster(high, np.full(2, 15.0), 0.035).tolist() == [0, 0]

"""Made-up things: kinds and heaps in several poses, solids whose surfaces are seen from outside, layers that are right."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dpcli.prepare.articulated.procedural.solids import ball, box, cylinder, plate, ring
from dpcli.prepare.meshes.layered_views import draw_views, posed
from dpcli.prepare.synthetic import shape_pictures
from dpcli.prepare.synthetic.made_thing import made_thing, outward
from dpcli.prepare.synthetic.shape_pictures import PictureSource


def volume(triangles):
    a, b, c = np.moveaxis(triangles, 1, 0)
    return np.einsum("ti,ti->", a, np.cross(b, c)) / 6


@pytest.mark.parametrize(
    ("solid", "expected"),
    [
        (box((1, 2, 3), (5, 0, 0)), 6.0),
        (cylinder(0.5, 2, (0, 9, 0)), np.pi / 2),
        (ball(1), 4 * np.pi / 3),
        (ring(1, 0.2), 2 * np.pi**2 * 0.04),
        (plate([(0, 0), (0, 1), (1, 1), (1, 0)], 0.1), 0.1),
    ],
)
@pytest.mark.parametrize("inside_out", [False, True])
def test_solids_are_seen_from_outside_whichever_way_they_were_built(solid, expected, inside_out):
    built = solid[:, ::-1] if inside_out else solid
    assert volume(outward(built, np.zeros(len(built), int))) == pytest.approx(expected, rel=0.12)


def test_solids_of_one_body_and_solids_that_touch_are_told_apart():
    one, other = box((1, 1, 1)), box((1, 1, 1), (1, 0, 0))[:, ::-1]
    body = np.array([0, 1]).repeat(12)
    assert volume(outward(np.concatenate([one, other]), body)) == pytest.approx(2)
    apart = np.concatenate([one, other + [1, 0, 0]])
    assert volume(outward(apart, np.zeros(24, int))) == pytest.approx(2)


def test_things_differ_move_and_repeat():
    things = [made_thing(np.random.default_rng(seed), 4) for seed in range(40)]
    assert len({thing.name for thing in things}) > 10
    for thing in things:
        assert np.isfinite(thing.positions).all() and np.isfinite(thing.normals).all()
        assert np.abs(thing.positions - thing.positions[0]).max() > 1e-3
    again = made_thing(np.random.default_rng(7), 4)
    assert np.array_equal(again.positions, things[7].positions) and np.array_equal(again.color, things[7].color)


def test_their_layers_lie_behind_each_other():
    rng = np.random.default_rng(2)
    meshes = [posed(made_thing(rng, 2), rng) for _ in range(20)]
    views = draw_views(meshes, 3, 32, rng, warp=0.1)
    front, back, front_2, back_2 = views.depth.float().unbind(1)
    shown = views.rgba[:, 3] > 0
    assert torch.isfinite(front[shown]).all() and (back - front)[shown].min() >= -1e-3
    second = torch.isfinite(front_2)
    assert second.any() and (front_2 > back)[second].all() and (back_2 >= front_2)[second].all()
    solid = (back - front)[shown] > 0.01
    assert solid.float().mean() > 0.8  # hardly a ray leaves where it enters


def test_three_in_ten_of_what_is_made_up_are_things(monkeypatch):
    made, rng = [], np.random.default_rng(0)
    monkeypatch.setattr(shape_pictures, "made_thing", lambda rng, poses: made.append("thing"))
    monkeypatch.setattr(shape_pictures, "made_creature", lambda rng: made.append("creature"))
    for _ in range(3000):
        PictureSource((), size=16, seed=0, made=1.0)._draw_mesh(rng)
    assert len(made) == 3000 and 0.27 < made.count("thing") / len(made) < 0.33

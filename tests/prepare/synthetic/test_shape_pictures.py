"""Pictures for a shape prior: creatures of any plan, models moving and still, held-out ones apart, rounds that repeat."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
import torch

from dpcli.errors import DataError
from dpcli.prepare.synthetic import shape_pictures
from dpcli.prepare.synthetic.creature_mesh import make_skin
from dpcli.prepare.synthetic.shape_pictures import PictureSource, find_meshes, made_creature, picture_sources
from dpcli.prepare.synthetic.wild_creature import wild_creature
from tests.support.gltf_files import arm, quad


def test_creatures_differ_in_plan_and_each_is_one_finite_body():
    legs = set()
    for seed in range(30):
        rng = np.random.default_rng(seed)
        animal = wild_creature(rng)
        legs.add(sum(bone.name.startswith("leg") and bone.name.endswith("_0") for bone in animal.bones))
        if seed < 6:
            skin = make_skin(animal, rng, 40)
            assert np.isfinite(skin.vertices).all() and np.ptp(skin.vertices, axis=0).min() > 0.05
            assert skin.weights.sum(1) == pytest.approx(1, abs=1e-5)
    assert {0, 2, 4} <= legs and max(legs) > 4


def test_some_creatures_are_round_and_upright():
    """Without a neck, and about as deep as they are wide, whatever the arms do."""
    drawn = [(rng := np.random.default_rng(seed), wild_creature(rng)) for seed in range(80)]
    figures = [(rng, animal) for rng, animal in drawn if not any(bone.name.startswith("neck") for bone in animal.bones)]
    assert 4 <= len(figures) <= 24
    for rng, animal in figures[:4]:
        skin = make_skin(animal, rng, 40)
        strongest = skin.bones[np.arange(len(skin.bones)), skin.weights.argmax(1)]
        trunk = skin.vertices[np.char.startswith([animal.bones[bone].name for bone in strongest], "spine")]
        width, _, depth = np.ptp(trunk, axis=0)
        assert 0.7 < depth / width < 1.4 and animal.eyes


def test_a_creature_takes_poses_that_differ():
    mesh = made_creature(np.random.default_rng(3))
    assert mesh.num_frames > 1 and np.abs(mesh.positions[1] - mesh.positions[0]).max() > 0.02
    assert np.isfinite(mesh.positions).all()


def test_a_round_repeats_and_another_differs():
    source = PictureSource((), size=24, seed=5, made=1.0)
    first, again, other = (source.make(number, 20).draw() for number in (2, 2, 3))
    assert first.rgba.shape == (20, 4, 24, 24) and torch.equal(first.rgba, again.rgba)
    assert torch.equal(first.depth.nan_to_num(9), again.depth.nan_to_num(9)) and not torch.equal(first.rgba, other.rgba)


@pytest.fixture
def models(tmp_path):
    """A moving arm, a moving square, and one that stands still, in two folders."""
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
    arm().write(tmp_path / "a" / "arm.glb")
    quad(1.0).write(tmp_path / "b" / "square.glb")
    still = quad()
    del still.tree["animations"]
    still.write(tmp_path / "b" / "still.glb")
    return tmp_path


def test_models_are_found_and_held_out_by_the_end_of_their_path(models):
    (models / "held.txt").write_text("# families\nb/square.glb  # one\n")
    learned, held = find_meshes([models / "a", models / "b"], str(models / "held.txt"))
    assert [file.path.name for file in learned] == ["arm.glb", "still.glb"]
    assert [file.path.name for file in held] == ["square.glb"]
    assert len(learned[0].clips) == 1 and learned[1].clips == ()


def test_learned_and_held_out_pictures_come_from_their_own_models(models):
    (models / "held.txt").write_text("square.glb\n")
    files = find_meshes([models], str(models / "held.txt"))
    learn, check, creatures, things = picture_sources(*files, 16, 0, made=0.0, moving=0.5)
    assert [file.path.name for file in creatures.files] == ["arm.glb"] and creatures.things == 0
    assert [file.path.name for file in things.files] == ["still.glb"] and things.things == 1
    assert {file.path.name for file in learn.files} == {"arm.glb", "still.glb"}
    assert {file.path.name for file in check.files} == {"square.glb"}
    assert len(learn.make(0, 8).draw().rgba) == 8 and len(check.make(0, 8).draw().rgba) == 8


def test_all_held_out_models_validate_whether_they_move_or_not(models, monkeypatch, capsys):
    """A still model that is held out beside a moving one is neither learned from nor left out of the validation."""
    (models / "held.txt").write_text("arm.glb\nsquare.glb\nstill.glb\n")
    seen = Counter()
    read = shape_pictures._read
    monkeypatch.setattr(shape_pictures, "_read", lambda file, rng: seen.update([file.path.name]) or read(file, rng))
    _, check, *_ = picture_sources(*find_meshes([models], str(models / "held.txt")), 16, 0, made=0.5, moving=0.35)
    assert "all 3 models are held out: what is made up is learned alone" in capsys.readouterr().err
    check.make(0, 60 * check.views)
    assert seen.keys() == {"arm.glb", "square.glb", "still.glb"} and 10 <= seen["still.glb"] <= 30


def test_mistakes_are_said(models):
    (models / "held.txt").write_text("cat.glb\n")
    with pytest.raises(DataError, match="cat.glb is none of the 3 models"):
        find_meshes([models], str(models / "held.txt"))
    (models / "empty").mkdir()
    with pytest.raises(DataError, match="no .glb or .gltf"):
        find_meshes([models / "empty"], None)


def test_a_model_that_cannot_be_drawn_is_said_once_and_ends_when_there_is_no_other(tmp_path, capsys):
    flat = quad()
    del flat.tree["animations"]
    flat.tree["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = 99  # there is no such accessor
    flat.write(tmp_path / "flat.glb")
    learned, _ = find_meshes([tmp_path], None)
    with pytest.raises(DataError, match="shows anything"):
        PictureSource(tuple(learned), 16, 0, made=0.0, moving=0.0).make(0, 4)
    assert capsys.readouterr().err.count("left out") == 1
    assert len(PictureSource(tuple(learned), 16, 0, made=0.9, moving=0.0).make(0, 12).draw().rgba) == 12

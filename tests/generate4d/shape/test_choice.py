"""`--prior auto`, `inflated` and `network`: the network is taken where it is sure, and what is taken is said."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from dpcli.errors import DataError
from dpcli.generate4d.config import FIT_PRESETS
from dpcli.generate4d.optimizer import SceneOptimizer
from dpcli.generate4d.shape.choice import guide
from dpcli.generate4d.shape.config import ShapeConfig
from dpcli.generate4d.shape.guidance import ShapeGuidance, reference_pictures
from dpcli.generate4d.shape.layers import ShapeLayers
from dpcli.generate4d.shape.model_file import save_shape_model
from dpcli.generate4d.shape.network import ShapeNetwork
from dpcli.generate4d.targets import Targets
from dpcli.ops.cameras import orbit_pose, pinhole


def _weights(path, offset: float) -> str:
    """Weights whose confidence is 1 / (1 + exp(-offset)) whatever they see."""
    torch.manual_seed(0)
    model = ShapeNetwork(ShapeConfig(widths=(4, 8), hidden=8, bins=5)).eval()
    save_shape_model(path, model, {"size": 16, "confidence": [0.0] * 8 + [offset]})
    return str(path)


@pytest.fixture
def targets():
    picture = torch.zeros(1, 2, 32, 32, 4)
    picture[:, :, 8:24, 10:22] = 1
    return Targets(
        "box", picture.half(), pinhole(0.8, 32, 32)[None], orbit_pose(0.0, 0.0)[None], np.arange(2.0), reference=0
    )


@pytest.mark.parametrize(
    ("prior", "offset", "name", "said"),
    [
        ("auto", 2.0, "network", "shape: network, confidence 0.88; the depth is"),
        ("auto", -2.0, "inflated", "this looks like none (confidence 0.12)"),
        ("network", -2.0, "network", "shape: network, confidence 0.12"),
        ("inflated", 2.0, "inflated", ""),
    ],
)
def test_the_network_is_taken_where_it_is_sure(prior, offset, name, said, targets, tmp_path, capsys):
    found = guide(prior, targets, _weights(tmp_path / "w.safetensors", offset))
    assert found.name == name and said in capsys.readouterr().err


def test_empty_frames_have_no_say(targets, tmp_path):
    """Of a creature that is in less than half of the clip the network knows as much as of one that stays."""
    weights = _weights(tmp_path / "w.safetensors", 2.0)
    pictures = torch.cat([targets.pictures, torch.zeros_like(targets.pictures), torch.zeros_like(targets.pictures)], 1)
    found = guide("auto", replace(targets, pictures=pictures, seconds=np.arange(6.0)), weights)
    assert (found.name, round(found.confidence, 2)) == ("network", 0.88)


class Bar:
    """A prior of one bar along the line of sight, from 2 to 3 away, as wide as the picture's middle half."""

    name = "bar"

    def layers(self, pictures, camera):
        presence = np.zeros((1, 32, 32), np.float32)
        presence[:, 8:24, 8:24] = 1
        depth = np.broadcast_to(np.float32([2, 3])[:, None, None], (2, 32, 32))
        return [ShapeLayers(depth, presence, np.zeros((2, 3, 32, 32), np.float32)) for _ in pictures]


def test_how_deep_an_object_is_beside_its_larger_side(targets):
    """The back of the bar is seen as large as its front and is farther away, so it is the larger side: 1 / (3 x 15 / f)."""
    focal = float(targets.intrinsics[0, 0, 0])
    assert ShapeGuidance(Bar(), targets).depth_share == pytest.approx(focal / 45, rel=0.03)


@pytest.mark.parametrize("stretched", [(2, 1), (1, 3)])
@pytest.mark.parametrize("prior", ["inflated", "network"])
def test_pixels_that_are_no_squares_make_nothing_thinner(prior, stretched, targets):
    across, down = stretched
    lens = np.diag([across, down, 1.0]) @ targets.intrinsics[0]
    pictures = targets.pictures.repeat_interleave(down, 2).repeat_interleave(across, 3)
    oblong = replace(targets, pictures=pictures, intrinsics=lens[None])
    (square, camera), (found, own) = (reference_pictures(given, 128) for given in (targets, oblong))
    np.testing.assert_allclose(found, square, atol=1e-3)
    np.testing.assert_allclose(own.intrinsics, camera.intrinsics)
    assert guide(prior, oblong).depth_share == pytest.approx(guide(prior, targets).depth_share, rel=1e-2)


def test_without_weights_auto_inflates_and_says_so(targets, tmp_path, monkeypatch, capsys):
    for where in ("choice", "model_file"):
        monkeypatch.setattr(f"dpcli.generate4d.shape.{where}.SHIPPED", tmp_path)
    assert guide("auto", targets).name == "inflated"
    assert "shape: inflated silhouette; this installation has no shape network" in capsys.readouterr().err
    with pytest.raises(DataError, match="--prior-model creatures: no such file"):
        guide("network", targets)


def test_other_priors_have_no_shape(targets):
    assert guide("none", targets) is None and guide("views", targets) is None


@pytest.mark.parametrize(("until", "judged"), [(0.5, 2), (1.0, 4), (0.0, 0)])
def test_the_last_steps_follow_the_input_view_alone(until, judged, targets, monkeypatch):
    shape, frames = guide("inflated", targets), []
    drawn = shape.pictures
    monkeypatch.setattr(shape, "pictures", lambda *given: frames.append(given[0]) or drawn(*given))
    config = replace(FIT_PRESETS["tiny"], size=32, dense_steps=2, sparse_steps=2, shape_until=until)
    optimizer = SceneOptimizer(targets, config, seed=0, shape=shape)
    optimizer.start()
    for _ in range(config.steps):
        optimizer.take_step()
    assert len(frames) == judged


def test_what_moves_in_depth_costs_with_and_without_a_shape(targets):
    for shape in (guide("inflated", targets), None):
        costs = {}
        for weight in (0.0, 1000.0):
            config = replace(FIT_PRESETS["tiny"], size=32, thickness=weight)
            optimizer = SceneOptimizer(targets, config, seed=0, shape=shape)
            optimizer.start()
            with torch.no_grad():
                instant = optimizer.model.at(optimizer.times[[1]])
                instant.mean += 0.1 * torch.from_numpy(targets.world_to_camera[0][2, :3]).float()
                costs[weight] = optimizer._motion_terms(instant, [1]).item()
        assert costs[1000.0] - costs[0.0] == pytest.approx(10, rel=1e-3)

"""The network as a prior: layers of the picture's size in order, at its border too, and what a wrong file says."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from dpcli.errors import DataError
from dpcli.generate4d.shape.config import ShapeConfig
from dpcli.generate4d.shape.layers import Camera, points_of
from dpcli.generate4d.shape.learned import Network, choose_length, lengthened
from dpcli.generate4d.shape.model_file import load_shape_model, save_shape_model
from dpcli.generate4d.shape.network import ShapeNetwork
from dpcli.generate4d.shape.silhouette import Inflated
from dpcli.generate4d.shape.splats import splats_of
from dpcli.ops.cameras import orbit_pose, pinhole
from dpcli.runtime.weights import save_weights

CONFIG = ShapeConfig(widths=(4, 8), hidden=8, bins=5)


@pytest.fixture
def weights(tmp_path):
    """A network that knows nothing yet and so inflates."""
    torch.manual_seed(0)
    model = ShapeNetwork(CONFIG).eval()
    for layer in (model.out, model.name[-1]):
        torch.nn.init.zeros_(layer.weight)
        torch.nn.init.zeros_(layer.bias)
    with torch.no_grad():
        model.name[-1].bias[[2, 7]] = 20.0  # the middle bins: nothing is turned
    save_shape_model(tmp_path / "shape.safetensors", model, {"size": 64, "confidence": [0.0] * 9})
    return tmp_path / "shape.safetensors"


def _disc(row: float, column: float, radius: float, size: int = 96) -> np.ndarray:
    axis = np.arange(size) + 0.5
    picture = np.zeros((4, size, size), np.float32)
    picture[3] = (axis[:, None] - row) ** 2 + (axis - column) ** 2 < radius**2
    picture[0] = 0.7 * picture[3]
    return picture


def _camera(size: int = 96) -> Camera:
    return Camera(pinhole(0.5, size, size), orbit_pose(0.4, 0.1, 3.0))


def test_without_knowledge_it_inflates(weights):
    pictures, camera = np.stack([_disc(48, 48, 30), _disc(40, 60, 12)]), _camera()
    for found, plain in zip(Network(str(weights)).layers(pictures, camera), Inflated().layers(pictures, camera)):
        inside = plain.presence[0] > 0.5
        unit = np.ptp(plain.depth[:2, inside])
        assert np.abs(found.depth[:2] - plain.depth[:2])[:, inside].mean() < 0.05 * unit
        assert found.confidence == pytest.approx(0.5) and np.array_equal(found.presence[0], plain.presence[0])
        assert np.array_equal(found.color, plain.color)


def test_what_is_thicker_than_its_inflation_is_longer_yet():
    """Two frames of a box: all of a clip is stretched alike, away from its turned plane, and nothing is made shorter."""
    cut = torch.zeros(2, 5, 16, 16)
    cut[:, 3, 4:12, 4:12] = 1
    cut[:, 4] = 0.1 * cut[:, 3]
    plane, second = 0.3 * torch.linspace(-1, 1, 16).expand(2, 1, 16, 16), torch.zeros(2, 16, 16)

    def box(half: float) -> torch.Tensor:
        return 0.05 + plane + torch.tensor([-half, half, half, half])[:, None, None]

    inside = cut[:, None, 3].expand(-1, 4, -1, -1) > 0
    for half, becomes in ((0.2, 0.2 * 2**1.5), (0.1, 0.1), (0.06, 0.06), (0.9, 2.7)):
        found = lengthened(box(half), second, cut, plane)
        assert found[inside].numpy() == pytest.approx(box(becomes)[inside].numpy(), abs=1e-5)
    empty = lengthened(box(0.2), second, 0 * cut, plane)
    assert torch.isfinite(empty).all()


def test_layers_are_in_order_where_weights_are_random(tmp_path):
    torch.manual_seed(1)
    save_shape_model(
        tmp_path / "x.safetensors", ShapeNetwork(CONFIG).eval(), {"size": 32, "confidence": [0.0] * 8 + [2.0]}
    )
    found = Network(str(tmp_path / "x.safetensors")).layers(np.stack([_disc(50, 40, 25)] * 3), _camera())
    for layers in found:
        assert (np.diff(layers.depth, axis=0) >= 0).all() and np.isfinite(layers.depth).all()
        assert 0 <= layers.presence.min() and layers.presence.max() <= 1
        assert len(points_of(layers, _camera()).position) >= 2 * (layers.presence[0] > 0.5).sum()
    assert np.array_equal(found[0].depth, found[2].depth)


@pytest.mark.parametrize("picture", [_disc(2, 90, 30), _disc(48, 48, 70), _disc(20, 20, 0.8)])
def test_objects_at_the_border_all_over_and_of_one_pixel(weights, picture):
    (found,) = Network(str(weights)).layers(picture[None], _camera())
    assert found.depth.shape == (4, 96, 96) and np.isfinite(found.depth).all() and found.depth.min() > 0


def test_empty_frames_have_no_presence(weights):
    nothing = np.zeros((4, 96, 96), np.float32)
    found = Network(str(weights)).layers(np.stack([nothing, _disc(48, 48, 20)]), _camera())
    assert not found[0].presence.any() and found[0].confidence == 0 and found[1].presence.any()
    assert not Network(str(weights)).layers(nothing[None], _camera())[0].presence.any()


def test_wrong_files_are_said(weights, tmp_path):
    with pytest.raises(DataError, match="--prior-model nosuch: no such file"):
        Network("nosuch")
    (tmp_path / "cut.safetensors").write_bytes(weights.read_bytes()[:-100])
    with pytest.raises(DataError, match="not a complete safetensors file"):
        load_shape_model(tmp_path / "cut.safetensors")
    save_weights(tmp_path / "other.safetensors", {"a": torch.zeros(1)}, {"format": "dpc-parts-1"})
    with pytest.raises(DataError, match="format 'dpc-parts-1', expected 'dpc-shape"):
        load_shape_model(tmp_path / "other.safetensors")


def test_a_clip_has_one_length_and_rather_too_long_a_one():
    """All frames speak for it; where they leave it open it is half a standard deviation above the mean."""
    model = ShapeNetwork(ShapeConfig(widths=(4, 8), hidden=8, bins=5, lengths=True))
    centers = model.length_centers.tolist()
    sure, open_ = torch.full((2, 3, 5), -20.0)
    sure[:, 3], open_[:, [1, 3]] = 0.0, 0.0
    assert choose_length(model, sure).tolist() == pytest.approx([centers[3]] * 3, abs=1e-4)
    middle, spread = (centers[1] + centers[3]) / 2, (centers[3] - centers[1]) / 2
    assert choose_length(model, open_).tolist() == pytest.approx([middle + spread / 2] * 3, abs=1e-4)
    open_[0], open_[0, 3] = -20.0, 0.0
    assert choose_length(model, open_)[0] > middle + spread / 2
    assert choose_length(ShapeNetwork(CONFIG), torch.zeros(3, 0)).tolist() == [0.0] * 3


def test_a_network_that_names_lengths_goes_through_a_file(tmp_path):
    torch.manual_seed(2)
    config = ShapeConfig(widths=(4, 8), hidden=8, bins=5, lengths=True)
    save_shape_model(
        tmp_path / "x.safetensors", ShapeNetwork(config).eval(), {"size": 32, "confidence": [0.0] * 8 + [2.0]}
    )
    found = Network(str(tmp_path / "x.safetensors")).layers(np.stack([_disc(50, 40, 25)] * 2), _camera())
    assert all((np.diff(layers.depth, axis=0) >= 0).all() and np.isfinite(layers.depth).all() for layers in found)


@pytest.mark.parametrize("fovy", [0.5, 1.6, 2.2, 2.8])
def test_a_wide_picture_puts_nothing_behind_the_camera(fovy, weights):
    """Thickness is as many pixels as the disc's radius, more than the focal length where the picture is wide."""
    pictures, camera = np.stack([_disc(48, 48, 44)]), Camera(pinhole(fovy, 96, 96), orbit_pose(0.4, 0.1, 3.0))
    for prior in (Inflated(), Network(str(weights))):
        (layers,) = prior.layers(pictures, camera)
        assert layers.depth[:, layers.presence[0] > 0.5].min() >= 0.29
        assert len(splats_of(layers, camera).mean)

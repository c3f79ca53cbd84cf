"""The FID Inception against a definition of its own, torch-fidelity's values, and torchmetrics' way to its input."""

from __future__ import annotations

import functools

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from dpcli.evaluate.networks.inception import FidInception, inception_input
from dpcli.evaluate.video.frechet.clip_features import FeatureNetwork, VideoFeatures, video_distance
from dpcli.evaluate.video.frechet.frame_inputs import prepare_frame
from dpcli.evaluate.video.frechet.variants import VARIANTS
from dpcli.runtime.seeds import generator
from tests.support import network_helpers

# torch-fidelity 0.4.0's FeatureExtractorInceptionV3 on `seeded_state` and `picture`: the first features
TORCH_FIDELITY = [1.23219, 0.00268905, 0.690231, 7.18121, 0.0, 0.147934]


def _vector(rng: np.random.Generator, name: str, shape: tuple[int, ...]) -> np.ndarray:
    if name.endswith(("running_var", "bn.weight", "bn1.weight")):
        return rng.uniform(0.75, 1.25, shape)
    return rng.standard_normal(shape) * 0.1


seeded_state = functools.partial(network_helpers.seeded_state, stream=40, vector=_vector)
seeded = functools.partial(network_helpers.seeded, stream=40, vector=_vector)


def picture() -> np.ndarray:
    return generator(0, 41).integers(0, 256, (1, 3, 299, 299), dtype=np.uint8)


class Twin:
    """The same network from its table, batch norm folded into the weights, pools as sums over counted pixels."""

    def __init__(self, state: dict[str, torch.Tensor]) -> None:
        self.state = state

    def conv(self, x, name, stride=1, pad=(0, 0)):
        s = {
            key: self.state[f"{name}.{key}"].double()
            for key in ("conv.weight", "bn.weight", "bn.bias", "bn.running_mean", "bn.running_var")
        }
        scale = s["bn.weight"] / (s["bn.running_var"] + 0.001).sqrt()
        weight = (s["conv.weight"] * scale[:, None, None, None]).float()
        bias = (s["bn.bias"] - s["bn.running_mean"] * scale).float()
        return F.relu(F.conv2d(x, weight, bias, stride, pad))

    def chain(self, x, block, *steps):
        for name, stride, pad in steps:
            x = self.conv(x, f"{block}.{name}", stride, pad)
        return x

    @staticmethod
    def mean(x):
        ones = torch.ones(1, 1, 3, 3)
        counted = F.conv2d(torch.ones_like(x[:, :1]), ones, padding=1)
        summed = F.conv2d(x.transpose(0, 1), ones, padding=1).transpose(0, 1)
        return summed / counted

    def a(self, x, block):
        yield self.chain(x, block, ("branch1x1", 1, 0))
        yield self.chain(x, block, ("branch5x5_1", 1, 0), ("branch5x5_2", 1, 2))
        yield self.chain(x, block, ("branch3x3dbl_1", 1, 0), ("branch3x3dbl_2", 1, 1), ("branch3x3dbl_3", 1, 1))
        yield self.chain(self.mean(x), block, ("branch_pool", 1, 0))

    def b(self, x, block):
        yield self.chain(x, block, ("branch3x3", 2, 0))
        yield self.chain(x, block, ("branch3x3dbl_1", 1, 0), ("branch3x3dbl_2", 1, 1), ("branch3x3dbl_3", 2, 0))
        yield F.max_pool2d(x, 3, 2)

    def c(self, x, block):
        row, column = (1, (0, 3)), (1, (3, 0))
        yield self.chain(x, block, ("branch1x1", 1, 0))
        yield self.chain(x, block, ("branch7x7_1", 1, 0), ("branch7x7_2", *row), ("branch7x7_3", *column))
        yield self.chain(
            x,
            block,
            ("branch7x7dbl_1", 1, 0),
            ("branch7x7dbl_2", *column),
            ("branch7x7dbl_3", *row),
            ("branch7x7dbl_4", *column),
            ("branch7x7dbl_5", *row),
        )
        yield self.chain(self.mean(x), block, ("branch_pool", 1, 0))

    def d(self, x, block):
        yield self.chain(x, block, ("branch3x3_1", 1, 0), ("branch3x3_2", 2, 0))
        yield self.chain(
            x,
            block,
            ("branch7x7x3_1", 1, 0),
            ("branch7x7x3_2", 1, (0, 3)),
            ("branch7x7x3_3", 1, (3, 0)),
            ("branch7x7x3_4", 2, 0),
        )
        yield F.max_pool2d(x, 3, 2)

    def e(self, x, block):
        yield self.chain(x, block, ("branch1x1", 1, 0))
        for stem, fork in (("branch3x3", ("branch3x3_1",)), ("branch3x3dbl", ("branch3x3dbl_1", "branch3x3dbl_2"))):
            y, step = self.chain(x, block, *((name, 1, int(name.endswith("dbl_2"))) for name in fork)), len(fork) + 1
            yield self.chain(y, block, (f"{stem}_{step}a", 1, (0, 1)))
            yield self.chain(y, block, (f"{stem}_{step}b", 1, (1, 0)))
        pooled = self.mean(x) if block == "Mixed_7b" else F.max_pool2d(x, 3, 1, 1)
        yield self.chain(pooled, block, ("branch_pool", 1, 0))

    def stages(self, x):
        for name, stride, pad in (("1a", 2, 0), ("2a", 1, 0), ("2b", 1, 1), ("3b", 1, 0), ("4a", 1, 0)):
            name = next(key for key in self.state if f"_{name}_" in key).split(".")[0]
            x = self.conv(x, name, stride, pad)
            yield name, x
            if name in ("Conv2d_2b_3x3", "Conv2d_4a_3x3"):
                x = F.max_pool2d(x, 3, 2)
        kinds = {"5b": "a", "5c": "a", "5d": "a", "6a": "b", "6b": "c", "6c": "c", "6d": "c", "6e": "c", "7a": "d"}
        for name, kind in (kinds | {"7b": "e", "7c": "e"}).items():
            x = torch.cat(list(getattr(self, kind)(x, f"Mixed_{name}")), 1)
            yield f"Mixed_{name}", x


@pytest.fixture(scope="module")
def network() -> FidInception:
    return seeded(FidInception)


@torch.inference_mode()
def test_every_stage_equals_an_independent_definition(network, one_thread):
    x = inception_input(torch.from_numpy(picture()))
    names = []
    for (name, ours), (other, theirs) in zip(network.stages(x), Twin(network.state_dict()).stages(x), strict=True):
        assert name == other and ours.shape == theirs.shape
        assert (ours - theirs).abs().max() < 1e-5 * theirs.abs().max(), name
        names.append(name)
    assert len(names) == 16 and ours.shape == (1, 2048, 8, 8)
    features = network(x)
    assert (features - theirs.mean((2, 3))).abs().max() < 1e-5 * features.abs().max()
    np.testing.assert_allclose(features[0, : len(TORCH_FIDELITY)], TORCH_FIDELITY, rtol=1e-4, atol=1e-5)


@torch.inference_mode()
def test_torchvisions_block_would_not_pass(network, one_thread):
    """The quirks that make it TensorFlow's: a mean with its zeros counted, or a mean in the last block, are told."""
    x = torch.from_numpy(generator(0, 42).standard_normal((1, 2048, 8, 8), np.float32)).abs()
    good, twin = network.Mixed_7c(x), torch.cat(list(Twin(network.state_dict()).e(x, "Mixed_7c")), 1)
    torch.testing.assert_close(good, twin, rtol=1e-4, atol=1e-5)
    network.Mixed_7c.pool = "mean"
    try:
        assert (network.Mixed_7c(x) - twin).abs().max() > 0.1
    finally:
        network.Mixed_7c.pool = "max"
    counted = F.avg_pool2d(x, 3, 1, 1)
    assert (counted - Twin.mean(x)).abs().max() > 0.1


def test_the_input_is_torchmetrics(one_thread):
    frame = generator(0, 43).integers(0, 256, (3, 64, 48)).astype(np.float32) / 255
    found = prepare_frame(VARIANTS["inception"], frame)
    values = torch.from_numpy((frame * 255).round())[None]
    expected = F.interpolate(values, size=(299, 299), mode="bilinear", align_corners=False, antialias=True)
    torch.testing.assert_close(found, ((expected - 128) / 128)[0], rtol=0, atol=1e-6)
    large = generator(0, 44).random((3, 400, 400), np.float32)
    values = torch.from_numpy((large * 255).round())[None]
    small = (F.interpolate(values, size=(299, 299), mode="bilinear", align_corners=False) - 128) / 128
    found = prepare_frame(VARIANTS["inception"], large)
    assert (found - small).abs().max() > 0.1  # shrinking is where antialias counts


def test_mean_over_videos_of_each_videos_own_distance(one_thread):
    """With the picture itself as the feature, checked against plain NumPy."""
    from scipy.linalg import sqrtm

    class Few(torch.nn.Module):
        def forward(self, x: torch.Tensor) -> torch.Tensor:
            return F.adaptive_avg_pool2d(x, 1).flatten(1)

    network = FeatureNetwork(VARIANTS["inception"], Few())
    rng, pairs, expected = generator(0, 45), [], []
    for _ in range(2):
        videos = rng.random((2, 6, 3, 20, 20), np.float32) * rng.random((2, 6, 3, 1, 1), np.float32)
        features = VideoFeatures(network)
        for predicted, truth in zip(*videos, strict=True):
            features.add(predicted, truth)
        pairs.append(features.result())
        x, y = (
            np.stack([prepare_frame(VARIANTS["inception"], f).double().mean((1, 2)) for f in video]) for video in videos
        )
        s, t = np.cov(x.T), np.cov(y.T)
        expected.append(np.square(x.mean(0) - y.mean(0)).sum() + np.trace(s + t - 2 * sqrtm(s @ t).real))
    found = video_distance(VARIANTS["inception"], pairs)
    assert found.each == pytest.approx(expected, rel=1e-4)
    assert found.value == pytest.approx(np.mean(expected), rel=1e-4)
    assert (found.videos, found.clips, found.frames) == (2, 12, 12)

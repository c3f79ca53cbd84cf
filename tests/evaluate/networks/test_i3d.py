"""I3D and the 3D ResNet-50 against definitions of their own and other projects' values; how videos become features."""

from __future__ import annotations

import functools
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from PIL import Image

from dpcli.errors import DataError, UsageError
from dpcli.evaluate.networks.i3d import I3D, ScriptedI3D, Unit, pool_same, same_padding
from dpcli.evaluate.networks.resnet3d import ResNet3D50
from dpcli.evaluate.networks.weights import find_weights, weights_folder
from dpcli.evaluate.video.frechet.clip_features import (
    LONGEST,
    ClipFeatures,
    FeatureNetwork,
    VideoFeatures,
    VideoPair,
    build_network,
    video_distance,
)
from dpcli.evaluate.video.frechet.frame_inputs import prepare_frame
from dpcli.evaluate.video.frechet.variants import VARIANTS, feature_choices, feature_variant
from dpcli.runtime.seeds import generator
from tests.support import network_helpers

# on `seeded_state` and the clips below: the I3D of cd-fvd 0.1.1, the 3D ResNet-50 of monai 1.6.1
CD_FVD = [5.0683, -1.0638, -5.09506, 2.50488, -2.62659, -2.9186]
MONAI = [11678.1, 10520.7, 4324.28, 5793.8, 1718.51, 0.0]


def _vector(rng: np.random.Generator, name: str, shape: tuple[int, ...]) -> np.ndarray:
    if name.endswith("running_var"):
        return rng.uniform(0.75, 1.25, shape)
    return rng.standard_normal(shape) * 0.1 + (name.endswith("weight"))


seeded_state = functools.partial(network_helpers.seeded_state, stream=50, vector=_vector)
seeded = functools.partial(network_helpers.seeded, stream=50, vector=_vector)


def i3d_clip() -> torch.Tensor:
    return torch.from_numpy(generator(0, 51).random((1, 3, 10, 224, 224), np.float32) * 2 - 1)


def r3d_clip() -> torch.Tensor:
    return torch.from_numpy(generator(0, 52).random((1, 3, 16, 56, 56), np.float32) * 255 - 105)


def folded(state: dict[str, torch.Tensor], conv: str, norm: str, eps: float) -> tuple[torch.Tensor, torch.Tensor]:
    """A convolution's weight and bias with the batch norm behind it inside."""
    w, b = state[f"{norm}.weight"].double(), state[f"{norm}.bias"].double()
    scale = w / (state[f"{norm}.running_var"].double() + eps).sqrt()
    weight = state[f"{conv}.weight"].double() * scale[:, None, None, None, None]
    return weight.float(), (b - state[f"{norm}.running_mean"].double() * scale).float()


def i3d_twin(
    state: dict[str, torch.Tensor], x: torch.Tensor, pool: int, eps: float
) -> Iterator[tuple[str, torch.Tensor]]:
    """I3D on 10 frames of 224 x 224 with every padding written out, in front and behind; maxima over -inf."""

    def unit(x, name, pad=(0,) * 6, stride=1):
        weight, bias = folded(state, f"{name}.conv3d", f"{name}.bn", eps)
        return F.relu(F.conv3d(F.pad(x, pad), weight, bias, stride))

    def largest(x, pad, kernel, stride):
        return F.max_pool3d(F.pad(x, pad, value=-torch.inf), kernel, stride)

    def mixed(x, name):
        around = (1,) * 6
        three = unit(unit(x, f"{name}.b1a"), f"{name}.b1b", around)
        other = unit(unit(x, f"{name}.b2a"), f"{name}.b2b", around)
        return torch.cat([unit(x, f"{name}.b0"), three, other, unit(largest(x, around, 3, 1), f"{name}.b3b")], 1)

    x = unit(x, "Conv3d_1a_7x7", (2, 3, 2, 3, 2, 3), 2)  # 10x224x224 -> 5x112x112
    yield "Conv3d_1a_7x7", x
    x = unit(largest(x, (0, 1, 0, 1, 0, 0), (1, 3, 3), (1, 2, 2)), "Conv3d_2b_1x1")
    yield "Conv3d_2b_1x1", x
    x = unit(x, "Conv3d_2c_3x3", (1,) * 6)
    yield "Conv3d_2c_3x3", x
    x = largest(x, (0, 1, 0, 1, 0, 0), (1, 3, 3), (1, 2, 2))  # 5x28x28
    for name in ("3b", "3c", "4b", "4c", "4d", "4e", "4f", "5b", "5c"):
        if name == "4b":
            x = largest(x, (0, 1, 0, 1, 1, 1), 3, 2)  # 3x14x14
        if name == "5b":
            x = largest(x, (0, 0, 0, 0, 0, 1), 2, 2)  # 2x7x7
        x = mixed(x, f"Mixed_{name}")
        yield f"Mixed_{name}", x
    means = torch.stack([x[:, :, t : t + pool].mean((2, 3, 4)) for t in range(x.shape[2] - pool + 1)]).mean(0)
    yield "logits", means @ state["logits.conv3d.weight"][:, :, 0, 0, 0].T + state["logits.conv3d.bias"]


def r3d_twin(state: dict[str, torch.Tensor], x: torch.Tensor) -> Iterator[tuple[str, torch.Tensor]]:
    def conv(x, conv, norm, stride=1, pad=0):
        return F.conv3d(x, *folded(state, conv, norm, 1e-5), stride, pad)

    x = F.relu(conv(x, "conv1", "bn1", (1, 2, 2), 3))
    x = F.max_pool3d(x, 3, 2, 1)
    yield "stem", x
    for layer, blocks in (("layer1", 3), ("layer2", 4), ("layer3", 6), ("layer4", 3)):
        for block in range(blocks):
            at, stride = f"{layer}.{block}", 2 if block == 0 and layer != "layer1" else 1
            y = F.relu(conv(x, f"{at}.conv1", f"{at}.bn1"))
            y = F.relu(conv(y, f"{at}.conv2", f"{at}.bn2", stride, 1))
            y = conv(y, f"{at}.conv3", f"{at}.bn3")
            x = F.relu(y + (conv(x, f"{at}.downsample.0", f"{at}.downsample.1", stride) if block == 0 else x))
        yield layer, x


@pytest.fixture(scope="module")
def i3d() -> I3D:
    return seeded(I3D)


@torch.inference_mode()
def test_every_stage_of_i3d_equals_an_independent_definition(i3d, one_thread):
    x, state = i3d_clip(), i3d.state_dict()
    twin = dict(i3d_twin(state, x, 2, 1e-5))
    for name, ours in i3d.stages(x):
        assert ours.shape == twin[name].shape, name
        assert (ours - twin[name]).abs().max() < 1e-5 * twin[name].abs().max(), name
    logits = i3d.logits(F.avg_pool3d(ours, (2, 7, 7), 1)).mean((2, 3, 4))
    assert (logits - twin["logits"]).abs().max() < 1e-5 * logits.abs().max()
    np.testing.assert_allclose(logits[0, : len(CD_FVD)], CD_FVD, rtol=1e-4, atol=1e-5)
    i3d.avg_pool = (1, 7, 7)
    try:  # DisCo's pool over single frames gives other numbers: a definition of it, and a broken twin of the above
        means = ours.mean((3, 4))
        expected = (means.mean(2) @ state["logits.conv3d.weight"][:, :, 0, 0, 0].T) + state["logits.conv3d.bias"]
        single = i3d.logits(F.avg_pool3d(ours, i3d.avg_pool, 1)).mean((2, 3, 4))
        assert (single - expected).abs().max() < 1e-5 * expected.abs().max()
    finally:
        i3d.avg_pool = (2, 7, 7)
    assert len(twin) == 13


@torch.inference_mode()
def test_disco_and_videogpt_networks_differ_as_named(i3d, one_thread):
    with torch.device("meta"):
        made = {name: build_network(name) for name in ("videogpt", "disco", "consistent4d")}
    norms = {name: {m.eps for m in net.modules() if isinstance(m, torch.nn.BatchNorm3d)} for name, net in made.items()}
    assert norms == {"videogpt": {1e-5}, "disco": {1e-3}, "consistent4d": {1e-3}}
    assert [net.avg_pool[0] for net in made.values()] == [2, 1, 1]
    assert not made["disco"].training
    assert sum(p.numel() for p in i3d.parameters()) == 12_697_264


def test_same_padding_is_tensorflows():
    assert [
        same_padding(*case) for case in ((224, 7, 2), (10, 7, 2), (112, 3, 2), (5, 3, 2), (14, 2, 2), (3, 2, 2))
    ] == [(2, 3), (2, 3), (0, 1), (1, 1), (0, 0), (0, 1)]
    assert same_padding(9, 1, 3) == (0, 0)  # a kernel under its stride needs none


@torch.inference_mode()
def test_a_unit_is_tensorflows_by_brute_force():
    unit = Unit(2, 3, 3, 2).eval()
    x = torch.from_numpy(generator(0, 53).standard_normal((1, 2, 4, 5, 6), np.float32))
    out, kernel, values = unit(x), unit.conv3d.weight.double().numpy(), x.double().numpy()[0]
    front = (0, 1, 0)  # 4, 5, 6 at kernel 3, stride 2: one zero missing, two, one; the odd one behind
    assert out.shape == (1, 3, 2, 3, 3)
    for t, i, j in np.ndindex(2, 3, 3):
        total = np.zeros(3)
        for a, b, c in np.ndindex(3, 3, 3):
            at = [2 * o + k - f for o, k, f in zip((t, i, j), (a, b, c), front, strict=True)]
            if all(0 <= p < n for p, n in zip(at, values.shape[1:], strict=True)):
                total += kernel[:, :, a, b, c] @ values[(slice(None), *at)]
        np.testing.assert_allclose(out[0, :, t, i, j], np.maximum(total / np.sqrt(1 + 1e-5), 0), atol=1e-5)
    pooled = pool_same(x.abs(), (3, 3, 3), (2, 2, 2))
    assert pooled[0, 0, 1, 2, 2] == x.abs()[0, 0, 2:, 3:, 4:].max()


@torch.inference_mode()
def test_every_stage_of_the_3d_resnet_equals_an_independent_definition(one_thread):
    network = seeded(ResNet3D50)
    x = r3d_clip()
    for (name, ours), (other, theirs) in zip(network.stages(x), r3d_twin(network.state_dict(), x), strict=True):
        assert name == other and ours.shape == theirs.shape
        assert (ours - theirs).abs().max() < 1e-5 * theirs.abs().max(), name
    assert ours.shape == (1, 2048, 1, 2, 2)
    np.testing.assert_allclose(ours.mean((2, 3, 4))[0, : len(MONAI)], MONAI, rtol=1e-4)


class Color(torch.nn.Module):
    """A network whose features can be told by hand: mean and spread of each channel of a clip."""

    def __init__(self) -> None:
        super().__init__()
        self.frames: list[int] = []

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        self.frames.append(x.shape[2])
        x = x[..., ::32, ::32]
        return torch.cat([x.mean((2, 3, 4)), x.std((2, 3, 4))], dim=1)


def flat(levels: Iterator[float] | list[float], side: int = 8) -> list[np.ndarray]:
    return [np.full((3, side, side), level, np.float32) for level in levels]


def test_pictures_are_prepared_as_each_variant_says():
    picture = generator(0, 54).random((3, 40, 60), np.float32)
    wide = F.interpolate(torch.from_numpy(picture)[None], size=(224, 336), mode="bilinear", align_corners=False)[0]
    torch.testing.assert_close(
        prepare_frame(VARIANTS["styleganv"], picture), wide[:, :, 56:280] * 2 - 1, rtol=0, atol=1e-6
    )
    eight = torch.from_numpy(np.floor(picture * 255) / 255)[None]
    wide = F.interpolate(eight, size=(224, 336), mode="bilinear", align_corners=False)[0]
    torch.testing.assert_close(
        prepare_frame(VARIANTS["videogpt"], picture), wide[:, :, 56:280] * 2 - 1, rtol=0, atol=1e-6
    )
    tall = prepare_frame(VARIANTS["styleganv"], np.ascontiguousarray(picture.transpose(0, 2, 1)))
    torch.testing.assert_close(tall, prepare_frame(VARIANTS["styleganv"], picture).transpose(1, 2))


@pytest.mark.parametrize(("name", "side"), [("disco", 224), ("consistent4d", 224), ("r3d50", 112)])
def test_pil_bicubic_is_of_eight_bits_in_floats(name: str, side: int):
    picture = generator(0, 55).random((3, 300, 260), np.float32) * 0.3 + 0.3
    found = prepare_frame(VARIANTS[name], picture)
    eight = np.rint(picture * 255).astype(np.uint8)
    back = found + torch.tensor([114.7748, 107.7354, 99.4750])[:, None, None] if side == 112 else (found + 1) * 127.5
    whole = np.asarray(Image.fromarray(eight.transpose(1, 2, 0)).resize((side, side), Image.Resampling.BICUBIC))
    apart = np.abs(back.numpy().clip(0, 255) - whole.transpose(2, 0, 1))
    assert apart.max() < 1.25 and 0 < apart.mean() < 0.4  # PIL rounds the 8-bit picture, after each of two passes
    edge = np.zeros((3, 300, 260), np.float32)
    edge[:, :, 130:] = 1
    assert prepare_frame(VARIANTS["disco"], edge).max() > 1.001  # overshoots are kept


def test_features_on_a_gpu_would_not_round():
    """TF32, torch's default for convolutions, is off while a network runs, and back afterwards."""
    network, seen, before = FeatureNetwork(VARIANTS["disco"], Color()), [], torch.backends.cudnn.allow_tf32
    network.module.register_forward_hook(lambda *_: seen.append(torch.backends.cudnn.allow_tf32))
    network.features([torch.zeros(3, 32, 32)] * 2)
    assert seen == [False] and torch.backends.cudnn.allow_tf32 is before


def test_a_whole_video_is_one_clip_and_windows_slide():
    for name, frames, clips, lengths in (("videogpt", 12, 1, [12]), ("disco", 20, 5, [16] * 5), ("r3d50", 16, 1, [16])):
        network = FeatureNetwork(VARIANTS[name], Color())
        video = ClipFeatures(network)
        for frame in flat(np.linspace(0, 1, frames)):
            video.add(frame)
        assert video.result().samples == clips and network.module.frames == lengths
    network = FeatureNetwork(VARIANTS["disco"], Color())
    video = ClipFeatures(network, hop=4)
    levels = np.arange(24) / 255
    for frame in flat(levels):
        video.add(frame)
    expected = [levels[start : start + 16].mean() * 2 - 1 for start in (0, 4, 8)]
    np.testing.assert_allclose(video.result().rows.reshape(-1, 6)[:, 0], expected, atol=1e-5)


def test_memory_is_bounded_by_a_clip():
    network = FeatureNetwork(VARIANTS["disco"], Color())
    video = ClipFeatures(network, hop=20)
    for frame in flat([0.5] * 60):
        video.add(frame)
        assert len(video._waiting) <= 16
    long = ClipFeatures(FeatureNetwork(VARIANTS["videogpt"], Color()))
    long.frames = LONGEST
    with pytest.raises(DataError, match="256 frames at most.*disco"):
        long.add(flat([0.5])[0])


def test_too_few_frames_say_how_many_are_needed():
    for name, least in (("styleganv", 10), ("videogpt", 10), ("disco", 16), ("r3d50", 16), ("consistent4d", 2)):
        video = VideoFeatures(FeatureNetwork(VARIANTS[name], Color()))
        for frame in flat([0.5] * (least - 1)):
            video.add(frame, frame)
        with pytest.raises(DataError, match=rf"{least - 1} frames: .* at least {least}"):
            video.result()


def test_bad_pictures_are_refused():
    with pytest.raises(DataError, match="divide by 255"):
        prepare_frame(VARIANTS["disco"], np.full((3, 8, 8), 200, np.float32))
    with pytest.raises(DataError, match="1 values that are NaN"):
        prepare_frame(VARIANTS["disco"], np.where(np.arange(192).reshape(3, 8, 8) == 7, np.nan, 0.5).astype(np.float32))
    with pytest.raises(ValueError, match="shape"):
        prepare_frame(VARIANTS["disco"], np.zeros((8, 8, 3), np.float32))
    with pytest.raises(UsageError, match="expected styleganv"):
        feature_variant("tensorflow")
    with pytest.raises(UsageError, match="1 or more"):
        ClipFeatures(FeatureNetwork(VARIANTS["disco"], Color()), hop=0)


def pair(network: FeatureNetwork, levels: list[float], others: list[float]):
    video = VideoFeatures(network)
    for one, other in zip(flat(levels), flat(others), strict=True):
        video.add(one, other)
    return video.result()


def test_consistent4d_is_the_closed_form_of_each_view_then_their_mean():
    network = FeatureNetwork(VARIANTS["consistent4d"], Color())
    pairs = [pair(network, [0.0] * 3, [1.0] * 3), pair(network, [0.0] * 3, [0.0] * 3)]
    found = video_distance(VARIANTS["consistent4d"], pairs)
    # features of black: -1, -1, -1, 0, 0, 0, of white: 1, 1, 1, 0, 0, 0: equal spread, three apart by 2
    assert found.each == pytest.approx((12.0, 0.0)) and found.value == pytest.approx(6.0)
    assert (found.videos, found.clips, found.frames) == (2, 2, 6)


def test_one_video_gives_the_mean_term_or_an_error_as_published():
    for name in ("styleganv", "videogpt"):
        network = FeatureNetwork(VARIANTS[name], Color())
        found = video_distance(VARIANTS[name], [pair(network, [0.0] * 10, [1.0] * 10)])
        assert found.value == pytest.approx(12.0, rel=1e-5)
    network = FeatureNetwork(VARIANTS["disco"], Color())
    with pytest.raises(DataError, match="at least 2: .*closed form"):
        video_distance(VARIANTS["disco"], [pair(network, [0.0] * 16, [1.0] * 16)])
    with pytest.raises(DataError, match="no videos"):
        video_distance(VARIANTS["disco"], [])


def test_windows_of_all_videos_are_pooled_and_equal_videos_are_no_distance_apart():
    network, rng = FeatureNetwork(VARIANTS["disco"], Color()), generator(0, 56)
    levels = rng.random((3, 2, 17)).round(2)
    pairs = [pair(network, *both) for both in levels]
    found = video_distance(VARIANTS["disco"], pairs)
    assert (found.videos, found.clips, found.each) == (3, 6, ())
    exact = replace(VARIANTS["disco"], root="eig")
    same = video_distance(exact, [VideoPair(one.truth, one.truth, one.frames) for one in pairs])
    assert found.value > 1e-4 and 0 <= same.value < 1e-6
    assert feature_choices(VARIANTS["disco"], 4)["clips"] == "windows of 16 frames, one from every 4"
    choices = json.loads(json.dumps(feature_choices(found.variant, 1), allow_nan=False))
    assert choices["network"].startswith("I3D, average pool 1x7x7") and choices["root"] == "scipy"
    assert found.frames == 51


def test_a_torchscript_network_is_asked_as_styleganv_asks_it(tmp_path: Path):
    class Script(torch.nn.Module):
        def forward(self, x: torch.Tensor, rescale: bool = True, resize: bool = True, return_features: bool = False):
            if rescale or resize or not return_features:
                return x[:, :, 0, 0, 0] * 0
            return x.mean(dim=[2, 3, 4])

    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.jit.script(Script()).save(str(tmp_path / "script.pt"))
        network = FeatureNetwork(VARIANTS["styleganv"], ScriptedI3D(tmp_path / "script.pt"))
    assert video_distance(VARIANTS["styleganv"], [pair(network, [1.0] * 10, [0.0] * 10)]).value == pytest.approx(12)
    (tmp_path / "broken.pt").write_bytes(b"no script")
    with pytest.raises(DataError, match=r"broken\.pt: not a TorchScript file"):
        ScriptedI3D(tmp_path / "broken.pt")


def test_published_names_load_and_absent_weights_say_where_to_get_them(tmp_path: Path, i3d):
    with pytest.raises(DataError, match=r"i3d_pretrained_400\.pt.*weights fetch"):
        FeatureNetwork.load("videogpt", tmp_path)
    torch.save(
        {f"module.{name}": value for name, value in i3d.state_dict().items()}, tmp_path / "i3d_pretrained_400.pt"
    )
    loaded = FeatureNetwork.load("videogpt", tmp_path)
    assert torch.equal(loaded.module.Mixed_4e.b2b.conv3d.weight, i3d.Mixed_4e.b2b.conv3d.weight)
    state = i3d.state_dict()
    state.pop("Mixed_4e.b2b.conv3d.weight")
    torch.save(state, tmp_path / "i3d_pretrained_400.pt")
    with pytest.raises(DataError, match=r"no tensor Mixed_4e\.b2b\.conv3d\.weight"):
        FeatureNetwork.load("disco", tmp_path)
    assert {name.split(".")[0] for name in ResNet3D50().state_dict()} == {
        "conv1",
        "bn1",
        "layer1",
        "layer2",
        "layer3",
        "layer4",
    }


@pytest.mark.parametrize("name", ["styleganv", "videogpt"])
def test_the_figure_that_common_metrics_prints(name: str):
    """8 videos of 30 black frames against white ones: 151.26; needs the real weights."""
    folder = weights_folder()
    try:
        find_weights(VARIANTS[name].weights, folder)
    except DataError as error:
        pytest.skip(f"no weights: {error}")
    network = FeatureNetwork.load(name, folder)
    once = pair(network, [0.0] * 30, [1.0] * 30)
    assert video_distance(replace(VARIANTS[name], root="eig"), [once] * 8).value == pytest.approx(151.26, abs=0.05)

"""LPIPS: trunks layer by layer against other definitions, the formula in numpy, and one value of real weights."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from collections import OrderedDict
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import load_file, save_file
from torch import nn

from dpcli.errors import DataError, UsageError
from dpcli.evaluate.networks import lpips as lpips_module
from dpcli.evaluate.networks import weights as weights_module
from dpcli.evaluate.networks.lpips import HEADS, NETS, Lpips, _unit
from dpcli.evaluate.networks.weights import Weights

pytestmark = pytest.mark.usefixtures("one_thread")

SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of RGB in -1..1, as `lpips` 0.1.4 has them

# torchvision's layer tables: a number is a 3 x 3 convolution of that many channels, M a pooling
VGG16 = [64, 64, "M", 128, 128, "M", 256, 256, 256, "M", 512, 512, 512, "M", 512, 512, 512, "M"]
SQUEEZENET = ["M", (16, 64), (16, 64), "M", (32, 128), (32, 128), "M", (48, 192), (48, 192), (64, 256), (64, 256)]
TAPS = {"alex": [1, 4, 7, 9, 11], "vgg": [3, 8, 15, 22, 29], "squeeze": [1, 4, 7, 9, 10, 11, 12]}
PARAMETERS = {"alex": 2_469_696, "vgg": 14_714_688, "squeeze": 722_496}  # as torchvision's `features` have
TORCHMETRICS = {"alex": "alexnet", "vgg": "vgg16", "squeeze": "squeezenet1_1"}


class FireTwin(nn.Module):
    def __init__(self, before: int, few: int, many: int):
        super().__init__()
        self.convs = nn.ModuleDict(
            {
                "squeeze": nn.Conv2d(before, few, 1),
                "expand1x1": nn.Conv2d(few, many, 1),
                "expand3x3": nn.Conv2d(few, many, 3, 1, 1),
            }
        )

    def forward(self, x):
        x = F.relu(self.convs["squeeze"](x))
        return torch.cat((F.relu(self.convs["expand1x1"](x)), F.relu(self.convs["expand3x3"](x))), dim=1)


def twin_of(net: str) -> nn.Sequential:
    """`features` as torchvision lays them out, from its tables."""
    layers: list[nn.Module] = []
    if net == "alex":
        layers = [nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2), nn.Conv2d(64, 192, 5, 1, 2), nn.ReLU()]
        layers += [nn.MaxPool2d(3, 2)]
        for before, after in ((192, 384), (384, 256), (256, 256)):
            layers += [nn.Conv2d(before, after, 3, 1, 1), nn.ReLU()]
        layers += [nn.MaxPool2d(3, 2)]
    elif net == "vgg":
        before = 3
        for entry in VGG16:
            layers += [nn.MaxPool2d(2, 2)] if entry == "M" else [nn.Conv2d(before, entry, 3, 1, 1), nn.ReLU()]
            before = before if entry == "M" else entry
    else:
        layers, before = [nn.Conv2d(3, 64, 3, 2), nn.ReLU()], 64
        for entry in SQUEEZENET:
            layers.append(nn.MaxPool2d(3, 2, ceil_mode=True) if entry == "M" else FireTwin(before, *entry))
            before = before if entry == "M" else 2 * entry[1]
    return nn.Sequential(*layers)


def twin_with(net: str, state: dict[str, torch.Tensor]) -> nn.Sequential:
    twin = twin_of(net).double()
    named = {
        re.sub(r"^(\d+)\.(squeeze|expand)", r"\1.convs.\2", k.removeprefix("features.")): v for k, v in state.items()
    }
    twin.load_state_dict({k: v.double() for k, v in named.items()})
    return twin.requires_grad_(False)


def twin_maps(net: str, twin: nn.Sequential, x: torch.Tensor) -> list[torch.Tensor]:
    found = []
    for position, layer in enumerate(twin[: TAPS[net][-1] + 1]):
        x = layer(x)
        found += [x] if position in TAPS[net] else []
    return found


def scaled(pictures: torch.Tensor, mistake: bool = False) -> torch.Tensor:
    shift, scale = (torch.tensor(x, dtype=torch.float64)[:, None, None] for x in (SHIFT, SCALE))
    return ((pictures.double() if mistake else pictures.double() * 2 - 1) - shift) / scale


def numpy_lpips(maps_a: list, maps_b: list, heads: list[np.ndarray]) -> np.ndarray:
    """The paper's equation 1 with v0.1's constants, float64."""
    total = 0.0
    for a, b, head in zip(maps_a, maps_b, heads, strict=True):
        unit = [m.numpy() / (np.sqrt((m.numpy() ** 2).sum(1, keepdims=True)) + 1e-10) for m in (a, b)]
        total = total + np.einsum("bchw,c->bhw", (unit[0] - unit[1]) ** 2, head).mean((1, 2))
    return total


def heads_of(net: str) -> list[np.ndarray]:
    state = load_file(HEADS / f"lpips-v0.1-{net}.safetensors")
    return [state[f"lin{layer}.model.1.weight"].double().numpy().ravel() for layer in range(len(state))]


def two_pictures(count: int = 2, side: int = 64, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Smooth colors, and the same shifted, dimmed and with noise; f32 (count,3,side,side) in 0..1."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:side, :side] / side
    waves = [np.sin(2 * np.pi * (f * x + g * y) + p) for f, g, p in rng.uniform(0.5, 4, (3 * count, 3))]
    first = np.stack(waves).reshape(count, 3, side, side) / 2 + 0.5
    second = np.clip(0.8 * np.roll(first, 3, -1) + rng.normal(0, 0.05, first.shape), 0, 1)
    return torch.from_numpy(first).float(), torch.from_numpy(second).float()


@pytest.fixture(scope="module", params=["alex", "vgg", "squeeze"])
def random_net(request) -> tuple[str, Lpips, nn.Sequential]:
    """Ours with seeded random weights, and the twin with the same."""
    torch.manual_seed(5)
    ours = Lpips(request.param)
    return request.param, ours, twin_with(request.param, ours.trunk.state_dict())


def test_the_trunk_layer_by_layer(random_net):
    net, ours, twin = random_net
    assert sum(p.numel() for p in ours.trunk.parameters()) == PARAMETERS[net]
    pictures = two_pictures(1, 67)[0]
    found, expected = ours.feature_maps(pictures), twin_maps(net, twin, scaled(pictures))
    assert len(found) == len(TAPS[net]) == len(ours.heads)
    for layer, (a, b) in enumerate(zip(found, expected, strict=True)):
        assert a.shape == b.shape and a.std() > 1e-3
        assert (a - b).abs().max() < 1e-5, f"map {layer} of {net}"


def test_the_distance_is_the_papers(random_net):
    net, ours, twin = random_net
    a, b = two_pictures(2, 40)
    for mistake in (False, True):
        expected = numpy_lpips(*(twin_maps(net, twin, scaled(x, mistake)) for x in (a, b)), heads_of(net))
        assert np.abs(ours.distance(a, b, range01_mistake=mistake).numpy() - expected).max() < 1e-6
        assert expected.min() > 1e-3
    assert (ours.distance(a, a) == 0).all()
    assert torch.equal(ours.distance(a, b), ours.distance(b, a))
    assert (ours.distance(a, b) - ours.distance(a, b, range01_mistake=True)).abs().min() > 1e-4


def test_torchmetrics_agrees(random_net, monkeypatch):
    """Its slices decide what a tap is; its epsilon stands under the root, which these features don't feel."""
    theirs_module = pytest.importorskip("torchmetrics.functional.image.lpips")
    net, ours, twin = random_net
    monkeypatch.setattr(
        theirs_module, "_get_tv_model_features", lambda name, pretrained=False: {TORCHMETRICS[net]: twin}[name]
    )
    theirs = theirs_module._LPIPS(pretrained=True, net=net, pnet_rand=True, use_dropout=True).double()
    a, b = two_pictures(1, 48)
    for mine, other in zip(ours.feature_maps(a), theirs.net(scaled(a)), strict=True):
        assert (mine - other).abs().max() < 1e-5
    expected = theirs(a.double() * 2 - 1, b.double() * 2 - 1).flatten()
    assert (ours.distance(a, b) - expected).abs().max() < 1e-5


def test_a_gpu_would_not_round():
    """TF32, torch's default for convolutions, is off while the trunk runs, and back afterwards."""
    net, seen = Lpips("squeeze"), []
    net.trunk.register_forward_hook(lambda *_: seen.append(torch.backends.cudnn.allow_tf32))
    before = torch.backends.cudnn.allow_tf32
    net.distance(*two_pictures(1, 32))
    assert seen == [False, False] and torch.backends.cudnn.allow_tf32 is before


def test_epsilon_is_added_to_the_length():
    """As `lpips` does; under the root (torchmetrics) a faint feature would come out a thousand times shorter."""
    faint = torch.full((1, 4, 1, 1), 5e-9, dtype=torch.float64)  # length 1e-8
    assert _unit(faint).norm().item() == pytest.approx(1e-8 / (1e-8 + 1e-10), rel=1e-9)
    assert (_unit(0 * faint) == 0).all()


def test_a_broken_twin_is_noticed(random_net):
    """What the tolerances above would not forgive: an unscaled input, heads that weigh alike, floor instead of ceil."""
    net, ours, twin = random_net
    a, b = two_pictures(1, 40)
    expected = numpy_lpips(*(twin_maps(net, twin, scaled(x)) for x in (a, b)), heads_of(net))
    unscaled = numpy_lpips(*(twin_maps(net, twin, x.double() * 2 - 1) for x in (a, b)), heads_of(net))
    assert abs(expected - unscaled).max() > 1e-4
    equal_heads = [np.full_like(head, head.mean()) for head in heads_of(net)]
    assert abs(expected - numpy_lpips(*(twin_maps(net, twin, scaled(x)) for x in (a, b)), equal_heads)).max() > 1e-4
    if net == "squeeze":
        for layer in twin:
            if isinstance(layer, nn.MaxPool2d):
                layer.ceil_mode = False
        shapes = [m.shape for m in twin_maps(net, twin, scaled(a))]
        assert shapes != [m.shape for m in ours.feature_maps(a)]
        for layer in twin:
            if isinstance(layer, nn.MaxPool2d):
                layer.ceil_mode = True


def test_smallest_pictures(random_net):
    net, ours, _ = random_net
    least = ours.trunk.smallest
    assert ours.distance(*two_pictures(1, least)).isfinite().all()
    with pytest.raises(DataError, match=f"at least {least} pixels"):
        ours.distance(*two_pictures(1, least - 1))
    with pytest.raises(RuntimeError):  # the network itself could not, so `smallest` is not larger than need be
        ours.trunk(two_pictures(1, least - 1)[0])


def test_bad_pictures():
    net = Lpips("squeeze")
    a, b = two_pictures(1, 32)
    nan = b.clone()
    nan[0, 1, 2, 3] = torch.nan
    for bad, words in (
        (b * 255, "divide by 255"),
        (b * 2 - 1, "add 1 and halve"),
        (nan, "1 values are NaN"),
        ((b * 255).to(torch.uint8), "uint8"),
    ):
        with pytest.raises(DataError, match=words):
            net.distance(a, bad)
    with pytest.raises(ValueError, match="shapes"):
        net.distance(a, b[:, :, 1:])
    with pytest.raises(ValueError, match=r"\(B,3,H,W\)"):
        net.distance(a[:, :2], b[:, :2])
    with pytest.raises(UsageError, match="alex, vgg, squeeze"):
        Lpips("resnet")
    assert net.distance(a * 1.005, b).isfinite().all()  # a renderer's overshoot


def test_the_shipped_heads(monkeypatch, tmp_path):
    """Non-negative, of the right channels, and those of two packages."""
    card = (HEADS / "LPIPS.md").read_text()
    for net in NETS:
        assert f"lpips-v0.1-{net}" in card
        assert all((head >= 0).all() and head.max() > 0 for head in heads_of(net))
    folder = pytest.importorskip("torchmetrics").functional.image.lpips.__file__
    for net in NETS:
        theirs = torch.load(Path(folder).parent / "lpips_models" / f"{net}.pth", map_location="cpu", weights_only=True)
        for layer, head in enumerate(heads_of(net)):
            assert np.array_equal(head, theirs[f"lin{layer}.model.1.weight"].double().numpy().ravel())
    monkeypatch.setattr(lpips_module, "HEADS", tmp_path)
    save_file(load_file(HEADS / "lpips-v0.1-vgg.safetensors"), tmp_path / "lpips-v0.1-alex.safetensors")
    with pytest.raises(DataError, match="not the heads of alex"):
        Lpips("alex")


def test_loading_a_zoo_file(tmp_path, monkeypatch):
    """A whole classifier's file: the classifier is left alone, another network's is refused, an absent one named."""
    torch.manual_seed(1)
    source = Lpips("squeeze")
    state = OrderedDict(source.trunk.state_dict())
    state["classifier.1.weight"] = torch.zeros(10, 512, 1, 1)
    torch.save(state, tmp_path / "zoo.pth")
    entry = Weights(
        "squeezenet",
        "zoo.pth",
        "https://example.org/zoo.pth",
        (tmp_path / "zoo.pth").stat().st_size,
        "none",
        "",
        "lpips",
    )
    monkeypatch.setattr(weights_module, "known_weights", lambda: {"squeezenet": entry})
    a, b = two_pictures(1, 32)
    assert torch.equal(Lpips.load("squeeze", tmp_path).distance(a, b), source.distance(a, b))
    with pytest.raises(DataError, match="zoo.pth: no such weights; run `dpc evaluate weights fetch squeezenet`"):
        Lpips.load("squeeze", tmp_path / "elsewhere")
    torch.save({k: v for k, v in state.items() if "9.squeeze" not in k}, tmp_path / "zoo.pth")
    monkeypatch.setattr(
        weights_module, "known_weights", lambda: {"squeezenet": Weights(**{**vars(entry), "about": True})}
    )
    with pytest.raises(DataError, match="no tensor features.9.squeeze.weight; expected weights of Trunk"):
        Lpips.load("squeeze", tmp_path)


# Real weights: SqueezeNet 1.1 as Caffe published it, once in a Keras file, once in OpenVINO's graph

FIRES = dict(zip(range(2, 10), (3, 4, 6, 7, 9, 10, 11, 12)))  # Caffe's number -> position in `features`
GOLDEN = np.array([0.10023333103913237, 0.08917108842518598])  # of `two_pictures`, by the twin in float64
MEAN = np.array([104.0, 117.0, 123.0])  # subtracted from BGR 0..255


@pytest.fixture(scope="module")
def real_folder(shared_data) -> Path:
    folder = shared_data / "weights" / "squeezenet1_1"
    if not folder.is_dir():
        pytest.skip(f"no real SqueezeNet weights at {folder}")
    return folder


def torchvision_form(convs: dict[str, tuple[np.ndarray, np.ndarray]]) -> dict[str, torch.Tensor]:
    """Caffe's layers by name, kernels (out,in,h,w) -> torchvision's names and input: scaled RGB instead of BGR bytes."""
    kernel, bias = (x.astype(np.float64) for x in convs["conv1"])
    kernel = kernel[:, ::-1]
    offset = 255 * (np.array(SHIFT) + 1) / 2 - MEAN[::-1]
    bias = bias + np.einsum("oihw,i->o", kernel, offset)
    state = {"features.0.weight": kernel * (255 * np.array(SCALE) / 2)[:, None, None], "features.0.bias": bias}
    for number, position in FIRES.items():
        for part in ("squeeze1x1", "expand1x1", "expand3x3"):
            ours = f"features.{position}.{part.replace('squeeze1x1', 'squeeze')}"
            state[f"{ours}.weight"], state[f"{ours}.bias"] = convs[f"fire{number}/{part}"]
    return {name: torch.from_numpy(np.ascontiguousarray(value)).double() for name, value in state.items()}


@pytest.fixture(scope="module")
def keras_state(real_folder) -> dict[str, torch.Tensor]:
    convs: dict[str, list[np.ndarray]] = {}
    with h5py.File(real_folder / "squeezenet_weights_tf_dim_ordering_tf_kernels_notop.h5") as file:

        def visit(name: str, found: object) -> None:
            if isinstance(found, h5py.Dataset):
                layer = "conv1" if name.startswith("conv1") else "/".join(name.split("/")[:2])
                value = found[()]
                convs.setdefault(layer, [None, None])[value.ndim == 1] = (
                    value.transpose(3, 2, 0, 1) if value.ndim == 4 else value
                )

        file.visititems(visit)
    return torchvision_form({name: tuple(both) for name, both in convs.items()})


class Graph:
    """OpenVINO's published graph, run layer by layer in float64: its wiring and constants are the file's."""

    def __init__(self, folder: Path):
        net = ElementTree.parse(folder / "squeezenet1.1.xml").getroot()
        raw = (folder / "squeezenet1.1.bin").read_bytes()
        self.layers = {layer.get("id"): layer for layer in net.find("layers")}
        self.inputs: dict[str, dict[int, str]] = {}
        for edge in net.find("edges"):
            self.inputs.setdefault(edge.get("to-layer"), {})[int(edge.get("to-port"))] = edge.get("from-layer")
        self.constants = {}
        for key, layer in self.layers.items():
            data = layer.find("data")
            if layer.get("type") == "Const" and data.get("element_type") == "f16":
                start, size = int(data.get("offset")), int(data.get("size"))
                shape = [int(n) for n in data.get("shape").split(",") if n]
                self.constants[key] = torch.from_numpy(
                    np.frombuffer(raw, np.float16, size // 2, start).reshape(shape).astype(np.float64)
                )

    def run(self, bgr: torch.Tensor, until: str) -> dict[str, torch.Tensor]:
        """Outputs by layer name, up to `until`."""
        found, named = dict(self.constants), {}
        for key, layer in self.layers.items():  # the file lists them in order
            kind, data = layer.get("type"), layer.find("data")
            given = [found.get(k) for _, k in sorted(self.inputs.get(key, {}).items())]
            if kind == "Parameter":
                found[key] = bgr
            elif kind == "Add":
                found[key] = given[0] + given[1]
            elif kind == "Convolution":
                pads = [int(n) for n in data.get("pads_begin").split(",")]
                found[key] = F.conv2d(*given, stride=[int(n) for n in data.get("strides").split(",")], padding=pads)
            elif kind == "ReLU":
                found[key] = given[0].clamp(min=0)
            elif kind == "MaxPool":
                assert data.get("rounding_type") == "ceil" and data.get("kernel") == "3,3"
                found[key] = F.max_pool2d(given[0], 3, 2, ceil_mode=True)
            elif kind == "Concat":
                found[key] = torch.cat(given, 1)
            named[layer.get("name")] = found.get(key)
            if layer.get("name") == until:
                return named
        raise AssertionError(f"no layer {until}")

    def convs(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Kernel and bias of each convolution, whose sum with the bias bears the layer's name."""
        found = {}
        for key, layer in self.layers.items():
            if layer.get("type") == "Add" and layer.get("name") != "Add_":
                conv, bias = (self.inputs[key][port] for port in sorted(self.inputs[key]))
                kernel = self.inputs[conv][1]
                found[layer.get("name")] = self.constants[kernel].numpy(), self.constants[bias].numpy().ravel()
        return found


@pytest.fixture(scope="module")
def graph(real_folder) -> Graph:
    return Graph(real_folder)


def real_net(state: dict[str, torch.Tensor]) -> Lpips:
    net = Lpips("squeeze").double()
    net.trunk.load_state_dict(state)
    return net


MAPS = ["relu_conv1", "fire3/concat", "fire5/concat", "fire6/concat", "fire7/concat", "fire8/concat", "fire9/concat"]


def as_bgr_bytes(pictures: torch.Tensor) -> torch.Tensor:
    return pictures.double().flip(1) * 255


def test_real_squeezenet_is_the_published_graph(graph, keras_state):
    """Every map of ours equals that of the graph; the other encoding of the weights gives it to half precision."""
    picture = two_pictures(1, 99)[0].double()
    named = graph.run(as_bgr_bytes(picture), MAPS[-1])
    same, other = real_net(torchvision_form(graph.convs())), real_net(keras_state)
    for name, ours, keras in zip(MAPS, same.feature_maps(picture), other.feature_maps(picture), strict=True):
        size = named[name].abs().max()
        assert (ours - named[name]).abs().max() < 1e-6 * size, name  # the scaling's constants are float32
        assert 0 < (keras - named[name]).abs().max() < 2e-3 * size, name


def test_real_squeezenet_knows_a_cat(graph, keras_state, real_folder):
    """The trunk's features through the published last layer: what a person sees in two photographs."""
    data = pytest.importorskip("skimage.data")
    from PIL import Image

    kernel, bias = graph.convs()["conv10"]
    labels = (real_folder / "squeezenet1.1.labels").read_text().splitlines()
    for photograph, words in ((data.chelsea(), "cat"), (data.coffee(), "cup|espresso|coffee")):
        side = min(photograph.shape[:2])
        top, left = (photograph.shape[0] - side) // 2, (photograph.shape[1] - side) // 2
        square = Image.fromarray(photograph[top : top + side, left : left + side]).resize((227, 227))
        picture = torch.from_numpy(np.asarray(square).transpose(2, 0, 1)[None] / 255)
        last = real_net(keras_state).feature_maps(picture)[-1]
        scores = (np.einsum("bchw,oc->bohw", last.numpy(), kernel[:, :, 0, 0]) + bias[:, None, None]).clip(0)
        best = labels[int(scores.mean((2, 3)).argmax())]
        assert re.search(words, best), best


def test_real_value(graph, keras_state, shared_data):
    """End to end: real trunk, real heads. The numbers come from the twin in float64 and the heads' other copy."""
    a, b = two_pictures(2, 64)
    twin = twin_with("squeeze", keras_state)
    other = torch.load(
        shared_data / "weights" / "lpips_linear_heads" / "squeeze.pth", map_location="cpu", weights_only=True
    )
    heads = [other[f"lin{layer}.model.1.weight"].double().numpy().ravel() for layer in range(7)]
    expected = numpy_lpips(*(twin_maps("squeeze", twin, scaled(x)) for x in (a, b)), heads)
    assert np.abs(expected - GOLDEN).max() < 1e-9
    assert np.abs(real_net(keras_state).distance(a, b).numpy() - GOLDEN).max() < 1e-6
    assert 1e-6 < np.abs(real_net(torchvision_form(graph.convs())).distance(a, b).numpy() - GOLDEN).max() < 1e-4
    assert np.abs(real_net(keras_state).float().distance(a, b).numpy() - GOLDEN).max() < 1e-5

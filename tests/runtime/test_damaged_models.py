"""Weights files whose header was changed: each is refused as bad data that names the file, before memory is asked for."""

import json
import random

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from dpcli.classify.network.config import KinetConfig
from dpcli.classify.network.kinet import Kinet
from dpcli.classify.network.model_file import ModelInfo, load_model, save_model
from dpcli.errors import DataError
from dpcli.generate4d.shape.config import ShapeConfig
from dpcli.generate4d.shape.model_file import load_shape_model, save_shape_model
from dpcli.generate4d.shape.network import ShapeNetwork
from dpcli.segment.flow.config import FlowConfig
from dpcli.segment.flow.flowstep3d import FlowStep3D
from dpcli.segment.flow.model_file import load_flow_model, save_flow_model
from dpcli.segment.network import model_file as part_file
from dpcli.segment.network.config import Layer, PartConfig
from dpcli.segment.network.part_network import PartNetwork

_WRONG = (None, True, "word", [], {}, [[]], -1, 0, 0.5, 10**6, 10**12, float("nan"), float("inf"), [1, 2, 3], "\ud800")


def _kinet(path):
    config = KinetConfig(3, 4, 32, radii=(0.5, 1.0), centroids=(32, 16), neighbors=8, widths=((4, 8), (8, 8), (8, 8)))
    save_model(path, Kinet(config), ModelInfo(config, ["a", "b", "c"], notes={"streams": ["static", "dynamic"]}))
    return load_model


def _parts(path):
    blocks = ((Layer(4, 2, 0.3, 0.03, 8, 0.2),), (Layer(4, 2, 0.6, 0.1, 8, 0.4),))
    sizes = {"decoder": ((8,), (8,)), "slots": 3, "slot_width": 8, "slot_layers": 1, "embedding": 8, "pool_heads": 1}
    part_file.save_model(path, PartNetwork(PartConfig(blocks, motion_width=4, motion_layers=(4,), **sizes)), {})
    return part_file.load_model


def _flow(path):
    config = FlowConfig(local=(4, 4), deep=(4, 4), hidden=4, head=4, neighbors=4, correlated=2, iterations=2)
    save_flow_model(path, FlowStep3D(config), {})
    return load_flow_model


def _shape(path):
    network = ShapeNetwork(ShapeConfig(widths=(4, 8, 8, 8), hidden=8, bins=3))
    save_shape_model(path, network, {"size": 32, "confidence": [0.0] * 9})
    return load_shape_model


def _rewritten(path, whole, **changes):
    """The file again with other texts in its header; None takes one out."""
    with safe_open(whole, "pt") as file:
        tensors = {key: file.get_tensor(key) for key in file.keys()}
        header = {**file.metadata(), **changes}
    save_file(tensors, path, {key: value for key, value in header.items() if value is not None})


@pytest.mark.parametrize("make", [_kinet, _parts, _flow, _shape])
def test_a_header_with_a_wrong_value_is_refused_by_name(make, tmp_path):
    """Values of the configuration and the notes replaced, missing, or beside an unknown one; and texts that are no JSON."""
    whole, path = tmp_path / "whole.safetensors", tmp_path / "changed.safetensors"
    load = make(whole)
    load(whole)
    with safe_open(whole, "pt") as file:
        header = file.metadata()
    texts = ("", "{", "[" * 100_000, '"\\ud800"', "\0", "5")
    changes = [{key: None} for key in header] + [{key: text} for key in ("config", "notes") for text in texts]
    values = json.loads(header["config"])
    changes.append({"config": json.dumps({**values, "unknown": 1})})
    wrong = [{**values, name: one} for name in values for one in _WRONG]
    lacking = [{name: value for name, value in values.items() if name != lost} for lost in values]
    changes += [{"config": json.dumps(one)} for one in random.Random(0).sample(wrong + lacking, 45)]
    changes += [{"notes": json.dumps({**json.loads(header["notes"]), "size": one, "streams": one})} for one in _WRONG]
    refused = 0
    for change in changes:
        _rewritten(path, whole, **change)
        try:
            load(path)
        except DataError as error:
            assert str(error).startswith(str(path)) and "\n" not in str(error), error
            refused += 1
    assert refused > 0.4 * len(changes)


def test_classes_may_have_any_name_that_a_file_of_clouds_can_hold(tmp_path):
    """Joiners, no-break spaces and tabs came as far as the weights, which then could not be read."""
    load = _kinet(tmp_path / "whole.safetensors")
    for names in (["نمی\u200cخواهم", "no\u00a0break", "tab\tx"], ["👩\u200d👧", "", "a\nb"]):
        _rewritten(tmp_path / "named.safetensors", tmp_path / "whole.safetensors", class_names=json.dumps(names))
        assert load(tmp_path / "named.safetensors")[1].class_names == names
    for wrong in ("a\0b", "\ud800", 3):
        _rewritten(
            tmp_path / "named.safetensors", tmp_path / "whole.safetensors", class_names=json.dumps([wrong, "b", "c"])
        )
        with pytest.raises(DataError, match="expected 3 names|surrogate"):
            load(tmp_path / "named.safetensors")


def test_a_configuration_of_more_weights_than_the_file_holds_takes_no_memory(tmp_path):
    whole, path = tmp_path / "whole.safetensors", tmp_path / "changed.safetensors"
    load = _kinet(whole)
    for change in ({"widths": [[4, 8], [8, 8], [4096, 4096]]}, {"num_classes": 10**9}):
        with safe_open(whole, "pt") as file:
            values = {**json.loads(file.metadata()["config"]), **change}
        names = json.dumps(["a", "b", "c"]) if "widths" in change else json.dumps(["a"])
        _rewritten(path, whole, config=json.dumps(values), class_names=names)
        with pytest.raises(DataError, match="claims|expected 1000000000 names"):
            load(path)


def test_tensors_of_another_kind_are_refused(tmp_path):
    whole, path = tmp_path / "whole.safetensors", tmp_path / "changed.safetensors"
    load = _flow(whole)
    with safe_open(whole, "pt") as file:
        tensors, header = {key: file.get_tensor(key) for key in file.keys()}, file.metadata()
    first = next(name for name, value in tensors.items() if value.ndim == 2)
    for other in (
        tensors[first].to(torch.int32),
        tensors[first].to(torch.complex64),
        tensors[first].T.contiguous()[:1],
    ):
        save_file({**tensors, first: other}, path, header)
        with pytest.raises(DataError, match=first.replace(".", r"\.")):
            load(path)
    data = whole.read_bytes()
    for end in (0, 5, 8, 100, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:end])
        with pytest.raises(DataError, match="changed.safetensors"):
            load(path)
    path.write_bytes((2**62).to_bytes(8, "little") + data[8:])  # the length of the header
    with pytest.raises(DataError, match="changed.safetensors"):
        load(path)

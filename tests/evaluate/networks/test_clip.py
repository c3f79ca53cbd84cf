"""CLIP: preprocessing and embeddings against transformers on a tiny network, and similarities by hand."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dpcli.errors import DataError, DpcError, UsageError
from dpcli.evaluate.networks import weights as module
from dpcli.evaluate.networks.clip import DEVIATION, MEAN, Clip, cosines, preprocess, spherical
from dpcli.evaluate.networks.weights import Weights

pytestmark = pytest.mark.usefixtures("one_thread")

SIDE, WIDTH = 64, 8


def pictures(count: int, height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (count, height, width, 3), dtype=np.uint8)


@pytest.fixture(scope="module")
def tiny_model():
    transformers = pytest.importorskip("transformers")
    torch.manual_seed(2)
    vision = {
        "hidden_size": 16,
        "intermediate_size": 32,
        "num_hidden_layers": 2,
        "num_attention_heads": 2,
        "image_size": SIDE,
        "patch_size": 16,
    }
    return transformers.CLIPVisionModelWithProjection(
        transformers.CLIPVisionConfig(**vision, projection_dim=WIDTH)
    ).eval()


@pytest.fixture(scope="module")
def tiny_folder(tiny_model, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("clip")
    tiny_model.save_pretrained(folder)
    return folder


# Embeddings


def test_embeddings_are_those_of_transformers(tiny_model, tiny_folder):
    from transformers.models.clip import image_processing_clip as processing

    try:
        from transformers.models.clip.image_processing_pil_clip import CLIPImageProcessorPil as Processor
    except ImportError:
        Processor = processing.CLIPImageProcessor
    given_pictures = pictures(3, 70, 91)
    processor = Processor(size={"shortest_edge": SIDE}, crop_size={"height": SIDE, "width": SIDE})
    values = processor(images=list(given_pictures), return_tensors="pt")["pixel_values"]
    assert np.abs(preprocess(given_pictures, SIDE) - values.numpy()).max() < 1e-5
    with torch.no_grad():
        expected = tiny_model(pixel_values=values).image_embeds.numpy()
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    clip = Clip.open(tiny_folder)
    found = clip.embed(given_pictures)
    assert found.dtype == np.float32 and found.shape == (3, WIDTH) and (clip.side, clip.width) == (SIDE, WIDTH)
    assert np.abs(found - expected).max() < 1e-5
    assert np.abs(expected[0] - expected[1]).max() > 1e-3  # or equal embeddings would prove nothing


def test_floats_and_bgr(tiny_folder):
    clip = Clip.open(tiny_folder)
    given_pictures = pictures(2, 64, 64)
    expected = clip.embed(given_pictures)
    assert np.array_equal(clip.embed(given_pictures.astype(np.float32) / 255), expected)
    assert np.array_equal(clip.embed(given_pictures[..., ::-1].copy(), bgr=True), expected)
    assert np.abs(clip.embed(given_pictures, bgr=True) - expected).max() > 1e-3
    assert clip.embed(given_pictures[:0]).shape == (0, WIDTH)


@pytest.mark.parametrize("shape", [(32, 32), (48, 80), (81, 33), (200, 224)])
def test_preprocessing_by_pillow(shape):
    """The twin resizes each float channel by itself; eight bits make half a step of difference, and a step at edges."""
    from PIL import Image

    picture = pictures(1, *shape, seed=3)[0] // 3 + 85  # bicubic overshoots; away from black and white it isn't cut
    found = preprocess(picture[None], SIDE)[0] * np.array(DEVIATION)[:, None, None] + np.array(MEAN)[:, None, None]
    short = min(shape)
    size = (SIDE * shape[1] // short, SIDE * shape[0] // short)
    planes = [
        np.asarray(Image.fromarray(picture[..., c].astype(np.float32)).resize(size, Image.Resampling.BICUBIC))
        for c in range(3)
    ]
    top, left = (size[1] - SIDE) // 2, (size[0] - SIDE) // 2
    expected = np.stack(planes)[:, top : top + SIDE, left : left + SIDE].clip(0, 255) / 255
    assert found.shape == (3, SIDE, SIDE)
    assert np.abs(found - expected).max() < 1.6 / 255


def test_bad_pictures():
    good = np.full((1, 8, 8, 3), 0.5, np.float32)
    nan = good.copy()
    nan[0, 1, 2] = np.nan
    for bad, words in (
        (good * 255, "divide by 255"),
        (good - 1, "expected 0..1"),
        (nan, "3 values are NaN"),
        (good.astype(np.int64), "int64"),
    ):
        with pytest.raises(DataError, match=words):
            preprocess(bad)
    with pytest.raises(ValueError, match=r"\(B,H,W,3\)"):
        preprocess(good[0])


# Files


def test_a_folder_of_either_kind(tiny_model, tiny_folder, tmp_path):
    """A whole CLIP as published: text tensors are left alone, the vision's settings lie inside its own."""
    state = {
        **tiny_model.state_dict(),
        "text_model.final_layer_norm.bias": torch.zeros(4),
        "logit_scale": torch.ones(()),
    }
    torch.save(state, tmp_path / "pytorch_model.bin")
    vision = json.loads((tiny_folder / "config.json").read_text())
    whole = {"model_type": "clip", "projection_dim": WIDTH, "vision_config": vision, "text_config": {}}
    (tmp_path / "config.json").write_text(json.dumps(whole))
    given_pictures = pictures(2, 64, 64)
    assert np.array_equal(Clip.open(tmp_path).embed(given_pictures), Clip.open(tiny_folder).embed(given_pictures))


def test_loading_a_variant(tiny_folder, tmp_path, monkeypatch):
    (tmp_path / "toy").symlink_to(tiny_folder)
    size = (tiny_folder / "model.safetensors").stat().st_size
    entry = Weights("clip-laion", "toy/model.safetensors", "https://example.org/m", size, "MIT", "", "clip")
    monkeypatch.setattr(module, "known_weights", lambda: {"clip-laion": entry})
    assert Clip.load(tmp_path, "laion").width == WIDTH
    with pytest.raises(DataError, match="fetch clip-laion"):
        Clip.load(tmp_path / "elsewhere", "laion")
    with pytest.raises(UsageError, match="openai, laion"):
        Clip.load(tmp_path, "google")
    monkeypatch.setattr(module, "known_weights", lambda: {"clip-laion": Weights(**{**vars(entry), "size": size + 1})})
    with pytest.raises(DataError, match="damaged weights"):
        Clip.load(tmp_path, "laion")


def test_bad_folders(tiny_folder, tmp_path):
    with pytest.raises(DataError, match="expected config.json and model.safetensors or pytorch_model.bin"):
        Clip.open(tmp_path)
    (tmp_path / "model.safetensors").write_bytes((tiny_folder / "model.safetensors").read_bytes())
    with pytest.raises(DataError, match="expected config.json"):
        Clip.open(tmp_path)
    config = json.loads((tiny_folder / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps({**config, "num_hidden_layers": 3}))
    with pytest.raises(DataError, match="no tensor .*layers.2.*; expected weights of CLIPVisionModelWithProjection"):
        Clip.open(tmp_path)
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(DataError, match="not the configuration of a CLIP"):
        Clip.open(tmp_path)


def test_without_transformers(tiny_folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(
        DpcError, match=r"needs the package transformers: pip install 'dpc-toolkit\[metrics\]'"
    ) as caught:
        Clip.open(tiny_folder)
    assert "\n" not in str(caught.value)


# Similarities


def test_by_hand():
    x, y = np.array([[1.0, 0], [0, 2]]), np.array([[1.0, 1], [0, 3]])
    assert np.allclose(cosines(x, y), [np.sqrt(0.5), 1])
    assert np.allclose(spherical(x, y), [(np.pi / 4) ** 2 / 2, 0])  # half the squared angle
    assert spherical(x[:1], -x[:1]) == pytest.approx(np.pi**2 / 2)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(2, 6), st.floats(0.1, 100))
def test_the_angle_is_what_counts(seed, width, scale):
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=(2, 3, width))
    angle = np.arccos(np.clip(cosines(x, y), -1, 1))
    assert np.allclose(spherical(x, y), angle**2 / 2, atol=1e-6)
    assert np.allclose(cosines(x * scale, y), cosines(x, y)) and np.allclose(cosines(x, x), 1)
    turn = np.linalg.qr(rng.normal(size=(width, width)))[0]
    assert np.allclose(cosines(x @ turn, y @ turn), cosines(x, y))


def test_too_little_or_nothing():
    one = np.ones((1, 4))
    for call, words in (
        (lambda: cosines(one, 0 * one), "an embedding is zero"),
        (lambda: spherical(one, np.nan * one), "an embedding is zero, NaN"),
    ):
        with pytest.raises(DataError, match=words):
            call()
    with pytest.raises(ValueError, match="shapes"):
        cosines(one, np.ones((2, 4)))

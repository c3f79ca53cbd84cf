"""Settings of a training run: a preset, what a variant or a backbone brings along, a file, and the command line over all."""

from __future__ import annotations

import json
import re
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch

from dpcli.classify.data.clips import normalize
from dpcli.classify.network.config import KinetConfig
from dpcli.classify.network.kinet import Kinet, fuse
from dpcli.classify.presets import BACKBONE_CHANGES, PRESETS, VARIANT_CHANGES
from dpcli.classify.settings import TRAINING, about_unread, network_config, training_settings
from dpcli.errors import UsageError
from dpcli.runtime.settings.catalog import Given


def settings(preset: str = "quick", config: dict | None = None, **typed):
    return training_settings(Given(preset, config or {}, typed))


def written(given: Given, path: Path) -> dict:
    """What a file of the settings says when it is read back."""
    path.write_text(training_settings(given).to_toml("classify train"))
    return TRAINING.read_config(path)


@pytest.mark.parametrize("preset", PRESETS)
def test_nothing_given_is_the_preset(preset):
    assert vars(settings(preset)) == PRESETS[preset]


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize(
    "typed",
    [
        {},
        {"variant": "release", "augment": "peers", "augment_turn": 0.4},
        {"backbone": "dgcnn", "normals": False, "amp": True, "validation": "fold:1/3"},
        {"pretrain": True, "points": 2048},
        {"init": "some/model", "workers": None, "lr_dynamic": None, "draws": 4},
    ],
)
def test_a_file_of_all_settings_gives_an_equal_run_whatever_the_preset(preset, typed, tmp_path):
    first = Given(preset, sets=typed)
    if preset == "sparse" and "backbone" in typed:
        with pytest.raises(UsageError, match="--preset sparse"):
            training_settings(first)
        return
    config = written(first, tmp_path / "settings.toml")
    assert set(config) == set(TRAINING.settings)
    for other in PRESETS:
        again = training_settings(Given(other, config))
        assert again == training_settings(first)
        assert json.dumps(asdict(again)) == json.dumps(asdict(training_settings(first)))  # 0 and 0.0 are told apart


def test_a_variant_brings_its_choices_below_what_is_typed():
    config = settings(variant="release", group_size=5).network
    expected = {**VARIANT_CHANGES["release"], "group_size": 5}
    assert {key: getattr(config, key) for key in expected} == expected
    assert config.centroids == PRESETS["quick"]["network"].centroids
    told = KinetConfig.__dataclass_fields__["variant"].metadata["setting"]["help"]
    assert set(re.findall(r"\w+", told)) >= set(VARIANT_CHANGES["thesis"]) - {"variant"}
    back = settings("release", variant="thesis").network
    assert {key: getattr(back, key) for key in VARIANT_CHANGES["thesis"]} == VARIANT_CHANGES["thesis"]
    assert settings("quick", variant="thesis").network == PRESETS["quick"]["network"]  # quick is no release


def test_a_backbone_brings_the_sizes_of_its_preset():
    for backbone, by_preset in BACKBONE_CHANGES.items():
        for preset, changes in by_preset.items():
            config = network_config(Given(preset, flags={"backbone": backbone, "reduction": 0.25}), 7)
            expected = {**changes, "reduction": 0.25, "backbone": backbone, "num_classes": 7}
            assert {key: getattr(config, key) for key in expected} == expected


def test_the_command_line_changes_what_a_file_says_with_all_that_follows(tmp_path):
    """A file of all settings names each of the backbone's sizes: another backbone must not be built with these."""
    config = written(
        Given("tiny", sets={"backbone": "dgcnn", "variant": "release", "normals": False}), tmp_path / "s.toml"
    )
    back = training_settings(
        Given("tiny", config, {"backbone": "pointnet2", "variant": "thesis", "normals": True})
    ).network
    assert back == PRESETS["tiny"]["network"]
    same = training_settings(Given("tiny", config, {"backbone": "dgcnn", "dropout": 0.1})).network
    assert same.widths == BACKBONE_CHANGES["dgcnn"]["tiny"]["widths"] and same.dropout == 0.1
    loud = written(Given("tiny", sets={"augment_scale": 0.5}), tmp_path / "a.toml")
    assert training_settings(Given("tiny", loud, {"augment": "none"})).augmentation.scale == 0


def test_networks_without_normals_have_no_weights():
    assert settings(normals=False).network.weighting == "none"
    assert settings(normals=False, variant="release").network.weighting == "none"
    assert settings(weighting="none").network.normals


def test_pretraining_is_one_frame_and_no_dynamic_stage():
    found = settings(pretrain=True, temporal_radius=2)
    assert (found.network.num_frames, found.network.temporal_radius, found.schedule.stage_epochs) == (1, 0, (80, 0))
    for wrong in ({"frames": 8}, {"epochs_dynamic": 3}):
        with pytest.raises(UsageError, match="pretrain trains the static stream on clips of one frame"):
            settings(pretrain=True, **wrong)


@pytest.mark.parametrize(
    ("typed", "sentence"),
    [
        ({"init": "a", "static_from": "b"}, "give one of them"),
        ({"augment_speed": 0.3, "timing": "uniform"}, "augment_speed = 0.3: speed changes random clips"),
        ({"augment_speed": 0.3, "clips_per_video": 0}, "augment_speed = 0.3: speed changes random clips"),
        ({"video_loss": True, "clips_per_video": 0}, "video_loss = true with clips_per_video = 0: expected two clips"),
        ({"video_loss": True, "clips_per_video": 1}, "video_loss = true with clips_per_video = 1: expected two clips"),
        ({"neighbors": 2}, "temporal_radius = 1: balanced grouping shares 2 neighbors among 3 frames"),
        ({"backbone": "dgcnn", "static_temporal_radius": 0}, "dgcnn's one graph serves both streams"),
        ({"members": 4}, "members = 4: only the backbone slots has it"),  # or `cross` would judge by videos learned
        ({"copies": True}, "copies = true: only the backbone slots has it"),
        ({"slot_details": True}, "slot_details = true: only the backbone slots has it"),
    ],
)
def test_settings_that_contradict_end_with_a_sentence(typed, sentence):
    with pytest.raises(UsageError, match=sentence):
        settings(**typed)


def test_the_settings_of_weights_files_stay_as_they_were():
    """Shipped weights hold these names; classes, columns, scales and forests follow from the data and are no settings."""
    names = set(json.loads(KinetConfig().to_json()))
    assert names - {one.field for one in TRAINING.settings.values()} == {"num_classes", "columns", "scales", "forest"}
    assert {"num_frames", "points_per_frame", "radii", "weighting"} <= names
    config = KinetConfig(widths=((8, 8), (8, 16), (16, 32)), head=(8, 9), radii=(0.1, 0.3))
    assert KinetConfig.from_json(config.to_json()) == config


SMALL = {"frames": 4, "points": 24, "neighbors": 9}
POINTS = {**SMALL, "radius": (0.9, 1.8), "centroids": (16, 8), "widths": ((8, 8), (8, 16), (16, 16))}
GRAPH = {**SMALL, "backbone": "dgcnn", "widths": ((8, 8), (16,), (8, 8, 8, 8, 8), (16, 16)), "head": (8, 16)}
SPIDER = {**GRAPH, "backbone": "spidercnn", "widths": ((8, 8), (3,), (16, 16))}
CHANGES = {
    "normalize": "unit",
    "centroids": (12, 6),
    "neighbors": 10,
    "radius": (0.3, 0.6),
    "temporal_radius": 0,
    "grouping": "nearest",
    "head": (8, 24),
    "group_size": 4,
    "reduction": 0.3,
    "xyz_group": False,
    "time_input": True,
    "weighting": "projection",
    "normals": False,
    "merge": "cross",
    "merge_norm": False,
    "solver": "inverse",
    "guard": "release",
    "fusion": "logits",
}
# weights that nothing reads, but other draws of all; a guard acts on singular fits alone; a merge that is refused
OTHER = [("no normals", "weighting"), ("inverse", "guard"), ("dgcnn", "merge"), ("spidercnn", "merge")]
BASES = {
    "pointnet2": POINTS,
    "no normals": {**POINTS, "normals": False},
    "cross": {**POINTS, "merge": "cross"},
    "inverse": {**POINTS, "solver": "inverse"},
    "dgcnn": GRAPH,
    "spidercnn": SPIDER,
}


def answer(network: KinetConfig) -> list[np.ndarray]:
    """The shapes of a new network's weights, and its scores of one clip that is normalized as it asks."""
    rng = np.random.default_rng(0)
    clip = rng.normal(size=(1, network.num_frames, network.points_per_frame, 3)).astype(np.float32) * 0.4 + 1
    torch.manual_seed(0)
    model = Kinet(network).eval()
    shapes = [np.array(value.shape) for value in model.state_dict().values()]
    with torch.no_grad():
        static, dynamic = model(torch.from_numpy(normalize(clip[0], network.normalize))[None])
        return [*shapes, *(found.numpy() for found in (static, dynamic, fuse(static, dynamic, network.fusion)))]


def changes(base: str, name: str) -> bool:
    """Whether the value to be tried is another one than the base has."""
    return CHANGES[name] != getattr(settings(**BASES[base]).network, TRAINING.settings[name].field)


@pytest.mark.parametrize(
    ("base", "name"),
    [(base, name) for base in BASES for name in CHANGES if (base, name) not in OTHER and changes(base, name)],
)
def test_a_setting_is_told_where_it_changes_nothing(base, name):
    """That of a setting which isn't told changes the weights, or what they say of a clip."""
    base = BASES[base]
    before, after = settings(**base), settings(**{**base, name: CHANGES[name]})
    one, other = answer(before.network), answer(after.network)
    same = len(one) == len(other) and all(np.array_equal(a, b) for a, b in zip(one, other))
    told = about_unread(after, [name])
    assert same == bool(told), told
    assert not same or told[0].startswith(f"{name} changes nothing: ")


@pytest.mark.parametrize(
    ("typed", "unread"),
    [
        ({"augment_crop": 0.4}, True),
        ({"augment_crop": 0.4, "timing": "uniform"}, False),
        ({"augment": "none", "augment_origin": True}, True),
        ({"augment": "none", "augment_per_axis": False}, True),
        ({"augment": "none", "augment_scale": 0.1, "augment_per_axis": False}, False),
        ({"epochs_dynamic": 0, "lr_dynamic": 0.1}, True),
        ({"epochs_dynamic": 0, "draws": 2}, True),
        ({"draws": 2}, False),
        ({"validation": "none", "validation_clips": 2}, True),
        ({"validation": "none", "validate_every": 2}, True),
        ({"pretrain": True, "temporal_radius": 2}, True),
        ({"backbone": "my:Own", "radius": (1.0, 2.0), "centroids": (16, 8)}, False),
    ],
)
def test_what_else_changes_nothing_is_told(typed, unread):
    assert bool(about_unread(settings(**typed), typed)) == unread


def test_a_network_for_sparse_clouds_says_what_it_does_not_read():
    typed = {"normalize": "height", "solver": "ridge", "drop_short": True, "augment_still": 0.1, "augment_crop": 0.2}
    told = about_unread(settings("sparse", **typed), typed)
    assert [line.split()[0] for line in told] == ["normalize", "solver", "augment_still", "drop_short"]

"""The settings of a fit: presets, what a user changes, what is refused, and the file they are read back from."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import asdict

import pytest

from dpcli.errors import UsageError
from dpcli.generate4d.config import (
    CATALOG,
    FIT_PRESETS,
    PRESETS,
    FitConfig,
    Supervision,
    resolve_settings,
    unread_settings,
)
from dpcli.runtime.settings.catalog import Given


def resolve(*words: str, preset: str = "quick") -> FitConfig:
    return resolve_settings(Given(preset, sets=CATALOG.parse_set(words)))[0]


def test_what_is_given_stands_over_the_preset():
    assert resolve() == FIT_PRESETS["quick"]
    changed = asdict(resolve("dense_steps=7", "rigid=false", "coarse=0.5,4", "rate_mean=0.1,0.01"))
    different = {key: value for key, value in changed.items() if value != asdict(FIT_PRESETS["quick"])[key]}
    assert different == {"dense_steps": 7, "rigid": False, "coarse": ((0.5, 4),), "rate_mean": (0.1, 0.01)}
    assert resolve_settings(Given("tiny", flags={"prior": "views"}))[1] == Supervision("views")


def test_a_limit_on_gaussians_holds_from_the_start():
    assert resolve("max_gaussians=800").gaussians == 800
    assert resolve("max_gaussians=9000").gaussians == 6000
    with pytest.raises(UsageError, match="max_gaussians = 800: expected at least the 900"):
        resolve("max_gaussians=800", "gaussians=900")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("start_radius=0.3", ["start_radius: not read with start = auto"]),
        ("start_radius=0.3 start=sphere", []),
        ("temporal=false temporal_weight=3", ["temporal_weight: not read with rigid or temporal = false"]),
        ("rigid=false spatial_weight=3 spatial_radius=0.2", ["spatial_weight: not read with rigid or spatial = false"]),
        ("sparse=false control_points=9 arap=1", ["control_points: not read with sparse = false"]),
        ("regularize=false aspect=3 thickness=1", ["aspect, thickness: not read with regularize = false"]),
        ("prior=none shape_until=0.5", ["shape_until: not read with prior = none"]),
        ("prior=inflated shape_until=0.5 views=2", ["views: not read with prior = inflated"]),
        ("prior=views views=2 augmentation=2", ["augmentation: not read with prior = views"]),
        ("sparse=false neighbors=8", []),  # as in the preset
    ],
)
def test_what_nothing_reads_is_told(words, says):
    given = Given("quick", sets=CATALOG.parse_set(words.split()))
    found = unread_settings(given, *resolve_settings(given))
    assert [", ".join(sorted(line.split(": ")[0].split(", "))) + line[line.index(":") :] for line in found] == says


@pytest.mark.parametrize(
    ("word", "says"),
    [
        ("parts=0", "parts = 0: expected at least 1"),
        ("start=cube", "start = cube: expected one of auto, sphere, inflate, hull"),
        ("partition=none", "partition = none: expected one of static, time"),
        ("max_gaussians=5", "max_gaussians = 5: expected at least 16"),
        ("rate_mean=0,1", "rate_mean = 0,1: expected numbers, each above 0"),
        ("prior=magic", "prior = magic: expected one of auto, none, inflated, network, views, zero123"),
        ("speed=3", "unknown setting speed"),
    ],
)
def test_wrong_settings_are_named(word, says):
    with pytest.raises(UsageError, match=says):
        resolve(word)


@pytest.mark.parametrize("name", PRESETS)
def test_the_file_of_settings_reads_back(tmp_path, name):
    path = tmp_path / "settings.toml"
    path.write_text(CATALOG.to_toml(PRESETS[name], "generate4d fit"))
    assert resolve_settings(Given("tiny", config=CATALOG.read_config(path))) == tuple(PRESETS[name].values())


def test_the_options_load_without_torch():
    code = "import sys, dpcli.cli.generate4d.app; print(sorted({'torch', 'numpy', 'h5py'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"

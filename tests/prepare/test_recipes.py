"""The data recipes: what they promise is what the code does."""

from __future__ import annotations

import shlex
import sys

import pytest

from dpcli.prepare.actions import msraction3d, nvgesture
from tests.support.commands import told as dpc
from tests.support.prepare_helpers import ROOT

if sys.version_info >= (3, 11):
    import tomllib
else:
    tomllib = pytest.importorskip("tomli")

RECIPES = {path.stem: path for path in (ROOT / "data_recipes").glob("*.toml")}
SECTIONS = {"get": {"ask", "license"}, "layout": {"tree"}, "checks": set(), "prepare": {"command"}, "split": {"rule"}}


@pytest.mark.parametrize("name", ["msraction3d", "nvgesture"])
def test_recipes_are_complete_and_their_command_exists(name):
    recipe = tomllib.loads(RECIPES[name].read_text())
    assert recipe["name"] == name
    for section, keys in SECTIONS.items():
        assert keys <= recipe[section].keys(), section
    program, *words = shlex.split(recipe["prepare"]["command"])
    assert program == "dpc" and words[:2] == ["prepare", name]
    assert dpc(*words[:2], "--help").returncode == 0


def test_counts_agree_with_the_readers():
    msr = tomllib.loads(RECIPES["msraction3d"].read_text())
    names = msraction3d.published_names()
    assert msr["checks"]["videos"] == msr["expect"]["sequences"] == len(names)
    assert msr["split"]["train"] == sum(int(name[5:7]) <= 5 for name in names)
    assert msr["split"]["train"] + msr["split"]["test"] == len(names)
    assert msr["expect"]["classes"] == len(msraction3d.CLASS_NAMES)
    assert msr["prepare"]["unit"] == msraction3d.MSRAction3D(ROOT).length_unit
    nv = tomllib.loads(RECIPES["nvgesture"].read_text())
    assert {k: nv["split"][k] for k in ("train", "test")} == nvgesture.PUBLISHED
    assert nv["checks"]["classes"] == nvgesture.CLASSES
    assert nv["prepare"]["unit"] == nvgesture.NvGesture(ROOT).length_unit

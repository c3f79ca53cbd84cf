"""What `dpc segment` shows and refuses: everyday options, settings, and what it prints."""

from __future__ import annotations

import subprocess
import sys

import pytest
import typer

from dpcli.cli.segment.app import ROOM
from dpcli.cli.segment.profile import render_cost
from dpcli.errors import DataError
from dpcli.runtime.settings.value_types import words_of, write_text
from dpcli.segment import prediction_settings
from dpcli.segment.flow import config as flow_settings
from dpcli.segment.network.config import NETWORK_PRESETS, PartConfig, compact, release
from dpcli.segment.training import settings as train_settings
from tests.support.commands import exit_code

GROUP = typer.main.get_command(ROOM.application())
EVERYDAY = {
    "train": "output preset init flow supervised epochs batch lr points validation config set help-all seed device force",
    "flow": "output preset steps batch config set help-all seed device force",
    "predict": "output model fast scene method parts flow pairs points split config set help-all picture turntable ply seed device "
    "jobs shard dask force",
    "estimate-flow": "output flow points as-points split seed device jobs shard dask force",
    "profile": "preset group points config set help-all json device",
}


@pytest.mark.parametrize("command", EVERYDAY)
def test_commands_show_everyday_options_alone(command):
    shown = [
        one.opts[-1].removeprefix("--") for one in GROUP.commands[command].params if one.param_type_name == "option"
    ]
    assert shown == EVERYDAY[command].split()


@pytest.mark.parametrize(
    ("command", "catalog"),
    [("train", train_settings.CATALOG), ("flow", flow_settings.CATALOG), ("predict", prediction_settings.CATALOG)],
)
def test_all_settings_are_listed_with_help(command, catalog, capsys):
    assert exit_code("segment", command, "--help-all") == 0
    listed = capsys.readouterr().out
    for name, setting in catalog.settings.items():
        assert f"\n  {name} " in listed and setting.help[-1] in ".)", name


def test_the_room_and_help_load_no_torch():
    for words in ("['segment', 'train', '--help']", "['segment', 'predict', '--help-all']", "['segment', '--help']"):
        code = f"import sys\nfrom dpcli.cli.app import main\ntry: main({words})\nfinally: print('torch' in sys.modules)"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        assert done.stdout.strip().endswith("False"), done.stderr


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("train", "--set", "flow_decy=1"), "unknown setting flow_decy; did you mean flow_decay?"),
        (("train", "--set", "epochs=1", "--epochs", "2"), "epochs is given twice, by --epochs and by --set"),
        (("train", "--supervised", "--flow", "nearest"), "flow: not read with supervised = true"),
        (("train", "--supervised", "--set", "flow_decay=1"), "flow_decay: not read with supervised = true"),
        (("train", "--supervised", "--set", "loss=per-part"), "loss: not read with supervised = true"),
        (("train", "--set", "motion_head=false", "--set", "motion=1"), "motion: not read with motion_head = false"),
        (("train", "--set", "motion_head=false", "--set", "tau=1"), "tau: not read with no consensus"),
        (("train", "--set", "consensus=none", "--set", "tau=1"), "tau: not read with no consensus"),
        (("train", "--set", "cold_start=0", "--set", "cold_until=0.5"), "cold_until: not read with cold_start = 0"),
        (("train", "--set", "flow_decay=1", "--set", "update_after=0"), "update_after: not read with flow_decay = 1"),
        (("flow", "--steps", "0"), "steps = 0: expected at least 1"),
        (("flow", "--set", "norm=none"), "norm = none: expected one of layer, batch"),
        (("predict", "--set", "vote"), "--set vote: expected NAME=VALUE, such as --set vote=true"),
        (("predict", "--pairs", "some"), "pairs = some: expected one of adjacent, all"),
        (("predict", "--points", "3"), "points = 3: expected at least 32"),
        (("profile", "--set", "lr=0.1"), "unknown setting lr"),
    ],
)
def test_wrong_settings_end_with_a_sentence(words, sentence, tmp_path, capsys):
    data = ["none.h5", "-o", str(tmp_path / "out")] if words[0] != "profile" else []
    assert exit_code("segment", *words, *data) == 2
    assert sentence in " ".join(capsys.readouterr().err.split()) and not (tmp_path / "out").exists()


METHODS = prediction_settings.CATALOG.settings["method"]


@pytest.mark.parametrize(
    ("name", "readers"),
    [
        ("points", "multibody network dbscan ward ssc trajaffn"),
        ("normalize", "multibody network dbscan ward ssc trajaffn"),
        ("icp", "network dbscan ward ssc trajaffn"),
        ("vote", "network dbscan ward ssc trajaffn"),
        ("smallest", "network dbscan ward ssc trajaffn"),
        ("split_bodies", "network"),
        ("border", "multibody"),
        ("flexible", "multibody"),
        ("travel", "scene"),
        ("max_objects", "scene"),
        ("pairs", "multibody scene network dbscan ward ssc trajaffn"),
    ],
)
def test_predict_refuses_a_setting_that_its_method_does_not_read(name, readers, tmp_path, capsys):
    value = prediction_settings.CATALOG.settings[name].default
    for method in words_of(METHODS.hint):
        given = ("--method", method, "--set", f"{name}={write_text(value)}")
        code = exit_code("segment", "predict", tmp_path / "none.h5", "-o", tmp_path / "out.h5", *given)
        said = " ".join(capsys.readouterr().err.split())
        if method in readers.split():
            assert code == 3 and "none.h5" in said
        else:
            assert code == 2 and f"{name} belongs to --method" in said and f"{method} doesn't read it" in said


def test_settings_of_a_preset_survive_their_file(tmp_path):
    """What --config reads back stands over another preset: the file alone says the run."""
    for name, preset in train_settings.PRESETS.items():
        path = tmp_path / f"{name}.toml"
        path.write_text(train_settings.CATALOG.to_toml(preset, "segment train"))
        given = train_settings.CATALOG.read_config(path)
        assert {one: given[one] for one in ("sizes", "loss", "pairs_per_epoch", "amp")} == {
            "sizes": name,
            "loss": "blended",
            "pairs_per_epoch": 1000,
            "amp": None,
        }


def test_network_settings_make_the_sizes():
    assert NETWORK_PRESETS["compact"].config() == compact() and NETWORK_PRESETS["release"].config() == release()
    changed = type(NETWORK_PRESETS["compact"])(group="trivial", pooling="global", motion_head=False, slots=3, points=64)
    config = changed.config()
    assert (config.group, config.pooling, config.motion_width, config.slots, config.points) == (
        "trivial",
        "global",
        0,
        3,
        64,
    )
    with pytest.raises(DataError, match="group = 'cubic': expected one of icosahedral, trivial"):
        PartConfig.from_json(config.to_json().replace("trivial", "cubic"))


def test_costs_are_printed_for_a_person():
    cost = {
        "group": "trivial",
        "points": 64,
        "slots": 8,
        "parameters": {"total": 12345, "encoder": 345, "attention": 12000},
        "paper_style_parameters": {"total": 99, "rule": "1x1 layers only"},
        "macs_per_frame": {"neighbor_sums": 2_000_000, "total": 3_000_000},
        "uncounted": "norms",
        "latency_ms": {"four_frames": 1.5},
        "peak_memory_mb": 7.0,
        "device": "cpu",
        "threads": 1,
    }
    lines = render_cost(cost).splitlines()
    assert lines[0] == "part network, trivial group, 64 points a frame, 8 slots"
    assert lines[1] == "parameters    12,345 (encoder 345, attention 12,000)"
    assert lines[3] == "multiply-adds 0.003 G per frame (M: neighbor sums 2)"

"""What `dpc classify` shows and refuses: everyday options, settings, and what it prints."""

from __future__ import annotations

import subprocess
import sys

import pytest
import typer

from dpcli.classify.explain.pac_settings import PacSettings
from dpcli.classify.network.config import KinetConfig
from dpcli.classify.settings import TRAINING
from dpcli.cli.classify.app import ROOM
from dpcli.errors import UsageError
from tests.support.commands import exit_code

GROUP = typer.main.get_command(ROOM.application())
TRAIN = "output preset init fine-tune frames points timing epochs batch lr validation config set help-all seed device force".split()


def shown(*path: str) -> list[str]:
    """The options of a command, its arguments left out."""
    command = GROUP
    for name in path:
        command = command.commands[name]
    return [one.opts[-1].removeprefix("--") for one in command.params if one.param_type_name == "option"]


def test_training_shows_everyday_options_alone():
    assert shown("train") == TRAIN


@pytest.mark.parametrize("path", [("predict",), ("fuse",), ("profile",), ("explain", "pac"), ("explain", "tsne")])
def test_the_other_commands_show_fifteen_options_at_most(path):
    """Beside the three that say who works on the samples, and those under a heading of their own."""
    ways = (
        {"stream", "follow", "json", "page", "segments", "shortest", "hop", "window"} if path == ("predict",) else set()
    )
    assert len(set(shown(*path)) - {"jobs", "shard", "dask"} - ways) <= 15


def test_all_settings_are_listed_with_help_and_default(capsys):
    assert exit_code("classify", "train", "--help-all") == 0
    listed = capsys.readouterr().out
    for name, setting in TRAINING.settings.items():
        assert f"\n  {name} " in listed and setting.help[-1] in ".)", name
    assert "[default: thesis 0; release, quick, long, tiny" in " ".join(listed.split())


def test_help_of_training_loads_no_torch():
    code = "import sys\nfrom dpcli.cli.app import main\ntry: main(['classify', 'train', '--help'])\nfinally: print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip().endswith("False"), done.stderr


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("train", "--set", "epoch_dynamic=1"), "unknown setting epoch_dynamic; did you mean epochs_dynamic?"),
        (("train", "--set", "decay=foo"), "decay = foo: expected one of cosine, staircase, constant"),
        (("train", "--epochs", "-1"), "epochs = -1: expected at least 0"),
        (("train", "--set", "epochs=1", "--epochs", "2"), "epochs is given twice, by --epochs and by --set"),
        (("train", "--preset", "quik"), "preset = quik: expected one of thesis, release, quick, long, tiny"),
        (("profile", "--set", "reduction=2"), "reduction = 2: expected a number above 0 and at most 1"),
        (("profile", "--set", "lr=0.1"), "unknown setting lr"),
        (("explain", "pac", "--set", "rule=gradiant"), "rule = gradiant: expected one of activation, gradient"),
    ],
)
def test_wrong_settings_end_with_a_sentence(words, sentence, tmp_path, capsys):
    data = ["none.h5", "-o", str(tmp_path / "out")] if words[0] != "profile" else []
    model = ["--model", "msraction3d-16"] if words[0] == "explain" else []
    assert exit_code("classify", *words, *data, *model) == 2
    assert sentence.split(";")[0] in " ".join(capsys.readouterr().err.split()) and not (tmp_path / "out").exists()


def test_a_class_needs_the_rule_that_knows_one():
    assert PacSettings(rule="gradient", target="wave").target == "wave"
    with pytest.raises(UsageError, match="rule=gradient"):
        PacSettings(target="wave")


def test_profile_says_the_costs_of_changed_networks(capsys):
    words = ("--preset", "tiny", "--frames", 2, "--points", 64, "--classes", 3)
    assert exit_code("classify", "profile", *words, "--set", "group_size=5") == 0
    assert (
        f"Kinet on {KinetConfig().backbone}, thesis variant, 3 classes, clip 2 x 64 points" in capsys.readouterr().out
    )

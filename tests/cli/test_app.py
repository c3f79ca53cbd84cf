"""`dpc` sets up only the command that is asked for; nobody may notice, but by the clock."""

from __future__ import annotations

import errno
import math
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import typer
from typer.testing import CliRunner

from dpcli.cli import app as cli
from dpcli.cli.out_of_memory import naming_large
from dpcli.errors import UsageError
from dpcli.runtime.provenance import command_line
from dpcli.store import CloudSequence, CloudsWriter, ScoresWriter
from tests.fuzz.forks import Limits, forked
from tests.fuzz.fuzz_options import is_bug, odd


def paths_of(group: typer.Typer) -> list[tuple[str, ...]]:
    """The words of every command below a group."""
    own = [(command.name,) for command in group.registered_commands]
    below = [(entry.name, *path) for entry in group.registered_groups for path in paths_of(entry.typer_instance)]
    return own + below


PATHS = paths_of(cli.application())


def said(app: typer.Typer, *words: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, list(words))
    return result.exit_code, result.output


def test_there_are_commands_at_every_depth():
    assert {("info",), ("prepare", "nvgesture"), ("prepare", "synthetic", "gestures")} <= set(PATHS)
    assert len(PATHS) > 40


@pytest.fixture(scope="module")
def whole() -> typer.Typer:
    return cli.application()


def test_files_that_a_command_writes_beside_its_result_are_not_in_its_provenance(whole):
    """Whichever option names a picture, a page or a folder to write: the result's bytes don't depend on it."""
    recorded, commands = {}, [typer.main.get_command(whole)]
    while commands:
        command = commands.pop()
        commands += getattr(command, "commands", {}).values()
        for option in command.params:
            if re.match(
                r"Write (a|an|every|one) .*(file|folder|\.html|\.png|\.gif)|Folder for ",
                getattr(option, "help", 0) or "",
            ):
                recorded |= {name: command_line(["x", name, "there", "--seed", "0"]) for name in option.opts}
    assert {"--picture", "--ply", "--turntable", "--page", "--run", "--animation"} <= set(recorded)
    assert set(recorded.values()) == {"dpc x --seed 0"}


@pytest.mark.parametrize("path", PATHS, ids=" ".join)
def test_a_command_set_up_alone_is_the_same_command(path, whole):
    words = (*path, "--help")
    alone = cli.application(words)
    assert said(alone, *words) == said(whole, *words)
    assert len(paths_of(alone)) == len(cli.ROOMS)  # the other rooms by name, and of this one a single command


@pytest.mark.parametrize("words", [("prepare",), ("prepare", "--help"), ("prepare", "synthetic"), ("--help",), ()])
def test_groups_list_all_they_have(words, whole):
    code, text = said(cli.application(words), *words)
    expected, all_text = said(whole, *words)
    assert code == expected and sorted(text.splitlines()) == sorted(all_text.splitlines())  # typer puts groups last


@pytest.mark.parametrize("words", [("prepare", "nvgestur"), ("prepare", "synthetic", "gesture"), ("prepar",)])
def test_a_misspelled_command_is_told_the_right_one(words, whole):
    code, text = said(cli.application(words), *words)
    assert (code, text) == said(whole, *words)
    assert code == 2 and "Did you mean" in text


@pytest.mark.parametrize("reader", ["nvgesture", "msraction3d", "depth", "ntu60"])
def test_what_every_worker_imports_is_little(reader):
    code = (
        f"import sys, dpcli.__main__, dpcli.prepare.convert_item, dpcli.prepare.actions.{reader}\n"
        "print(*sorted({'typer', 'h5py', 'torch', 'scipy', 'open3d', 'rich', 'numba'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


@pytest.mark.parametrize(
    "error, expected",
    [
        (
            MemoryError("Unable to allocate 7.28 TiB for an array with shape (1000000000000,)"),
            "this machine (7.28 TiB more",
        ),
        (
            torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB. GPU 0 has 44"),
            "the GPU (2.00 GiB more",
        ),
        (
            RuntimeError(
                "[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried to allocate 8000000000 bytes."
            ),
            "this machine (8.0 GB more",
        ),
        (MemoryError(), "this machine; take less"),
    ],
)
def test_too_little_memory_is_no_bug(error, expected, capsys):
    assert cli._explain(error) == 1
    assert f"not enough memory on {expected}" in capsys.readouterr().err


def test_numbers_that_ask_for_the_memory_are_named(capsys):
    error = MemoryError("Unable to allocate 7.28 TiB for an array with shape (1000000000000,)")
    given = {"--batch 4": (4, 8), "hidden = 4096": (4096, 64), "widths = 64,4096": (((64, 4096),), ((64, 64),))}
    with pytest.raises(UsageError, match=r"hidden = 4096, widths = 64,4096: .* than this machine has \(7.28 TiB more"):
        with naming_large(given):
            raise error
    with pytest.raises(MemoryError), naming_large({"--batch 4": (4, 8), "--jobs 2": (2, None), "--amp": (True, False)}):
        raise error


def test_another_error_of_torch_s_stays_a_bug():
    with pytest.raises(RuntimeError):
        cli._explain(RuntimeError("mat1 and mat2 shapes cannot be multiplied"))


def test_a_network_too_large_for_this_machine_is_told_so(dpc_here):
    done = dpc_here("classify", "profile", "--preset", "tiny", "--points", 10**6)
    assert done.returncode == 2 and b"expected at most 4194304 points in a clip" in done.stderr


def leaves(command):
    below = getattr(command, "commands", {}).values()
    return [leaf for one in below for leaf in leaves(one)] if below else [command]


def test_no_option_takes_what_is_no_number():
    checked = leaves(cli._checking(typer.main.get_command(cli.application())))
    numbers = [(leaf, one) for leaf in checked for one in leaf.params if "float" in str(one.type_descriptor.annotation)]
    assert len(numbers) > 60
    for leaf, one in numbers:
        with pytest.raises(UsageError, match=f"{one.opts[-1]} nan: expected a finite number"):
            leaf.callback(**{one.name: math.nan})
        with pytest.raises((TypeError, UsageError)) as refused:  # where it is let through, the other words are missing
            leaf.callback(**{one.name: math.inf})
        assert ("inf: expected a finite number" in str(refused.value)) == (one.default != math.inf)


def test_no_option_takes_a_count_of_a_thousand_millions():
    """Seeds alone are no counts; settings have bounds of their own (test_settings_options.py)."""
    checked = leaves(cli._checking(typer.main.get_command(cli.application())))
    counts = [(leaf, one) for leaf in checked for one in leaf.params if "int" in str(one.type_descriptor.annotation)]
    counts = [(leaf, one) for leaf, one in counts if one.type_descriptor.parameter_info.parser is None]
    assert len(counts) > 60
    for leaf, one in counts:
        with pytest.raises(UsageError, match=f"{one.opts[-1]} 1000000000: expected a whole number up to 10000000"):
            leaf.callback(**{one.name: 10**9})


def test_a_number_that_is_none_ends_with_a_sentence(dpc_here):
    for room, number, expected in (
        ("classify", "nan", "a number above 0"),
        ("classify", "1e+300", "a finite number below 1e+30"),
        ("segment", "1e+300", "a finite number below 1e+30"),
    ):
        done = dpc_here(room, "train", "clouds.h5", "-o", "runs", "--lr", number)
        assert done.returncode == 2 and done.stderr.decode() == f"dpc: error: lr = {number}: expected {expected}\n"


@pytest.mark.parametrize(
    "number, said", [(errno.ENOSPC, "no space left"), (errno.EDQUOT, "disk quota"), (errno.EFBIG, "size limit")]
)
def test_a_full_disk_is_no_bug(number, said, capsys):
    assert cli._explain(OSError(number, "of the system")) == 1 and said in capsys.readouterr().err
    assert cli._explain(OSError(errno.ENXIO, "No such device", "socket")) == 3  # what lies there can't be opened
    assert cli._explain(OSError(number, "of the system", 3)) == 1  # the system may name a file by its number
    assert "3: " in capsys.readouterr().err


def test_too_many_open_files_are_no_bug(capsys):
    for number in (errno.EMFILE, errno.ENFILE):
        for named in ((), ("a.h5",)):
            assert cli._explain(OSError(number, os.strerror(number), *named)) == 1
            assert capsys.readouterr().err.startswith("dpc: error: too many open files; allow more (ulimit -n 1024)")


REPLACING = [
    "classify predict good.h5 --model run -o",
    "classify explain pac good.h5 --model run -o",
    "classify explain tsne good.h5 --model run -o",
    "classify fuse good.h5 other.h5 -o",
    "classify fuse other.h5 third.h5 --weights-from fourth.h5,good.h5 -o",
    "prepare split good.h5 -o",
    "prepare split other.h5 --list good.h5 -o",
    "prepare merge good.h5 other.h5 -o",
    "prepare video good.h5 -o",
    "segment predict good.h5 -o",
    "segment estimate-flow good.h5 -o",
    "generate4d fit good.h5 -o",
    "generate4d render good.h5 -o",
    "generate4d export good.h5 --as clouds -o",
    "evaluate report good.h5 -o",
    "info other.h5 --picture",
]


@pytest.fixture
def files(tmp_path, monkeypatch):
    """good.h5 under three names, a folder of a trained model, and a pipe: one that was opened would hang."""
    monkeypatch.chdir(tmp_path)
    for name in ("good.h5", "other.h5", "third.h5", "fourth.h5"):
        (tmp_path / name).write_text(name)
    (tmp_path / "link.h5").symlink_to("good.h5")
    (tmp_path / "twin.h5").hardlink_to("good.h5")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "best.safetensors").write_text("weights")
    os.mkfifo(tmp_path / "pipe")
    return tmp_path


@pytest.mark.parametrize("words", REPLACING[:-1])
@pytest.mark.parametrize("output", ["good.h5", "./good.h5", "link.h5", "twin.h5"])
def test_force_replaces_no_input(words, output, files, dpc_here):
    done = dpc_here(*words.split(), output, "--force")
    assert done.returncode == 2 and f"{Path(output)}: is an input, too" in done.stderr.decode()
    assert (files / output).read_text() == "good.h5" and sorted(os.listdir()) == sorted(
        path.name for path in files.iterdir()
    )


def test_force_replaces_no_file_of_an_input_folder(files, dpc_here):
    done = dpc_here("classify", "predict", "good.h5", "--model", "run", "-o", "run/best.safetensors", "--force")
    assert done.returncode == 2 and "best.safetensors: belongs to the input run" in done.stderr.decode()
    assert (files / "run" / "best.safetensors").read_text() == "weights"
    with ScoresWriter(files / "run" / "s.h5", class_names=["a"]) as writer:  # a result in that folder may go
        writer.write("v", np.ones(1))
    done = dpc_here("classify", "predict", "good.h5", "--model", "run", "-o", "run/s.h5", "--force")
    assert "input" not in done.stderr.decode()


@pytest.mark.parametrize("words", REPLACING)
@pytest.mark.parametrize("output", ["pipe", "/dev/null", "/dev/stdout"])
@pytest.mark.parametrize("force", [[], ["--force"]])
def test_what_is_no_regular_file_is_not_replaced(words, output, force, files, dpc_here):
    done = dpc_here(*words.split(), output, *([] if "info" in words else force))
    assert (
        done.returncode == 2
        and f"{output}: is not a regular file; to write into a pipe use `-o -" in done.stderr.decode()
    )
    assert (files / "pipe").is_fifo() and Path("/dev/null").is_char_device()


def test_a_writer_refuses_what_is_no_regular_file(files):
    with pytest.raises(UsageError, match="pipe: is not a regular file"):
        ScoresWriter(files / "pipe", class_names=["a"], force=True)


def test_a_split_in_a_folder_replaces_no_input(files, dpc_here):
    with CloudsWriter(files / "train.h5") as writer:
        writer.write(CloudSequence("v", np.zeros((1, 3), np.float32), np.array([0, 1]), split="train"))
    before = (files / "train.h5").read_bytes()
    done = dpc_here("prepare", "split", "train.h5", "-o", ".", "--force")
    assert done.returncode == 2 and "train.h5: is an input, too" in done.stderr.decode()
    assert (files / "train.h5").read_bytes() == before


def test_the_search_for_bugs_tells_one_from_a_refusal():
    def excused() -> int:
        print("dpc: error: KeyError: 'foo' (a bug, or an unusual machine; --debug shows where)", file=sys.stderr)
        return 1

    for work in (lambda: 1 // 0, lambda: os.kill(os.getpid(), signal.SIGKILL), excused):
        ended = forked(work, Limits())
        assert is_bug(ended.code, ended.said)
    ended = forked(lambda: print("--lr nan: expected a finite number", file=sys.stderr) or 2, Limits())
    assert not is_bug(ended.code, ended.said)
    tried = list(odd("evaluate runs a.h5 --confidence 0.9".split()))
    assert ["evaluate", "runs", "a.h5", "--confidence", "nan"] in tried and len(tried) > 20

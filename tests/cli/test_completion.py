"""Shell completion as the three shells ask for it, by the variables that their installed scripts set."""

from __future__ import annotations

import shutil
import subprocess
import sys

import pytest

from tests.support.commands import told

ASK = {
    "bash": lambda words: {"COMP_WORDS": " ".join(words), "COMP_CWORD": str(len(words) - 1)},
    "zsh": lambda words: {"_TYPER_COMPLETE_ARGS": " ".join(words)},
    "fish": lambda words: {"_TYPER_COMPLETE_ARGS": " ".join(words), "_TYPER_COMPLETE_FISH_ACTION": "get-args"},
}


@pytest.mark.parametrize("shell", ASK)
@pytest.mark.parametrize(
    "words, expected, other",
    [
        (("dpc", "cla"), "classify", "prepare"),
        (("dpc", "prepare", "msr"), "msraction3d", "nvgesture"),
        (("dpc", "classify", "train", "--pre"), "--preset", "--epochs"),
    ],
)
def test_commands_and_options_are_completed(monkeypatch, shell, words, expected, other):
    for name, value in {"_DPC_COMPLETE": f"complete_{shell}", **ASK[shell](words)}.items():
        monkeypatch.setenv(name, value)
    done = told()
    assert done.returncode == 0 and expected in done.stdout and other not in done.stdout


def test_completion_loads_no_heavy_library():
    code = "import sys; sys.argv = ['dpc']\ntry:\n  from dpcli.cli.app import main; main()\nexcept SystemExit: pass\n"
    code += "print('torch' in sys.modules, 'h5py' in sys.modules, file=sys.stderr)"
    words = ASK["bash"](("dpc", "classify", "train", "--e"))
    environment = {"PATH": "/usr/bin", "_DPC_COMPLETE": "complete_bash", **words}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert "--epochs" in done.stdout and done.stderr.split()[-2:] == ["False", "False"]


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
def test_bash_takes_the_installed_script(tmp_path):
    """The script that `--install-completion` writes, sourced by a real bash, registers a completion for `dpc`."""
    run = f"{sys.executable} -m dpcli --install-completion; for f in ~/.bash_completions/*; do source $f; done; complete -p dpc"
    environment = {"HOME": str(tmp_path), "PATH": "/usr/bin:/bin", "SHELL": "/bin/bash"}
    done = subprocess.run(["bash", "-c", run], capture_output=True, text=True, env=environment)
    assert "bash completion installed" in done.stdout and "_dpc_completion" in done.stdout, done.stderr

"""The recipes of docs/batch.md, read by bash as they stand there with fewer shards, and the commands that come out of them run."""

from __future__ import annotations

import os
import re
import subprocess
import textwrap
from glob import glob
from pathlib import Path

import numpy as np
import pytest

from dpcli.store import CloudsReader, CloudsWriter
from tests.cli.test_spread import save_untrained
from tests.support.commands import exit_code
from tests.support.documents import ROOT
from tests.support.drawers import drawer

# Stand-ins for the programs of a cluster; `dpc` notes its words and ends as the test wants it to.
PROGRAMS = {
    "dpc": "IFS=$(printf '\\037'); printf '%s\\n' \"$*\" >> $NOTES; exit ${ENDS:-0}",
    "srun": 'exec "$@"',
    "scontrol": 'echo "$*" >> $NOTES',
    "parallel": """
[ "$1" = -j ] && shift 2
words=()
while [ "$1" != ::: ]; do words+=("$1"); shift; done
shift
for each; do "${words[@]//\\{\\}/$each}" || exit; done""",
    "sbatch": """
for word; do last=$word; done
tasks=$(echo "$*" | sed -n 's/.*--array=0-\\([0-9]*\\) .*/\\1/p')
[ -f "$last" ] && tasks=$(sed -n 's/^#SBATCH --array=0-\\([0-9]*\\)/\\1/p' "$last") && last=$(cat "$last")
for id in $(seq 0 ${tasks:-0}); do
    SLURM_ARRAY_TASK_ID=$id SLURM_ARRAY_JOB_ID=9 SLURM_CPUS_PER_TASK=1 bash -c "$last"
done
true""",
}
FAST = ("--flow", "nearest", "--points", "40")
MORE = {
    ("segment", "predict"): ("--method", "ward", *FAST),
    ("segment", "estimate-flow"): FAST,
    ("evaluate", "segmentation"): ("--split", "all", "--resamples", "0"),
}  # what makes them quick


def recipe(title: str) -> list[str]:
    """The blocks of code below a heading, for two shards."""
    text = (ROOT / "docs" / "batch.md").read_text("utf-8")
    section = re.search(rf"^##+ {title}\n(.*?)(?=^##)", text, re.MULTILINE | re.DOTALL)[1]
    for many, two in (("/16", "/2"), ("seq 0 15", "seq 0 1"), ("/32", "/2"), ("0-31", "0-1"), ("0 1 2 3;", "0 1;")):
        section = section.replace(many, two)
    section = section.replace("/4 -o", "/2 -o").replace("[0-3]", "[0-1]")
    blocks = re.findall(r"(?:^(?: {4}.*)?\n)+", section, re.MULTILINE)
    return [textwrap.dedent(block).strip() for block in blocks if block.strip()]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("recipes")
    for number in range(3):
        (place / "raw" / f"v{number}").mkdir(parents=True)
        for frame in range(3):
            points = np.random.default_rng([number, frame]).random((60, 3), np.float32)
            np.save(place / "raw" / f"v{number}" / f"{frame}.npy", points)
    with CloudsWriter(place / "objects.h5", class_names=["a", "b"], fields=["part"]) as writer:
        for number in range(3):
            writer.write(drawer(f"v{number}", number, frames=3, points=60, label=number % 2))
    (place / "clips").mkdir()
    for name in ("a.h5", "b.h5"):
        (place / "clips" / name).touch()
    save_untrained(place / "MODEL")
    (place / "bin").mkdir()
    for name, text in PROGRAMS.items():
        (place / "bin" / name).write_text(f"#!/bin/bash\n{text}\n")
        (place / "bin" / name).chmod(0o755)
    return place


def noted(folder: Path, script: str, **environment: str) -> list[str]:
    """What bash, reading a script, calls of `dpc` (words apart by \\x1f) and of scontrol."""
    notes = folder / "notes"
    notes.unlink(missing_ok=True)
    path = f"{folder / 'bin'}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-c", script],
        cwd=folder,
        env={**os.environ, "PATH": path, "NOTES": str(notes), "RAW": "raw", **environment},
        capture_output=True,
        timeout=60,
    )
    assert not done.stderr, done.stderr
    return notes.read_text().splitlines()


def run(line: str) -> int:
    """In this process, with names that bash would have found had the files been made as it read."""
    words = (
        line.replace("\x1fntu60\x1fRAW", "\x1fclouds\x1fraw")
        .replace("\x1fntu60\x1fraw", "\x1fclouds\x1fraw")
        .split("\x1f")
    )
    found = [name for word in words for name in (sorted(glob(word)) if set(word) & set("*[") else [word])]
    return exit_code(*found, *MORE.get(tuple(found[:2]), ()))


def test_recipes_of_gnu_parallel(folder, monkeypatch, capsys):
    """One block each for `prepare` and, in the second, for what comes after; each makes the file that the next one takes."""
    first, others, *_ = recipe("GNU parallel")
    monkeypatch.chdir(folder)
    for block in [first, *others.split("\n\n")]:
        lines = noted(folder, block)
        assert "--shard\x1f0/2" in lines[0] and "--shard\x1f1/2" in lines[1]
        if lines[0].startswith("generate4d"):  # tests/generate4d/test_fit_clips.py fits in shards
            assert "clips/a.h5\x1fclips/b.h5\x1f-o\x1fscenes" in lines[0] and len(lines) == 2
            continue
        for line in lines:
            assert run(line) == 0, (line, capsys.readouterr().err)
    assert len(others.split("\n\n")) == 5
    for name in ("ntu60", "scores", "parts", "flow", "counts"):
        assert (folder / f"{name}.h5").is_file(), name


def test_recipes_of_slurm_and_of_a_loop(folder, monkeypatch, capsys):
    """An array, its merge, the same in one line; and a plain loop: all the same file."""
    script, merge, line, others = recipe("Slurm array")
    (folder / "job.sh").write_text(script)
    ways = ["sbatch job.sh\n" + merge, line + "\n" + merge, *recipe("A plain loop")]
    monkeypatch.chdir(folder)
    made = []
    for way in ways:
        for path in folder.glob("part-*.h5"):
            path.unlink()
        (folder / "ntu60.h5").unlink(missing_ok=True)
        lines = noted(folder, way)
        assert len(lines) == 3, lines
        for one in lines:
            assert run(one) == 0, (one, capsys.readouterr().err)
        with CloudsReader("ntu60.h5") as reader:
            assert list(reader.names) == ["v0", "v1", "v2"]
        made.append((folder / "ntu60.h5").read_bytes())
    assert made[0] == made[1] == made[2]
    lines = noted(folder, others, SLURM_ARRAY_TASK_ID="1")
    assert all("--shard\x1f1/2" in one for one in lines)
    outputs = [one.split("\x1f")[one.split("\x1f").index("-o") + 1] for one in lines]
    assert outputs == ["scores-1.h5", "parts-1.h5", "flow-1.h5", "counts-1.h5", "scenes"]


def test_a_job_that_was_stopped_is_put_back_into_the_queue(folder):
    script, _, line, _ = recipe("Slurm array")
    (folder / "job.sh").write_text(script)
    for way in ("sbatch job.sh", line):
        assert [one for one in noted(folder, way, ENDS="75") if one.startswith("requeue")] == [
            "requeue 9_0",
            "requeue 9_1",
        ]
        assert not [one for one in noted(folder, way, ENDS="3") if one.startswith("requeue")]


def test_recipes_of_dask_are_commands_of_this_program(folder):
    """Clusters themselves: test_spread.py and tests/prepare/test_dask_cluster.py."""
    block = recipe("Dask")[-1]
    lines = noted(folder, block)
    assert len(lines) == len(block.splitlines()) == 7 and all("--dask" in line for line in lines)

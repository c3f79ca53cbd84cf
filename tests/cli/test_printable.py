"""Names that would command a terminal: no command lets them, in a pipe, on a terminal, or in a report."""

from __future__ import annotations

import io
import json
import os
import pty
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dpcli.draw.page.assemble import as_json
from dpcli.evaluate.markdown import as_markdown, markdown_code, markdown_table
from dpcli.runtime.progress import Progress, log
from dpcli.standard_streams import PrintableStream, printable
from dpcli.store import CloudSequence, CloudsWriter, ScoresWriter

EVIL = "r\x1b[31mRED\x1b]0;pwn\x07\u202egnp\x9b2J\rdpc: [bold]done[/bold]\ndpc: [bold]x"
FORBIDDEN = ("\x1b[31mRED", "\x1b]0", "\x07", "\u202e", "\x9b", "\rdpc")
COMMANDS = [
    "info C",
    "info C --json",
    "info C --picture P.png --page P.html",
    "info S",
    "info EVIL",
    "info R/EVIL",
    "prepare clouds R --label-from-folder --points 8 -o O.h5 --force",
    "-v prepare clouds R --label-from-folder --points 8 -o O.h5 --force",
    "--debug prepare clouds EVIL -o O.h5",
    "prepare depth R -o O.h5",
    "prepare msraction3d EVIL -o O.h5",
    "prepare sapien EVIL -o O.h5",
    "prepare video EVIL.mp4 -o O.h5",
    "prepare animation EVIL.glb --list",
    "prepare merge EVIL C -o O.h5",
    "prepare split C -o D --force",
    "prepare split C -o N.h5 --force",
    "classify predict C --model EVIL -o O.h5",
    "classify train C --set EVIL=1 -o D",
    "segment predict EVIL --model EVIL -o O.h5",
    "generate4d render EVIL -o O.mp4",
    "evaluate classification S --split all",
    "evaluate classification S --split all --markdown",
    "evaluate classification S --split all --json",
    "evaluate classification S --split EVIL",
    "evaluate report J --markdown",
    "evaluate report J --latex",
    "evaluate EVIL",
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A file of clouds, one of scores and a result whose names are evil; raw data in folders of such names, good and bad."""
    root = tmp_path_factory.mktemp("evil")
    with CloudsWriter(root / "C.h5", class_names=[EVIL, "b"], source=EVIL) as writer:
        for n in range(2):
            frames = [np.random.default_rng(n).random((9, 3))] * 3
            writer.write(CloudSequence.from_frames(f"{n} {EVIL}", frames, label=n, split=EVIL if n else "test"))
        writer.skipped = [(EVIL, EVIL)]
    history = [{"command": f"dpc x {EVIL}", "config": {EVIL: EVIL}}]
    with ScoresWriter(root / "S.h5", class_names=[EVIL, "b|`c`\n<script>"], provenance=history) as writer:
        for n in range(4):
            writer.write(f"{n} {EVIL}", np.eye(2)[n % 2], label=n // 2, split="test")
    for video in ("v1", f"v2 {EVIL}"):
        (root / "R" / EVIL / video).mkdir(parents=True)
        for t in range(2):
            np.save(root / "R" / EVIL / video / f"{t}.npy", np.random.default_rng(t).random((9, 3), np.float32))
    (root / "R" / EVIL / f"v2 {EVIL}" / "1.npy").write_bytes(b"no array")
    told = command(root, "evaluate classification S --split all --json").stdout
    (root / "J.json").write_bytes(told)
    return root


def words(line: str) -> list[str]:
    places = {"C": "C.h5", "S": "S.h5", "J": "J.json"}
    return [places.get(word, word.replace("EVIL", EVIL)) for word in line.split()]


def command(folder: Path, line: str) -> subprocess.CompletedProcess:
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2]), "TERM": "xterm"}
    run = {"cwd": folder, "env": environment, "timeout": 300, "stdin": subprocess.DEVNULL, "capture_output": True}
    return subprocess.run([sys.executable, "-m", "dpcli", *words(line)], **run)


EACH_IN_A_FORK = """
import gc, json, os, sys
import dpcli.__main__, dpcli.cli.app, cv2, torch  # what the commands load, once for all of them
gc.freeze()
for n, words in enumerate(json.load(sys.stdin)):
    child = os.fork()
    if child == 0:
        for number, name in ((0, os.devnull), (1, f"{n}.out"), (2, f"{n}.err")):
            os.dup2(os.open(name, os.O_RDWR | os.O_CREAT), number)
        sys.argv = ["dpc", *words]
        try:
            dpcli.__main__.main()
        finally:
            sys.stdout.flush()
            os._exit(0)
    os.waitpid(child, 0)
"""


@pytest.fixture(scope="module")
def said(folder) -> dict[str, tuple[str, str]]:
    """What each command wrote to stdout and to stderr."""
    given = json.dumps([words(line) for line in COMMANDS]).encode()
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2]), "TERM": "xterm"}
    program = [sys.executable, "-c", EACH_IN_A_FORK]
    subprocess.run(program, input=given, cwd=folder, env=environment, timeout=300, check=True)
    return {
        line: tuple((folder / f"{n}.{end}").read_bytes().decode() for end in ("out", "err"))
        for n, line in enumerate(COMMANDS)
    }


@pytest.mark.parametrize("line", COMMANDS)
def test_nothing_that_commands_a_terminal_comes_out(said, line):
    for told in said[line]:
        assert told == printable(told, kept="\n\t")
        assert "\ndpc: [bold]" not in told or "--debug" in line  # a trace has lines of its own
    assert "RED" in "".join(said[line]) or "-o D" in line or "report" in line, said[line]  # the name was there


@pytest.mark.parametrize(
    "line", ["info C", "evaluate classification S --split all", "prepare clouds R -o T.h5 --force"]
)
def test_on_a_terminal_only_our_own_colors_pass(folder, line):
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "dpcli", *words(line)],
        cwd=folder,
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2]), "TERM": "xterm", "COLUMNS": "300"},
    )
    os.close(theirs)
    told = b""
    while True:
        try:
            piece = os.read(ours, 65536)
        except OSError:
            break
        told += piece
        if not piece:
            break
    os.close(ours)
    assert process.wait(60) in (0, 3), told
    text = told.decode()
    assert "\x1b[" in text and "RED" in text and not [one for one in FORBIDDEN if one in text]


@pytest.mark.parametrize("ending", ["html", "md", "tex"])
def test_reports_are_printable(folder, ending):
    assert command(folder, f"evaluate report J S -o r.{ending}").returncode == 0
    text = (folder / f"r.{ending}").read_text("utf-8")
    assert text == printable(text, kept="\n\t") and "RED" in text
    if ending == "md":
        assert "\n<script" not in text and "|b|" not in text


def test_the_page_of_a_file_is_printable(folder):
    done = command(folder, "info C --page p.html")
    assert done.returncode == 0, done.stderr
    text = (folder / "p.html").read_text("utf-8")
    assert text == printable(text, kept="\n\t\r") and "\\u202e" not in text.replace("\\\\u202e", "")


def test_json_stays_json(folder):
    told = json.loads(command(folder, "info C --json").stdout)
    assert told["classes"][0]["name"] == EVIL  # spelled by JSON's own rules, and the very name


def test_markdown_escapes_what_markdown_reads():
    assert as_markdown("a|b\n`c` <d> [e](f) *g* _h_ #i \\ &amp;") == (
        r"a\|b \`c\` &lt;d\> \[e\](f) \*g\* \_h\_ \#i \\ \&amp;"
    )
    assert markdown_code("a `` b\x1b") == "``` a `` b\\x1b ```"
    table = markdown_table(["a", ""], [["x|y\nz", "1"]], [False, True])
    assert table == "| a |   |\n| --- | ---: |\n| x\\|y z | 1 |"


def test_values_of_pages_are_spelled_and_nothing_else():
    told = json.loads(
        as_json({"names": [EVIL, "größe 走る"], "n": 3, "x": 1.5, "none": None, "deep": {"a": ("\x07",)}})
    )
    assert told == {
        "names": [printable(EVIL, kept="\n\t"), "größe 走る"],
        "n": 3,
        "x": 1.5,
        "none": None,
        "deep": {"a": ["\\x07"]},
    }


def test_a_message_never_begins_a_line_like_another(capsys):
    log.warn("odd\ndpc: error: forged\x1b[2J")
    assert capsys.readouterr().err == "dpc: warning: odd\n     dpc: error: forged\\x1b[2J\n"


def test_a_bar_spells_its_task_and_values():
    stream = io.StringIO()
    with Progress("fit \x1b[2J", total=1, stream=PrintableStream(stream)) as bar:
        bar.note(name="\u202ex")
        bar.advance()
    assert "fit \\x1b[2J 1/1" in stream.getvalue() and "\\u202ex" in stream.getvalue()


WARNS = """
import sys, warnings
from dpcli import __main__, errors
import dpcli.cli.app as app
def main():
    warnings.warn("overflow encountered", RuntimeWarning)
    raise errors.DataError("not an image <_io.BytesIO object at 0x7f12ab34cd50>")
app.main = main
__main__.main()
"""


@pytest.mark.parametrize(
    ("words", "environment", "heard"),
    [([], {}, False), (["--debug"], {}, True), ([], {"PYTHONWARNINGS": "default"}, True)],
)
def test_warnings_of_libraries_are_for_debugging(words, environment, heard):
    run = [sys.executable, "-c", WARNS, *words]
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONWARNINGS"}
    where = {"PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    done = subprocess.run(run, capture_output=True, text=True, env={**clean, **where, **environment})
    assert ("RuntimeWarning: overflow encountered" in done.stderr) == heard, done.stderr
    said = done.stderr.splitlines()[-1]  # newer Pythons show the line that raised it above, too
    assert "not an image _io.BytesIO" in said and "0x7f" not in said

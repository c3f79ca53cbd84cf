"""The project's documents taken apart: links, code, and the `dpc` commands in them, beside what `dpc` really has."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import click
import typer

from dpcli.cli.app import application

ROOT = Path(__file__).parents[2]
_FENCED = re.compile(r"^ *```.*?^ *```", re.MULTILINE | re.DOTALL)
_SPAN = re.compile(r"(`+)(.+?)\1", re.DOTALL)
_LINK = re.compile(r"\[(?:[^\[\]]|\[[^\[\]]*\])*\]\(([^()\s]+)\)")
_ASSIGNED = re.compile(r"""\b([A-Z][A-Z0-9_]*) *[:?]?="([^"]*)\"""")
_FREE = re.compile(r"[A-Z$…<{.*]")  # how a placeholder begins
_ANYWHERE = {"-q", "--quiet", "-v", "--verbose", "--debug", "-h", "--help", "--version"}


def documents() -> list[Path]:
    """Every text that a reader of the project is given, model cards included."""
    named = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]
    return named + sorted((ROOT / "docs").rglob("*.md")) + sorted((ROOT / "dpcli").rglob("*.md"))


def code_blocks(text: str) -> list[str]:
    """The blocks of code in a text, fenced or indented, without their indentation."""
    fenced = [found[0].split("\n", 1)[1].rsplit("\n", 1)[0] for found in _FENCED.finditer(text)]
    blocks, before = [], ""
    for line in _FENCED.sub("", text).splitlines():
        if line.startswith("    ") and before is None:
            blocks[-1].append(line)
        elif line.startswith("    ") and not before.strip():
            blocks.append([line])
            before = None
        else:
            before = line
    return fenced + ["\n".join(line.strip() for line in lines) for lines in blocks]


def prose(text: str) -> str:
    """A text without its blocks of code."""
    kept, before = [], ""
    for line in _FENCED.sub("", text).splitlines():
        if line.startswith("    ") and (before is None or not before.strip()):
            before = None
        else:
            kept.append(line)
            before = line
    return "\n".join(kept)


def spans(text: str) -> list[str]:
    """The inline code of a text; a span may go over the end of a line, but not of a paragraph."""
    paragraphs = re.split(r"\n\s*\n", prose(text))
    found = [match[2] for paragraph in paragraphs for match in _SPAN.finditer(paragraph)]
    return [" ".join(one.replace("\\|", "|").split()) for one in found]


def links(text: str) -> list[str]:
    """The targets of a text's links and pictures that are not on the web."""
    targets = [match[1] for match in _LINK.finditer(_SPAN.sub("", prose(text)))]
    return [target for target in targets if not re.match(r"[a-z]+:", target)]


def anchors(text: str) -> set[str]:
    """The anchors that GitHub gives to the headings of a text."""
    found: dict[str, int] = {}
    for line in _FENCED.sub("", text).splitlines():
        heading = re.match(r"#+ +(.*)", line)
        if heading:
            words = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading[1]).lower().strip()
            name = re.sub(r"[^\w\- ]", "", words).replace(" ", "-")
            found[name] = found.get(name, -1) + 1
    return {name if not again else f"{name}-{again}" for name, last in found.items() for again in range(last + 1)}


def commands(code: str) -> Iterator[list[str]]:
    """The words after each `dpc` in lines of shell, with the variables that are assigned there put in."""
    values = dict(_ASSIGNED.findall(code.replace("\\\n", " ")))
    for line in code.replace("\\\n", " ").splitlines():
        for _ in range(3):  # a value may hold variables, too
            line = re.sub(r"\$\{?([A-Z][A-Z0-9_]*)\}?", lambda found: values.get(found[1], found[0]), line)
        yield from _commands_of(line)


def _commands_of(line: str) -> Iterator[list[str]]:
    part: list[str] = []
    for word in [*_words(line), ";"]:
        if not set(word) <= set("|&;<>()"):
            part.append(word)
            continue
        at = next((i for i, one in enumerate(part) if one == "dpc" or one.endswith("/dpc")), None)
        if at is not None and part[at + 1 :] and part[at - 1 : at] != ["in"]:
            yield part[at + 1 :]
        for quoted in (one for one in part if "dpc " in one):
            yield from _commands_of(quoted)
        part = []


def _words(line: str) -> list[str]:
    reader = shlex.shlex(line, posix=True, punctuation_chars="|&;<>()")
    reader.whitespace_split = True
    try:
        return list(reader)
    except ValueError:  # prose with an apostrophe
        return line.split()


def assigned(text: str) -> list[tuple[str, str]]:
    """The variables that a text gives a value in quotes, as `BUDGET="--epochs 40"`, and the values."""
    return [(name, " ".join(value.split())) for name, value in _ASSIGNED.findall(text)]


@dataclass
class Has:
    """What a command takes: its options and settings; of a group, what any command of it takes.

    options, settings: the legal words of each by name, none where a value is not one of a few words.
    """

    options: dict[str, set[str]] = field(default_factory=dict)
    settings: dict[str, set[str]] = field(default_factory=dict)
    below: dict[str, Has] = field(default_factory=dict)

    def add(self, other: Has) -> None:
        """Take what the other takes, too; a name that takes any value in one of them takes any."""
        for own, more in ((self.options, other.options), (self.settings, other.settings)):
            for name, words in more.items():
                own[name] = own[name] | words if own.get(name) and words else set() if name in own else set(words)


def _has(command: click.Command) -> Has:
    has = Has(below={name: _has(one) for name, one in getattr(command, "commands", {}).items()})
    context = click.Context(command)
    for one in command.params:
        words = {item.value for item in one.shell_complete(context, "") if item.type == "plain"}
        if one.name == "set_values":
            for name, _, word in (item.partition("=") for item in words):
                has.settings.setdefault(name, set()).update({word} - {""})
            words = set()
        for opt in (*one.opts, *one.secondary_opts):
            if opt.startswith("-"):
                has.options[opt] = words
    for other in has.below.values():
        has.add(other)
    return has


@cache
def dpc() -> Has:
    """`dpc` as it is, built once."""
    return _has(typer.main.get_command(application()))


def faults(words: list[str]) -> Iterator[str]:
    """What is wrong with the words after `dpc`: a command, an option or a setting that does not exist."""
    has, path = dpc(), ["dpc"]
    rest = [word.strip("[]") for word in words]
    while rest and has.below and not rest[0].startswith("-"):
        word = rest.pop(0)
        if word not in has.below:
            if not _FREE.match(word):
                yield f"{' '.join(path)} has no command {word}"
                return
            break
        has, path = has.below[word], [*path, word]
    yield from option_faults(rest, has, " ".join(path))


def option_faults(words: list[str], has: Has, where: str) -> Iterator[str]:
    """Which of the words are options, or settings after `--set`, that a command lacks, and which values are not legal."""
    for word, following in zip(words, [*words[1:], ""]):
        name, _, value = word.partition("=")
        value = value or following
        if name in _ANYWHERE or not re.match(r"--?[A-Za-z]", name):
            continue
        legal = has.options.get(name)
        if legal is None:
            yield f"{where} has no option {name}"
        elif legal and value and not _FREE.match(value) and not legal.issuperset(value.split("|")):
            yield f"{where} {name} takes no {value}"
        elif name == "--set":
            yield from setting_faults(value, has, where)


def setting_faults(word: str, has: Has, where: str) -> Iterator[str]:
    """Whether the name in NAME=VALUE is no setting of a command, or the value not legal."""
    name, _, value = word.partition("=")
    legal = has.settings.get(name.replace("-", "_"))
    if _FREE.match(name) or not name:
        return
    if legal is None:
        yield f"{where} has no setting {name}"
    elif legal and value and not _FREE.match(value) and value not in legal:
        yield f"{where} takes no {name}={value}"

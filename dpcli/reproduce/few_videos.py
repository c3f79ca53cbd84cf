"""Accuracy against videos a class: fine-tuning a network on classes that it never saw, beside what else one could do.

    python -m dpcli.reproduce.few_videos CLOUDS FOLDER [--known 10] [--videos 5,10,all] [--model NAME] [--seed 0] [-- words]

CLOUDS: a file of clouds with splits train and test, such as `dpc prepare msraction3d` makes. The first `--known` classes
train a network; of the others so many videos a class, drawn by the seed, go on from it (`--init`), or train alone (`words`
of `dpc classify train`), or are the neighbors in the network's features, or teach a forest. With --known 0 a shipped
`--model` stands in for it, and all classes are new. Results: FOLDER/table.md, written again after every cell.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import torch

from dpcli.classify.data.clips import ClipSource
from dpcli.classify.explain.tsne import joined_features, video_features
from dpcli.classify.network.model_file import load_model
from dpcli.reproduce.runs import Cell, cut, digest, dpc, markdown, once, write_text
from dpcli.runtime.seeds import ClassifyStream, generator
from dpcli.store import CloudsReader, CloudsWriter

_CLIPS = 4  # of a video, whose features are averaged
_WAYS = ("fine-tuned", "from nothing", "nearest neighbor", "forest")


def write_classes(clouds: Path, output: Path, classes: list[int], videos: int | None, seed: int) -> Path:
    """Writes the videos of some classes, numbered anew from 0: all of the test split, and of the split train all or `videos`
    of each class. Returns the file."""
    with CloudsReader(clouds) as reader:
        names = [reader.class_names[label] for label in classes]
        chosen = [i for i, label in enumerate(reader.labels) if label in classes and reader.splits[i] == "test"]
        for label in classes:
            own = [i for i, known in enumerate(reader.labels) if known == label and reader.splits[i] == "train"]
            order = generator(seed, ClassifyStream.HELD_OUT_SAMPLES, label).permutation(len(own))
            chosen += [own[k] for k in order[: videos or len(own)]]
        with CloudsWriter(output, class_names=names, length_unit=reader.length_unit, force=True) as writer:
            for i in sorted(chosen):
                video = reader.read(i, fields=())
                video.label = classes.index(video.label)
                writer.write(video)
    return output


def nearest(model: Path | str, clouds: Path, seed: int) -> dict[str, float]:
    """Returns the share of the test videos whose nearest training video, by the angle of both streams' features, is of their
    class."""
    network, info = load_model(model)
    with CloudsReader(clouds) as reader:
        found = {}
        for split in ("train", "test"):
            chosen = [i for i, own in enumerate(reader.splits) if own == split]
            source = ClipSource(reader, chosen, info.config, timing=info.timing, seed=seed)
            features = joined_features(video_features(network, source, _CLIPS, 8, torch.device("cpu")))
            found[split] = features, reader.labels[chosen]
    (known, labels), (asked, true) = found["train"], found["test"]
    return {"accuracy": float((labels[(asked @ known.T).argmax(1)] == true).mean()), "videos": len(true)}


def cell_accuracy(cell: Cell) -> float:
    """Returns the share of the test videos that a network, once trained, gets right."""
    found = cell.run(dpc)
    return found["correct"]["fused"] / found["samples"]


def row(clouds: Path, folder: Path, model: Path | str, words: list[str], seed: int) -> list[float]:
    """Returns the accuracy of each way with the training videos of one file."""
    scored = ("--clips-per-video", str(_CLIPS))
    tuned = ("--init", model, "--validation", "none", "--seed", seed)
    alone = (*words, "--validation", "none", "--seed", seed)
    near = once(folder / "nearest.json", [str(model), digest(clouds), seed], lambda: nearest(model, clouds, seed))
    forest = json.loads(dpc("classify", "baseline", clouds, "--json", "--seed", seed))
    return [
        cell_accuracy(Cell(folder / "tuned", clouds, tuned, scored)),
        cell_accuracy(Cell(folder / "alone", clouds, alone, scored)),
        near["accuracy"],
        forest["accuracy"],
    ]


def main(words: list[str] | None = None) -> None:
    """Runs the program. Exit codes of the commands are its own."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("clouds", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--known", type=int, default=10, help="classes that the network learns first")
    parser.add_argument("--videos", default="5,10,all", help="training videos of each new class")
    parser.add_argument("--model", default="msraction3d-16", help="the network, with --known 0")
    parser.add_argument("--seed", type=int, default=0)
    own, budget = cut(words)
    given = parser.parse_args(own)
    if not given.clouds.is_file():
        parser.error(f"{given.clouds}: no such file; expected clouds, such as `dpc prepare msraction3d` makes")
    numbers = given.videos.split(",")
    if not all(one == "all" or one.isdecimal() and int(one) for one in numbers):
        parser.error(f"--videos {given.videos}: expected numbers from 1 and all, such as 5,10,all")
    given.folder.mkdir(parents=True, exist_ok=True)
    with CloudsReader(given.clouds) as reader:
        count = len(reader.class_names)
    model: Path | str = given.model
    if given.known:
        data = write_classes(given.clouds, given.folder / "known.h5", list(range(given.known)), None, given.seed)
        base = Cell(given.folder / "known", data, (*budget, "--validation", "none", "--seed", given.seed))
        base.run(dpc)
        model = base.model
    rows = []
    for videos in numbers:
        cells = given.folder / videos
        cells.mkdir(exist_ok=True)
        new = list(range(given.known, count))
        number = None if videos == "all" else int(videos)
        data = write_classes(given.clouds, cells / "clouds.h5", new, number, given.seed)
        rows.append([videos, *(f"{100 * share:.1f}" for share in row(data, cells, model, budget, given.seed))])
        table = markdown(["videos a class", *_WAYS], rows)
        write_text(given.folder / "table.md", table)
    print(table)


if __name__ == "__main__":
    main(sys.argv[1:])

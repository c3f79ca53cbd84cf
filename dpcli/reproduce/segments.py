"""Actions found in long recordings made of the test videos of MSR-Action3D, with and without pauses between them.

    python -m dpcli.reproduce.segments RAW FOLDER [--model NAME] [--pause 36] [--seed 0]

RAW: the folder of the depth videos. Each test person becomes one recording: all videos of that person in random order,
once one right after the other, once with pauses, in which the first frame of the next video stands still; a true segment
is a video. Results: FOLDER/table.md, and per kind the clouds, the truth, the segments and the evaluation's JSON object.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from dpcli.evaluate.segments.metrics import METRICS
from dpcli.reproduce.runs import dpc, markdown, write_text
from dpcli.runtime.seeds import ClassifyStream, generator
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter
from dpcli.store.tables.segments import Segment, Segments, segments_text

KINDS = {"one after the other": 0, "with pauses": 1}


def recording(reader: CloudsReader, chosen: list[int], name: str, pause: int) -> tuple[CloudSequence, list[Segment]]:
    """Returns the videos `chosen` as one sequence and its true segments; pause: frames that stand still before each video,
    and at the end."""
    frames: list[np.ndarray] = []
    truth = []
    for i in chosen:
        video = reader.read(i, fields=())
        shown = [video.frame(t) for t in range(video.num_frames)]
        frames += [shown[0]] * pause
        truth.append(Segment(len(frames), len(frames) + len(shown), reader.class_names[int(reader.labels[i])]))
        frames += shown
    frames += [frames[-1]] * pause
    return CloudSequence.from_frames(name, frames), truth


def write_recordings(clouds: Path, folder: Path, pause: int, seed: int) -> None:
    """Writes folder/clouds.h5 and folder/truth.csv: a recording of each person of the test split."""
    folder.mkdir(parents=True, exist_ok=True)
    truth = Segments({})
    with CloudsReader(clouds) as reader:
        people: dict[int, list[int]] = {}
        for i, split in enumerate(reader.splits):
            if split == "test":
                people.setdefault(int(reader.subjects[i]), []).append(i)
        with CloudsWriter(
            folder / "clouds.h5",
            class_names=reader.class_names,
            length_unit=reader.length_unit,
            provenance=reader.provenance,
            force=True,
        ) as writer:
            for person, videos in sorted(people.items()):
                order = generator(seed, ClassifyStream.RECORDING, person).permutation(len(videos))
                whole, own = recording(reader, [videos[k] for k in order], f"subject{person:02d}", pause)
                writer.write(whole)
                truth.recordings[whole.name] = own
    write_text(folder / "truth.csv", segments_text(truth, ".csv"))


def main(words: list[str] | None = None) -> None:
    """Runs the program. Exit codes of the commands are its own."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("raw")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--model", default="msraction3d-24")
    parser.add_argument("--pause", type=int, default=36, help="frames of a pause")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(words)
    given.folder.mkdir(parents=True, exist_ok=True)
    clouds = given.folder / "clouds.h5"
    dpc("prepare", "msraction3d", given.raw, "-o", clouds, "--points", 1024)
    rows = []
    for title, pauses in KINDS.items():
        own = given.folder / title.replace(" ", "-")
        write_recordings(clouds, own, pauses * given.pause, given.seed)
        predict = ("--model", given.model, "--segments", "-o", own / "segments.json", "--force")
        dpc("classify", "predict", own / "clouds.h5", "--split", "all", *predict)
        found = dpc("evaluate", "segments", own / "segments.json", "--truth", own / "truth.csv", "--json")
        write_text(own / "evaluation.json", found)
        rows.append([title, *_numbers(json.loads(found))])
    header = ["recordings", "frames", "true", "predicted", "frame accuracy", "edit score", "F1@10", "F1@25", "F1@50"]
    table = markdown(header, rows)
    write_text(given.folder / "table.md", table)
    print(table)


def _numbers(found: dict) -> list[str]:
    counts = found["denominators"]
    shares = [f"{100 * found['metrics'][key]:.1f}" for key in METRICS]
    return [*(str(counts[key]) for key in ("frames", "true_segments", "predicted_segments")), *shares]


if __name__ == "__main__":
    main(sys.argv[1:])

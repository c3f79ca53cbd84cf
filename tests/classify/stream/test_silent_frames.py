"""Frames in which nothing was seen: a stream leaves them out as `dpc prepare` does, so that both give the same predictions."""

from pathlib import Path

import numpy as np
import pytest
import torch

from dpcli.classify.network.config import KinetConfig
from dpcli.classify.network.kinet import Kinet
from dpcli.classify.network.model_file import ModelInfo, save_model
from dpcli.classify.settings import network_config
from dpcli.runtime.settings.catalog import Given
from dpcli.store import CloudsReader, ScoresReader
from tests.support.commands import exit_code as dpc

pytestmark = pytest.mark.usefixtures("one_thread")
NAMES = ["left", "right", "still"]


def untrained(path: Path, radar: bool) -> Path:
    """Writes a network whose last layers are large, so that its probabilities differ a lot from clip to clip."""
    torch.manual_seed(0)
    if radar:
        config = network_config(Given("sparse", sets={"members": 2, "widths": ((8, 8), (16,))}), 3)
        config = config.changed(columns=("doppler",), scales=(1.0, 0.0, 1.0))
        model, info = Kinet(config).eval(), ModelInfo(config, NAMES, "slots", {"streams": ["static"]})
    else:
        config = KinetConfig(3, 4, 24, "center", centroids=(16, 8), neighbors=9, widths=((8, 8), (8, 16), (16, 32)))
        model, info = Kinet(config).eval(), ModelInfo(config, NAMES, "clips")
    with torch.no_grad():
        for layer in model.modules():
            if isinstance(layer, torch.nn.Linear) and layer.out_features == 3:
                layer.weight *= 100
    save_model(path, model, info)
    return path


def frames_of(kind: str, silent: str) -> list[np.ndarray]:
    """Ten frames that are seen, f32 (P,3) or (P,4), with silent ones in bursts before, between and after them."""
    rng = np.random.default_rng(0)
    columns, fewest = (4, 1) if kind == "radar" else (3, 5)
    seen = [rng.normal((t, 0, 9, 0)[:columns], 1, (int(rng.integers(fewest, 9)), columns)) for t in range(10)]
    if silent == "padded":
        seen = [np.concatenate([frame, np.zeros((10 - len(frame), columns))]) for frame in seen]
    rows = {"empty": 0, "one row of zeros": 1, "padded": 10}[silent]
    for place in (10, 7, 3, 0):
        seen[place:place] = [np.zeros((rows, columns))] * int(rng.integers(2, 5))
    return [frame.astype(np.float32) for frame in seen]


def as_table(path: Path, frames: list[np.ndarray]) -> Path:
    """Writes a row for each point; a frame without any has no row."""
    rows = [(t, *row) for t, frame in enumerate(frames) for row in frame]
    header = ("frame", "x", "y", "z", "doppler")[: len(rows[0])]
    np.savetxt(path, rows, delimiter=",", header=",".join(header), comments="", fmt="%.9g")
    return path


@pytest.mark.parametrize("silent", ["empty", "one row of zeros", "padded"])
@pytest.mark.parametrize("kind", ["radar", "camera"])
def test_a_stream_with_silent_frames_says_what_the_file_of_its_frames_says(kind, silent, tmp_path, capsys):
    model = ("--model", untrained(tmp_path / "m.safetensors", kind == "radar"))
    keep = ("--keep-fields", "doppler") if kind == "radar" else ()
    frames = frames_of(kind, silent)
    table, file, pipe = (tmp_path / f"s.{end}" for end in ("csv", "h5", "npy"))
    assert dpc("prepare", "clouds", as_table(table, frames), "-o", file, "--frame-column", "frame", *keep) == 0
    with CloudsReader(file) as reader:
        kept = int(reader.frame_counts[0])
    with pipe.open("wb") as stream:
        for frame in frames:
            np.save(stream, frame)
    clips, window = (("--clips-per-video", 1), ("--window", kept)) if kind == "radar" else ((), ())
    of_file, of_stream = tmp_path / "file.h5", tmp_path / "stream.h5"
    assert dpc("classify", "predict", file, *model, *clips, "-o", of_file) == 0
    capsys.readouterr()
    assert dpc("classify", "predict", pipe, "--stream", *model, *window, "-o", of_stream) == 0
    told = capsys.readouterr()
    left_out = f"{len(frames) - kept} without points, left out"
    assert kept == 10 and told.err.count("one without points") == 1 and left_out in told.err
    assert ("10 with points at the origin, left out" in told.err) == (silent == "padded")
    assert "frame 9: " in told.out and "end of stream: 10 frames" in told.out
    assert np.allclose(ScoresReader(of_stream).scores, ScoresReader(of_file).scores, atol=1e-5)


def test_a_stream_of_silent_frames_alone_is_told(tmp_path, capsys):
    model = untrained(tmp_path / "m.safetensors", radar=False)
    with (tmp_path / "s.npy").open("wb") as stream:
        for rows in (0, 1, 0):
            np.save(stream, np.zeros((rows, 3), np.float32))
    assert dpc("classify", "predict", tmp_path / "s.npy", "--stream", "--model", model) == 3
    assert "none of its frames (3) has a point" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("held", "said"),
    [((), "holds nothing"), (("depth_1.png", "cam0"), ".npy and 18 more), and it holds cam0, depth_1.png")],
)
def test_a_folder_without_point_clouds_is_told_what_is_expected(held, said, tmp_path, capsys):
    model, folder = untrained(tmp_path / "m.safetensors", radar=False), tmp_path / "frames"
    for name in ("", *held):
        (folder / name).mkdir()
    assert dpc("classify", "predict", folder, "--stream", "--model", model) == 3
    assert said in " ".join(capsys.readouterr().err.split())

"""The part network that comes with the package."""

from __future__ import annotations

import json

from dpcli.segment.network.model_file import SHIPPED, default_model, load_model


def test_every_shipped_model_loads_has_a_card_and_names_no_machine():
    names = [path.stem for path in SHIPPED.glob("*.safetensors")]
    assert default_model() in names
    for name in names:
        model, notes = load_model(name)
        card = (SHIPPED / f"{name}.md").read_text()
        assert f"{sum(p.numel() for p in model.parameters()):,}" in card
        assert "/tmp" not in json.dumps(notes) and "/home" not in json.dumps(notes)
        assert notes["supervised"] is False


def test_it_finds_parts_of_objects_it_never_saw(dpc_here, one_thread, tmp_path):
    """Procedural objects are not what it learned from; it beats "all one part" on them."""
    words = ("--objects", 3, "--sequences-per-object", 1)
    made = dpc_here("prepare", "synthetic", "articulated", "-o", tmp_path / "o.h5", *words)
    assert made.returncode == 0, made.stderr.decode()
    score = {}
    for name, words in {"ours": ["--fast"], "one": ["--method", "ward", "--parts", 1]}.items():
        done = dpc_here("segment", "predict", tmp_path / "o.h5", "-o", tmp_path / f"{name}.h5", *words)
        assert done.returncode == 0, done.stderr.decode()
        judged = dpc_here("evaluate", "segmentation", tmp_path / f"{name}.h5", "--truth", tmp_path / "o.h5", "--json")
        score[name] = json.loads(judged.stdout)["metrics"]
    assert score["ours"]["miou"] > score["one"]["miou"] + 0.05 and score["ours"]["ri"] > score["one"]["ri"]

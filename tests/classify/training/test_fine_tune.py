"""Going on from a trained model with a person's own videos: what learns, for how long, and what is chosen by the data."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
import torch

from dpcli.classify.commands.train import train
from dpcli.classify.network.kinet import Kinet
from dpcli.classify.network.model_file import ModelInfo, load_model, save_model
from dpcli.classify.presets import PRESETS
from dpcli.classify.settings import network_config, training_settings
from dpcli.classify.training import fine_tune
from dpcli.classify.training.fine_tune import _schedule, freeze, part_for, settings_from, train_mode
from dpcli.classify.training.first_weights import take_weights
from dpcli.classify.training.optimizer_step import StageStep
from dpcli.classify.training.schedule import Schedule
from dpcli.errors import UsageError
from dpcli.runtime.distributed import Processes
from dpcli.runtime.settings.catalog import Given
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter

pytestmark = pytest.mark.usefixtures("one_thread")
SMALL = {
    "frames": 2,
    "points": 32,
    "centroids": (8, 4),
    "neighbors": 6,
    "widths": ((8, 8), (8, 8), (8, 8)),
    "timing": "uniform",
}


def clouds(path, videos, names=("left", "right"), points=80, frames=3, unit=1.0):
    """`videos` of each class for training and one to test, apart by where their points are."""
    rng = np.random.default_rng(0)
    with CloudsWriter(path, class_names=list(names)) as writer:
        for k in range(len(names) * (videos + 1)):
            label = k % len(names)
            made = [(rng.normal(0, 0.2, (points, 3)) + [label, 0, 0]).astype(np.float32) * unit for _ in range(frames)]
            split = "train" if k < len(names) * videos else "test"
            writer.write(CloudSequence.from_frames(f"v{k}", made, label=label, split=split))
    return path


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """A network of three other classes, as if it had been trained."""
    sets = {name: value for name, value in SMALL.items() if name != "timing"}
    config, path = network_config(Given("tiny", sets=sets), 3), tmp_path_factory.mktemp("model") / "m.safetensors"
    torch.manual_seed(0)
    save_model(path, Kinet(config), ModelInfo(config, ["a", "b", "c"], "uniform"))
    return path


@pytest.mark.parametrize("videos, part", [(1, "probe"), (3, "probe"), (5, "head"), (20, "head"), (21, "all")])
def test_the_number_of_videos_chooses_what_learns(videos, part, tmp_path):
    with CloudsReader(clouds(tmp_path / "c.h5", videos)) as reader:
        assert part_for(reader) == part
        info = ModelInfo(network_config(Given("tiny", sets={"frames": 2}), 3), ["a", "b", "c"], "uniform")
        base = settings_from(info, reader, None)
    schedule = base["schedule"]
    assert schedule.fine_tune == part and base["run"].timing == "uniform" and base["network"] == info.config
    assert 5 <= schedule.epochs <= 100 and schedule.epochs * 2 * videos <= 12_000


@pytest.mark.parametrize("videos, epochs", [(40, (80, 60)), (200, (45, 45)), (5000, (20, 15))])
def test_where_everything_learns_it_is_at_the_rate_of_a_training_from_nothing(videos, epochs):
    quick = PRESETS["quick"]["schedule"]
    schedule = _schedule(quick, "all", videos)
    assert schedule.stage_epochs == epochs and schedule.learning_rate == quick.learning_rate
    assert _schedule(quick, "head", videos).stage_epochs == (max(5, min(100, 5000 // videos)),) * 2
    assert _schedule(quick, "head", videos).learning_rate == _schedule(quick, "probe", videos).learning_rate == 6e-3
    sparse = PRESETS["sparse"]["schedule"]
    assert _schedule(sparse, "all", videos).epochs_dynamic == 0
    assert _schedule(sparse, "head", videos).learning_rate == sparse.learning_rate


@pytest.mark.parametrize("points, told", [(1, 0), (3, 0), (80, 1)])
def test_frames_of_few_points_and_none_say_nothing_about_a_unit(points, told, tmp_path, capsys):
    """The deviation of a frame without points is not a number, which is no other unit; that of one point is 0."""
    path, rng = tmp_path / "c.h5", np.random.default_rng(0)
    with CloudsWriter(path, class_names=["a", "b"]) as writer:
        for k in range(4):
            frames = [rng.normal(0, 9, (count, 3)).astype(np.float32) for count in (0, points, points)]
            writer.write(CloudSequence.from_frames(f"v{k}", frames, label=k % 2, split="train"))
    info = ModelInfo(network_config(Given("tiny", sets={"frames": 2}), 3), ["a", "b", "c"])
    with CloudsReader(path) as reader:
        settings_from(info, reader, None)
    said = capsys.readouterr().err
    assert said.count("y deviates by ") == told and "nan" not in said


def test_bodies_in_another_unit_are_made_as_tall_as_the_model_knows_them(tmp_path, capsys):
    info = ModelInfo(network_config(Given("tiny", sets={"frames": 2}), 3), ["a", "b", "c"])
    with CloudsReader(clouds(tmp_path / "m.h5", 2)) as reader:
        assert settings_from(info, reader, None)["network"].normalize == "center" and not capsys.readouterr().err
    with CloudsReader(clouds(tmp_path / "mm.h5", 2, unit=1000.0)) as reader:
        assert settings_from(info, reader, None)["network"].normalize == "height"
    assert "in what the model learned from" in capsys.readouterr().err


def test_a_file_in_the_order_of_its_classes_has_the_unit_of_all_of_them(tmp_path, monkeypatch):
    """Whoever lies in the first ones is not small."""
    monkeypatch.setattr(fine_tune, "_LOOKED_AT", 3)
    rng = np.random.default_rng(0)
    with CloudsWriter(tmp_path / "c.h5", class_names=["lie", "stand"]) as writer:
        for k in range(9):
            tall = 0.05 if k < 3 else 0.3
            frames = [rng.normal(0, (0.3, tall, 0.1), (80, 3)).astype(np.float32) for _ in range(3)]
            writer.write(CloudSequence.from_frames(f"v{k}", frames, label=int(k > 2), split="train"))
    info = ModelInfo(network_config(Given("tiny", sets={"frames": 2}), 3), ["a", "b", "c"])
    with CloudsReader(tmp_path / "c.h5") as reader:
        assert settings_from(info, reader, None)["network"].normalize == "center"


@pytest.mark.parametrize("part", ["probe", "head", "all"])
@pytest.mark.parametrize("stage", [0, 1])
def test_only_what_learns_changes_and_batch_norms_of_the_rest_stay(part, stage, model):
    network, _ = load_model(model)
    branch = network.static if stage == 0 else network.dynamic
    if stage == 1:
        network.freeze_static()
    freeze(branch, part)
    train_mode(branch, part)
    before = {name: value.clone() for name, value in network.state_dict().items()}
    schedule = Schedule(batch=4, fine_tune=part, weight_decay=0.5)
    step = StageStep(network, stage, schedule, torch.device("cpu"), Processes())
    step(torch.randn(4, 2, 32, 3) * 0.2, torch.tensor([0, 1, 2, 0]), 0.01)
    changed = {name for name, value in network.state_dict().items() if not torch.equal(value, before[name])}
    stream = "static" if stage == 0 else "dynamic"
    slowest = min(group["share"] for group in step.optimizer.param_groups)
    assert slowest == (0.1 if part == "all" else 1.0)  # a head alone has few steps, and its last layer is new
    groups = {id(one): group for group in step.optimizer.param_groups for one in group["params"]}
    for name, one in branch.named_parameters():
        last, group = name.startswith("head.classify"), groups.pop(id(one), None)
        told = (slowest if last else 1.0, 0.5 if last or one.dim() > 1 else 0.0, 0.01 * (slowest if last else 1.0))
        assert (group and (group["share"], group["weight_decay"], group["lr"])) == (told if one.requires_grad else None)
    assert not groups
    start = {"probe": f"{stream}.head.classify", "head": f"{stream}.head", "all": stream}[part]
    assert changed and all(name.startswith(start) for name in changed)
    assert f"{stream}.head.classify.weight" in changed
    assert part == "probe" or any(name.startswith(f"{stream}.head.linear1") for name in changed)
    assert part != "all" or any(not name.startswith(f"{stream}.head") for name in changed)


@pytest.mark.parametrize("videos", [1, 5])
def test_other_classes_go_on_from_a_model_with_its_own_network(videos, model, tmp_path, capsys):
    """One video a class leaves none to validate; the preset auto takes frames, points and timing of the model."""
    data = clouds(tmp_path / "c.h5", videos, names=("wave", "bow"))
    given = Given("auto", sets={"epochs_dynamic": 1}, flags={"init": str(model), "epochs": 1})
    done = train(str(data), str(tmp_path / "run"), given)
    made, info = load_model(done.weights)
    assert info.class_names == ["wave", "bow"] and info.timing == "uniform" and made.config.num_frames == 2
    assert f"learns: {'probe' if videos == 1 else 'head'}" in capsys.readouterr().err
    theirs, ours = load_model(model)[0].state_dict(), made.state_dict()
    assert all(torch.equal(ours[name], theirs[name]) for name in ours if ".head" not in name)
    assert done.videos == (0 if videos == 1 else 2)


@pytest.mark.parametrize("start", ["init", "static_from"])
def test_weights_to_start_from_that_changed_make_another_run(start, model, tmp_path):
    """What was learned from the weights that lay there before is not given out as learned from those of now."""
    data, weights = clouds(tmp_path / "c.h5", 1), tmp_path / "m.safetensors"
    shutil.copy(model, weights)
    sets = {**(SMALL if start == "static_from" else {}), "epochs_dynamic": 0, "clips_per_video": 1}
    chosen = {"sets": sets | {start: str(weights)}, "flags": {"epochs": 1}}
    given = Given("tiny", **chosen) if start == "static_from" else Given("auto", **chosen)
    train(str(data), str(tmp_path / "run"), given)
    train(str(data), str(tmp_path / "run"), given)
    network, info = load_model(weights)
    with torch.no_grad():
        next(network.parameters()).add_(1)
    save_model(weights, network, info)
    with pytest.raises(
        UsageError, match=f"holds a run with another configuration .other {start.partition('_')[0]} weights"
    ):
        train(str(data), str(tmp_path / "run"), given)


def test_settings_are_held_against_the_model_s_network(model, tmp_path, capsys):
    """Eight centroids are its own; as many as the preset quick has would not fit into 2 frames of 16 points. The data choose
    what learns also where a file of settings leaves it to them."""
    data = clouds(tmp_path / "c.h5", 1, names=("wave", "bow"))
    config, flags = {"epochs_dynamic": 0, "fine_tune": "auto"}, {"init": str(model), "epochs": 0, "points": 16}
    given = Given("auto", config=config, flags=flags)
    assert load_model(train(str(data), str(tmp_path / "run"), given).weights)[1].config.points_per_frame == 16
    assert "learns: probe" in capsys.readouterr().err
    with pytest.raises(UsageError, match="2 frames x 2 points = 4 are fewer than 8 centroids"):
        train(str(tmp_path / "none.h5"), str(tmp_path / "x"), Given("auto", flags={"init": str(model), "points": 2}))


def rows(network):
    """The tensors of a network's classifiers, each by class: (copies, classes, ...)."""
    state, count = network.state_dict(), network.config.num_classes
    return {key: value.unflatten(0, (-1, count)) for key, value in state.items() if "classify" in key.split(".")}


@pytest.mark.parametrize("preset, names", [("tiny", "bow,a,wave"), ("sparse", "c,wave,bow"), ("tiny", "x,y,z,b")])
def test_rows_of_the_last_layers_go_by_the_names_of_the_classes(preset, names, capsys):
    """As many classes as the model knows are no reason to begin with its rows: other classes in their places would have to be
    unlearned. A sparse network has a row for each class and kind of copy, and forests, which are no weights."""
    sizes = {name: value for name, value in SMALL.items() if name != "timing"} if preset == "tiny" else {}
    theirs = ["a", "b", "c"]
    model = Kinet(network_config(Given(preset, sets=sizes), 3).changed(forest=(5, 7) if preset == "sparse" else (0, 0)))
    if preset == "sparse":
        model.static.forest_share.fill_(0.3)
    own_names = names.split(",")
    mine = Kinet(network_config(Given(preset, sets=sizes), len(own_names)))
    before = {key: value.clone() for key, value in rows(mine).items()}
    take_weights(mine, model, own_names, theirs, "--init m")
    known = rows(model)
    for key, value in rows(mine).items():
        for k, name in enumerate(own_names):
            expected = known[key][:, theirs.index(name)] if name in theirs else before[key][:, k]
            assert torch.equal(value[:, k], expected), (key, name)
    others = {key: value for key, value in mine.state_dict().items() if key not in before and ".forest" not in key}
    assert preset != "sparse" or mine.static.forest_share == 0  # until there are forests
    assert all(torch.equal(value, model.state_dict()[key]) for key, value in others.items())
    shared = "".join(set(theirs) & set(own_names))
    told = (
        f"--init m: weights taken; it knows 1 of {len(own_names)} classes by name ({shared}), so the last layers learn"
    )
    forests = "; forests are grown anew at the end" if preset == "sparse" else ""
    assert capsys.readouterr().err.strip().endswith(f"{told} the others from nothing{forests}")


def test_what_can_not_be_tuned_is_refused(tmp_path, model):
    with pytest.raises(UsageError, match="--fine-tune head: needs a model to start from; name it with --init"):
        training_settings(Given("quick", flags={"fine_tune": "head"}))
    explicit = Given("tiny", sets=SMALL | {"epochs_dynamic": 0}, flags={"init": "x", "fine_tune": "auto"})
    assert training_settings(explicit).schedule.fine_tune == "auto"
    with pytest.raises(UsageError, match="no layers named head or classify"):
        freeze(torch.nn.Linear(2, 2), "probe")

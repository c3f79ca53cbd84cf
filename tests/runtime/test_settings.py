"""Settings: what is legal, what a bad value is told, the order of sources, and TOML that reads back."""

from __future__ import annotations

import re
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, get_args, get_origin, get_type_hints

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dpcli import __version__
from dpcli.errors import DataError, DpcError, UsageError
from dpcli.runtime.settings import value_types as kinds
from dpcli.runtime.settings.catalog import Catalog, Given
from dpcli.runtime.settings.fields import Settings, setting, settings_of


@dataclass(frozen=True)
class Network(Settings):
    """What a network is made of."""

    num_classes: int = 20  # no setting: the data say it
    num_frames: int = setting(16, "Frames per clip.", least=1, name="frames")
    normalize: Literal["none", "center", "unit"] = setting("none", "Coordinates of a clip.")
    centroids: tuple[int, int] = setting((1024, 512), "Neighborhoods of the two stages.", least=1)
    widths: tuple[tuple[int, ...], ...] = setting(((64, 128), (256,)), "Layers, a group a stage.", least=1)
    coarse: tuple[tuple[float, int], ...] = setting(((0.1, 4), (0.2, 2)), "Share of the steps, and size.")
    head: tuple[int, int] | None = setting(None, "Widths of the head.", least=1)
    static_radius: int | None = setting(1, "Frames before and after.", least=0)
    stride: Literal[1, 2, 4] = setting(1, "Every n-th frame.")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.centroids[1] > self.centroids[0]:
            raise UsageError(f"centroids = {kinds.write_text(self.centroids)}: expected the second not above the first")


@dataclass(frozen=True)
class Schedule(Settings):
    """How long and how fast."""

    batch: int = setting(16, "Clips per step.", least=1)
    decay: Literal["cosine", "staircase", "constant"] = setting("cosine", "Course of the learning rate.")
    learning_rate: float = setting(1e-3, "Adam's learning rate.", above=0, name="lr")
    label_smoothing: float = setting(0.0, "Share spread over the classes.", least=0, below=1)
    share: float = setting(1.0, "Share that is used.", above=0, most=1)
    amp: bool | None = setting(None, "Products in bfloat16.")
    augment: bool = setting(True, "Whether clips are changed\n   at random.")
    initial: str | None = setting(None, "A model to start from.")
    note: str = setting("", "Any text.")
    offset: float = setting(0.0, "Any number.")


CATALOG = Catalog(network=Network, schedule=Schedule)
BASE = {"network": Network(), "schedule": Schedule()}


def refusal(work: Any, *arguments: Any, kind: type[DpcError] = UsageError) -> str:
    with pytest.raises(kind) as caught:
        work(*arguments)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def set_refusal(*words: str) -> str:
    return refusal(CATALOG.parse_set, words)


@pytest.fixture
def config(tmp_path):
    def write(text: str | bytes):
        path = tmp_path / "a.toml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


def test_set_reads_every_type():
    words = [
        "frames=8",
        "normalize=unit",
        "centroids=256,128",
        "widths=1,2/3/4,5",
        "coarse=",
        "head=none",
        "stride=4",
        "static-radius=none",
        "decay=constant",
        "lr=1",
        "amp=false",
        "augment=true",
        "initial=a=b",
        "note= x ",
    ]
    assert CATALOG.parse_set(words) == {
        "frames": 8,
        "normalize": "unit",
        "centroids": (256, 128),
        "widths": ((1, 2), (3,), (4, 5)),
        "coarse": (),
        "head": None,
        "stride": 4,
        "static_radius": None,
        "decay": "constant",
        "lr": 1.0,
        "amp": False,
        "augment": True,
        "initial": "a=b",
        "note": " x ",
    }
    assert type(CATALOG.parse_set(["lr=1"])["lr"]) is float


@pytest.mark.parametrize(
    ("word", "sentence"),
    [
        ("batch=0", "batch = 0: expected at least 1"),
        ("batch=1.5", "batch = 1.5: expected a whole number"),
        ("batch=", "batch = '': expected a whole number"),
        ("batch=true", "batch = true: expected a whole number"),
        ("batch=99999999999999999999", "batch = 99999999999999999999: expected a whole number up to 1000000"),
        ("lr=0", "lr = 0: expected a number above 0"),
        ("lr=nan", "lr = nan: expected a number above 0"),
        ("lr=inf", "lr = inf: expected a finite number below 1e+30"),
        ("offset=nan", "offset = nan: expected a finite number below 1e+30"),
        ("offset=-1e300", "offset = -1e300: expected a finite number below 1e+30"),
        ("lr=fast", "lr = fast: expected a number"),
        ("label-smoothing=1", "label_smoothing = 1: expected at least 0 and below 1"),
        ("share=2", "share = 2: expected a number above 0 and at most 1"),
        ("decay=constnat", "decay = constnat: expected one of cosine, staircase, constant; did you mean constant?"),
        ("decay=zzz", "decay = zzz: expected one of cosine, staircase, constant"),
        ("amp=yes", "amp = yes: expected one of true, false, none"),
        ("augment=none", "augment = none: expected true or false"),
        ("stride=3", "stride = 3: expected one of 1, 2, 4"),
        ("static_radius=x", "static_radius = x: expected a whole number or none"),
        (
            "centroids=256",
            "centroids = 256: expected 2 whole numbers, as 1024,512 on the command line or [1024, 512] in TOML",
        ),
        ("centroids=256,0", "centroids = 256,0: expected numbers, each at least 1"),
        ("coarse=1,x/2,3", "coarse = 1,x/2,3: expected groups, each of a number and a whole number, as 0.1,4/0.2,2"),
        ("head=1,2,3", "head = 1,2,3: expected 2 whole numbers or none"),
        ("bacth=3", "unknown setting bacth; did you mean batch?"),
        ("learning-rate=3", "unknown setting learning-rate; did you mean lr?"),
        ("qqqq=3", "unknown setting qqqq; --help-all lists all settings"),
        ("num_classes=3", "unknown setting num_classes;"),
        ("batch", "--set batch: expected NAME=VALUE, such as --set batch=16"),
        ("=3", "--set =3: expected NAME=VALUE, such as --set frames=16"),
        ("note=\udce9", "note = '\\udce9': expected text"),
    ],
)
def test_a_bad_set_is_told_in_a_sentence(word, sentence):
    assert set_refusal(word).startswith(sentence)


def test_a_long_value_is_told_short():
    assert len(set_refusal("batch=" + "9" * 10_000)) < 150
    assert len(set_refusal("b" * 10_000 + "=1")) < 150


def test_the_same_name_twice_is_refused():
    assert set_refusal("label-smoothing=0", "label_smoothing=0") == (
        "label_smoothing is given twice, by --set label-smoothing=0 and --set label_smoothing=0; leave one out"
    )
    assert refusal(lambda: Given(sets={"lr": 1.0}, flags={"lr": 1.0})) == (
        "lr is given twice, by --lr and by --set; leave one out"
    )


def test_config_reads_tables_and_flat_keys(config):
    path = config(
        'lr = 1\ninitial = "none"\n[network]\ncentroids = [4, 2]\nwidths = [[1], [2, 3]]\nstatic-radius = 0\n'
    )
    read = CATALOG.read_config(path)
    assert read == {"lr": 1.0, "initial": None, "centroids": (4, 2), "widths": ((1,), (2, 3)), "static_radius": 0}
    assert type(read["lr"]) is float


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("batch = 0", "batch = 0: expected at least 1"),
        ("batch = '3'", "batch = 3: expected a whole number"),
        ("batch = true", "batch = true: expected a whole number"),
        ("batch = 3.0", "batch = 3.0: expected a whole number"),
        ("amp = 1", "amp = 1: expected one of true, false, none"),
        ("note = 3", "note = 3: expected text"),
        ("lr = nan", "lr = nan: expected a number above 0"),
        ("lr = 1" + "0" * 400, "lr = 1000"),
        ("stride = true", "stride = true: expected one of 1, 2, 4"),
        ("note = 2020-01-01", "note = 2020-01-01: expected text"),
        ("centroids = [1, 2.0]", "centroids = 1,2.0: expected 2 whole numbers, as"),
        ("batch.x = 1", "batch = {'x': 1}: expected a whole number"),
        ("decay = 'cosin'", "decay = cosin: expected one of cosine, staircase, constant; did you mean cosine?"),
        ("bacth = 1", "unknown setting bacth; did you mean batch?"),
        ("[shedule]\nbatch = 1", "unknown table [shedule]; expected one of network, schedule"),
        ("lr = 1\n[schedule]\nlr = 2", "lr is given twice, as lr and schedule.lr; leave one out"),
        ("static-radius = 1\nstatic_radius = 1", "static_radius is given twice, as static-radius and static_radius"),
        ("lr = 1\nlr = 2", "not TOML ("),
        ("lr = \n", "not TOML (Invalid value (at line 1"),
        (b"note = '\xe9'", "is not text in UTF-8 (byte 8 is 0xe9); save it as UTF-8"),
        ("batch = 1" + "0" * 10_000, "not TOML (it holds a number too long to be one)"),
    ],
)
def test_a_bad_config_is_told_in_a_sentence(config, text, sentence):
    path = config(text)
    kind = DataError if "TOML" in sentence or "UTF-8" in sentence else UsageError
    said = refusal(CATALOG.read_config, path, kind=kind)
    assert said.startswith(f"{path}: {sentence}")
    assert len(said) < len(str(path)) + 200


def test_a_config_that_cannot_be_read_is_told(tmp_path):
    (tmp_path / "file").touch()
    for path, words in (
        (tmp_path / "no.toml", "no such file"),
        (tmp_path, "is a folder; expected a TOML file"),
        (tmp_path / "file" / "a.toml", "can't be read (not a directory)"),
    ):
        assert refusal(CATALOG.read_config, path, kind=DataError) == f"{path}: {words}"


def test_later_sources_stand_over_earlier_ones():
    base = {**BASE, "schedule": Schedule(batch=8, label_smoothing=0.1, share=0.5, offset=1)}
    given = Given("quick", config={"batch": 4, "lr": 0.1, "share": 0.25}, sets={"lr": 0.2}, flags={"batch": 2})
    resolved = CATALOG.resolve(base, given)
    assert resolved["schedule"] == Schedule(batch=2, label_smoothing=0.1, learning_rate=0.2, share=0.25, offset=1)
    assert resolved["network"] == Network()
    assert given.preset == "quick"


def test_a_check_of_several_settings_comes_through():
    given = Given(config={"centroids": (256, 512)})
    assert "expected the second not above the first" in refusal(CATALOG.resolve, BASE, given)


@pytest.mark.parametrize(
    ("cls", "changes"),
    [
        (Schedule, {"batch": 0}),
        (Schedule, {"batch": True}),
        (Schedule, {"batch": 2.0}),
        (Schedule, {"decay": "x"}),
        (Schedule, {"learning_rate": float("nan")}),
        (Schedule, {"learning_rate": False}),
        (Schedule, {"amp": 1}),
        (Schedule, {"initial": "none"}),
        (Network, {"centroids": [2, 1]}),
        (Network, {"centroids": (2, 1, 1)}),
        (Network, {"widths": ((1,), 2)}),
        (Network, {"head": (0, 1)}),
        (Network, {"normalize": None}),
    ],
)
def test_an_instance_checks_itself(cls, changes):
    refusal(lambda: cls(**changes))


def test_a_whole_number_serves_as_a_float():
    assert Schedule(learning_rate=1).learning_rate == 1


def test_names_are_unique():
    @dataclass(frozen=True)
    class Other:
        width: int = setting(1, "A width.", name="batch")

    @dataclass(frozen=True)
    class Group:
        schedule: int = setting(1, "A number.")

    with pytest.raises(ValueError, match="Other.width: the name batch is taken"):
        Catalog(schedule=Schedule, other=Other)
    with pytest.raises(ValueError, match="Group.schedule"):
        Catalog(schedule=Schedule, group=Group)


@pytest.mark.parametrize("hint", [dict, list[int], int | str, Literal["none", "all"] | None, tuple[dict, ...]])
def test_types_that_no_setting_may_have(hint):
    with pytest.raises(TypeError):
        kinds.check_hint(hint)


def test_toml_is_told_apart_and_explained():
    text = CATALOG.to_toml(BASE, "classify train")
    assert text == CATALOG.to_toml({**BASE}, "classify train")
    first, *rest = text.splitlines()
    assert "dpc classify train" in first and __version__ in first
    assert "[network]" in rest and "frames = 16" in rest and 'head = "none"' in rest
    assert "# Whether clips are changed at random." in rest
    assert "num_classes" not in text
    assert not re.search("^# [WF]", CATALOG.to_toml(BASE, "classify train", helps=False), re.M)


def test_any_letter_reads_back(config):
    schedule = Schedule(note='"\\\x7f\x00\r\n\t\u2028 \U0001f642', initial="'")
    text = CATALOG.to_toml({"schedule": schedule}, "classify train")
    assert CATALOG.resolve(BASE, Given(config=CATALOG.read_config(config(text))))["schedule"] == schedule


def legal(hint: Any, low: float, high: float) -> st.SearchStrategy:
    """All values of a type, numbers between the bounds."""
    if kinds.may_be_none(hint):
        return st.none() | legal(kinds.without_none(hint), low, high).filter(lambda value: value != kinds.NONE)
    if get_origin(hint) is Literal:
        return st.sampled_from(get_args(hint))
    if get_origin(hint) is tuple:
        items = [legal(one, low, high) for one in get_args(hint) if one is not ...]
        return st.lists(items[0], max_size=4).map(tuple) if get_args(hint)[-1] is ... else st.tuples(*items)
    simple = {
        bool: st.booleans(),
        int: st.integers(int(max(low, -(10**6))), int(min(high, 10**6))),
        float: st.floats(low, high),
        str: st.text(st.characters(exclude_categories=["Cs"])),
    }
    return simple[hint]


def instances(cls: type) -> st.SearchStrategy:
    """All legal instances of a dataclass of settings."""
    drawn = {}
    for one in settings_of(cls):
        low = one.least if one.least is not None else 1e-300 if one.above is not None else -9e29
        high = one.most if one.most is not None else 0.999 if one.below is not None else 9e29
        drawn[one.field] = legal(one.hint, low, high)
    if "centroids" in drawn:
        drawn["centroids"] = drawn["centroids"].map(lambda pair: tuple(sorted(pair, reverse=True)))
    return st.builds(cls, **drawn)


@settings(max_examples=150, deadline=None)
@given(network=instances(Network), schedule=instances(Schedule), helps=st.booleans())
def test_toml_reads_back_over_any_preset(tmp_path_factory, network, schedule, helps):
    path = tmp_path_factory.getbasetemp() / "read_back.toml"
    path.write_text(
        CATALOG.to_toml({"network": network, "schedule": schedule}, "classify train", helps), "utf-8", newline=""
    )
    read = Given(config=CATALOG.read_config(path))
    other = {"network": replace(BASE["network"], head=(1, 2)), "schedule": Schedule(amp=True, initial="x")}
    for base in (BASE, other):
        assert CATALOG.resolve(base, read) == {"network": network, "schedule": schedule}


@settings(max_examples=150, deadline=None)
@given(network=instances(Network), schedule=instances(Schedule))
def test_text_of_a_value_reads_back(network, schedule):
    for instance in (network, schedule):
        for one in settings_of(type(instance)):
            value = getattr(instance, one.field)
            if isinstance(value, str) and value != value.strip() and one.hint is not str:
                continue  # spaces around a value are no part of it, but for plain text
            if isinstance(value, tuple) and any(item == () for item in value) and len(value) == 1:
                continue  # one empty group is written as no group is
            assert one.parse(kinds.write_text(value)) == value


def test_every_field_that_is_a_setting_has_help():
    assert all(one.help for cls in CATALOG.groups.values() for one in settings_of(cls))
    assert len(settings_of(Network)) == len(fields(Network)) - 1
    assert get_type_hints(Network)["num_frames"] is settings_of(Network)[0].hint is int

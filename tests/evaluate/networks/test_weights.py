"""Weights of learned metrics: the list, the folder, digests, state dicts, downloads from a server of the test's own."""

from __future__ import annotations

import hashlib
import json
import pickle
import re
import threading
from dataclasses import replace
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from socketserver import TCPServer

import pytest
import torch
import typer
from safetensors.torch import save_file
from torch import nn
from typer.testing import CliRunner

from dpcli.cli.evaluate.app import WEIGHTS
from dpcli.errors import DataError, DpcError, UsageError
from dpcli.evaluate.commands import weights as commands
from dpcli.evaluate.networks import weights as module
from dpcli.evaluate.networks.state_dicts import fill_module, load_tensors
from dpcli.evaluate.networks.weights import (
    Weights,
    bytes_text,
    check_file,
    check_weights,
    find_weights,
    known_weights,
    weights_folder,
    weights_named,
    whole_weights,
)
from dpcli.evaluate.networks.weights_fetch import fetch_weights
from dpcli.evaluate.video.frechet.clip_features import FeatureNetwork
from dpcli.runtime.provenance import file_digest

CONTENT = bytes(range(256)) * 40
ENTRY = Weights(
    "toy", "toy.bin", "https://example.org/toy.bin", len(CONTENT), "MIT", hashlib.sha256(CONTENT).hexdigest(), "tests"
)


# The list


def test_the_list_is_whole():
    entries = known_weights()
    needed = {
        "alexnet",
        "vgg16",
        "squeezenet",
        "i3d-torchscript",
        "i3d-400",
        "resnet50-kinetics",
        "inception",
        "clip-openai",
        "clip-laion",
    }
    assert set(entries) == needed
    files = [each for entry in entries.values() for each in entry.files]
    assert len({each.file for each in files}) == len(files)
    for each in files:
        assert each.url.startswith("https://") and each.size > 0 and each.license and each.used_by
        assert re.fullmatch(r"[0-9a-f]{64}|[0-9a-f]{8}|", each.sha256)
        digits = re.search(r"-([0-9a-f]{8})\.pth$", each.file)
        assert not digits or each.sha256.startswith(digits[1])
        assert each.by_hand or each.url.split("?")[0].endswith(Path(each.file).name)
    for entry in entries.values():  # what isn't published is said
        assert entry.sha256 or re.search("digest", entry.note), entry.name
    assert [entry.name for entry in entries.values() if entry.script] == ["i3d-torchscript"]


def test_names_of_entries_and_of_files():
    assert weights_named("vgg16") is weights_named("vgg16-397923af.pth")
    with pytest.raises(UsageError, match="no weights named 'vgg'; there are alexnet, vgg16"):
        weights_named("vgg")


def test_the_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("DPC_WEIGHTS", str(tmp_path / "set"))
    assert weights_folder(tmp_path) == tmp_path
    assert weights_folder() == tmp_path / "set"
    monkeypatch.delenv("DPC_WEIGHTS")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert weights_folder() == tmp_path / "cache" / "dpc" / "weights"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")  # the standard says to ignore it
    monkeypatch.setenv("HOME", str(tmp_path))
    assert weights_folder() == tmp_path / ".cache" / "dpc" / "weights"
    (tmp_path / "w.pt").touch()
    for name, said in (("nowhere", "no such folder"), ("w.pt", "a file, expected a folder")):
        with pytest.raises(DataError, match=f"--weights .*{name}: {said}"):
            weights_folder(tmp_path / name)


def test_a_missing_file_is_one_line(tmp_path):
    with pytest.raises(DataError) as caught:
        find_weights("alexnet", tmp_path)
    said = str(caught.value)
    assert "\n" not in said and str(tmp_path / "alexnet-owt-7be5be79.pth") in said
    assert (
        "`dpc evaluate weights fetch alexnet`" in said and "https://download.pytorch.org/" in said and "244 MB" in said
    )
    with pytest.raises(DataError) as caught:
        find_weights("resnet50-kinetics", tmp_path)
    assert "by hand" in str(caught.value) and "weights fetch" not in str(caught.value)
    (tmp_path / "clip-vit-base-patch32").mkdir()
    (tmp_path / "clip-vit-base-patch32" / "pytorch_model.bin").touch()
    with pytest.raises(DataError, match=r"patch32/config\.json: no such weights"):
        find_weights("clip-openai", tmp_path)
    (tmp_path / "clip-vit-base-patch32" / "config.json").touch()
    assert find_weights("clip-openai", tmp_path).name == "pytorch_model.bin"


@pytest.mark.parametrize(
    "count, words", [(4958839, "4.96 MB"), (605247071, "605 MB"), (4186, "4.19 kB"), (12, "12 B"), (2.5e9, "2.5 GB")]
)
def test_sizes_as_text(count, words):
    assert bytes_text(count) == words and bytes_text(count, about=True) == f"about {words}"


# Is it whole?


def test_check(tmp_path):
    path = tmp_path / "toy.bin"
    assert check_file(path, ENTRY).state == "absent"
    path.write_bytes(CONTENT)
    found = check_file(path, ENTRY)
    assert found.state == "present" and found.digest == file_digest(path) == ENTRY.sha256 and "whole" in found.finding
    prefix = check_file(path, replace(ENTRY, sha256=ENTRY.sha256[:8]))
    assert prefix.state == "present" and "first 8 digits" in prefix.finding
    unknown = check_file(path, replace(ENTRY, sha256=""))
    assert unknown.state == "present" and "no published digest" in unknown.finding and ENTRY.sha256 in unknown.finding
    assert check_file(path, ENTRY, digest=False).digest == ""


def test_check_finds_damage(tmp_path):
    path = tmp_path / "toy.bin"
    flipped = bytearray(CONTENT)
    flipped[5000] ^= 1
    for content, entry, words in (
        (bytes(flipped), ENTRY, "expected " + ENTRY.sha256),
        (bytes(flipped), replace(ENTRY, sha256=ENTRY.sha256[:8]), f"expected {ENTRY.sha256[:8]}…"),
        (CONTENT[:-1], ENTRY, f"{len(CONTENT) - 1} bytes, expected {len(CONTENT)}"),
        (CONTENT[:-1], replace(ENTRY, about=True), "expected " + ENTRY.sha256),
        (b"", replace(ENTRY, about=True, sha256=""), "empty"),
    ):
        path.write_bytes(content)
        found = check_file(path, entry)
        assert found.state == "damaged" and words in found.finding
    path.write_bytes(bytes(flipped))
    assert check_file(path, ENTRY, digest=False).state == "present"  # the size alone can't tell: `list` says so


def test_files_beside_count(tmp_path):
    both = replace(ENTRY, beside=(replace(ENTRY, file="config.json"),))
    (tmp_path / "toy.bin").write_bytes(CONTENT)
    assert check_weights(both, tmp_path).state == "absent"
    (tmp_path / "config.json").write_bytes(CONTENT[:9])
    assert check_weights(both, tmp_path).state == "damaged"
    (tmp_path / "config.json").write_bytes(CONTENT)
    assert check_weights(both, tmp_path).state == "present"


# What is in it


def small() -> nn.Module:
    torch.manual_seed(3)
    return nn.Sequential(nn.Conv2d(3, 4, 3), nn.BatchNorm2d(4))


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def test_load_state_of_every_kind(tmp_path):
    state = small().state_dict()
    save_file(state, tmp_path / "a.safetensors")
    torch.save(state, tmp_path / "a.pth")
    torch.save(state, tmp_path / "old.pth", _use_new_zipfile_serialization=False)
    parallel = {f"module.{name}": value for name, value in state.items()}
    optimizer = {"state": {0: {"momentum_buffer": torch.zeros(3)}}, "param_groups": [{"lr": 0.1, "params": [0]}]}
    torch.save(
        {"epoch": 7, "arch": "resnet-50", "state_dict": parallel, "optimizer": optimizer}, tmp_path / "train.pth"
    )
    for name in ("a.safetensors", "a.pth", "old.pth", "train.pth"):
        assert same(load_tensors(tmp_path / name), state), name


@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")
def test_a_torchscript_archive_is_no_state_dict(tmp_path):
    torch.jit.trace(small().eval(), torch.zeros(1, 3, 8, 8)).save(str(tmp_path / "script.pt"))
    with pytest.raises(DataError, match="its members claim"):  # its code is packed
        load_tensors(tmp_path / "script.pt")


class Hostile:
    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


def test_load_state_refuses(tmp_path):
    state = small().state_dict()
    torch.save({"weight": Hostile(tmp_path / "proof")}, tmp_path / "hostile.pth")
    (tmp_path / "bare.pth").write_bytes(pickle.dumps(Hostile(tmp_path / "proof")))
    torch.save(small(), tmp_path / "module.pth")
    torch.save([1, 2], tmp_path / "list.pth")
    torch.save({}, tmp_path / "empty.pth")
    torch.save({"epoch": 3}, tmp_path / "numbers.pth")
    torch.save(state, tmp_path / "cut.pth")
    (tmp_path / "cut.pth").write_bytes((tmp_path / "cut.pth").read_bytes()[:700])
    save_file(state, tmp_path / "cut.safetensors")
    (tmp_path / "cut.safetensors").write_bytes((tmp_path / "cut.safetensors").read_bytes()[:100])
    for name in ("hostile", "bare", "module", "list", "empty", "numbers", "cut"):
        with pytest.raises(DataError, match=f"{name}.pth: not a (plain state dict|file of plain tensors)") as caught:
            load_tensors(tmp_path / f"{name}.pth")
        assert "\n" not in str(caught.value)
    with pytest.raises(DataError, match="cut.safetensors: not a plain state dict"):
        load_tensors(tmp_path / "cut.safetensors")
    assert not (tmp_path / "proof").exists()
    torch.save({"a": torch.tensor([1.0, torch.nan])}, tmp_path / "nan.pth")
    with pytest.raises(DataError, match="NaN or infinite values in a"):
        load_tensors(tmp_path / "nan.pth")


def test_a_damaged_file_is_not_opened(tmp_path, monkeypatch):
    state = small().state_dict()
    torch.save(state, tmp_path / "toy.bin")
    entry = replace(ENTRY, size=(tmp_path / "toy.bin").stat().st_size, sha256=file_digest(tmp_path / "toy.bin"))
    monkeypatch.setattr(module, "known_weights", lambda: {"toy": entry})
    assert same(load_tensors(whole_weights("toy", tmp_path, digest=True)), state)
    monkeypatch.setattr(module, "known_weights", lambda: {"toy": replace(entry, size=entry.size + 1)})
    with pytest.raises(DataError, match="damaged weights .* fetch it again"):
        whole_weights("toy", tmp_path)
    code = replace(entry, name="i3d-torchscript", sha256="0" * 64, script=True)
    monkeypatch.setattr(module, "known_weights", lambda: {"i3d-torchscript": code})
    monkeypatch.setattr(torch.jit, "load", lambda *_, **__: pytest.fail("an archive of code, of another digest"))
    with pytest.raises(DataError, match="damaged weights .SHA-256"):
        FeatureNetwork.load("styleganv", tmp_path)


def test_fill(tmp_path):
    source, target = small(), small()
    with torch.no_grad():
        source[0].weight.mul_(2)
    state = {**source.state_dict(), "classifier.weight": torch.zeros(3)}
    del state["1.num_batches_tracked"]  # files of before PyTorch 0.4.1 have none
    fill_module(target, state, tmp_path)
    assert torch.equal(target[0].weight, source[0].weight)
    with pytest.raises(DataError, match="no tensor 1.running_var; expected weights of Sequential"):
        fill_module(target, {name: value for name, value in state.items() if name != "1.running_var"}, tmp_path)
    with pytest.raises(DataError, match=r"0.bias has shape \(5,\), expected \(4,\)"):
        fill_module(target, {**state, "0.bias": torch.zeros(5)}, tmp_path)


# Downloads


@pytest.fixture
def server(monkeypatch):
    """Answers of this process: path -> (status, bytes, announced length). `asked` lists the paths that came."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            made.asked.append(self.path)
            status, content, length = made.answers.get(self.path, (404, b"", 0))
            self.send_response(status)
            self.send_header("Content-Length", str(length))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_: object) -> None:
            pass

    monkeypatch.setenv("no_proxy", "127.0.0.1")
    made = TCPServer(("127.0.0.1", 0), Handler)
    made.asked, made.answers = [], {"/toy.bin": (200, CONTENT, len(CONTENT))}
    thread = threading.Thread(target=made.serve_forever, args=(0.01,))
    thread.start()
    made.entry = replace(ENTRY, url=f"http://127.0.0.1:{made.server_address[1]}/toy.bin")
    yield made
    made.shutdown()
    thread.join()
    made.server_close()


def test_fetch(server, tmp_path, capfd):
    folder = tmp_path / "not yet" / "there"
    both = replace(server.entry, beside=(replace(server.entry, file="sub/config.json"),))
    assert fetch_weights(both, folder) == [folder / "toy.bin", folder / "sub" / "config.json"]
    assert (folder / "toy.bin").read_bytes() == CONTENT and (folder / "sub" / "config.json").read_bytes() == CONTENT
    assert sorted(path.name for path in folder.rglob("*") if path.is_file()) == ["config.json", "toy.bin"]
    out, err = capfd.readouterr()
    assert out == "" and "whole SHA-256 checked" in err and "fetch toy" in err
    fetch_weights(both, folder)
    assert len(server.asked) == 2 and "already there" in capfd.readouterr().err


def test_fetch_replaces_a_damaged_file_and_tells_an_unpublished_digest(server, tmp_path, capfd):
    (tmp_path / "toy.bin").write_bytes(CONTENT[:100])
    fetch_weights(replace(server.entry, sha256=""), tmp_path)
    assert (tmp_path / "toy.bin").read_bytes() == CONTENT
    assert f"no published digest; SHA-256 is {ENTRY.sha256}" in capfd.readouterr().err


@pytest.mark.parametrize(
    "answer, change, words",
    [
        ((404, b"", 0), {}, "the server says 404"),
        ((200, CONTENT[:999], len(CONTENT)), {}, "only 999 of 10240 bytes"),
        ((200, CONTENT[:-1] + b"x", len(CONTENT)), {}, "not the published file .SHA-256"),
        ((200, CONTENT[:-1], len(CONTENT) - 1), {}, "not the published file .10239 bytes"),
        ((200, b" <!DOCTYPE html>", 16), {"sha256": "", "about": True}, "a web page came"),
        ((200, b"", 0), {"sha256": "", "about": True}, "an empty file"),
    ],
)
def test_fetch_keeps_nothing_wrong(server, tmp_path, answer, change, words):
    server.answers["/toy.bin"] = answer
    before = {} if change else {"toy.bin": b"what was there"}  # with nothing published any file is taken for whole
    for name, content in before.items():
        (tmp_path / name).write_bytes(content)
    with pytest.raises(DpcError, match=words) as caught:
        fetch_weights(replace(server.entry, **change), tmp_path)
    assert "\n" not in str(caught.value)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_fetch_without_a_network(tmp_path, monkeypatch):
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with TCPServer(("127.0.0.1", 0), BaseHTTPRequestHandler) as closed:
        port = closed.server_address[1]
    with pytest.raises(DpcError, match="no connection .*Connection refused.*give the folder with --weights"):
        fetch_weights(replace(ENTRY, url=f"http://127.0.0.1:{port}/toy.bin"), tmp_path)
    with pytest.raises(DpcError, match="no direct link; download toy.bin from .* by hand and put it at"):
        fetch_weights(replace(ENTRY, by_hand=True), tmp_path)
    assert list(tmp_path.iterdir()) == []


# The commands


@pytest.fixture
def run(monkeypatch, server):
    """Run `weights ...` of a toy app, with two toy entries; what it raises is raised."""
    lost = replace(server.entry, name="lost", file="lost.bin", url=server.entry.url.replace("toy", "lost"))
    for one in (module, commands):
        monkeypatch.setattr(one, "known_weights", lambda: {"toy": server.entry, "lost": lost})
    app = typer.Typer()
    app.add_typer(WEIGHTS.application(), name="weights")
    app.command("other")(lambda: None)
    return lambda *words: CliRunner().invoke(app, ["weights", *map(str, words)], catch_exceptions=False)


def test_commands(run, tmp_path):
    folder = tmp_path / "made by fetch"
    assert run("fetch", "toy", "--weights", folder).stdout == f"{folder / 'toy.bin'}\n"
    listed = json.loads(run("list", "--weights", folder, "--json").stdout)
    assert [(entry["name"], entry["state"]) for entry in listed["weights"]] == [("toy", "present"), ("lost", "absent")]
    assert listed["folder"] == str(folder) and listed["weights"][0]["files"][0]["published_sha256"] == ENTRY.sha256
    text = run("list", "--weights", folder).stdout
    assert re.search(r"toy +tests +10.2 kB +MIT +present", text) and re.search(r"lost .* absent", text)
    assert max(map(len, text.splitlines()[:6])) < 80
    found = json.loads(run("check", "--weights", folder, "--json").stdout)["weights"]
    assert [(entry["name"], entry["sha256"]) for entry in found] == [("toy", ENTRY.sha256)]


def test_a_check_of_nothing_says_so(run, tmp_path):
    done = run("check", "--weights", str(tmp_path))
    assert done.exit_code == 0 and done.stdout.startswith(f"No weights are installed in {tmp_path}; ")


def test_commands_that_fail(run, tmp_path):
    (tmp_path / "toy.bin").write_bytes(CONTENT[:-1] + b"x")
    with pytest.raises(DataError, match="toy: SHA-256"):
        run("check", "--weights", tmp_path)
    with pytest.raises(DataError, match="lost: no file"):
        run("check", "lost", "--weights", tmp_path)
    with pytest.raises(UsageError, match="name the weights, or give --all: toy, lost"):
        run("fetch", "--weights", tmp_path)
    with pytest.raises(UsageError, match="no weights named 'nothing'"):
        run("fetch", "nothing", "--weights", tmp_path)
    with pytest.raises(DpcError, match="404"):  # the other one is fetched nevertheless
        run("fetch", "lost", "toy", "--weights", tmp_path)
    assert check_file(tmp_path / "toy.bin", ENTRY).state == "present"

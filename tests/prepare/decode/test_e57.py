"""E57 written byte by byte from its standard (ASTM E2807): points, poses, colors, invalid returns, damage."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.prepare.decode.cloud_files import read_cloud
from dpcli.prepare.decode.e57_files import INVALID, JOINED, PLAIN

PAGE, HEAD = 1024, 48


def checksum(data: bytes) -> bytes:
    """CRC-32C, as each page ends with."""
    value = 0xFFFFFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ (0x82F63B78 if value & 1 else 0)
    return struct.pack(">I", value ^ 0xFFFFFFFF)


def physical(place: int) -> int:
    """Where a byte lies when every 1020 are followed by a checksum of four."""
    return place + 4 * (place // (PAGE - 4))


def section(columns: list[np.ndarray], start: int) -> bytes:
    """The records of one scan at a place of the file, in one packet; doubles and bytes as they are."""
    streams = [np.ascontiguousarray(column).tobytes() for column in columns]
    packet = (
        struct.pack("<H", len(streams)) + b"".join(struct.pack("<H", len(one)) for one in streams) + b"".join(streams)
    )
    packet += bytes(-(len(packet) + 4) % 4)
    packet = struct.pack("<BBH", 1, 0, len(packet) + 3) + packet
    return struct.pack("<B7xQQQ", 1, 32 + len(packet), physical(start + 32), 0) + packet


def write(path: Path, *scans: dict) -> None:
    """scans: points f64 (N,3), perhaps color u8 (N,3), invalid u8 (N), pose (w x y z, translation)."""
    body, children = b"", ""
    for scan in scans:
        columns = {f"cartesian{axis}": scan["points"][:, k] for k, axis in enumerate("XYZ")}
        if "invalid" in scan:
            columns["cartesianInvalidState"] = np.packbits(scan["invalid"], bitorder="little")
        if "color" in scan:
            columns |= {f"color{name}": scan["color"][:, k] for k, name in enumerate(("Red", "Green", "Blue"))}
        kinds = {
            np.dtype("f8"): 'type="Float" precision="double"',
            np.dtype("u1"): 'type="Integer" minimum="0" maximum="255"',
        }
        fields = "".join(
            f"<{name} " + (kinds[v.dtype] if "Invalid" not in name else 'type="Integer" minimum="0" maximum="1"') + "/>"
            for name, v in columns.items()
        )
        turn, shift = scan.get("pose", (np.eye(4)[0], np.zeros(3)))
        words = [f'<{name} type="Float">{value!r}</{name}>' for name, value in zip("wxyz", map(float, turn))]
        moves = [f'<{name} type="Float">{value!r}</{name}>' for name, value in zip("xyz", map(float, shift))]
        limits = "".join(
            f'<color{name}{end} type="Integer">{value}</color{name}{end}>'
            for name in ("Red", "Green", "Blue")
            for end, value in (("Minimum", 0), ("Maximum", 255))
        )
        children += (
            f'<vectorChild type="Structure"><guid type="String">{len(body)}</guid>'
            f'<pose type="Structure"><rotation type="Structure">{"".join(words)}</rotation>'
            f'<translation type="Structure">{"".join(moves)}</translation></pose>'
            + (f'<colorLimits type="Structure">{limits}</colorLimits>' if "color" in scan else "")
            + f'<points type="CompressedVector" fileOffset="{physical(HEAD + len(body))}" recordCount="{len(scan["points"])}">'
            f'<prototype type="Structure">{fields}</prototype><codecs type="Vector"/></points></vectorChild>'
        )
        body += section(list(columns.values()), HEAD + len(body))
        body += bytes(-len(body) % 4)
    xml = (
        '<?xml version="1.0" encoding="UTF-8"?><e57Root type="Structure" xmlns="http://www.astm.org/COMMIT/E57/2010-e57-v1.0">'
        '<formatName type="String">ASTM E57 3D Imaging Data File</formatName><guid type="String">a</guid>'
        '<versionMajor type="Integer">1</versionMajor><versionMinor type="Integer">0</versionMinor>'
        f'<data3D type="Vector" allowHeterogeneousChildren="1">{children}</data3D></e57Root>'
    ).encode()
    pages = -(-(HEAD + len(body) + len(xml)) // (PAGE - 4))
    head = struct.pack("<8sIIQQQQ", b"ASTM-E57", 1, 0, pages * PAGE, physical(HEAD + len(body)), len(xml), PAGE)
    whole = (head + body + xml).ljust(pages * (PAGE - 4), b"\0")
    parts = (whole[k : k + PAGE - 4] for k in range(0, len(whole), PAGE - 4))
    path.write_bytes(b"".join(part + checksum(part) for part in parts))


def test_without_the_package_it_is_named(tmp_path, monkeypatch):
    import sys

    from dpcli.errors import DpcError

    monkeypatch.setitem(sys.modules, "e57", None)
    write(tmp_path / "a.e57", {"points": np.ones((3, 3))})
    with pytest.raises(DpcError, match=r"pip install 'dpc-toolkit\[e57\]'"):
        read_cloud(tmp_path / "a.e57")


@pytest.mark.parametrize("seed", range(4))
def test_scans_are_joined_by_their_poses(tmp_path, seed):
    pytest.importorskip("e57")
    rng = np.random.default_rng(seed)
    first = {
        "points": rng.normal(size=(40 + seed, 3)) + (seed > 1) * np.array([5e5, 4.6e6, 90]),
        "color": rng.integers(0, 256, (40 + seed, 3), np.uint8),
    }
    write(tmp_path / "a.e57", first)
    cloud = read_cloud(tmp_path / "a.e57")
    assert np.array_equal(cloud.points, first["points"]) and cloud.points.dtype == np.float64 and not cloud.dropped
    assert np.array_equal(np.rint(cloud.color * 255), first["color"])
    invalid = rng.integers(0, 2, 30).astype(np.uint8)
    turn = np.array([np.cos(0.3), 0, 0, np.sin(0.3)])
    second = {"points": rng.normal(size=(30, 3)), "invalid": invalid, "pose": (turn, np.array([1.0, 2.0, 3.0]))}
    write(tmp_path / "b.e57", first, second)
    about_z = np.array([[np.cos(0.6), -np.sin(0.6), 0], [np.sin(0.6), np.cos(0.6), 0], [0, 0, 1]])
    moved = second["points"][invalid == 0] @ about_z.T + (1, 2, 3)
    both = read_cloud(tmp_path / "b.e57")
    assert np.allclose(both.points, np.concatenate([first["points"], moved])) and both.color is None
    assert both.dropped == {JOINED: 1, PLAIN: 1, INVALID: int(invalid.sum())}


def test_damage_is_told_by_the_checksums(tmp_path):
    pytest.importorskip("e57")
    rng = np.random.default_rng(5)
    write(tmp_path / "a.e57", {"points": rng.normal(size=(50, 3))})
    whole = (tmp_path / "a.e57").read_bytes()
    for place in rng.integers(0, len(whole), 20):
        damaged = bytearray(whole)
        damaged[place] ^= 0x11
        (tmp_path / "a.e57").write_bytes(damaged)
        with pytest.raises(DataError, match="not a readable E57 file"):
            read_cloud(tmp_path / "a.e57")
    with pytest.raises(DataError, match="only points and colors"):
        read_cloud(tmp_path / "a.e57", keep=("intensity",))

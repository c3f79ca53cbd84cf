"""Files that are no glTF: recognized by how they begin, and told what to do with them."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

from dpcli.errors import DataError

_BLENDER = "open it in Blender and use File > Export > glTF 2.0"
_SHAPE = (
    "it holds one shape that stands still; import a series of them into Blender as one animation, and export glTF 2.0"
)
_UNPACK = "unpack it, and name the .glb or .gltf in it"
_AGAIN = "download it again"
_KINDS = {  # how files begin: what they are, and what to do
    b"Kaydara FBX Binary": ("FBX", _BLENDER),
    b"; FBX": ("FBX", _BLENDER),
    b"FBXHeaderExtension": ("FBX", _BLENDER),
    b"PXR-USDC": ("USD", _BLENDER),
    b"#usda": ("USD", _BLENDER),
    b"BLENDER": ("a Blender file", _BLENDER),
    b"Ogawa": ("Alembic", _BLENDER),
    b"\x89HDF": ("HDF5 (Alembic, or a file that dpc made)", f"of Alembic: {_BLENDER}"),
    b"HIERARCHY": ("BVH, motion without a surface", f"put it on a model: {_BLENDER}"),
    b"<?xml": ("XML (COLLADA, perhaps)", _BLENDER),
    b"<COLLADA": ("COLLADA", _BLENDER),
    b"//Maya ASCII": ("Maya", "export it as glTF 2.0, or as FBX for Blender"),
    b"FOR4": ("Maya", "export it as glTF 2.0, or as FBX for Blender"),
    b"FOR8": ("Maya", "export it as glTF 2.0, or as FBX for Blender"),
    b"\xd0\xcf\x11\xe0": ("3ds Max, perhaps", "export it as glTF 2.0, or as FBX for Blender"),
    b"b3dm": ("a tile of 3D Tiles", "extract the .glb in it"),
    b"\x1f\x8b": ("a gzip archive (or a compressed Blender file)", f"unpack it, or {_BLENDER}"),
    b"\x28\xb5\x2f\xfd": ("a zstd archive (or a compressed Blender file)", f"unpack it, or {_BLENDER}"),
    b"7z\xbc\xaf\x27\x1c": ("a 7z archive", _UNPACK),
    b"Rar!": ("a rar archive", _UNPACK),
    b"\xff\xfe": ("text in UTF-16", "save it as UTF-8"),
    b"solid": ("STL", _SHAPE),
    b"ply": ("PLY", f"{_SHAPE}; as points, `dpc prepare clouds` reads a folder of them"),
    b"<!DOCTYPE html": ("a web page", _AGAIN),
    b"<html": ("a web page", _AGAIN),
    b"version https://git-lfs": ("a pointer of Git LFS", "fetch the file itself: git lfs pull"),
}
_BY_SUFFIX = {  # of formats whose beginning tells nothing
    ".obj": ("OBJ", _SHAPE),
    ".stl": ("STL", _SHAPE),
    ".3ds": ("3DS", _SHAPE),
    ".off": ("OFF", _SHAPE),
    ".fbx": ("FBX", _BLENDER),
    ".drc": ("Draco alone", _SHAPE),
}
_VIDEO = (".mp4", ".mov", ".mkv", ".avi", ".webm", ".gif")
_MODELS = (".glb", ".gltf", ".vrm")


def refuse_other_formats(path: Path, data: bytes) -> None:
    """Raises DataError when the bytes of a file are those of another format.."""
    if not data.strip():
        raise DataError(f"{path}: the file is empty; copy or export it again")
    if data.startswith(b"PK\x03\x04"):
        raise DataError(f"{path}: not a glTF file but {_archive(data)}")
    start = data[:64].lstrip(b"\xef\xbb\xbf \n\r\t").lower()
    for begin, (what, advice) in _KINDS.items():
        if start.startswith(begin.lower()):
            raise DataError(f"{path}: not a glTF file but {what}; {advice}")


def not_gltf(path: Path) -> DataError:
    """Returns the error for a file that no beginning tells of; its suffix does, perhaps."""
    suffix = path.suffix.lower()
    if suffix in _VIDEO:
        return DataError(f"{path}: not a glTF file but a video; use `dpc prepare video`")
    if suffix in _BY_SUFFIX:
        what, advice = _BY_SUFFIX[suffix]
        return DataError(f"{path}: not a glTF file but {what}; {advice}")
    return DataError(f"{path}: not a glTF file (no JSON with an asset version); expected .glb or .gltf")


def is_folder(path: Path) -> DataError:
    """Returns the error for a folder given for a file: it names the models in it, or what else it holds."""
    files = sorted(file for file in path.iterdir() if file.is_file() and not file.name.startswith("."))
    models = [file.name for file in files if file.suffix.lower() in _MODELS]
    if models:
        return DataError(f"{path}: a folder; name one of its {len(models)} files, such as {models[0]}")
    shapes = [file for file in files if file.suffix.lower() in (".ply", *_BY_SUFFIX)]
    if shapes:
        return DataError(f"{path}: a folder of {len(shapes)} files such as {shapes[0].name}, not a glTF file; {_SHAPE}")
    return DataError(f"{path}: a folder; expected a .glb or .gltf file")


def _archive(data: bytes) -> str:
    """Returns what a zip archive is, and what to do with it."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            names = archive.namelist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
        return "a damaged zip archive; download it again"
    suffixes = {Path(name).suffix.lower() for name in names}
    if suffixes & {".usdc", ".usda", ".usd"}:
        return f"USDZ; {_BLENDER}"
    if ".model" in suffixes:
        return f"3MF; {_SHAPE}"
    models = sorted(name for name in names if Path(name).suffix.lower() in _MODELS)
    return f"a zip archive; unpack it, and name {models[0]}" if models else f"a zip archive without a glTF; {_BLENDER}"

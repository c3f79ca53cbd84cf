"""Files that are no glTF: recognized by how they begin, and told what to do with them."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

from dpcli.counted import counted
from dpcli.errors import DataError
from dpcli.runtime.clips.other_files import PAGE, POINTER, what_it_is

_BLENDER = "open it in Blender and use File > Export > glTF 2.0"
_SHAPE = (
    "it holds one shape that stands still; import a series of them into Blender as one animation, and export glTF 2.0"
)
_ADVICE = {  # of what is treated alike
    **{"model": _BLENDER, "motion": f"put it on a model: {_BLENDER}", "arrays": f"of Alembic: {_BLENDER}"},
    **{"archive": "unpack it, and name the .glb or .gltf in it", "packed": f"unpack it, or {_BLENDER}"},
    **{"program": "export it as glTF 2.0, or as FBX for Blender", "tile": "extract the .glb in it"},
    **{"shape": f"{_SHAPE}; as points, `dpc prepare clouds` reads a folder of PLY", "wide": "save it as UTF-8"},
    **{"page": PAGE, "pointer": POINTER, "picture": "name a model"},
}
_BY_SUFFIX = {  # of formats whose beginning tells nothing
    ".obj": ("OBJ", _SHAPE),
    ".stl": ("STL", _SHAPE),
    ".3ds": ("3DS", _SHAPE),
    ".off": ("OFF", _SHAPE),
    ".fbx": ("FBX", _BLENDER),
    ".drc": ("Draco alone", _SHAPE),
}
_START = 512
_VIDEO = (".mp4", ".mov", ".mkv", ".avi", ".webm", ".gif")
_MODELS = (".glb", ".gltf", ".vrm")


def refuse_other_formats(path: Path, data: bytes) -> None:
    """Raises DataError when the bytes of a file are those of another format."""
    if not data.strip():
        raise DataError(f"{path}: the file is empty; copy or export it again")
    if data.startswith(b"PK\x03\x04"):
        raise DataError(f"{path}: not a glTF file but {_archive(data)}")
    if what := what_it_is(data[:_START], _ADVICE):
        raise DataError(f"{path}: not a glTF file but {what}")


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
        _, advice = _BY_SUFFIX.get(shapes[0].suffix.lower(), ("PLY", _SHAPE))
        many = counted(len(shapes), "file")
        return DataError(f"{path}: a folder of {many} such as {shapes[0].name}, not a glTF file; {advice}")
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

"""Images in the folder of a clip: upright and in sRGB, as they are shown, and sorted into the series that their names tell."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Sequence
from contextlib import contextmanager
from fnmatch import fnmatchcase
from io import BytesIO
from pathlib import Path

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError
from dpcli.path_names import first_names
from dpcli.runtime.clips import wide_color
from dpcli.runtime.clips.color_tags import color_tags
from dpcli.runtime.clips.other_files import known_kind
from dpcli.runtime.progress import log

IMAGE_SUFFIXES = (
    *(".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff", ".avif"),
    *(".jfif", ".tga", ".jp2", ".ppm"),
)
ORIENTATION = 0x0112  # of EXIF
_PIXELS, _PIXELS_A_BYTE = 1 << 24, 10  # that any picture may have; and as many times its bytes beyond them
_NAMED = 6  # series at most in a message
_TAGS = "transfer and primaries"  # of H.273, beside what Pillow finds
_COLORS = ("1", "L", "LA", "P", "PA", "RGB", "RGBA")  # modes of 8 bits
_WEBP_FLAGS, _MOVES, _ALPHA = 20, 2, 16  # the byte of flags in an extended WebP, and two of them
_EXTRA_SAMPLES = 338  # a tag of TIFF
_SAID: set[str] = set()
_PHOTOMETRIC, _WHITE_IS_ZERO = 262, 0  # a tag of TIFF, and what it may say
_PLANES, _APART = 284, 2  # the same: whether the channels lie one after the other
_OF_SEVERAL = ("GIF", "PNG", "WEBP", "AVIF", "TIFF")
_GAMMA = 1 / 2.2  # of sRGB, as PNG writes it
_CAMERA_GAMMA = (
    0.50994  # of BT.709's camera curve: older FFmpeg writes it beside the unchanged levels of a video's frames
)
_BT2020_XY = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046)  # of red, green and blue
_GRAY_SCALES = {"L;2": 85, "L;4": 17}  # of fewer bits than 8, by Pillow's names for them


def is_plausible(width: int, height: int, held: int) -> bool:
    """Returns whether `held` bytes of a file can tell a picture of so many pixels.

    Flat colors pack a thousand times smaller, so a small file could fill the memory.
    """
    return width * height <= max(_PIXELS, _PIXELS_A_BYTE * held)


def require_plausible(where: object, width: int, height: int, held: int) -> None:
    """Raises DataError for a picture that claims far more pixels than its `held` bytes can tell, before any is decoded."""
    if not is_plausible(width, height, held):
        raise DataError(
            f"{where}: claims {width} x {height} pixels, {held} bytes of a file can't hold such a picture; export it smaller"
        )


@contextmanager
def open_image(path: Path):  # -> Iterator[PIL.Image.Image]
    """Opens an image whose size is plausible. Raises DataError where it isn't or is known to be something else, and what Pillow
    does for one that is damaged.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        opened = Image.open(_with_alpha_of_webp(path) or path)
    except UnidentifiedImageError:
        if what := known_kind(path):
            raise DataError(f"{path}: not a readable image ({what})") from None
        raise
    except Image.DecompressionBombError as error:
        raise DataError(f"{path}: not a picture of plausible size ({error}); export it smaller") from None
    if opened.format == "TIFF" and opened.tag_v2.get(_PLANES) == _APART:
        opened.close()
        opened = _open_by_libtiff(path)
    with opened as image:
        require_plausible(path, *image.size, path.stat().st_size)
        if (tags := color_tags(path, image.format)) and wide_color.is_wide(*tags):
            image.info[_TAGS] = tags
        elif not tags and "icc_profile" not in image.info:
            _tell_primaries(path, image.info.get("chromaticity", ()))
        _tell_unread_channel(path, image)
        _scale_clear_level(image)
        yield image


def _open_by_libtiff(path: Path):  # -> PIL.Image.Image
    """Opens a TIFF whose channels lie one after the other: Pillow reads those of 16 bits by itself as if they had 8."""
    from PIL import Image, TiffImagePlugin, features

    before = TiffImagePlugin.READ_LIBTIFF
    TiffImagePlugin.READ_LIBTIFF = before or features.check("libtiff")
    try:
        return Image.open(path)
    finally:
        TiffImagePlugin.READ_LIBTIFF = before


def _with_alpha_of_webp(path: Path) -> BytesIO | None:
    """Returns an animated WebP that says it has no alpha with the mark that it has: what none of its pictures covers is clear,
    as in browsers, and Pillow makes it black. None for other files.
    """
    with path.open("rb") as file:
        start = file.read(_WEBP_FLAGS + 1)
        if start[:4] != b"RIFF" or start[8:16] != b"WEBPVP8X" or start[-1] & (_MOVES | _ALPHA) != _MOVES:
            return None
        return BytesIO(start[:-1] + bytes([start[-1] | _ALPHA]) + file.read())


def _scale_clear_level(image) -> None:  # image: PIL.Image.Image
    """Brings the level or color that an opened PNG names as see-through to the scale of its pixels: Pillow scales gray of 2 and 4
    bits and colors of 16 bits to 8, but not that, so that all would be opaque.
    """
    stored = str(image.tile[0][3]) if image.format == "PNG" and image.tile else ""
    clear = image.info.get("transparency")
    if stored in _GRAY_SCALES and isinstance(clear, int):
        image.info["transparency"] = clear * _GRAY_SCALES[stored]
    elif stored == "RGB;16B" and isinstance(clear, tuple):
        image.info["transparency"] = tuple(level >> 8 for level in clear)


def as_rgba(image):  # image: PIL.Image.Image -> PIL.Image.Image
    """Returns a picture that Pillow has just opened with alpha; gray of 16 bits, which Pillow would cut off at 255, is scaled."""
    from PIL import Image

    _scale_clear_level(image)
    if not image.mode.startswith("I"):
        return image.convert("RGBA")
    gray, clear = np.asarray(image).astype(np.int64), image.info.get("transparency")
    level = np.rint(gray / 257).astype(np.uint8)
    return Image.fromarray(np.dstack([level, level, level, np.where(gray == clear, 0, 255).astype(np.uint8)]))


def _tell_primaries(path: Path, xy: Sequence[float]) -> None:
    """Warns of a PNG whose chromaticities (white, red, green, blue) are those of BT.2020, where nothing tells its curve."""
    if len(xy) == 8 and np.abs(np.array(xy[2:]) - _BT2020_XY).max() < 0.002:
        with log.each_once(_SAID):
            log.warn(
                f"{path.parent}: PNGs with primaries of BT.2020 alone (cHRM), as older FFmpeg takes from HDR clips; their colors are"
                " read as sRGB, which makes them pale: give the clip itself, or take frames by FFmpeg 9, which tells all (cICP)"
            )


def _tell_unread_channel(path: Path, image) -> None:  # image: PIL.Image.Image
    """Warns of the further channel of a TIFF that doesn't say what it holds; it may be alpha."""
    if image.format == "TIFF" and 0 in image.tag_v2.get(_EXTRA_SAMPLES, ()) and "A" not in image.mode.upper():
        with log.each_once(_SAID):
            log.warn(
                f"{path.parent}: a further channel of its TIFFs is not declared as alpha (ExtraSamples 0) and is not read; if it is "
                "alpha, export PNG"
            )


def require_one_picture(path: Path, image) -> None:  # image: PIL.Image.Image
    """Raises DataError for a file of several pictures where one is wanted: an animation, or a TIFF of pages of one size.

    A smaller second page is a preview; the second picture of a JPEG is one for other screens.
    """
    if getattr(image, "n_frames", 1) < 2 or image.format not in _OF_SEVERAL:
        return
    if image.format == "TIFF":
        first, _ = image.size, image.seek(1)
        second, _ = image.size, image.seek(0)
        if first != second:
            return
    raise DataError(
        f"{path}: {image.n_frames} pictures in one file; an animation is a clip itself, name it; else write each into an image"
    )


def upright(image):  # image: PIL.Image.Image -> PIL.Image.Image
    """Returns the image turned and mirrored as its EXIF orientation asks for, with straight alpha; itself where there is none.

    Gray of 16 bits whose file has white at 0 is turned round: Pillow does so with 8 bits alone.
    """
    from PIL import Image, ImageOps

    turned = ImageOps.exif_transpose(image)
    if image.mode.startswith("I;16") and getattr(image, "tag_v2", {}).get(_PHOTOMETRIC) == _WHITE_IS_ZERO:
        return Image.fromarray(65535 - np.asarray(turned))
    return turned.convert("LA") if image.mode == "La" else turned


def as_shown(image, info: dict | None = None):  # image: PIL.Image.Image -> PIL.Image.Image
    """Returns the image upright and in sRGB: colors of a wide gamut, of HDR or of print are converted by their ICC profile
    or color tags, a PNG's by the gamma that it names.

    info: what Pillow found in the file of an image that lost it. A damaged profile is passed over, as browsers do.
    """
    image = upright(image)
    info = info or image.info
    profile, tags = info.get("icc_profile"), info.get(_TAGS)
    if tags and not (profile and image.format == "AVIF"):
        return _of_tags(image, *tags)
    if profile:
        return _of_profile(image, profile)
    gamma = info.get("gamma") or _GAMMA
    plain = abs(gamma / _GAMMA - 1) < 0.05 or round(gamma, 5) == _CAMERA_GAMMA
    if "srgb" in info or plain or image.mode not in _COLORS:
        return image
    image = image.convert("RGBA")
    return image.point([*(wide_color.codes_of_gamma(gamma).tolist() * 3), *range(256)])


def _of_tags(image, transfer: int, primaries: int):  # -> PIL.Image.Image
    from PIL import Image

    rgba = np.array(image.convert("RGBA"))
    rgba[..., :3] = wide_color.to_srgb(rgba[..., :3].astype(np.uint16) * 257, transfer, primaries)
    return Image.fromarray(rgba)


def _of_profile(image, profile: bytes):  # -> PIL.Image.Image
    from PIL import ImageCms

    if image.mode not in ("RGB", "RGBA", "CMYK", "P"):
        return image
    try:
        own = ImageCms.ImageCmsProfile(BytesIO(profile))
        if "srgb" in ImageCms.getProfileDescription(own).lower():
            return image
        image = image.convert("RGBA") if image.mode == "P" else image
        mode = "RGBA" if image.mode == "RGBA" else "RGB"
        return ImageCms.profileToProfile(image, own, ImageCms.createProfile("sRGB"), outputMode=mode)
    except (ImageCms.PyCMSError, OSError):
        return image


def one_series(folder: Path, paths: Sequence[Path], option: str = "", quiet: bool = False) -> list[Path]:
    """Returns the images of the one series that `paths` hold, in their order; images without fellows are named and left out.

    Names belong to one series where they differ in numbers alone. option: the one that chooses a series, if any. quiet: nothing
    is told.
    Raises DataError, which names them, when two or more series lie in the folder: they are several objects, or color
    beside depth.
    """
    series: dict[str, list[Path]] = defaultdict(list)
    for path in paths:
        series[re.sub(r"\d+", "#", path.stem)].append(path)
    several = {name: own for name, own in series.items() if len(own) > 1}
    if len(several) > 1:
        found = ", ".join(f"{_pattern(name, own)} ({len(own)} images)" for name, own in list(several.items())[:_NAMED])
        first = next(iter(several.values()))[0]
        pattern = _pattern_of_one(first.name, [path.name for own in list(several.values())[1:] for path in own])
        choose = f"Name one: {option} '{pattern}', or move" if option and pattern else "Move"
        raise DataError(
            f"{folder}: images of {len(several)} series: {found}\n"
            f"{choose} each into a folder of its own and name the one you want: the one that {first.name} belongs to, or another"
        )
    if len(several) == 1 and len(series) > 1:
        kept = next(iter(several.values()))
        others = [own[0].name for own in series.values() if len(own) == 1]
        if len(others) >= len(kept):
            return list(paths)
        if not quiet:
            log.warn(
                f"{folder}: left out {len(others)} of {counted(len(paths), 'image')}, whose names are not like {kept[0].name}: "
                f"{first_names(others, _NAMED)}"
            )
        return kept
    return list(paths)


def refuse_twins(folder: Path, paths: Sequence[Path], advice: str) -> None:
    """Raises DataError where two images differ in their suffixes alone, as pictures and their masks do: each would be a frame."""
    for stem, count in Counter(path.stem for path in paths).items():
        if count > 1:
            raise DataError(f"{folder}: {stem!r} is there with two suffixes; {advice}")


def _pattern_of_one(first: str, others: list[str]) -> str:
    """Returns the pattern that fits the series of a name and none of the `others`; "" where none is as simple."""
    patterns = [re.sub("[0-9]+", digits, first) for digits in ("*", "*[0-9]", "[0-9]*[0-9]")]
    return next((one for one in patterns if not any(fnmatchcase(name, one) for name in others)), "")


def _pattern(name: str, paths: Sequence[Path]) -> str:
    """Returns the name of a series, with a # for each digit of its first image."""
    return re.sub(r"\d", "#", paths[0].stem) + paths[0].suffix if "#" in name else paths[0].name

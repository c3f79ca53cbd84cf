"""Colors of HDR, linear and wide-gamut clips (PQ, HLG, BT.2020, Display P3) brought to sRGB, as players on plain screens do.

The signal becomes light of the screen by ITU-R BT.2100; light above an SDR white of 203 cd/m2 (BT.2408) is bent below it
by the curve of BT.2390, section 5.4.1, whose gain is that of the largest channel, so that hues stay; the primaries
become those of BT.709, and colors outside of them are clipped.
"""

from __future__ import annotations

from functools import cache

import numpy as np

LINEAR, PQ, HLG = 8, 16, 18  # transfer functions, by their number in H.273
_BT2020, _DISPLAY_P3 = 9, 12  # primaries, likewise
_BT709_XY = ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06))
_PRIMARIES_XY = {
    _BT2020: ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046)),
    _DISPLAY_P3: ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060)),
}
_WHITE_XY = (0.3127, 0.3290)
_SDR_WHITE, _PEAK = 203.0, 1000.0  # cd/m2; what HLG is made for, and most PQ is mastered at
_LUMINANCE = np.array([0.2627, 0.6780, 0.0593], np.float32)  # of BT.2020
_LEVELS = 65_536
_KNOTS = 4096


def is_wide(transfer: int, primaries: int) -> bool:
    """Returns whether a clip of this transfer function and these primaries (numbers of H.273) isn't shown as stored."""
    return transfer in (LINEAR, PQ, HLG) or primaries in _PRIMARIES_XY


def to_srgb(rgb: np.ndarray, transfer: int, primaries: int) -> np.ndarray:
    """Returns u8 (...,3) in sRGB of a full-range signal, u16 (...,3), of this transfer function and these primaries.

    HDR without a word on its primaries is of BT.2020.
    """
    light = _light(transfer)[rgb]
    if transfer == HLG:  # the OOTF of a screen of 1000 cd/m2
        light *= (light @ _LUMINANCE)[..., None] ** 0.2 * (_PEAK / _SDR_WHITE)
    if transfer in (PQ, HLG):
        primaries = primaries if primaries in _PRIMARIES_XY else _BT2020
        light *= np.interp(light.max(-1), *_gains())[..., None].astype(np.float32)
    light = light @ _to_bt709(primaries).T
    return _srgb_codes()[np.round(light.clip(0, 1) * (_LEVELS - 1)).astype(np.uint16)]


def codes_of_gamma(gamma: float) -> np.ndarray:
    """Returns the sRGB codes, u8 (256), of levels that a PNG of this gamma (1: linear) stores."""
    light = np.linspace(0, 1, 256) ** (1 / gamma)
    return _srgb_codes()[np.round(light * (_LEVELS - 1)).astype(np.uint16)]


def pq_light(signal: np.ndarray) -> np.ndarray:
    """Returns cd/m2 of PQ signals 0..1: the EOTF of BT.2100, table 4."""
    root = np.asarray(signal, np.float64) ** (1 / 78.84375)
    return 10_000 * (np.maximum(root - 0.8359375, 0) / (18.8515625 - 18.6875 * root)) ** (1 / 0.1593017578125)


def pq_signal(light: np.ndarray) -> np.ndarray:
    """Returns the PQ signal 0..1 of light in cd/m2: the inverse EOTF of BT.2100, table 4."""
    power = (np.asarray(light, np.float64) / 10_000) ** 0.1593017578125
    return ((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power)) ** 78.84375


def hlg_scene_light(signal: np.ndarray) -> np.ndarray:
    """Returns the light of the scene, 0..1, of HLG signals 0..1: the inverse OETF of BT.2100, table 5."""
    a = 0.17883277
    b, c = 1 - 4 * a, 0.5 - a * np.log(4 * a)
    signal = np.asarray(signal, np.float64)
    return np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)


def tone_curve(light: np.ndarray) -> np.ndarray:
    """Returns cd/m2 up to the SDR white for cd/m2 up to the peak: the EETF of BT.2390, by its Hermite spline."""
    peak = pq_signal(_PEAK)
    signal, top = np.minimum(pq_signal(light) / peak, 1), pq_signal(_SDR_WHITE) / peak
    knee = 1.5 * top - 0.5
    t = np.maximum(signal - knee, 0) / (1 - knee)
    bent = (2 * t**3 - 3 * t**2 + 1) * knee + (t**3 - 2 * t**2 + t) * (1 - knee) + (3 * t**2 - 2 * t**3) * top
    return pq_light(np.where(signal < knee, signal, bent) * peak)


@cache
def _light(transfer: int) -> np.ndarray:
    """Returns the light of each level of a signal, f32 (65536): 1 is the SDR white, in HLG the scene's peak."""
    signal = np.linspace(0, 1, _LEVELS)
    if transfer == PQ:
        light = pq_light(signal) / _SDR_WHITE
    elif transfer == HLG:
        light = hlg_scene_light(signal)
    elif transfer == LINEAR:
        light = signal
    else:
        light = np.where(signal <= 0.04045, signal / 12.92, ((signal + 0.055) / 1.055) ** 2.4)
    return light.astype(np.float32)


@cache
def _gains() -> tuple[np.ndarray, np.ndarray]:
    """Returns light, 1 the SDR white, and by how much the tone curve multiplies it."""
    light = np.linspace(0, pq_light(1.0) / _SDR_WHITE, _KNOTS * 10 + 1)
    return light, np.divide(
        tone_curve(light * _SDR_WHITE) / _SDR_WHITE, light, out=np.ones_like(light), where=light > 0
    )


@cache
def _to_bt709(primaries: int) -> np.ndarray:
    """Returns the matrix f32 (3,3) from linear RGB of these primaries to that of BT.709."""
    ours = _PRIMARIES_XY.get(primaries, _BT709_XY)
    return (np.linalg.inv(_to_xyz(_BT709_XY)) @ _to_xyz(ours)).astype(np.float32)


def _to_xyz(corners: tuple[tuple[float, float], ...]) -> np.ndarray:
    """Returns the matrix (3,3) from linear RGB to CIE XYZ, of chromaticities (x,y) of red, green and blue under D65."""
    red_green_blue = np.array([[x / y, 1, (1 - x - y) / y] for x, y in corners]).T
    x, y = _WHITE_XY
    return red_green_blue * np.linalg.solve(red_green_blue, [x / y, 1, (1 - x - y) / y])


@cache
def _srgb_codes() -> np.ndarray:
    """Returns the sRGB code, u8 (65536), of each level of linear light."""
    light = np.linspace(0, 1, _LEVELS)
    signal = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return (255 * signal).round().astype(np.uint8)

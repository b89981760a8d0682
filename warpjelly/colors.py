"""The force colour map: raspberry jelly at rest, glowing through orange to yellow where the forces are.

Ten anchors of Matplotlib's plasma (CC0; by Nathaniel Smith and Stéfan van der Walt), its part from 7/16 to 1,
interpolated to 256 entries. Lightness rises evenly along it, so it also reads in grey and with colour blindness.
"""

from __future__ import annotations

import numpy as np

COLOR_MAP = "plasma (upper 9/16)"
COLOR_COUNT = 256

_ANCHORS = "bc3587 cc4778 da5a6a e66c5c f0804e f89540 fdac33 fdc527 f8df25 f0f921"


def linear_from_srgb(srgb: np.ndarray) -> np.ndarray:
    """Decode sRGB in 0 to 1 into linear Rec.709, any shape."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(linear: np.ndarray) -> np.ndarray:
    """Encode linear Rec.709 as sRGB in 0 to 1, any shape; what is outside is clipped."""
    linear = np.clip(linear, 0.0, 1.0)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)


def _interpolated() -> np.ndarray:
    anchors = np.array([list(bytes.fromhex(color)) for color in _ANCHORS.split()]) / 255.0
    at = np.linspace(0, len(anchors) - 1, COLOR_COUNT)
    return np.stack([np.interp(at, np.arange(len(anchors)), channel) for channel in anchors.T], axis=1)


# From no force to the most, [COLOR_COUNT, 3] in 0 to 1. USD's displayColor is linear.
SRGB_TABLE = _interpolated().astype(np.float32)
LINEAR_TABLE = linear_from_srgb(_interpolated()).astype(np.float32)


def color_indices(force: np.ndarray, force_range: tuple[float, float]) -> np.ndarray:
    """Return where forces fall in the colour table, int32 [n]; what is outside the range gets the end colours.

    Args:
        force: magnitudes [n], N.
        force_range: forces at both ends of the table, N; the first below the second.
    """
    low, high = force_range
    position = (np.asarray(force, dtype=np.float32) - np.float32(low)) * np.float32((COLOR_COUNT - 1) / (high - low))
    # Unlike clip, fmin and fmax leave no NaN behind, which as an index would be far outside the table.
    return np.rint(np.fmax(np.fmin(position, COLOR_COUNT - 1), 0)).astype(np.int32)


def range_in_words(force_range: tuple[float, float]) -> tuple[str, str]:
    """Return the forces at both ends of the table as people write them: three digits, and 0 for next to nothing."""
    low, high = force_range
    nothing = max(abs(low), abs(high)) / 1000
    return _number(0.0 if abs(low) < nothing else low), _number(0.0 if abs(high) < nothing else high)


def _number(value: float) -> str:
    rounded = f"{value:.2e}"
    digits, exponent = rounded.split("e")
    if -4 <= int(exponent) < 6:
        return f"{float(rounded):,.6f}".rstrip("0").rstrip(".")
    return f"{float(digits):g}e{int(exponent)}"


# Structural, face shear, body shear and bend springs, told apart by people who see colours differently, too
# (M. Okabe and K. Ito, Color Universal Design, 2008).
_KINDS = "0072b2 e69f00 e69f00 009e73"
KIND_COLORS = linear_from_srgb(np.array([list(bytes.fromhex(color)) for color in _KINDS.split()]) / 255.0)

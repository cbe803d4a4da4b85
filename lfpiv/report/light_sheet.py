"""Find the edges of a light sheet inside a volume and its contrast, the brightness inside over that outside.

Outside the sheet there are no particles, so all intensity reconstructed there is due to ghosts. Tomographic PIV judges
reconstructions of real images by this contrast; values above 2 are commonly required.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

ENOUGH = 2.0
"""Contrast of an acceptable reconstruction."""

_CONTRAST = 1.4  # smallest contrast of a sheet
_EXPLAINED = 0.8  # smallest share of the profile's variance that the two levels explain
_EDGE = 0.1  # margin on either side of an edge that counts to neither level, in thicknesses of the sheet
_FEWEST, _LEAST = 3, 0.08  # smallest number of planes outside the sheet, and their smallest share of the depth
_AT_END = 0.25  # smallest thickness of a sheet that reaches an end of the volume, as a share of the depth


@dataclass(frozen=True, kw_only=True)
class LightSheet:
    """A light sheet with at least one edge inside the volume."""

    low_mm: float
    high_mm: float
    """Edges along z [mm], halfway between planes; the edge of the volume where the sheet continues beyond it."""
    inside: float
    outside: float
    """Mean brightness inside and outside the sheet [counts], without the planes near its edges."""

    @property
    def ratio(self) -> float:
        """Return the brightness inside over that outside."""
        return self.inside / max(self.outside, 1e-30)


def find_sheet(z_mm: np.ndarray, profile: np.ndarray) -> LightSheet | None:
    """Find the light sheet in the mean brightness over the depth.

    Parameters
    ----------
    z_mm : ndarray, shape (plane,)
        Depth of the planes [mm], evenly spaced, ascending.
    profile : ndarray, shape (plane,)
        Mean brightness of each plane [counts].

    Returns
    -------
    LightSheet or None
        The interval of planes that, as one level above another, fits the profile best in least squares. None where
        this interval is no clear light sheet.
    """
    n = len(profile)
    total = np.concatenate([[0.0], np.cumsum(profile, dtype=float)])
    low, high = np.triu_indices(n + 1, 1)
    low, high = low[high - low < n], high[high - low < n]
    if not len(low):
        return None
    count, light = high - low, total[high] - total[low]
    inside, outside = light / count, (total[n] - light) / (n - count)
    overall = total[n] / n
    between = count * (inside - overall) ** 2 + (n - count) * (outside - overall) ** 2
    best = int(np.argmax(np.where(inside > outside, between, -1.0)))
    variance = float(((profile - overall) ** 2).sum())
    if not (variance > 0 and between[best] > _EXPLAINED * variance and inside[best] > _CONTRAST * outside[best]):
        return None
    first, end, planes = int(low[best]), int(high[best]), np.arange(n)
    edges = [edge for edge in (first, end) if 0 < edge < n]
    if len(edges) == 1 and end - first < _AT_END * n:
        return None
    margin = max(round(_EDGE * (end - first)), 1)
    clear = np.all([(planes < edge - margin) | (planes >= edge + margin) for edge in edges], axis=0)
    within = (planes >= first) & (planes < end)
    if np.count_nonzero(~within & clear) < max(_FEWEST, _LEAST * n):
        return None
    core = within & clear if (within & clear).any() else within
    step = (z_mm[-1] - z_mm[0]) / (n - 1)
    return LightSheet(
        low_mm=float(z_mm[first] - step / 2),
        high_mm=float(z_mm[end - 1] + step / 2),
        inside=float(profile[core].mean()),
        outside=float(profile[~within & clear].mean()),
    )

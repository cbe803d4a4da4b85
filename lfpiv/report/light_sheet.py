"""Where a light sheet ends inside a volume, and how much brighter the volume is inside it than outside.

Outside the sheet there are no particles: all light that a reconstruction puts there is ghosts. The ratio of the mean
brightness inside to that outside is how tomographic PIV judges a reconstruction whose truth nobody knows; 2 is commonly
asked for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

ENOUGH = 2.0
"""Ratio of the brightness inside to that outside that a good reconstruction reaches."""

_CONTRAST = 1.4  # lower ones are also met where particles happen to be uneven over the depth
_EXPLAINED = 0.8  # of the variance of the profile by two levels; a slope reaches 0.75, uneven particles 0.5
_EDGE = 0.1  # of the sheet's thickness on either side of an edge belongs to neither level
_FEWEST, _LEAST = 3, 0.08  # planes outside, and their share of the depth; fewer are how any volume ends
_AT_END = 0.25  # of the depth; a thinner bright part at the volume's end is light from beyond it


@dataclass(frozen=True, kw_only=True)
class LightSheet:
    """A light sheet that ends inside the volume, at one side at least."""

    low_mm: float
    high_mm: float
    """Its edges along z [mm], halfway between planes; the volume's own edge where it goes on beyond that."""
    inside: float
    outside: float
    """Mean brightness inside and outside it [counts], without the planes about its edges."""

    @property
    def ratio(self) -> float:
        """Brightness inside over that outside."""
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
        The interval of planes whose mean, with the mean of the others, comes nearest to the profile; None where that is
        no bright interval on a dark ground.
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

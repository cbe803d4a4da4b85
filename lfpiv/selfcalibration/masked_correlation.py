"""Correlation of a window of volumes with other volumes, of which only the voxels inside both count."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.fft

LEAST_OVERLAP = 0.6
"""Least share of a window that must lie within the other volume at a lag."""


def mirrored_window(window: tuple[slice, ...], shape: tuple[int, ...], axes: tuple[int, ...]) -> tuple[slice, ...]:
    """Return the window of the same voxels in a volume that is mirrored along axes."""
    return tuple(
        slice(n - part.stop, n - part.start) if axis in axes else part
        for axis, (part, n) in enumerate(zip(window, shape, strict=True))
    )


def masked_correlation(
    first: Sequence[np.ndarray],
    second: Sequence[np.ndarray],
    window: tuple[slice, ...],
    centre: Sequence[int] | np.ndarray = (0, 0, 0),
    *,
    reach: int,
) -> np.ndarray:
    """Correlate a window of volumes with other volumes at every lag: masked normalised cross-correlation [1]_.

    At each lag only voxels inside both volumes count.

    Parameters
    ----------
    first, second : sequence of ndarray, shape (z, y, x)
        Volumes of some instants. Their products are summed over the instants.
    window : tuple of slice
        Voxels of `first`.
    centre : sequence of int
        Middle one of the lags (z, y, x) [voxel].
    reach : int
        Largest distance from it along each axis [voxel].

    Returns
    -------
    ndarray, shape (2 reach + 1,) * 3
        Correlation coefficients, lag `centre` - `reach` first; 0 where less than `LEAST_OVERLAP` of the window counts.

    References
    ----------
    .. [1] D. Padfield, "Masked object registration in the Fourier domain", IEEE Trans. Image Process. 21 (2012)
       2706-2718, doi:10.1109/TIP.2011.2181402.
    """
    inner = tuple(part.stop - part.start for part in window)
    shape = [scipy.fft.next_fast_len(n + 2 * reach, real=True) for n in inner]

    def around(volume: np.ndarray) -> np.ndarray:
        out = np.zeros([n + 2 * reach for n in inner])
        start = [part.start + lag - reach for part, lag in zip(window, centre, strict=True)]
        low = [max(first, 0) for first in start]
        high = [max(min(a + n, m), b) for a, n, m, b in zip(start, out.shape, volume.shape, low, strict=True)]
        to = tuple(slice(b - a, c - a) for a, b, c in zip(start, low, high, strict=True))
        out[to] = volume[tuple(slice(b, c) for b, c in zip(low, high, strict=True))]
        return out

    def spectrum(values: np.ndarray) -> np.ndarray:
        transformed: np.ndarray = scipy.fft.rfftn(values, shape)
        return transformed

    def summed(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        lags: np.ndarray = scipy.fft.irfftn(a.conj() * b, shape)
        return lags[tuple(slice(0, 2 * reach + 1) for _ in shape)]

    whole, known = spectrum(np.ones(inner)), spectrum(around(np.ones(second[0].shape)))
    count = np.maximum(summed(whole, known), 1.0)
    products, spread, other = (np.zeros(count.shape) for _ in range(3))
    for one, two in zip(first, second, strict=True):
        a = one[window].astype(float)
        b = around(two)
        a, b = a / max(a.std(), np.finfo(float).tiny), b / max(b.std(), np.finfo(float).tiny)
        a_, b_ = spectrum(a), spectrum(b)
        sum_a, sum_b = summed(a_, known), summed(whole, b_)
        products += summed(a_, b_) - sum_a * sum_b / count
        spread += summed(spectrum(a * a), known) - sum_a**2 / count
        other += summed(whole, spectrum(b * b)) - sum_b**2 / count
    scale = np.sqrt(np.maximum(spread, 0) * np.maximum(other, 0))
    enough = (count >= LEAST_OVERLAP * count.max()) & (scale > 1e-9 * scale.max())
    coefficient: np.ndarray = np.divide(products, scale, out=np.zeros_like(scale), where=enough)
    return coefficient

"""Measure whether the microimages of an image are turned, or farther apart, against the white image's lattice.

Each tile of lenses shows its own shift. A turn and a change of pitch shift the tiles in proportion to their distance
from the sensor's centre. The turn and the pitch that make the sum of all tiles most like the white image are sought on
one half of the tiles and judged on the other half.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import optimize

FEWEST_TILES = 16
"""Least number of lit tiles that can tell a turn from the parts of the pupil that single particles light."""

LEAST_EDGE = 0.1
"""Least displacement at the sensor's corner that counts [microlens pitch]."""

_HARMONICS = 3  # harmonics of a cell along each lattice vector
_EDGES = np.arange(-4, 4.1, 0.25)  # displacements at the sensor's corner that are tried [microlens pitch]
_STARTS = 12  # places of a cell along each lattice vector from which the shift is sought


@dataclass(frozen=True, kw_only=True)
class LatticeStretch:
    """Turn and change of pitch of an image's microimages, and how alike both halves of its tiles become."""

    edge_pitch: tuple[float, float]
    """Displacement at the sensor's corner by the turn and by the change of pitch [microlens pitch]."""
    turn_deg: float
    """Turn from the columns to the rows [degree]."""
    widening: float
    """Relative change of pitch."""
    likeness: float
    """Correlation of the folds by the stretch that the other half of the tiles shows."""
    unstretched: float
    """The same without a stretch or shift, or with the opposite ones, which blur the folds as much, if that is more."""

    @property
    def gain(self) -> float:
        """Gain of likeness, 0 where the displacement at the corner is too small to count."""
        return self.likeness - self.unstretched if np.hypot(*self.edge_pitch) > LEAST_EDGE else 0.0

    @property
    def sentence(self) -> str:
        """What fits: a clause with the turn and the change of pitch."""
        apart = "farther apart" if self.widening > 0 else "closer together"
        return (
            f"it fits microimages turned by {self.turn_deg:.2f} degrees and {abs(self.widening):.2%} {apart}: the "
            "array was turned, or the main lens refocused, after the white image"
        )


def fit_stretch(
    image: np.ndarray,
    white: np.ndarray,
    pixels: np.ndarray,
    centres: np.ndarray,
    basis: np.ndarray,
    half_diagonal: float,
) -> LatticeStretch | None:
    """Fit the turn and the change of pitch of an image's microimages.

    Parameters
    ----------
    image, white, pixels : ndarray, shape (tile, bins, bins)
        Folds of the image and of the white image on one cell, and the number of pixels.
    centres : ndarray, shape (tile, 2)
        Centre of each tile, relative to the sensor's centre, as (column, row) [half diagonal].
    basis : ndarray, shape (2, 2)
        Lattice vectors on the sensor, rows (column, row) [pixel].
    half_diagonal : float
        Half of the sensor's diagonal [pixel].

    Returns
    -------
    LatticeStretch or None
        None where fewer than `FEWEST_TILES` tiles are lit.
    """
    if len(image) < FEWEST_TILES:
        return None
    pitch = float(np.hypot(*basis[0]))
    turned, widened = (part * pitch @ np.linalg.inv(basis) for part in (centres[:, ::-1] * (-1, 1), centres))
    order = _harmonics()
    light, plain = (_spectra(part, pixels, order) for part in (image, white))
    shifts = [2 * np.pi * part @ order.T for part in (turned, widened)]
    half = np.random.default_rng(0).permutation(len(image)) % 2 == 0
    fits = [_Half(light[part], plain[part], order, [shift[part] for shift in shifts]) for part in (half, ~half)]
    found = [fit.best() for fit in fits]
    turn, widen = np.mean([place[:2] for place in found], axis=0)
    judged = list(zip(fits, found[::-1], strict=True))
    return LatticeStretch(
        edge_pitch=(float(turn), float(widen)),
        turn_deg=float(np.degrees(turn * pitch / half_diagonal)),
        widening=float(widen * pitch / half_diagonal),
        likeness=float(np.mean([fit.likeness(place) for fit, place in judged])),
        unstretched=float(np.mean([max(fit.likeness(sign * place) for sign in (0, -1)) for fit, place in judged])),
    )


@dataclass(frozen=True)
class _Half:
    """Harmonics of some tiles of an image and of the white image."""

    light: np.ndarray
    plain: np.ndarray
    order: np.ndarray
    shifts: list[np.ndarray]

    def likeness(self, place: np.ndarray) -> float:
        """Return the correlation of both folds by turn, change of pitch and shift of the image."""
        turn, widen, *shift = place
        light = (self.light * np.exp(1j * (turn * self.shifts[0] + widen * self.shifts[1]))).sum(axis=0)
        plain = self.plain.sum(axis=0) * np.exp(-2j * np.pi * self.order @ np.array(shift))
        return float((light * plain.conj()).real.sum() / max(np.linalg.norm(light) * np.linalg.norm(plain), 1e-30))

    def best(self) -> np.ndarray:
        """Return turn, change of pitch and shift with the highest correlation."""
        turned, widened = (np.exp(1j * np.multiply.outer(_EDGES, shift)).transpose(2, 0, 1) for shift in self.shifts)
        light = (turned * self.light.T[:, None]) @ widened.swapaxes(1, 2)  # (harmonic, turn, widen)
        steps = np.arange(_STARTS) / _STARTS
        starts = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
        cross = light * self.plain.sum(axis=0).conj()[:, None, None]
        alike = np.tensordot(np.exp(2j * np.pi * starts @ self.order.T), cross, 1).real / np.linalg.norm(light, axis=0)
        start, turn, widen = np.unravel_index(int(alike.argmax()), alike.shape)
        place = np.array([_EDGES[turn], _EDGES[widen], *starts[start]])
        fit = optimize.minimize(lambda place: -self.likeness(place), place, method="BFGS")
        return fit.x


def _harmonics() -> np.ndarray:
    """Return the orders of the harmonics of a cell, one of each conjugate pair, shape (harmonics, 2)."""
    order = np.arange(-_HARMONICS, _HARMONICS + 1)
    rows, columns = (part.ravel() for part in np.meshgrid(order, order, indexing="ij"))
    return np.stack([rows, columns], axis=-1)[(rows > 0) | ((rows == 0) & (columns > 0))]


def _spectra(part: np.ndarray, pixels: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Return harmonics of each tile's fold about its mean level, shape (tile, harmonics)."""
    level = part.sum(axis=(1, 2), keepdims=True) / np.maximum(pixels.sum(axis=(1, 2), keepdims=True), 1)
    return np.fft.fft2(part - level * pixels)[:, order[:, 0], order[:, 1]]

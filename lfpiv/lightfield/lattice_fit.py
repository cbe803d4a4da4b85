"""Compare where an image's light lies under the microlenses with the microimages of the white image.

The light of an image is folded onto one cell of the white image's lattice. So is the white image, with each lens as
bright as in the image. The folds agree up to a shift, which is 0 if both were recorded through the same array.
A particle lights a part of each microimage, and the parts of all its lenses make up a whole one: few particles suffice.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from lfpiv.lightfield.decoder import LightFieldDecoder
from lfpiv.lightfield.lattice_stretch import LatticeStretch, fit_stretch

LARGEST_SHIFT = 0.05
"""Shift of an image's light from the microimages up to which both agree [microlens pitch]."""
ERRORS = 5.0
"""The same in standard errors."""
LEAST_LIKENESS = 0.7
"""Correlation of the two folds at the shift that fits best, below which the image shows no microimages."""

MOVED = "the array moved, or another region of the sensor was recorded, after the white image"
"""What fits where a shift does."""

_BINS = 16  # bins of a cell along each lattice vector
_FINER = 8  # parts of a bin to which the shift is read
_TILE_LENSES = 6  # side of a tile: about the lenses that see one particle
_PIXELS = 400_000  # pixels of the tiles that are folded, at most about
_CLIP_PERCENTILE = 99.9  # percentile at which pixels are clipped
_WHOLE_LENS = 0.3  # least white light of a lens, relative to the median
_FEWEST_TILES = 4  # least number of lit tiles
_DRAWS = 40  # draws of the tiles that give the standard error
_GAIN = 0.02  # least gain of likeness by a shift: microimages of unlike width agree over a range of shifts
_ALIKE = 0.03  # loss of likeness up to which a hypothesis fits as well as a shift


@dataclass(frozen=True, kw_only=True)
class LatticeFit:
    """Shift between an image's light and the microimages of a white image."""

    shift_px: tuple[float, float]
    """Along columns and rows, within one cell of the lattice [pixel]."""
    shift_pitch: float
    """Its length [microlens pitch]."""
    error_pitch: float
    """Its standard error [microlens pitch], 0 where the shift is too small to need one."""
    likeness: float
    """Correlation of the two folds at that shift."""
    unshifted: float
    """Correlation of the two folds without a shift."""

    @property
    def shifted(self) -> bool:
        """Whether the image's light certainly lies beside the microimages of the white image.

        A shift explains more than half of their unlikeness. Light that fills the pupil unevenly moves the maximum, too,
        but makes them little more alike.
        """
        limit = max(LARGEST_SHIFT, ERRORS * self.error_pitch)
        gain = self.likeness - self.unshifted
        explained = self.likeness > LEAST_LIKENESS and gain > max(_GAIN, 1 - self.likeness)
        return explained and self.shift_pitch > limit


@dataclass(frozen=True, kw_only=True)
class _Folding:
    """Pixels of the tiles that are folded: their place in the image, lens and bin."""

    pixels: np.ndarray
    lens: np.ndarray
    bins: np.ndarray
    tiles: int
    white: np.ndarray
    """Response of each pixel to white light."""
    white_light: np.ndarray
    """Sum of it for each lens, 0 for a lens that is not seen as a whole."""
    basis: np.ndarray
    """Lattice vectors on the sensor, rows (column, row) [pixel]."""
    places: np.ndarray
    """Place of each pixel, relative to the sensor's centre, rows (column, row) [half diagonal]."""
    half_diagonal: float
    """Half of the sensor's diagonal [pixel]."""


Cells = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Folds of the image and of the white image, and the number of pixels, each (tile, bins, bins)."""

_foldings: WeakKeyDictionary[LightFieldDecoder, _Folding] = WeakKeyDictionary()


def fit_lattice(light: np.ndarray, decoder: LightFieldDecoder) -> LatticeFit | None:
    """Measure the shift between an image's light and the microimages of the white image.

    Parameters
    ----------
    light : ndarray, shape (rows, columns)
        Image without its dark level [counts].
    decoder : LightFieldDecoder
        The camera's decoder, made from its white image.

    Returns
    -------
    LatticeFit or None
        None where too few lenses are lit.
    """
    folding = _folding_of(decoder)
    cells, _ = _fold(light, folding)
    return _fit(cells, folding, decoder) if len(cells[0]) >= _FEWEST_TILES else None


def _fit(cells: Cells, folding: _Folding, decoder: LightFieldDecoder) -> LatticeFit:
    """Measure the shift between the folds of an image and of the white image."""
    correlation = _correlate(*cells)
    shift, likeness = _highest(correlation)
    vectors = folding.basis / decoder.optics.microimage_pitch_px
    same = shift + np.stack(np.meshgrid((-1, 0, 1), (-1, 0, 1)), axis=-1).reshape(-1, 2)
    shift = same[np.hypot(*(same @ vectors).T).argmin()]
    length, error = float(np.hypot(*(shift @ vectors))), 0.0
    if length > LARGEST_SHIFT:
        rng = np.random.default_rng(0)
        draws = (rng.integers(0, len(cells[0]), len(cells[0])) for _ in range(_DRAWS))
        drawn = [_highest(_correlate(*(cell[draw] for cell in cells)))[0] for draw in draws]
        error = float(np.sqrt(np.mean(((((np.array(drawn) - shift + 0.5) % 1 - 0.5) @ vectors) ** 2).sum(axis=1))))
    column, row = map(float, shift @ folding.basis)
    return LatticeFit(
        shift_px=(column, row),
        shift_pitch=length,
        error_pitch=error,
        likeness=likeness,
        unshifted=float(correlation[0, 0]),
    )


def disagreement(
    light: np.ndarray,
    decoder: LightFieldDecoder,
    others: Mapping[str, LightFieldDecoder] | None = None,
    *,
    misplaced: bool = False,
) -> dict[str, Any] | None:
    """Return by how far an image's light lies beside the white image's microimages, and what fits; None for nowhere.

    Parameters
    ----------
    light, decoder
        As for `fit_lattice`.
    others : mapping of str to LightFieldDecoder, optional
        Decoders of the other cameras.
    misplaced : bool
        Whether the image is known not to fit, at no shift perhaps, as that of an array turned or of another pitch.

    Returns
    -------
    dict or None
        ``fit``, a clause; ``shift_px`` and ``shift_pitch``, if the image fits when it is shifted.
    """
    folding = _folding_of(decoder)
    cells, centres = _fold(light, folding)
    if len(cells[0]) < _FEWEST_TILES:
        return None
    found = _fit(cells, folding, decoder)
    alike = found.shifted or found.unshifted > 1 - _GAIN
    stretch = None if alike else _stretch(cells, centres, folding)
    if not (found.shifted or stretch or misplaced):
        return None
    likeness = _hypotheses(light, decoder, others or {})
    if stretch is not None:
        likeness[stretch.sentence] = stretch.likeness
    best = max([found.likeness, *likeness.values()])
    fits = [what for what, value in likeness.items() if value > best - _ALIKE]
    if found.likeness > LEAST_LIKENESS:
        fits.append(("or " if fits else "") + MOVED)
    if not fits:
        return None
    shift = {"shift_px": float(np.hypot(*found.shift_px)), "shift_pitch": found.shift_pitch}
    return (shift if found.likeness > LEAST_LIKENESS else {}) | {"fit": ", ".join(fits)}


def _hypotheses(
    light: np.ndarray, decoder: LightFieldDecoder, others: Mapping[str, LightFieldDecoder]
) -> dict[str, float]:
    """Return what makes the image's light fit, and how well: its mirror images and turns, and the other cameras."""
    hypotheses = [
        *((f"{how} it fits", turned, decoder) for how, turned in _turned(light)),
        *((f"it fits the white image of camera {name}", light, other) for name, other in others.items()),
    ]
    likeness = {}
    for what, image, lattice in hypotheses:
        fit = fit_lattice(image, lattice) if image.shape == lattice.gain.shape else None
        if fit is not None and not fit.shifted and fit.unshifted > LEAST_LIKENESS:
            likeness[what] = fit.unshifted
    return likeness


def _stretch(cells: Cells, centres: np.ndarray, folding: _Folding) -> LatticeStretch | None:
    """Return the turn and the change of pitch that lay the image's microimages on the white image's."""
    stretch = fit_stretch(*cells, centres, folding.basis, folding.half_diagonal)
    if stretch is None or stretch.likeness < LEAST_LIKENESS or stretch.gain < max(_GAIN, 1 - stretch.likeness):
        return None
    return stretch


def _turned(light: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """Return an image in its mirror images and, of a square sensor, in its turns, each with a name."""
    ways = [
        ("if it is mirrored left to right", light[:, ::-1]),
        ("if it is mirrored upside down", light[::-1]),
        ("if it is turned by 180 degrees", light[::-1, ::-1]),
    ]
    if light.shape[0] == light.shape[1]:
        ways += [
            ("if it is turned by 90 degrees", np.rot90(light)),
            ("if it is turned by -90 degrees", np.rot90(light, -1)),
            ("if it is mirrored at a diagonal", light.T),
            ("if it is mirrored at the other diagonal", light[::-1, ::-1].T),
        ]
    return ways


def _folding_of(decoder: LightFieldDecoder) -> _Folding:
    """Return the tiles of a decoder, chosen at its first use."""
    if decoder not in _foldings:
        _foldings[decoder] = _folding(decoder)
    return _foldings[decoder]


def _folding(decoder: LightFieldDecoder) -> _Folding:
    """Choose tiles of lenses, evenly spread over the sensor, and find lens and bin of their pixels."""
    index = decoder.lens_index - decoder.lens_index.min((0, 1))
    count = int(index[..., 1].max()) + 1
    tile = index // _TILE_LENSES
    step = max(1, round((decoder.gain.size / _PIXELS) ** 0.5))
    pixels = np.flatnonzero((tile % step == 0).all(axis=-1))
    index, tile = (part.reshape(-1, 2)[pixels].astype(np.int64) for part in (index, tile // step))
    across = int(tile[:, 1].max()) + 1
    scale = decoder.optics.sensor_per_pupil
    basis = np.asarray(decoder.lattice.basis_mm) * (1 + scale)
    offset = decoder.pupil_mm.reshape(-1, 2)[pixels] @ (-scale * np.linalg.inv(basis)).astype(np.float32)
    place = (np.floor(offset % 1 * _BINS).astype(np.int64) % _BINS) @ [_BINS, 1]
    lens = index @ [count, 1]
    white = (decoder.gain * decoder.coverage).ravel()[pixels]
    tile_of, tiles = tile @ [across, 1], int((tile @ [across, 1]).max()) + 1
    total = np.bincount(lens, white)
    whole = total > _WHOLE_LENS * np.median(total[total > 0])
    return _Folding(
        pixels=pixels,
        lens=lens,
        bins=tile_of * _BINS**2 + place,
        tiles=tiles,
        white=white,
        white_light=np.where(whole, total, 0),
        basis=basis / decoder.optics.pixel_mm,
        places=_places(pixels, decoder.gain.shape),
        half_diagonal=float(np.hypot(*decoder.gain.shape)) / 2,
    )


def _places(pixels: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the places of pixels, relative to the sensor's centre, over its half diagonal, shape (2, pixels)."""
    rows, columns = np.divmod(pixels, shape[1])
    middle = (np.array([[shape[1]], [shape[0]]]) - 1) / 2
    return (np.stack([columns, rows]) - middle) / (np.hypot(shape[0], shape[1]) / 2)


def _fold(light: np.ndarray, folding: _Folding) -> tuple[Cells, np.ndarray]:
    """Fold an image, and the white image with lenses as bright, onto the cell of each tile that is lit.

    Returns
    -------
    cells : (ndarray, ndarray, ndarray), each of shape (tile, bins, bins)
        Sums of light of the image and the white image [counts], and the number of pixels.
    centres : ndarray, shape (tile, 2)
        Centre of each tile's light, relative to the sensor's centre, as (column, row) [half diagonal].
    """
    light = light.ravel()[folding.pixels]
    clip = float(np.percentile(light, _CLIP_PERCENTILE))
    light = np.clip(light, -clip, clip)
    level, total = np.bincount(folding.lens, light), folding.white_light
    level = np.divide(np.maximum(level, 0), total, out=np.zeros_like(level), where=total > 0)[folding.lens]
    lit = level > 0
    bins, size = folding.bins[lit], folding.tiles * _BINS**2
    parts = light[lit], (folding.white * level)[lit], None
    image, white, pixels = (np.bincount(bins, part, size).reshape(-1, _BINS, _BINS) for part in parts)
    kept = white.sum(axis=(1, 2)) > 0
    tile, bright = bins // _BINS**2, parts[1]
    moments = np.stack([np.bincount(tile, bright * place[lit], folding.tiles)[kept] for place in folding.places], -1)
    return (image[kept], white[kept], pixels[kept]), moments / white[kept].sum(axis=(1, 2))[:, None]


def _correlate(image: np.ndarray, white: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return the correlation of both folds at each shift of the image, shape (bins, bins)."""
    count = np.maximum(pixels.sum(axis=0), 1)
    folds = [part.sum(axis=0) / count for part in (image, white)]
    first, second = (fold - fold.mean() for fold in folds)
    power = float((first**2).sum() * (second**2).sum()) ** 0.5
    return np.fft.ifft2(np.fft.fft2(first) * np.fft.fft2(second).conj()).real / max(power, 1e-30)


def _highest(correlation: np.ndarray) -> tuple[np.ndarray, float]:
    """Return place [cell, -0.5 to 0.5] and height of the maximum of a periodic correlation, between its samples."""
    fine = _BINS * _FINER
    known = np.fft.fftfreq(_BINS, 1 / _BINS).astype(int)
    padded = np.zeros((fine, fine), complex)
    padded[np.ix_(known, known)] = np.fft.fft2(correlation) * _FINER**2
    between = np.fft.ifft2(padded).real
    highest = np.unravel_index(int(between.argmax()), between.shape)
    place = (np.array(highest) / fine + 0.5) % 1 - 0.5
    return place, float(between.max())

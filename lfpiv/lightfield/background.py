"""Estimate the light that stands still in a series of particle images: reflections, stray light, hot pixels.

Light of particles moves from image to image, and no pixel is lit by particles in all images of a long series. So the
smallest count of each pixel over the series is standing light, plus noise, plus the light of particles that overlap
there in every image by chance. How often chance does so is measured: the images are shifted against each other by whole
microlenses, where standing light no longer overlaps, and the minimum is taken again. Light is taken as standing only
where it exceeds what the shifted images show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import ndimage

from lfpiv.lightfield.decoder import CORE_COVERAGE, LightFieldDecoder
from lfpiv.lightfield.standing_light import LEAST_RATIO_PIXELS, POWER_RANGE, StandingLight, mode, nothing

CHANCE = 99.99
"""A pixel has standing light if it is above this percentile of the shifted images' minimum."""
CLEAR_SIGMA = 5.0
"""Least count of a pixel with standing light in a background image [noise]."""
NOISE_SIGMA = 3.0
"""Least count of a pixel that is counted among those brighter than chance, and least stray light [noise]."""
LEAST_STANDING = 0.005
"""Compact standing light is subtracted if it has a larger share of an image's light. Chance reaches a fifth of this
share."""
LIT_PART = 2.0
"""Sensor over the part of it on which particles are imaged, as a rough figure."""
RARE, OFTEN = 1e-4, 10.0
"""Numbers of places with light in all images by chance: what may be neglected, and what shows how bright they are."""
STANDS_EVERYWHERE = 0.6
"""Standing light in a larger share of the lit parts of a sensor comes from particles at rest."""

_LEVELS = (90.0, 99.0, 99.9)  # percentiles of the chance minimum whose excess is counted around each pixel
_REACH_PITCHES = 1.0  # half width of the square around a pixel in which excess pixels are counted
_MARGIN = 1.6  # least share of such pixels over the largest one in the shifted images
_MARGIN_OF_ONE = 1.5  # least count of a single pixel over the largest one of the shifted images
_LEAST_SHARE = 0.05  # lower limit of the share of such pixels in the shifted images
_TILE_PITCHES = 6.0  # edge of the tiles of smooth stray light
_TILE_NEIGHBOURS = 5  # tiles along each axis whose median removes compact reflections from the stray light
_COPIES = np.array([(3.0, 0.0), (0.0, 3.0)])  # shifts of the copies that tell stray light from particles [lens]
_UNEVEN = 0.15  # accepted relative decrease of stray light over such a shift
_BLOCK_ROWS = 64  # rows whose median is taken at once
_LEAST_GAIN = 0.2  # least gain of a pixel that counts
_LEAST_TILE_PIXELS = 300  # least number of pixels of a tile
_UNLIKE = 0.3  # relative difference of the frames' standing light that counts as unlike
_UNLIKE_SHARE = 0.15  # share of unlike pixels above which the frames have backgrounds of their own
_MANY_MICROIMAGES = 20.0  # least area of saturated pixels that no particle lights [squares of a pitch]
_FILLED = 0.35  # least part of such an area, half a pitch around the pixels included, that is saturated
_FEW = 0.03  # least share of the pixels of a lit tile
_CUT_OFF = 0.01  # share of the pixels with the least count above which images are cut off there
_STUCK_PIXELS = 0.01  # number of pixels that repeat their count in all images by chance
_SHIFT_PITCHES = 24.0  # largest shift of an image along each axis
_GOLDEN = (0.7548776662466927, 0.5698402909980532)  # steps of an even sequence in the plane


@dataclass(eq=False)
class Series:
    """Running figures of the images of one camera and one frame. `add` takes one image after the other.

    Where one laser lights all images, as in a time series, all are of one frame, and `second` is None below.
    """

    decoder: LightFieldDecoder
    frame: int = 0
    """0 for the first frame, 1 for the second."""
    overlapping: int | None = None
    """Number of images that are shifted, see `overlapping_by_chance`; None: all."""
    count: int = 0
    noise: float = 0.0
    """Mean noise of the images so far [counts]."""
    lit: float = 0.0
    """Mean share of the pixels that particles light."""
    light: float = 0.0
    """Mean light of the images so far, summed over the sensor [counts]."""
    smallest: np.ndarray = field(init=False)
    """Smallest count of each pixel, float32."""
    shifted: np.ndarray = field(init=False)
    """Smallest count over the images shifted against each other by whole microlenses, float32."""
    largest: np.ndarray = field(init=False)
    """Largest count of each pixel, float32."""
    saturated: np.ndarray = field(init=False)
    """Number of images in which a pixel is saturated, uint16."""

    def add(self, light: np.ndarray, noise: float, saturated: np.ndarray, shift: int | None = None) -> None:
        """Add an image.

        Parameters
        ----------
        light : ndarray, shape (rows, columns), float32
            Image without its dark level [counts].
        noise : float
            Its noise [counts].
        saturated : ndarray, shape (rows, columns), bool
            Its saturated pixels.
        shift : int, optional
            Number of its shift. Images of the same particles have the same; default: one for each image.
        """
        number = 2 * self.count + self.frame if shift is None else shift
        shifted = np.roll(light, lens_shift(self.decoder, number), (0, 1))
        if self.count == 0:
            self.smallest, self.largest = light.copy(), light.copy()
            self.shifted, self.saturated = shifted, saturated.astype(np.uint16)
        else:
            np.minimum(self.smallest, light, out=self.smallest)
            if self.overlapping is None or self.count < self.overlapping:
                np.minimum(self.shifted, shifted, out=self.shifted)
            np.maximum(self.largest, light, out=self.largest)
            self.saturated += saturated
        self.light += (float(light.sum(dtype=float)) - self.light) / (self.count + 1)
        self.lit += (float(np.mean(light > CLEAR_SIGMA * noise)) - self.lit) / (self.count + 1)
        self.noise += (noise - self.noise) / (self.count + 1)
        self.count += 1


def overlapping_by_chance(series: Series) -> int | None:
    """Return of how many images particles overlap somewhere by chance; None if the shifted images show chance.

    Of few thin images, a chance of some percent shows in no shifted image but may in the images themselves. Their
    minimum then has to surpass the minimum of fewer shifted images, which overlap somewhere.
    """
    lenses = series.largest.size / series.decoder.optics.microimage_pitch_px**2
    lit = LIT_PART * series.lit
    if not 0 < lit < 1 or not RARE < lenses * lit**series.count < 1:
        return None
    return max(int(np.log(lenses / OFTEN) / -np.log(lit)), 1)


def recorded_light(images: Sequence[tuple[np.ndarray, float, np.ndarray]], decoder: LightFieldDecoder) -> StandingLight:
    """Return the standing light in background images of one or both frames: light, noise and saturated pixels."""
    (first, noise, clipped), (second, _, clipped_too) = images[0], images[-1]
    region = first > CLEAR_SIGMA * noise
    return StandingLight(
        light=(first, second), unusable=clipped | clipped_too, found=True, region=region, stray=0.0, ratio=None
    )


def median_light(
    first: Series, second: Series | None, images: tuple[Sequence[np.ndarray], Sequence[np.ndarray]]
) -> StandingLight:
    """Return the median of each pixel over a series as standing light, with the series' unusable pixels."""
    one = _median(images[0])
    other = one if second is None else _median(images[1])
    return StandingLight(
        light=(one, other),
        unusable=_unusable(first, second),
        found=True,
        region=one > CLEAR_SIGMA * first.noise,
        stray=0.0,
        ratio=None,
    )


def _median(images: Sequence[np.ndarray]) -> np.ndarray:
    """Return the median of each pixel, by blocks of rows."""
    result = np.empty_like(images[0])
    for first in range(0, len(result), _BLOCK_ROWS):
        rows = slice(first, first + _BLOCK_ROWS)
        result[rows] = np.median(np.stack([image[rows] for image in images]), axis=0)
    return result


def standing_light(first: Series, second: Series | None, *, everywhere: bool = False) -> StandingLight:
    """Estimate the standing light of a camera from the series of both frames.

    `everywhere` takes the minimum of all pixels, also where it is no brighter than chance.
    """
    decoder = first.decoder
    pooled, ratio = (None, 1.0) if second is None else _pool(first, second)
    series = [first] if second is None else [first, second]
    parts = [_Minimum.from_series(one) for one in series] if pooled is None else [pooled, pooled]
    stray = [_stray(one, decoder) for one in series]
    light, region = [], np.zeros(decoder.gain.shape, bool)
    scales = [1.0] * len(series) if pooled is None else [1.0, ratio]
    for part, smooth, scale in zip(parts, stray, scales, strict=True):
        excess = part.smallest - smooth / np.float32(scale)
        level = np.where(_cut_off(part.smallest), 0, np.maximum(excess + part.bias(decoder), 0))
        if everywhere:
            stands = np.ones_like(region)
        else:
            stands = _stands(excess, part.shifted - smooth / np.float32(scale), part.noise, decoder)
            if level.sum(where=stands, dtype=float) < LEAST_STANDING * min(one.light for one in series):
                stands = np.zeros_like(region)
        region |= stands
        light.append(((np.where(stands, level, 0)) * np.float32(scale) + smooth).astype(np.float32))
    unusable = _unusable(first, second)
    if not everywhere and _spread(region, first) > STANDS_EVERYWHERE:
        return replace(nothing(decoder), at_rest=True)
    seen = first.smallest.sum(where=region | unusable, dtype=float)
    return StandingLight(
        light=(light[0], light[-1]),
        unusable=unusable,
        found=bool(region.any() or unusable.any() or any(s.any() for s in stray)),
        region=region,
        stray=float(np.median(stray[0])),
        ratio=ratio if pooled is not None else None,
        share=float(np.clip(seen / max(first.light, 1e-9), 0, 1)),
    )


@dataclass(frozen=True, eq=False)
class _Minimum:
    """Smallest counts of a series, of the shifted series, and their origin."""

    smallest: np.ndarray
    shifted: np.ndarray
    count: int
    noise: float

    @classmethod
    def from_series(cls, series: Series) -> _Minimum:
        return cls(series.smallest, series.shifted, series.count, series.noise)

    def bias(self, decoder: LightFieldDecoder) -> np.ndarray:
        """Return by how much noise lowers the minimum of each pixel [counts]; photon noise grows with the light."""
        sigma = np.sqrt(self.noise**2 + decoder.counts_per_photon * np.maximum(self.smallest, 0))
        return (-least_of_normal(self.count) * sigma).astype(np.float32)


def _pool(first: Series, second: Series) -> tuple[_Minimum | None, float]:
    """Return the minimum over both frames at the first one's power, and the second's power relative to it.

    The minimum is None where the standing light of the frames is unlike, or none is bright enough to tell.
    """
    bright = np.percentile(first.shifted, CHANCE)
    seeds = (first.smallest > bright) & (first.saturated == 0) & (second.saturated == 0)
    if np.count_nonzero(seeds) < LEAST_RATIO_PIXELS:
        return None, 1.0
    quotient = second.smallest[seeds] / first.smallest[seeds]
    ratio = mode(quotient)
    if not POWER_RANGE[0] < ratio < POWER_RANGE[1] or np.mean(np.abs(quotient / ratio - 1) > _UNLIKE) > _UNLIKE_SHARE:
        return None, 1.0
    scaled = np.float32(1 / ratio)
    return _Minimum(
        np.minimum(first.smallest, second.smallest * scaled),
        np.minimum(first.shifted, second.shifted * scaled),
        first.count + second.count,
        (first.noise + second.noise / ratio) / 2,
    ), ratio


def _stands(excess: np.ndarray, chance: np.ndarray, noise: float, decoder: LightFieldDecoder) -> np.ndarray:
    """Return the pixels whose light stands: far brighter than chance by themselves, or with many bright ones around."""
    stands = excess > max(_MARGIN_OF_ONE * float(chance.max()), CLEAR_SIGMA * noise)
    reach = 2 * int(_REACH_PITCHES * decoder.optics.microimage_pitch_px) + 1
    for level in np.maximum(np.percentile(chance, _LEVELS), NOISE_SIGMA * noise):
        found, usual = (ndimage.uniform_filter((part > level).astype(np.float32), reach) for part in (excess, chance))
        stands |= found > _MARGIN * max(float(usual.max()), _LEAST_SHARE)
    return stands


def _stray(series: Series, decoder: LightFieldDecoder) -> np.ndarray:
    """Return the smooth stray light, from the mode of the minimum in tiles of some microlenses.

    Smooth light stays where the minimum over two shifted copies is taken, too. Where that is darker by more than noise,
    the light is that of particles, and the stray light is 0.
    """
    aside, down = (np.roll(series.smallest, shift, (0, 1)) for shift in _whole_lenses(decoder, _COPIES))
    thinned = np.minimum(np.minimum(aside, down), series.smallest)
    shape, tile = series.smallest.shape, int(_TILE_PITCHES * decoder.optics.microimage_pitch_px)
    cells = [max(n // tile, 1) for n in shape]
    core = (decoder.coverage > CORE_COVERAGE) & (decoder.gain > _LEAST_GAIN)
    values = np.zeros(cells, float)
    for i, rows in enumerate(np.array_split(np.arange(shape[0]), cells[0])):
        for j, columns in enumerate(np.array_split(np.arange(shape[1]), cells[1])):
            place = np.ix_(rows, columns)
            chosen = core[place]
            if np.count_nonzero(chosen) < _LEAST_TILE_PIXELS:
                continue
            gain = decoder.gain[place][chosen]
            found, darker = (mode(image[place][chosen] / gain) for image in (series.smallest, thinned))
            found -= least_of_normal(series.count) * series.noise
            darker -= least_of_normal(3 * series.count) * series.noise
            values[i, j] = found if found - darker < series.noise + _UNEVEN * found else 0.0
    values = ndimage.median_filter(values, _TILE_NEIGHBOURS, mode="nearest")
    if np.median(values) < NOISE_SIGMA * series.noise:
        return np.zeros(shape, np.float32)
    at = np.meshgrid(*((np.arange(n) + 0.5) / n * m - 0.5 for n, m in zip(shape, cells, strict=True)), indexing="ij")
    smooth = ndimage.map_coordinates(values, at, order=1, mode="nearest")
    return (np.maximum(smooth, 0) * decoder.gain * np.minimum(decoder.coverage, 1)).astype(np.float32)


def _unusable(first: Series, second: Series | None) -> np.ndarray:
    """Return pixels that are saturated in most images, or repeat one count in all where noise would change it.

    Where noise alone may repeat a dark pixel's count, only bright pixels are meant: half of the noise of images cut off
    at 0 is one count. One pair alone may show resting particles. So its saturated pixels must lie together and fill
    many microimages.
    """
    if second is None:
        images, saturated, low, high = first.count, first.saturated, first.smallest, first.largest
    else:
        images, saturated = first.count + second.count, first.saturated + second.saturated
        low, high = np.minimum(first.smallest, second.smallest), np.maximum(first.largest, second.largest)
    often: np.ndarray = saturated > images / 2
    if images <= 2:
        return _extended(often, first)
    stuck: np.ndarray = high == low
    same = 1 / (2 * max(first.noise, 1e-3) * np.sqrt(np.pi))  # chance of two equal counts
    if _cut_off(low).mean() > _CUT_OFF:
        same = max(same, 0.5)
    if same >= 1 or same ** (images - 1) * low.size > _STUCK_PIXELS:
        stuck &= low > CLEAR_SIGMA * first.noise
    return often | stuck


def _cut_off(smallest: np.ndarray) -> np.ndarray:
    """Return the pixels whose smallest count is the least that the camera stores: they show no light that stands.

    Levels of the images differ by less than a count. Where the camera has an offset, hardly a pixel is among them.
    """
    return smallest < smallest.min() + 1


def _extended(often: np.ndarray, series: Series) -> np.ndarray:
    """Return those pixels that lie together in areas of many microimages; none where they lie all over the sensor."""
    if _spread(often, series) > STANDS_EVERYWHERE:
        return np.zeros_like(often)
    pitch = series.decoder.optics.microimage_pitch_px
    areas, count = ndimage.label(ndimage.maximum_filter(often, 2 * int(pitch / 2) + 1))
    sizes, around = np.bincount(areas[often], minlength=count + 1), np.bincount(areas.ravel(), minlength=count + 1)
    return often & ((sizes > _MANY_MICROIMAGES * pitch**2) & (sizes > _FILLED * around))[areas]


def _spread(pixels: np.ndarray, series: Series) -> float:
    """Return the share of the lit tiles of the sensor in which some of the pixels lie."""
    tile = int(_TILE_PITCHES * series.decoder.optics.microimage_pitch_px)
    rows, columns = (np.arange(n) // tile for n in pixels.shape)
    number = (rows[:, None] * (columns.max() + 1) + columns).ravel()
    lit = (series.largest > CLEAR_SIGMA * series.noise).ravel()
    total, light, chosen = (np.bincount(number, part) for part in (None, lit, pixels.ravel()))
    seen = light > _FEW * total
    return float((chosen > _FEW * total)[seen].mean()) if seen.any() else 0.0


def lens_shift(decoder: LightFieldDecoder, number: int) -> tuple[int, int]:
    """Return a shift by whole microlenses, another for each number, as (rows, columns) [pixel]; 0 for number 0."""
    optics = decoder.optics
    reach = np.minimum(_SHIFT_PITCHES * optics.microimage_pitch_px, np.array(optics.sensor_shape) / 3)
    target = (np.array(_GOLDEN) * number % 1) * reach
    (shift,) = _whole_lenses(decoder, np.rint(target @ np.linalg.inv(_lens_vectors(decoder)))[None])
    return shift


def _whole_lenses(decoder: LightFieldDecoder, lenses: np.ndarray) -> list[tuple[int, int]]:
    """Return shifts (i, j) of the lattice, shape (n, 2), as (rows, columns) [pixel]."""
    return [(int(rows), int(columns)) for rows, columns in np.rint(lenses @ _lens_vectors(decoder))]


def _lens_vectors(decoder: LightFieldDecoder) -> np.ndarray:
    """Return the vectors (rows, columns) between neighbouring microimages [pixel], shape (2, 2)."""
    optics = decoder.optics
    vectors: np.ndarray = np.asarray(decoder.lattice.basis_mm)[:, ::-1]
    return vectors * ((1 + optics.sensor_per_pupil) / optics.pixel_mm)


def least_of_normal(count: int) -> float:
    """Return the mean of the smallest of `count` normal numbers [standard deviations], Blom's approximation."""
    from scipy.special import ndtri

    return float(ndtri((1 - 0.375) / (count + 0.25)))

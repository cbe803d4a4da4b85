"""Images of a board's planes: read when needed within a bounded memory, and freed of their dark level."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from lfpiv.errors import InputError
from lfpiv.experiment.experiment import Experiment
from lfpiv.lightfield.decoder import LightFieldDecoder
from lfpiv.lightfield.saturation import saturated_pixels

HELD_BYTES = 16
"""Memory for the images of all planes, per pixel of the sensor [byte]."""

_SATURATED_PIXELS = 10  # least number of pixels at the highest value that count as saturated
_SATURATED_SIGMA = 20.0  # their least height above the dark level [standard deviations of the noise]


class Planes(Sequence[np.ndarray]):
    """Images that are read on access; the first ones stay in memory as 16-bit counts, up to `HELD_BYTES`."""

    def __init__(self, read: Callable[[int], np.ndarray], count: int):
        self._read, self._count = read, count
        self._held: dict[int, np.ndarray] = {}

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, plane: int) -> np.ndarray:  # type: ignore[override]  # planes are never sliced
        if not 0 <= plane < self._count:
            raise IndexError(plane)
        if plane not in self._held:
            image = self._read(plane)
            full = (len(self._held) + 1) * np.dtype(np.uint16).itemsize > HELD_BYTES
            if full or image.min() < 0 or image.max() > np.iinfo(np.uint16).max:
                return image
            counts = image.astype(np.uint16)
            if not np.array_equal(counts, image):
                return image
            self._held[plane] = counts
        return self._held[plane]


def board_images(experiment: Experiment, camera: str) -> Planes:
    """Return the images of the board of one camera."""
    return Planes(lambda plane: experiment.board_image(camera, plane), len(experiment.board.planes_mm))


@dataclass(frozen=True, eq=False)
class Signals:
    """Images of all planes above their dark levels. Made by `from_images`."""

    images: Sequence[np.ndarray]
    """Raw image of each plane [counts]."""
    dark: np.ndarray | None
    """Image with the lens capped [counts]."""
    levels: tuple[tuple[float, float], ...]
    """Dark level, after `dark` is subtracted, and noise of each plane [counts]."""

    @classmethod
    def from_images(cls, images: Sequence[np.ndarray], decoder: LightFieldDecoder, dark: np.ndarray | None) -> Signals:
        """Check the images and measure their dark levels.

        Raises
        ------
        InputError
            If an image does not have the sensor's shape, or holds counts that are not finite.
        """
        shape = tuple(decoder.optics.sensor_shape)
        if dark is not None and np.shape(dark) != shape:
            raise InputError(f"dark: expected an image of shape {shape}, got {np.shape(dark)}.")
        levels = []
        for plane, image in enumerate(images):
            name = f"plane {plane} of the board"
            if np.shape(image) != shape:
                raise InputError(f"{name}: expected an image of shape {shape}, got {np.shape(image)}.")
            bad = np.size(image) - np.count_nonzero(np.isfinite(image))
            if bad:
                raise InputError(f"{name}: expected finite counts, got {bad} pixels that are not.")
            levels.append(decoder.background(_without_dark(image, dark)))
        return cls(images, dark, tuple(levels))

    @property
    def noise(self) -> float:
        """Read-out noise, median over the planes [counts]."""
        return float(np.median([sigma for _, sigma in self.levels]))

    def of_plane(self, plane: int) -> np.ndarray:
        """Return the image of a plane above its dark level [counts], nan where saturated, float32.

        Saturated pixels are found in the raw image; after the dark image is subtracted their values differ.
        """
        image = np.asarray(self.images[plane])
        level, sigma = self.levels[plane]
        signal = _without_dark(image, self.dark)
        signal -= np.float32(level)
        top = (image == image.max()) | saturated_pixels(image)
        if np.count_nonzero(top) >= _SATURATED_PIXELS and np.median(signal[top]) > _SATURATED_SIGMA * sigma:
            signal[top] = np.nan
        return signal


def _without_dark(image: np.ndarray, dark: np.ndarray | None) -> np.ndarray:
    light = np.array(image, np.float32)
    if dark is not None:
        light -= dark
    return light

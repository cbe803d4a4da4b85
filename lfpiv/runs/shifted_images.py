"""Find a camera whose images are shifted by whole microlenses in the plane of the lines of sight.

Its white image does not show such a shift. The other cameras see the shifted particles at another depth. But each
camera sees depths by itself, so images that are shifted back leave less light unexplained. In a sound pair a trial
shift changes both frames alike. Where only one frame is shifted, the frames differ.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from lfpiv.runs.moved_frames import FRAMES
from lfpiv.selfcalibration.belonging import CLEAR, SURE, ImageFit, in_errors
from lfpiv.selfcalibration.disparity import slant
from lfpiv.warn import Code, Warning

if TYPE_CHECKING:
    from lfpiv.selfcalibration.mistakes import Shown
    from lfpiv.weights.operator import Weights

SHIFTS = (1, 2)
"""Distances by which images are shifted either way, the first one in any case [microlens]."""
DOUBT = -1.0
"""Advantage of a second frame shifted by a microlens from which on all frames are tried [standard errors]. Single sound
images have less."""

Shift = tuple[str, int]
"""Camera, and microlenses by which its image is shifted."""


def shifted_images(shown: Shown, pairs: Sequence[int], weights: Weights, *, series: bool) -> Warning | None:
    """Return the warning about a camera whose images of either frame, or of both, are shifted; None without any.

    In a `series` no frame is a first or second one.
    """
    fit = ImageFit(weights)
    axes = {name: _axis(weights, name) for name in weights.cameras}
    first = _gains(fit, shown, (pairs[0], FRAMES - 1), axes, 1)
    if not any(in_errors([gain]) > DOUBT for gain in first.values()):
        return None
    gains = {
        place: _gains(fit, shown, place, axes, max(SHIFTS))
        for place in [(pair, frame) for pair in pairs for frame in range(FRAMES)]
    }

    def clear(one: Shift, signs: Mapping[int, int], than: Shift | None = None) -> float:
        """Return how clearly a shift explains the images of the frames in `signs` better than none, or than another."""
        frames = [(signs[frame], known) for (_, frame), known in gains.items() if known and frame in signs]
        return in_errors([sign * (known[one] - (known[than] if than else 0)) for sign, known in frames])

    tried = [(name, sign * lenses) for name in axes for lenses in SHIFTS for sign in (-1, 1)]
    frame, best = max(product(range(FRAMES), tried), key=lambda one: clear(one[1], {one[0]: 1}))
    if clear(best, {frame: 1}) < CLEAR:
        return None
    camera, lenses = weights.cameras[best[0]], abs(best[1])
    alike = [name for name, shift in tried if clear(best, {frame: 1}, (name, shift)) < SURE]
    either = " or ".join(name for name in axes if name in alike)
    length_mm = lenses * camera.optics.microlens_pitch_mm / abs(camera.optics.magnification)
    figures: dict[str, float | str] = {"voxel": length_mm / weights.volume.voxel_mm}
    if not series and clear(best, {1 - frame: 1}) < 0 and clear(best, {frame: 1, 1 - frame: -1}) > SURE:
        figures |= {"lenses": float(lenses), "cause": "its images are shifted"}
        return Warning(code=Code.MOVED_FRAMES, subject=either, figures=figures)
    if clear(best, {0: 1, 1: 1}) < CLEAR:
        return None
    cause = f"{either} moved since the board was recorded, or its particle images are shifted by {lenses} microlens"
    cause += "es" * (lenses > 1)
    advice = "compare them with the board images where nothing moves, or record the board again"
    figures |= {"names": " and ".join(axes), "mm": length_mm, "cause": cause, "advice": advice}
    return Warning(code=Code.APART, figures=figures)


def _gains(
    fit: ImageFit, shown: Shown, place: tuple[int, int], axes: Mapping[str, int], farthest: int
) -> dict[Shift, np.ndarray]:
    """Return how much less light each shift leaves unexplained in the parts of the sensors; empty without images."""
    images = shown(*place)
    if images is None:
        return {}
    right, found = fit.unexplained(images), {}
    for name, axis in axes.items():
        pitch_px = fit.weights.cameras[name].optics.microimage_pitch_px
        for lenses in (sign * number for number in SHIFTS if number <= farthest for sign in (-1, 1)):
            shifted = np.roll(images[name], round(lenses * pitch_px), axis)
            found[name, lenses] = right - fit.unexplained({**images, name: shifted})
    return found


def _axis(weights: Weights, name: str) -> int:
    """Return the axis of a camera's images in the plane of its line of sight and the other cameras'."""
    camera, grid = weights.cameras[name], weights.volume
    ends = [camera.map(grid.centre_mm + sign * grid.voxel_mm * np.eye(3), np.zeros((3, 2))) for sign in (-1, 1)]
    seen = (ends[1] - ends[0]).T  # of a step along each axis
    planes = [slant([camera, other], grid) for other in weights.cameras.values() if other is not camera]
    across_rows, along_rows = (sum(float(np.linalg.norm(row @ plane)) for plane in planes) for row in seen[::-1])
    return int(along_rows > across_rows)

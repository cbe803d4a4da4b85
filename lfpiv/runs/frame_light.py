"""Read particle images: light without background, its noise, and warnings about the images.

`frame_light` takes the calibrated cameras and their dark images, and returns light, noise and warnings of one frame: a
frame of a pair or an instant of a series. `compare` compares both frames of a pair. `pair_light` does both.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from lfpiv.errors import InputError
from lfpiv.experiment.recording import Frame
from lfpiv.lightfield import frame_comparison, image_checks
from lfpiv.lightfield.particle_signal import NOISE, measure_structure
from lfpiv.lightfield.saturation import saturated_pixels
from lfpiv.lightfield.standing_light import remains_warnings
from lfpiv.warn import Warning

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera
    from lfpiv.experiment.experiment import Experiment

log = logging.getLogger(__name__)

SAMPLED, TRIED = 3, 9
"""Largest number of pairs that stand for the whole experiment, and that are tried."""


@dataclass(frozen=True, kw_only=True)
class FrameLight:
    """Images of one frame and figures measured in them; every mapping is by camera name."""

    frame: Frame
    images: Mapping[str, np.ndarray]
    """Images without dark image and background, shape (rows, columns), float32 [counts]."""
    noise: Mapping[str, float]
    """Noise of the background [counts]."""
    structure: Mapping[str, float]
    """Correlation of near pixels under one microlens: about 0 for noise, 0.2 or more for clear particles."""
    fingerprints: Mapping[str, bytes]
    """Hash of the recorded pixels."""
    warnings: tuple[Warning, ...]
    """Warnings about the images; from `pair_light` those about both frames are with the first one."""
    seconds: float
    """Time that reading and checking took [s]."""
    clipped: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Pixels at the end of the sensor's range, shape (rows, columns), bool; empty where they are not known."""


def read_darks(experiment: Experiment) -> dict[str, np.ndarray | None]:
    """Read the dark image of every camera, shape (rows, columns) [counts]; None for a camera without one."""
    return {camera.name: experiment.dark(camera.name) for camera in experiment.cameras}


def frame_light(
    experiment: Experiment,
    cameras: Mapping[str, CalibratedCamera],
    darks: Mapping[str, np.ndarray | None],
    frame: Frame,
    read: Callable[[str, Frame], np.ndarray] | None = None,
) -> FrameLight:
    """Read and check the images of one frame of a pair, or of one instant.

    `darks` is from `read_darks`. `read` returns the image of a camera; default: it is read from its file.

    Raises
    ------
    InputError
        If an image is missing, damaged, of another shape, or uniform.
    """
    start = time.perf_counter()
    images, noise, structure, fingerprints, warnings = {}, {}, {}, {}, list[Warning]()
    clipped = {}
    for name, camera in cameras.items():
        raw = experiment.frame_image(name, frame) if read is None else read(name, frame)
        top = experiment.frame_white_level(name, frame)
        images[name], noise[name] = without_background(camera, raw, darks[name], frame)
        light = images[name]
        clipped[name] = saturated_pixels(raw, top)
        structure[name] = measure_structure(light, camera.decoder)
        fingerprints[name] = frame_comparison.fingerprint(raw)
        judged = raw if camera.standing is None else np.where(camera.standing.pixels, 0, raw)
        others = {other: one.decoder for other, one in cameras.items() if other != name}
        warnings += image_checks.image_warnings(judged, light, camera.decoder, name, frame.name, top, others)
    warnings += image_checks.signal_warnings(structure, frame.name)
    return FrameLight(
        frame=frame,
        images=images,
        noise=noise,
        structure=structure,
        fingerprints=fingerprints,
        warnings=tuple(experiment.recording.by_frame(warning, frame) for warning in warnings),
        seconds=time.perf_counter() - start,
        clipped=clipped,
    )


def without_background(
    camera: CalibratedCamera, raw: np.ndarray, dark: np.ndarray | None, frame: Frame
) -> tuple[np.ndarray, float]:
    """Return a recorded image without dark image and background, and the noise of the background [counts]."""
    image = raw if dark is None else raw - dark
    level, noise = camera.decoder.background(image)
    light = image - np.float32(level)
    return (light, noise) if camera.standing is None else camera.standing.subtract(light, noise, frame.laser)


def compare(cameras: Mapping[str, CalibratedCamera], first: FrameLight, second: FrameLight) -> tuple[Warning, ...]:
    """Compare both frames of a pair; return the warnings about both.

    Raises
    ------
    InputError
        If two images are the same, pixel by pixel or but for some pixels.
    """
    repeats = [name for name in cameras if frame_comparison.same_light(first.images[name], second.images[name])]
    marks = {**second.fingerprints, **{name: first.fingerprints[name] for name in repeats}}
    frame_comparison.require_different(
        (f"{name}, {one.frame.label}", fingerprint)
        for one, fingerprints in ((first, first.fingerprints), (second, marks))
        for name, fingerprint in fingerprints.items()
    )
    uneven = [
        warning
        for name in cameras
        for warning in frame_comparison.uneven_warnings(first.images[name], second.images[name], name)
    ]
    remains = [
        warning
        for name, camera in cameras.items()
        if camera.standing is not None
        for warning in remains_warnings(camera.standing, first.images[name], second.images[name], name)
    ]
    double = [] if uneven else frame_comparison.double_warnings(first.images, second.images)
    return (*uneven, *double, *remains)


def pair_light(
    experiment: Experiment,
    cameras: Mapping[str, CalibratedCamera],
    darks: Mapping[str, np.ndarray | None],
    pair: int,
    read: Callable[[str, Frame], np.ndarray] | None = None,
) -> tuple[FrameLight, FrameLight]:
    """Read and check the images of both frames of a pair; the parameters are those of `frame_light`.

    Raises
    ------
    InputError
        As `frame_light`, and if two images are the same, pixel by pixel.
    """
    first, second = (frame_light(experiment, cameras, darks, frame, read) for frame in experiment.pair_frames(pair))
    between = compare(cameras, first, second)
    return replace(first, warnings=(*first.warnings, *between)), second


def sampled_light(
    experiment: Experiment, cameras: Mapping[str, CalibratedCamera]
) -> dict[int, list[dict[str, np.ndarray]]]:
    """Read up to `SAMPLED` pairs that show particles, spread over the whole experiment.

    Returns
    -------
    dict of int to list of dict
        Pair -> the images of both frames: camera name -> image, shape (rows, columns), background removed [counts].
    """
    return dict(_lit_pairs(experiment, cameras))


def _lit_pairs(
    experiment: Experiment, cameras: Mapping[str, CalibratedCamera]
) -> Iterator[tuple[int, list[dict[str, np.ndarray]]]]:
    darks, used = read_darks(experiment), 0
    for pair in dict.fromkeys(experiment.spread_pairs(SAMPLED) + experiment.spread_pairs(TRIED)):
        try:
            light = pair_light(experiment, cameras, darks, pair)
        except InputError as error:  # a pair that cannot be used fails when it is reconstructed
            log.debug("light of %s: %s", experiment.name_of(pair), error)
            continue
        if min(min(frame.structure.values()) for frame in light) < NOISE:
            continue
        if image_checks.misplaced(frame.warnings for frame in light):
            continue
        yield pair, [dict(frame.images) for frame in light]
        used += 1
        if used == SAMPLED:
            return

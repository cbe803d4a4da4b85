"""Light that stands still in the particle images: estimate it once for a run, store it, and hand it to the cameras.

The estimate uses a spread part of all pairs of the experiment, whatever pairs an invocation selects, so that numbers do
not depend on the selection. Results depend on it by a hash of its content, which is None where nothing is subtracted.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lfpiv import files
from lfpiv.errors import InputError
from lfpiv.experiment.experiment import Experiment
from lfpiv.files import writing
from lfpiv.lightfield import background, image_checks
from lfpiv.lightfield.background import Series, StandingLight
from lfpiv.progress import StepProgress
from lfpiv.results import provenance

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera, Calibration
    from lfpiv.runs.run import Run

log = logging.getLogger(__name__)

LONGEST_SERIES = 32
"""Largest number of pairs, evenly spread, from which the standing light is estimated."""
MEDIAN_PAIRS = 7
"""The same for a median, which holds both frames of all pairs in memory."""


@dataclass(frozen=True)
class Background:
    """Light that stands still, of all cameras of a run."""

    cameras: Mapping[str, StandingLight] = field(default_factory=dict)
    """By camera; empty where nothing is subtracted."""
    content: str | None = None
    """Hash of the content; None where nothing is subtracted."""

    def seen_by(self, calibration: Calibration) -> Calibration:
        """Return the calibration with cameras that know what stands still, and have no gain in unusable pixels."""
        cameras = {
            name: camera.with_standing(self.cameras[name]) if name in self.cameras else camera
            for name, camera in calibration.cameras.items()
        }
        return replace(calibration, cameras=cameras)


def prepare(run: Run, calibration: Calibration) -> Background:
    """Estimate the standing light of all cameras and store it, unless the folder holds one that fits."""
    experiment, path = run.experiment, run.folder.background
    pairs = series(experiment)
    stamp = provenance.of_background(experiment, run.calibration_stamp.hash, pairs)
    if stamp is None:
        return Background()
    marks = provenance.read_marks(path)
    if marks is not None and marks.figures is not None and stamp.fits(marks):
        return load(path)
    found = estimate(experiment, calibration.cameras, pairs, run.step("background"))
    _write(found, path, stamp.attributes)
    return found


def series(experiment: Experiment) -> list[int]:
    """Return the pairs from which the standing light is estimated, evenly spread over all."""
    longest = MEDIAN_PAIRS if experiment.background == "median" else LONGEST_SERIES
    count = min(longest, experiment.pairs)
    return [(2 * number + 1) * experiment.pairs // (2 * count) for number in range(count)]


def estimate(
    experiment: Experiment, cameras: Mapping[str, CalibratedCamera], pairs: list[int], progress: StepProgress
) -> Background:
    """Estimate the standing light of all cameras from their background images or from some pairs."""
    found = {}
    for number, (name, camera) in enumerate(cameras.items()):
        dark = experiment.dark(name)
        if experiment.camera(name).background is not None:
            images = [experiment.background_image(name, frame) for frame in experiment.frames]
            found[name] = background.recorded_light(
                [_without_dark(image, dark, camera) for image in images if image is not None], camera.decoder
            )
            log.info("background of %s: its background image", name)
        else:
            found[name] = _of_series(experiment, camera, dark, pairs)
        progress((number + 1) / len(cameras))
    standing = {name: light for name, light in found.items() if light.found}
    return Background(standing, _digest(standing))


def _of_series(
    experiment: Experiment, camera: CalibratedCamera, dark: np.ndarray | None, pairs: list[int]
) -> StandingLight:
    """Estimate the standing light of one camera from pairs; those that cannot be used are left out."""
    first, second = (Series(camera.decoder, frame) for frame in (0, 1))
    kept: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    median = experiment.background == "median"
    for pair in pairs:
        try:
            images = [experiment.particle_image(camera.name, pair, frame) for frame in experiment.frames]
        except InputError as error:  # the pair fails when it is reconstructed
            log.debug("background of %s: pair %d is left out: %s", camera.name, pair, error)
            continue
        for one, image, all_of_frame in zip((first, second), images, kept, strict=True):
            light, noise, saturated = _without_dark(image, dark, camera)
            one.add(light, noise, saturated)
            if median:
                all_of_frame.append(light)
    if not first.count:
        return background.nothing(camera.decoder)
    if median:
        found = background.median_light(first, second, kept)
    else:
        found = background.standing_light(first, second, everywhere=experiment.background == "minimum")
    _log_series(camera.name, found, first.count)
    return found


def _log_series(name: str, light: StandingLight, pairs: int) -> None:
    if not light.found:
        log.info("background of %s: nothing stands out in %d pairs, nothing is subtracted", name, pairs)
        return
    frames = "both frames" if light.ratio is not None else "each frame"
    log.info(
        "background of %s: estimated from %s of %d pairs; light stands in %.1f %% of the sensor, %d pixels are "
        "unusable, stray light of %.1f counts",
        name,
        frames,
        pairs,
        100 * light.region.mean(),
        np.count_nonzero(light.unusable),
        light.stray,
    )


def _without_dark(
    raw: np.ndarray, dark: np.ndarray | None, camera: CalibratedCamera
) -> tuple[np.ndarray, float, np.ndarray]:
    """Return the light of an image above its dark level, its noise, and its saturated pixels."""
    image = raw if dark is None else raw - dark
    level, noise = camera.decoder.background(image)
    return image - np.float32(level), noise, image_checks.saturated_pixels(raw)


def _digest(standing: Mapping[str, StandingLight]) -> str | None:
    if not standing:
        return None
    digest = hashlib.blake2b(digest_size=8)
    for name, light in standing.items():
        for array in (*light.light, light.unusable):
            digest.update(name.encode() + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def load(path: Path) -> Background:
    """Read a background that `prepare` stored.

    Raises
    ------
    InputError
        If the file cannot be read.
    """
    import h5py

    try:
        with h5py.File(path, "r") as file:
            content = json.loads(file.attrs["figures"])["content"]
            found = {}
            for name, group in file.items():
                first, second = group["light"][()]
                found[name] = StandingLight(
                    light=(first, second),
                    unusable=group["unusable"][()],
                    region=group["region"][()],
                    **json.loads(group.attrs["figures"]),
                )
    except (OSError, KeyError, ValueError) as error:
        raise InputError(f"{path}: expected a stored background, could not read it ({error}). Remove it.") from None
    return Background(found, content)


def _write(found: Background, path: Path, attributes: Mapping[str, Any]) -> None:
    import h5py

    content = io.BytesIO()  # see `files.write_bytes` for why not straight to disk
    with h5py.File(content, "w") as file:
        file.attrs.update(attributes)
        file.attrs["figures"] = json.dumps({"content": found.content})
        for name, light in found.cameras.items():
            group = file.create_group(name)
            arrays = {"light": np.stack(light.light), "unusable": light.unusable, "region": light.region}
            for key, value in arrays.items():
                group.create_dataset(key, data=value, compression="gzip", compression_opts=1)
            group.attrs["figures"] = json.dumps(light.figures)
    with writing(path):
        files.write_bytes(content.getbuffer(), path)

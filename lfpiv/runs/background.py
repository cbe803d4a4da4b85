"""Light that stands still in the particle images: estimate it once for a run, store it, and hand it to the cameras.

The estimate uses a spread part of all pairs of the experiment, whatever pairs an invocation selects, so that numbers do
not depend on the selection. Results depend on it by a hash of its content, which is None where nothing is subtracted.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lfpiv import files, hdf5
from lfpiv.errors import DamagedFile, InputError
from lfpiv.experiment.experiment import Experiment, white_level
from lfpiv.experiment.recording import Frame
from lfpiv.files import writing
from lfpiv.lightfield import background, decorrelation
from lfpiv.lightfield.background import Series
from lfpiv.lightfield.saturation import saturated_pixels
from lfpiv.lightfield.standing_light import StandingLight, nothing
from lfpiv.progress import StepProgress
from lfpiv.records import RecordError, read_object, validate
from lfpiv.results import datasets, provenance, stamps
from lfpiv.results.provenance import Marks, Stamp
from lfpiv.version import SOURCE, history
from lfpiv.warn import Code, Warning, to_text, warn

if TYPE_CHECKING:
    import h5py

    from lfpiv.calibration.camera import CalibratedCamera, Calibration
    from lfpiv.runs.run import Run

log = logging.getLogger(__name__)

LEAST_STRAY = 0.05
"""Least stray light that is told [counts]; less rounds to nothing."""
LARGE_SHARE = 0.02
"""Share of an image's light that stands still and is not subtracted, above which a warning is due."""
LONGEST_SERIES = 32
"""Largest number of pairs, evenly spread, from which the standing light is estimated; of instants twice as many."""
MEDIAN_PAIRS = 7
"""The same for a median, which holds both frames of all pairs in memory."""
WARNING_PAIRS = 4
"""The same where nothing is subtracted and the light is only warned of."""


@dataclass(frozen=True)
class Background:
    """Light that stands still, of all cameras of a run."""

    cameras: Mapping[str, StandingLight] = field(default_factory=dict)
    """By camera; empty where nothing is subtracted."""
    content: str | None = None
    """Hash of the content; None where nothing is subtracted."""
    figures: Mapping[str, Any] = field(default_factory=dict)
    """Figures of each camera for the summary; empty for cameras without standing light."""
    warnings: tuple[Warning, ...] = ()
    """Warnings about light that stands and is not subtracted."""

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
    stamp = stamps.of_background(experiment, run.calibration_stamp.hash, pairs)
    marks, found = provenance.read_marks(path), None
    if marks is not None and marks.figures is not None and (stamp.fits(marks) or _images_lost(stamp, marks)):
        try:
            found = load(path, calibration)
            log.info("background: estimated before from the same images, kept")
        except DamagedFile as error:
            provenance.reject(path, error.reason)
            found = None
    if found is None:
        found = estimate(experiment, calibration.cameras, pairs, run.step("background"))
        write(found, path, stamp.attributes)
    for warning in found.warnings:
        warn(log, warning)
    return found


def _images_lost(stamp: Stamp, marks: Marks) -> bool:
    """Return whether all that changed is that some images are missing, because raw data may be deleted."""
    if stamp.changes(marks) != ["images"]:
        return False
    before = read_object(marks.depends_on).get("images") or []
    now = stamp.parts["images"]
    return now is None or now.all_in(before)


def series(experiment: Experiment) -> list[int]:
    """Return the pairs from which the standing light is estimated, evenly spread over all.

    A pair of a time series gives one image: in two successive ones the same particles overlap, which chance does not.
    """
    longest = {"median": MEDIAN_PAIRS, "none": WARNING_PAIRS}.get(experiment.background, LONGEST_SERIES)
    return experiment.spread_pairs(2 * longest // experiment.recording.lasers)


def estimate(
    experiment: Experiment, cameras: Mapping[str, CalibratedCamera], pairs: list[int], progress: StepProgress
) -> Background:
    """Estimate the standing light of all cameras from their background images or from some pairs."""
    found = {}
    for number, (name, camera) in enumerate(cameras.items()):
        dark = experiment.dark(name)
        if experiment.camera(name).background is not None:
            images = [experiment.background_image(name, frame) for frame in experiment.laser_names]
            paths = [experiment.background_path(name, frame) for frame in experiment.laser_names]
            found[name] = background.recorded_light(
                [
                    _without_dark(image, dark, camera, white_level(path, experiment.camera(name)))
                    for image, path in zip(images, paths, strict=True)
                    if image is not None and path is not None
                ],
                camera.decoder,
            )
            log.info("background of %s: its background image", name)
        else:
            found[name] = _of_series(experiment, camera, dark, pairs)
        progress((number + 1) / len(cameras))
    standing = {name: light for name, light in found.items() if light.found}
    figures = {name: _figures(light) for name, light in standing.items()}
    warnings = tuple(_warnings(experiment, standing, len(pairs)))
    if experiment.background == "none":
        return Background(figures=figures, warnings=warnings)
    return Background(standing, content_hash(standing), figures, warnings)


def _figures(light: StandingLight) -> dict[str, Any]:
    return {
        "standing_share": round(float(light.region.mean()), 5),
        "unusable_share": round(float(light.unusable.mean()), 5),
        "light_share": round(light.share, 4),
        "stray_counts": round(light.stray, 2),
        "power_ratio": None if light.ratio is None else round(light.ratio, 4),
    }


def _warnings(experiment: Experiment, standing: Mapping[str, StandingLight], pairs: int) -> Iterator[Warning]:
    """Warn of standing light that is not subtracted: not wanted, or around pixels that one pair shows saturated."""
    for name, light in standing.items():
        if experiment.camera(name).background is not None and experiment.background != "none":
            continue
        if experiment.background == "none" and light.share > LARGE_SHARE:
            remedy = 'set particles.background = "auto", or record a background image (camera.background_image)'
        elif pairs == 1 and light.unusable.any():
            remedy = "one pair does not show how far it reaches; record a background image (camera.background_image)"
        else:
            continue
        figures = {"place": light.place, "share": light.share, "remedy": remedy}
        yield Warning(code=Code.STANDING, subject=name, figures=figures)


def _of_series(
    experiment: Experiment, camera: CalibratedCamera, dark: np.ndarray | None, pairs: list[int]
) -> StandingLight:
    """Estimate the standing light of one camera from pairs; those that cannot be used are left out."""
    median = experiment.background == "median"
    everywhere = experiment.background == "minimum"
    chance = experiment.recording.is_series and not (median or everywhere)
    apart = _independent_after(experiment, camera, dark, pairs) if chance else 1
    if apart is None:
        text = "particles move too little within the series to tell their light from light that stands"
        log.info("background of %s: %s, nothing is subtracted", camera.name, text)
        return nothing(camera.decoder)
    first, second, kept = _read_series(experiment, camera, dark, pairs, apart, keep=median)
    if not first.count:
        return nothing(camera.decoder)
    if median:
        found = background.median_light(first, second, kept)
    else:
        found = background.standing_light(first, second, everywhere=everywhere)
        if found.region.any():  # again, with the images at equal power of the laser
            few = background.overlapping_by_chance(first)
            first, second, _ = _read_series(experiment, camera, dark, pairs, apart, estimate=found, overlapping=few)
            found = background.standing_light(first, second, everywhere=everywhere)
    _log_series(experiment, camera.name, found, first.count)
    return found


def _independent_after(
    experiment: Experiment, camera: CalibratedCamera, dark: np.ndarray | None, pairs: list[int]
) -> int | None:
    """Return the number of instants after which particles are elsewhere; None where the series does not show it."""
    instants = sorted({frame for pair in pairs for frame in experiment.pair_frames(pair)})
    overlaps: dict[int, list[float]] = {}
    for end in (instants[0], instants[-1]):
        reference = _light(experiment, camera, dark, end)
        for instant in instants:
            light = None if instant == end else _light(experiment, camera, dark, instant)
            if light is not None and reference is not None:
                overlaps.setdefault(abs(instant.number - end.number), []).append(
                    decorrelation.overlap(reference, light)
                )
    lags = sorted(overlaps)
    return decorrelation.independent_after(lags, [float(np.mean(overlaps[lag])) for lag in lags])


def _light(
    experiment: Experiment, camera: CalibratedCamera, dark: np.ndarray | None, frame: Frame
) -> np.ndarray | None:
    """Return the light of an image; None if it cannot be used."""
    try:
        return _without_dark(experiment.frame_image(camera.name, frame), dark, camera, None)[0]
    except InputError:
        return None


def _read_series(
    experiment: Experiment,
    camera: CalibratedCamera,
    dark: np.ndarray | None,
    pairs: list[int],
    apart: int,
    *,
    keep: bool = False,
    estimate: StandingLight | None = None,
    overlapping: int | None = None,
) -> tuple[Series, Series | None, tuple[list[np.ndarray], list[np.ndarray]]]:
    """Read the images of one camera; return the series of both frames, and with `keep` all light.

    All images of a time series are of one frame: one laser lights them. They are independent when they are `apart`
    instants apart. An `estimate` gives the power of the laser in each image, by which it is divided.
    """
    series = Series(camera.decoder, 0, overlapping), Series(camera.decoder, 1, overlapping)
    kept: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    for pair in pairs:
        frames = experiment.recording.new_frames(pair)
        try:
            images = [experiment.frame_image(camera.name, frame) for frame in frames]
        except InputError as error:  # the pair fails when it is reconstructed
            log.debug("background of %s: %s is left out: %s", camera.name, experiment.name_of(pair), error)
            continue
        for frame, image in zip(frames, images, strict=True):
            shift = 2 * (frame.number // apart) if experiment.recording.is_series else None
            level = experiment.frame_white_level(camera.name, frame)
            light, noise, saturated = _without_dark(image, dark, camera, level)
            power = 1.0 if estimate is None else estimate.power(light, frame.laser)
            series[frame.laser].add(light / np.float32(power), noise / power, saturated, shift)
            if keep:
                kept[frame.laser].append(light)
    return series[0], series[1] if experiment.recording.lasers > 1 else None, kept


def _log_series(experiment: Experiment, name: str, light: StandingLight, count: int) -> None:
    images = f"{count} {experiment.noun}s"
    if light.at_rest:
        text = "light stands nearly everywhere, as that of particles at rest: nothing is subtracted"
        log.info('background of %s: %s. particles.background = "minimum" subtracts it', name, text)
        return
    if not light.found:
        log.info("background of %s: nothing stands out in %s, nothing is subtracted", name, images)
        return
    frames = "both frames" if light.ratio is not None else "each frame"
    if experiment.recording.lasers > 1:
        images = f"{frames} of {images}"
    parts = [f"light stands still in {100 * light.region.mean():.2g} % of the sensor"] if light.region.any() else []
    parts += [f"stray light of {light.stray:.2g} counts lies on all pixels"] if light.stray > LEAST_STRAY else []
    if light.unusable.any():
        parts.append(f"{np.count_nonzero(light.unusable)} pixels saturate or repeat one count, and are left out")
    log.info("background of %s, estimated from %s and subtracted: %s", name, images, "; ".join(parts))


def _without_dark(
    raw: np.ndarray, dark: np.ndarray | None, camera: CalibratedCamera, saturated_from: float | None
) -> tuple[np.ndarray, float, np.ndarray]:
    """Return the light of an image above its dark level, its noise, and its saturated pixels."""
    image = raw if dark is None else raw - dark
    level, noise = camera.decoder.background(image)
    return image - np.float32(level), noise, saturated_pixels(raw, saturated_from)


def content_hash(standing: Mapping[str, StandingLight]) -> str | None:
    """Return the hash of the light of all cameras; None where nothing is subtracted."""
    if not standing:
        return None
    digest = hashlib.blake2b(digest_size=8)
    for name, light in standing.items():
        for array in (*light.light, light.unusable):
            digest.update(name.encode() + np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


@dataclass(frozen=True, kw_only=True)
class _Light:
    """Numbers of one camera's standing light, as its file stores them."""

    found: bool
    stray: float
    ratio: float | None
    share: float


@dataclass(frozen=True, kw_only=True)
class _Figures:
    """Figures of a background, as its file stores them."""

    content: str | None
    cameras: dict[str, dict[str, float | None]]


def load(path: Path, calibration: Calibration) -> Background:
    """Read a background that `prepare` stored; raise InputError if it is missing, damaged, or of other cameras."""
    try:
        with hdf5.opened(path) as file:
            figures = validate(_Figures, read_object(file.attrs["figures"]))
            warnings = provenance.stored_warnings(file.attrs)
            strange = set(file) - set(calibration.cameras)
            if strange:
                raise DamagedFile(path, f"it is of other cameras: {', '.join(sorted(strange))}")
            found = {
                name: _read_light(file[name], camera.optics.sensor_shape)
                for name, camera in calibration.cameras.items()
                if name in file
            }
            if content_hash(found) != figures.content:
                raise DamagedFile(path, "its light is not that of its figures")
    except FileNotFoundError:
        raise InputError(f"{path}: expected a stored background, found no such file. Run `lfpiv run`.") from None
    return Background(found, figures.content, figures.cameras, warnings)


def _read_light(group: h5py.Group, shape: tuple[int, int]) -> StandingLight:
    """Read one camera's light; its arrays must have the shape of the sensor."""
    expected = {"light": ((2, *shape), "f"), "unusable": (shape, "b"), "region": (shape, "b")}
    for name, (size, kind) in expected.items():
        if group[name].shape != size or group[name].dtype.kind != kind:
            raise RecordError(f"{group.name}/{name}: expected {size}, found {group[name].shape} {group[name].dtype}")
    (first, second), numbers = group["light"][()], validate(_Light, read_object(group.attrs["figures"]))
    if not (np.isfinite(first).all() and np.isfinite(second).all()):
        raise RecordError(f"{group.name}/light: expected finite numbers")
    return StandingLight(
        light=(first, second), unusable=group["unusable"][()], region=group["region"][()], **asdict(numbers)
    )


def write(found: Background, path: Path, attributes: Mapping[str, Any]) -> None:
    """Write a background with the attributes of its stamp, atomically."""
    import h5py

    content = io.BytesIO()  # see `files.write_bytes` for why not straight to disk
    with h5py.File(content, "w") as file:
        file.attrs.update({**attributes, datasets.FILE: path.name, "source": SOURCE, "history": history()})
        file.attrs["figures"] = json.dumps({"content": found.content, "cameras": found.figures})
        file.attrs["warnings"] = to_text(found.warnings)
        for name, light in found.cameras.items():
            group = file.create_group(name)
            arrays = {"light": np.stack(light.light), "unusable": light.unusable, "region": light.region}
            for key, value in arrays.items():
                group.create_dataset(key, data=value, **hdf5.options(value.shape))
            group.attrs["figures"] = json.dumps(light.figures)
    hdf5.seal(content)
    with writing(path):
        files.write_bytes(content.getbuffer(), path)

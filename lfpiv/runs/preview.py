"""Preview of one pair of a calibrated rig: a coarse volume by the steps of a run, refocused planes and light levels.

The run's own steps are done on larger voxels, which takes seconds. Only the picture is written.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from lfpiv.errors import InputError
from lfpiv.experiment.experiment import Experiment
from lfpiv.experiment.recording import Frame
from lfpiv.files import writing
from lfpiv.geometry.grid import Grid
from lfpiv.lightfield.saturation import saturated_share
from lfpiv.progress import Progress
from lfpiv.reconstruction.intensity_cap import PEAK_SIGMA, typical_peak
from lfpiv.report.preview import Level, Preview, draw
from lfpiv.runs import coarse, rig
from lfpiv.runs.frame_light import FrameLight, pair_light, read_darks
from lfpiv.runs.run import open_run
from lfpiv.weights.operator import Weights

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera

log = logging.getLogger(__name__)

MOST_VOXELS = 40_000
"""Largest number of voxels of the coarse volume, without its guard layers."""
ITERATIONS = 3
"""Largest number of SMART iterations."""


def preview(
    experiment: Experiment | str | Path,
    out: str | Path,
    pair: int | None = None,
    *,
    device: str | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Draw a preview of one pair into ``preview/`` of an output folder that holds the calibration.

    Parameters
    ----------
    experiment : Experiment or path
        The experiment, or its file.
    out : path
        Output folder with ``calibration.h5``.
    pair : int, optional
        Pair, or instant of a series; default: the first.
    device, progress
        As for `lfpiv.runs.pipeline.run`.

    Returns
    -------
    dict
        ``picture``, the file; ``levels``, the light of each camera and frame; ``warnings``, sentences; ``voxel_mm``.

    Raises
    ------
    InputError
        If the folder holds no calibration that fits the experiment, or the pair's images cannot be used.
    """
    selected = None if pair is None else (pair, pair + 1)
    with open_run(experiment, out, device, progress, selected, writes_results=False) as current:
        number = current.numbers[0]
        calibration = rig.with_standing_light(current, rig.load_calibration(current).calibration)
        rough = coarsened(current.experiment)
        raw: dict[tuple[str, Frame], np.ndarray] = {}

        def read(name: str, frame: Frame) -> np.ndarray:
            raw[name, frame] = current.experiment.frame_image(name, frame)
            return raw[name, frame]

        light = pair_light(rough, calibration.cameras, read_darks(rough), number, read)
        try:
            weights, volumes = coarse.reconstruct(rough, calibration, light, current.progress)
        except ValueError as error:
            raise InputError(f"{rough.name_of(number)}: {error}") from error
        cameras = calibration.cameras.values()
        shown = Preview(
            title=f"{rough.name}, {rough.name_of(number)}: preview on voxels of {rough.grid.voxel_mm:.3g} mm",
            volumes={frame.frame.within: one for frame, one in zip(light, volumes, strict=True)},
            refocused=_refocused(weights, light[0], rough.grid),
            counts=light[0].images,
            levels=[_level(rough, frame, camera, raw) for frame in light for camera in cameras],
        )
        picture = current.folder.path / "preview" / f"{rough.noun}_{number}.png"
        with writing(picture):
            picture.parent.mkdir(parents=True, exist_ok=True)
        draw(shown, picture)
    return {
        "picture": str(picture),
        "voxel_mm": rough.grid.voxel_mm,
        "levels": [level.to_json() for level in shown.levels],
        "warnings": [warning.sentence for frame in light for warning in frame.warnings],
    }


def coarsened(experiment: Experiment) -> Experiment:
    """Return an experiment with at most about `MOST_VOXELS` voxels in the same volume, reconstructed in few steps."""
    grid = experiment.grid
    found = coarse.coarsened(experiment, max(1.0, (grid.size / MOST_VOXELS) ** (1 / 3)) * grid.voxel_mm)
    return replace(found, smart=found.smart.model_copy(update={"iterations": ITERATIONS}))


def _refocused(weights: Weights, light: FrameLight, grid: Grid) -> dict[str, xr.DataArray]:
    """Return the mean light on the pixels of each voxel, by camera [counts]."""
    stacks = {}
    for name, image in light.images.items():
        back = weights.of_camera(name).T
        seen = back({name: np.ones_like(image)})
        stack = np.divide(back({name: image}), seen, out=np.zeros_like(seen), where=seen > 0)
        inner = stack[grid.within(weights.grid)]
        stacks[name] = xr.DataArray(inner, grid.coordinates(), ("z", "y", "x"))
    return stacks


def _level(
    experiment: Experiment,
    light: FrameLight,
    camera: CalibratedCamera,
    raw: Mapping[tuple[str, Frame], np.ndarray],
) -> Level:
    """Measure the light of one camera in one frame."""
    name = camera.name
    image, recorded, noise = light.images[name], raw[name, light.frame], light.noise[name]
    pitch = camera.optics.microimage_pitch_px
    peak = typical_peak(image, pitch, noise)
    edge = max(1, round(pitch))
    rows, columns = (n // edge for n in image.shape)
    brightest = image[: rows * edge, : columns * edge].reshape(rows, edge, columns, edge).max(axis=(1, 3))
    return Level(
        camera=name,
        frame=light.frame.within,
        dark=float(np.median(recorded - image)),
        noise=noise,
        peak=peak if np.isfinite(peak) else 0.0,
        lit=float((brightest > PEAK_SIGMA * noise).mean()),
        saturated=saturated_share(recorded, experiment.frame_white_level(name, light.frame)),
        structure=light.structure[name],
    )

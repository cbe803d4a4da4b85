"""Cameras that moved since the board was recorded: warn about them, or correct the calibration.

Both use the particle images of both frames of some pairs, without the light that stays in place. `check` measures how
far apart the cameras show the same particles; `correct` fits the movements of the cameras to these disparities.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from lfpiv.lightfield.particle_signal import NOISE, measure_structure
from lfpiv.progress import StepProgress
from lfpiv.records import validate
from lfpiv.runs.frame_light import read_darks, without_background
from lfpiv.runs.moved_frames import FRAMES, moved_frames
from lfpiv.runs.shifted_images import shifted_images
from lfpiv.selfcalibration.disparity import CameraVolumes, still_light, unlinked, without_still_light
from lfpiv.selfcalibration.movements import AGREEING, Verdict, fit_movements, self_calibrate
from lfpiv.warn import Code, Warning, warn

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera, Calibration
    from lfpiv.experiment.experiment import Experiment
    from lfpiv.experiment.recording import Frame
    from lfpiv.selfcalibration.movements import Movement, MovementFit
    from lfpiv.weights.operator import Weights

log = logging.getLogger(__name__)

LARGE_VOXEL = 0.25
"""Disparity of the cameras across their lines of sight above which `check` warns [voxel]."""

LONE_STD_VOXEL = 0.4
"""Standard error of a distance that one part of the volume shows in one pair, and nothing confirms [voxel]."""

KEPT_BYTES = 64 << 20
"""Memory of the images that are kept while pairs are compared. Small images are read once in place of three times."""

CLEAR = 2 * NOISE
"""Structure of images above which cameras that show no common particles are warned of."""


@dataclass(frozen=True, kw_only=True)
class MovementFigures:
    """Movement of one camera, with standard errors."""

    shift_mm: Sequence[float]
    shift_std_mm: Sequence[float]
    rotation_deg: Sequence[float]
    rotation_std_deg: Sequence[float]

    @classmethod
    def from_movement(cls, movement: Movement) -> MovementFigures:
        """Round a movement for the summary."""
        return cls(
            shift_mm=np.round(movement.shift_mm, 5).tolist(),
            shift_std_mm=np.round(movement.std[:3], 5).tolist(),
            rotation_deg=np.round(np.degrees(movement.rotation_rad), 4).tolist(),
            rotation_std_deg=np.round(np.degrees(movement.std[3:]), 4).tolist(),
        )


@dataclass(frozen=True, kw_only=True)
class SelfCalibrationFigures:
    """Figures of a self-calibration for the summary."""

    pairs: Sequence[int]
    """Pairs whose images were used."""
    verdict: str = Verdict.CORRECTED.value
    """Text of a `Verdict`."""
    corrections: int = 0
    """Corrections that were tried."""
    disparity_before_voxel: float | None = None
    disparity_voxel: float | None = None
    """Disparity after the last correction."""
    movements: Mapping[str, MovementFigures] = field(default_factory=dict)
    """Camera -> its movement; zero if the calibration of the board is kept."""

    @property
    def warnings(self) -> tuple[Warning, ...]:
        """Warning that the calibration of the board is kept although cameras may have moved."""
        if self.verdict in (Verdict.CORRECTED.value, Verdict.UNMOVED.value):
            return ()
        return (Warning(code=Code.NOT_SELF_CALIBRATED, figures={"verdict": self.verdict}),)

    def to_json(self) -> dict[str, Any]:
        """Return the form that a file stores."""
        return asdict(self)

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> SelfCalibrationFigures:
        """Read the form that a file stores; raise RecordError if it has another form."""
        return validate(cls, stored)


@dataclass(frozen=True, kw_only=True)
class CameraDisparity:
    """Distance at which the cameras show the same particles."""

    voxel: float
    std_voxel: float
    """Standard error of `voxel`."""
    pairs: tuple[int, ...]
    """Pairs that it was measured with."""


def correct(
    experiment: Experiment, calibration: Calibration, progress: StepProgress
) -> tuple[Calibration, SelfCalibrationFigures]:
    """Correct a calibration by the pairs that the experiment names; return it with its figures.

    It stays the board's where the images do not show how cameras moved; the figures say why.
    """
    shown = ShownParticles(experiment, calibration.cameras, experiment.self_calibration_pairs)
    used, images = list[int](), list[Mapping[str, np.ndarray]]()
    for pair in shown.pairs:
        try:
            images += shown.pair(pair)
        except ValueError as error:  # a pair that cannot be used fails when it is reconstructed
            log.debug("self-calibration without pair %d: %s", pair, error)
            continue
        used.append(pair)
    try:
        found = self_calibrate(calibration, experiment.grid, images, progress=progress)
    except ValueError as error:
        log.debug("self-calibration: %s", error)
        return calibration, SelfCalibrationFigures(pairs=used, verdict=Verdict.NOTHING_IN_COMMON.value)
    before, after = (apart.mm / experiment.grid.voxel_mm for apart in (found.apart[0], found.apart[-1]))
    corrections = len(found.apart) - 1
    text = "self-calibration: cameras were %.2f voxel apart, now %.2f (%d corrections): %s"
    log.info(text, before, after, corrections, found.verdict.value)
    return found.calibration, SelfCalibrationFigures(
        pairs=used,
        verdict=found.verdict.value,
        corrections=corrections,
        disparity_before_voxel=round(before, 3),
        disparity_voxel=round(after, 3),
        movements={name: MovementFigures.from_movement(movement) for name, movement in found.movements.items()},
    )


def check(shown: ShownParticles, weights: Weights, *, in_time: bool) -> CameraDisparity | Sequence[int]:
    """Measure how far apart the cameras show the same particles; warn if it is far.

    Uses one pair after another until the answer is clear. `in_time`: no camera is late; else the warning names that
    cause, too, since a camera that is late in a uniform flow shows all particles equally far apart. Return the pairs
    that show clear particles and none in common if that is all there is.
    """
    experiment, volumes, used, fit = shown.experiment, CameraVolumes(weights), list[int](), None
    nothing, limit_mm = list[int](), LARGE_VOXEL * experiment.grid.voxel_mm
    for pair in shown.pairs:
        try:
            light = shown.pair(pair)
            for images in light:
                volumes.add(images)
        except ValueError as error:  # a pair that cannot be used fails when it is reconstructed
            log.debug("disparity of the cameras in pair %d: %s", pair, error)
            continue
        used.append(pair)
        found = volumes.disparities()
        if unlinked(found, weights.cameras):
            fit = None
            if all_show_particles(light, weights.cameras):
                nothing.append(pair)
            continue
        fit = fit_movements(found, list(weights.cameras), experiment.grid)
        if len(found) == len(used) == 1:
            fit = replace(fit, scatter_mm=LONE_STD_VOXEL * experiment.grid.voxel_mm)
        if fit.separation.differs_from(limit_mm) and (fit.separation.mm < limit_mm or _agree(volumes, used, fit)):
            break
    if fit is None:
        return nothing if nothing == used else []
    separation = fit.separation
    disparity, std = (length / experiment.grid.voxel_mm for length in (separation.mm, separation.std_mm))
    series = experiment.recording.is_series
    jolt = None if series else moved_frames(volumes, weights.cameras, in_order=in_time)
    if jolt is not None:
        warn(log, jolt)
    elif disparity > LARGE_VOXEL and separation.significant and (len(used) == 1 or _agree(volumes, used, fit)):
        warn(log, _apart(disparity, experiment, weights.cameras, in_time=in_time))
    elif (shifted := shifted_images(shown, shown.pairs, weights, series=series)) is not None:
        warn(log, shifted)
    return CameraDisparity(voxel=round(disparity, 3), std_voxel=round(std, 3), pairs=tuple(used))


def _agree(volumes: CameraVolumes, used: Sequence[int], fit: MovementFit) -> bool:
    """Return whether several pairs, each alone, show about the movements that all of them show together."""
    if len(used) < AGREEING:
        return False
    alone = [part.disparities() for part in volumes.each(FRAMES)]
    return fit.agrees_with(fit_movements(found, list(fit.cameras), volumes.weights.grid) for found in alone if found)


@dataclass(frozen=True)
class ShownParticles:
    """Images of the pairs that show particles, without the light that stays in place in all of them.

    One pair does not tell that light in a slow flow, where particles hardly move between its frames. A camera on
    another scale than in most frames of the pairs, while other cameras are not, is brought to its usual scale: it is
    judged by its particles.
    """

    experiment: Experiment
    cameras: Mapping[str, CalibratedCamera]
    pairs: Sequence[int]

    @cached_property
    def _darks(self) -> Mapping[str, np.ndarray | None]:
        return read_darks(self.experiment)

    @cached_property
    def _recent(self) -> dict[Frame, Mapping[str, np.ndarray]]:
        """The images that were read last, up to `KEPT_BYTES`, and those of a pair in any case."""
        return {}

    @cached_property
    def _levels(self) -> dict[Frame, Mapping[str, float]]:
        """Mean count of each camera's image in the frames that were read and show particles."""
        return {}

    @cached_property
    def _frames(self) -> list[Frame]:
        """Frames of the pairs whose images can be used."""
        return [frame for pair in self.pairs for frame in self._readable(pair)]

    @cached_property
    def _usual(self) -> dict[str, float]:
        """Median over the frames of each camera's mean count."""
        return {name: float(np.median([self._levels[frame][name] for frame in self._frames])) for name in self.cameras}

    @cached_property
    def _still(self) -> dict[str, np.ndarray]:
        return still_light(self._scaled(frame) for frame in self._frames)

    def __call__(self, pair: int, frame: int) -> Mapping[str, np.ndarray] | None:
        """Return the images of a frame, 0 or 1, of a pair, camera -> image; None if it has none that show particles."""
        if pair not in self.experiment.numbers:
            return None
        try:
            return self._moving(self.experiment.pair_frames(pair)[frame])
        except ValueError as error:
            log.debug("images of %s are not compared: %s", self.experiment.name_of(pair), error)
            return None

    def pair(self, pair: int) -> list[Mapping[str, np.ndarray]]:
        """Return the images of both frames; raise ValueError if one is missing or damaged, or shows only noise."""
        return [self._moving(frame) for frame in self.experiment.pair_frames(pair)]

    def counts(self, pair: int) -> Mapping[str, float]:
        """Return the mean count of each camera's first image of a pair as it is stored; raise ValueError as `pair`."""
        first = self.experiment.pair_frames(pair)[0]
        moving = self._moving(first)
        return {name: scale * float(np.mean(moving[name], dtype=float)) for name, scale in self._scale(first).items()}

    def _moving(self, frame: Frame) -> Mapping[str, np.ndarray]:
        still, images = self._still, self._scaled(frame)
        return without_still_light(images, still) if still else images

    def _readable(self, pair: int) -> Sequence[Frame]:
        """Return both frames of a pair; none if the images of one cannot be used."""
        frames = self.experiment.pair_frames(pair)
        try:
            for frame in frames:
                self._light(frame)
        except ValueError as error:  # a pair that cannot be used fails when it is reconstructed
            log.debug("movements of the cameras without pair %d: %s", pair, error)
            return ()
        return frames

    def _scaled(self, frame: Frame) -> Mapping[str, np.ndarray]:
        """Return the images of a frame, each on the usual scale of its camera; raise ValueError as `_light`."""
        light = self._light(frame)
        return {name: light[name] / np.float32(scale) for name, scale in self._scale(frame).items()}

    def _scale(self, frame: Frame) -> dict[str, float]:
        """Return the scale of each image of a frame that was read: 1 for the camera nearest to its usual scale.

        What all cameras share is the exposure of the frame, which stays.
        """
        levels = self._levels[frame]
        if not self._frames or min(*levels.values(), *self._usual.values()) <= 0:
            return dict.fromkeys(levels, 1.0)
        ratios = {name: level / self._usual[name] for name, level in levels.items()}
        exposure = min(ratios.values(), key=lambda ratio: abs(math.log(ratio)))
        return {name: ratio / exposure for name, ratio in ratios.items()}

    def _light(self, frame: Frame) -> Mapping[str, np.ndarray]:
        """Return the images of a frame; raise ValueError if one is missing or damaged, or shows only noise."""
        if frame in self._recent:
            return self._recent[frame]
        found = {}
        for name, camera in self.cameras.items():
            raw = self.experiment.frame_image(name, frame)
            found[name], _ = without_background(camera, raw, self._darks[name], frame)
            if frame not in self._levels and measure_structure(found[name], camera.decoder) < NOISE:
                raise ValueError("expected particles, found only noise")
        self._levels[frame] = {name: float(np.mean(image, dtype=float)) for name, image in found.items()}
        kept = max(len(self.experiment.frames), KEPT_BYTES // sum(image.nbytes for image in found.values()))
        for old in list(self._recent)[: max(len(self._recent) + 1 - kept, 0)]:
            del self._recent[old]
        self._recent[frame] = found
        return found


def all_show_particles(frames: Sequence[Mapping[str, np.ndarray]], cameras: Mapping[str, CalibratedCamera]) -> bool:
    """Return whether images without still light show particles clearly, in every frame and camera."""
    return all(
        measure_structure(images[name], camera.decoder) > CLEAR for images in frames for name, camera in cameras.items()
    )


def _apart(
    disparity: float, experiment: Experiment, cameras: Mapping[str, CalibratedCamera], *, in_time: bool
) -> Warning:
    names = " and ".join(cameras) if len(cameras) == 2 else "the cameras"
    cause = "a camera moved since the board was recorded" + ("" if in_time else ", or its images are late or early")
    advice = (
        "record the board again"
        if experiment.self_calibration.pairs
        else f"set self_calibration.pairs = {min(5, experiment.pairs)}, or record the board again"
    )
    advice = advice if in_time else f"compare the order of the images of all cameras; if it is right, {advice}"
    distance_mm = disparity * experiment.grid.voxel_mm
    figures = {"names": names, "voxel": disparity, "mm": distance_mm, "cause": cause, "advice": advice}
    return Warning(code=Code.APART, figures=figures)

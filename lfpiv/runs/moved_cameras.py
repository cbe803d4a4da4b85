"""Cameras that moved since the board was recorded: warn about them, or correct the calibration.

Both use the particle images of both frames of some pairs, without the light that stays in place. `check` measures how
far apart the cameras show the same particles; `correct` fits the movements of the cameras to these disparities.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from itertools import chain, islice
from typing import TYPE_CHECKING, Any

import numpy as np

from lfpiv.lightfield.particle_signal import NOISE, seen_structure
from lfpiv.progress import StepProgress
from lfpiv.records import validate
from lfpiv.runs.frame_light import frame_light, read_darks
from lfpiv.selfcalibration.disparity import SEARCH_VOXEL, CameraVolumes, still_light, unlinked, without_still_light
from lfpiv.selfcalibration.movements import Verdict, fit_movements, self_calibrate
from lfpiv.warn import Code, Warning, name_pairs, warn

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera, Calibration
    from lfpiv.experiment.experiment import Experiment, Frame
    from lfpiv.selfcalibration.movements import Movement, MovementFit
    from lfpiv.weights.operator import Weights

log = logging.getLogger(__name__)

LARGE_VOXEL = 0.25
"""Disparity of the cameras across their lines of sight above which `check` warns [voxel]."""

TRIED = 3
"""Largest number of pairs that `check` uses. One is enough if it shows clearly whether the disparity is large."""

FRAMES = 2
"""Instants of a pair."""

LEAST_FOR_NOTHING = 2
"""Least number of pairs without common particles that a warning of it needs."""

LIKE = 0.5
"""Least share of the movements shown by all pairs together in those that a pair shows alone, of pairs that agree."""

AGREEING = 2
"""Least number of pairs that agree on cameras that moved, where more than one was used: chance peaks differ by pair."""

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
    def of(cls, movement: Movement) -> MovementFigures:
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
        """Read the form that a file stores.

        Raises
        ------
        RecordError
            If it has another form.
        """
        return validate(cls, stored)


@dataclass(frozen=True, kw_only=True)
class CameraDisparity:
    """Distance at which the cameras show the same particles."""

    voxel: float
    std_voxel: float
    """Standard error of `voxel`."""
    pair: int
    """First pair that it was measured with."""


def correct(
    experiment: Experiment, calibration: Calibration, progress: StepProgress
) -> tuple[Calibration, SelfCalibrationFigures]:
    """Correct a calibration by the pairs that the experiment names; return it with its figures.

    It stays the board's where the images do not show how cameras moved; the figures say why.
    """
    shown, used, images = _ShownParticles(experiment, calibration.cameras), list[int](), list[dict[str, np.ndarray]]()
    for pair, moving in shown.without_still_light(experiment.self_calibration_pairs):
        images += moving
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
        movements={name: MovementFigures.of(movement) for name, movement in found.movements.items()},
    )


def check(experiment: Experiment, weights: Weights, pairs: Iterable[int]) -> CameraDisparity | None:
    """Measure how far apart the cameras show the same particles; warn if it is far.

    Uses one pair after another, `pairs` first, until the answer is clear. Return None if there is one camera only, if
    no pair shows particles, or if the cameras show none in common. Warn in the last case if several pairs agree on it.
    """
    if len(weights.cameras) < 2:
        return None
    shown, volumes, used = _ShownParticles(experiment, weights.cameras), CameraVolumes(weights), list[int]()
    fit, lost, losses, clear = None, list[str](), 0, True
    limit_mm = LARGE_VOXEL * experiment.grid.voxel_mm
    tried = list(islice(experiment.disjoint(chain(pairs, experiment.numbers)), TRIED))
    for pair, light in shown.without_still_light(tried):
        try:
            for images in light:
                volumes.add(images)
        except ValueError as error:  # a pair that cannot be used fails when it is reconstructed
            log.debug("disparity of the cameras in pair %d: %s", pair, error)
            continue
        used.append(pair)
        found = volumes.disparities()
        if lost := unlinked(found, weights.cameras):
            losses += 1
            clear = clear and all(_shows_particles(images, weights.cameras) for images in light)
            continue
        fit = fit_movements(found, list(weights.cameras), experiment.grid)
        if fit.separation.differs_from(limit_mm) and (fit.separation.mm < limit_mm or _agree(volumes, used, fit)):
            break
    if fit is None or lost:
        if clear and losses >= LEAST_FOR_NOTHING:
            warning = _nothing_in_common(dict.fromkeys(used, lost), len(weights.cameras))
            warn(log, warning if experiment.series is None else warning.by_instant())
        return None
    separation = fit.separation
    disparity, std = (length / experiment.grid.voxel_mm for length in (separation.mm, separation.std_mm))
    text = "cameras show the particles of %s %.2f voxel apart (standard error %.2f)"
    log.info(text, name_pairs(used, experiment.noun), disparity, std)
    if disparity > LARGE_VOXEL and separation.significant and (len(used) == 1 or _agree(volumes, used, fit)):
        warn(log, _apart(disparity, experiment, weights.cameras))
    return CameraDisparity(voxel=round(disparity, 3), std_voxel=round(std, 3), pair=used[0])


def _agree(volumes: CameraVolumes, used: Sequence[int], fit: MovementFit) -> bool:
    """Return whether several pairs, each alone, show about the movements that all of them show together."""
    if len(used) < AGREEING:
        return False
    alone = [part.disparities() for part in volumes.each(FRAMES)]
    fits = [fit_movements(found, list(fit.cameras), volumes.weights.grid) for found in alone if found]
    return sum(fit.share_in(one) > LIKE for one in fits) >= AGREEING


@dataclass(frozen=True)
class _ShownParticles:
    """Particle images of the pairs that show particles. An image of each camera is given by its name."""

    experiment: Experiment
    cameras: Mapping[str, CalibratedCamera]

    @cached_property
    def _darks(self) -> Mapping[str, np.ndarray | None]:
        return read_darks(self.experiment)

    def without_still_light(self, pairs: Sequence[int]) -> Iterator[tuple[int, list[dict[str, np.ndarray]]]]:
        """Yield each pair and the images of both its frames, without the light that stays in place in all pairs.

        One pair does not tell that light in a slow flow, where particles hardly move between its frames. Images are
        read twice, since those of all pairs may not fit into memory.
        """
        still = still_light(images for _, frames in self._each(pairs) for images in frames)
        for pair, frames in self._each(pairs):
            yield pair, [without_still_light(images, still) for images in frames]

    def _each(self, pairs: Iterable[int]) -> Iterator[tuple[int, list[Mapping[str, np.ndarray]]]]:
        for pair in pairs:
            try:
                light = [self._light(frame) for frame in self.experiment.pair_frames(pair)]
            except ValueError as error:  # a pair that cannot be used fails when it is reconstructed
                log.debug("movements of the cameras without pair %d: %s", pair, error)
                continue
            yield pair, light

    def _light(self, frame: Frame) -> Mapping[str, np.ndarray]:
        """Return the images of a frame; raise ValueError if one is missing or damaged, or shows only noise."""
        found = frame_light(self.experiment, self.cameras, self._darks, frame)
        if min(found.structure.values()) < NOISE:
            raise ValueError("expected particles, found only noise")
        return found.images


def _shows_particles(images: Mapping[str, np.ndarray], cameras: Mapping[str, CalibratedCamera]) -> bool:
    """Return whether images without still light show particles clearly, in every camera."""
    return all(seen_structure(images[name], camera.decoder) > CLEAR for name, camera in cameras.items())


def _apart(disparity: float, experiment: Experiment, cameras: Mapping[str, CalibratedCamera]) -> Warning:
    names = " and ".join(cameras) if len(cameras) == 2 else "the cameras"
    advice = (
        "record the board again"
        if experiment.self_calibration.pairs
        else f"set self_calibration.pairs = {min(5, experiment.pairs)}, or record the board again"
    )
    distance_mm = disparity * experiment.grid.voxel_mm
    return Warning(code=Code.APART, figures={"names": names, "voxel": disparity, "mm": distance_mm, "advice": advice})


def _nothing_in_common(lost: Mapping[int, Sequence[str]], cameras: int) -> Warning:
    """Return the warning about the cameras, by pair, that share no particle with another camera."""
    names = dict.fromkeys(name for some in lost.values() for name in some)
    others = "" if len(names) == cameras else " and the other cameras"
    figures = {"names": f"{' and '.join(names)}{others}", "search": SEARCH_VOXEL}
    return Warning(code=Code.NOTHING_IN_COMMON, pairs=tuple(lost), figures=figures)

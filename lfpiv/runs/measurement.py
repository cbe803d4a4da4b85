"""`prepare` and `measure_pair`: from the images of one pair to its vectors by calls, as `lfpiv run` does it.

The steps are those of `lfpiv.runs.rig` and `lfpiv.runs.pair`. What a run keeps in its folder lies in a temporary one.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

from lfpiv.errors import InputError
from lfpiv.experiment.experiment import Experiment
from lfpiv.geometry.grid import Layers
from lfpiv.progress import Progress, StepProgress, ignore_progress, part_of
from lfpiv.prompt import Card, Shown, count, times
from lfpiv.results.pair_files import PairVolumes
from lfpiv.runs import memory, rig, worker_plan
from lfpiv.runs.frame_light import FrameLight, pair_light
from lfpiv.runs.pair import PairWork
from lfpiv.runs.pair_outcome import CORRELATED, PREPARED, RECONSTRUCTED
from lfpiv.runs.run import open_run

if TYPE_CHECKING:
    from lfpiv.calibration.camera import Calibration
    from lfpiv.weights.operator import Weights

PAIR = "image pair"
"""Name of the step that measures a pair, for progress."""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Rig(Shown):
    """What all pairs of an experiment share. Made by `prepare`."""

    experiment: Experiment
    calibration: Calibration
    """Cameras that know what stands still in their images, corrected for movements if the experiment demands it."""
    weights: Weights
    """The operator on the voxels that are reconstructed: with guard layers, of smaller edges."""
    guard: Layers
    """Layers of voxels, in those of the experiment, beyond each face of its grid (z, y, x)."""
    refinement: float
    """Edge of a voxel of the experiment over the edge of a reconstructed voxel."""
    work: PairWork
    """The work on pairs, as a run does it."""

    def card(self) -> Card:
        """Return what matters of the rig, for people."""
        layers = ", ".join(f"{axis} {low} and {high}" for axis, (low, high) in zip("zyx", self.guard, strict=True))
        grid = self.weights.grid
        standing = [name for name, camera in self.calibration.cameras.items() if camera.standing is not None]
        facts = (
            ("experiment", str(self.experiment.path)),
            ("guard layers", layers),
            ("reconstructed voxels", f"{times(grid.shape)} (z, y, x) of {grid.voxel_mm:.4g} mm"),
            ("light that stands", f"subtracted from {', '.join(standing)}" if standing else "none"),
            ("use", "vectors = lfpiv.measure_pair(rig, pair)"),
        )
        cameras = count(len(self.weights.cameras), "camera")
        return Card(f"Rig of {cameras}, for {count(self.experiment.pairs, self.experiment.noun)}", facts)

    def light(self, pair: int) -> tuple[FrameLight, FrameLight]:
        """Read the images of both frames of a pair.

        The ``images`` of a frame are given by camera, less dark image and background, shape (rows, columns) [counts];
        ``noise`` is the noise of their background [counts], the floor of `lfpiv.reconstruct`.

        Raises
        ------
        InputError
            If an image is missing, damaged or uniform, or two images are the same.
        """
        return pair_light(self.experiment, self.work.cameras, self.work.darks, self._known(pair))

    def volumes(self, pair: int) -> tuple[xr.DataArray, xr.DataArray]:
        """Reconstruct both frames of a pair on the voxels of the experiment, shape (z, y, x) [counts].

        Raises
        ------
        InputError
            As `light`, and if the images cannot be reconstructed.
        """
        return self._volumes(pair, _ignore).volumes

    @property
    def smart(self) -> dict[str, Any]:
        """The experiment's settings as keywords of `lfpiv.reconstruct`, lengths in reconstructed voxels."""
        return self.experiment.smart.of_one_frame(self.refinement)

    @property
    def correlation(self) -> dict[str, Any]:
        """The experiment's settings as keywords of `lfpiv.correlate`."""
        return self.experiment.correlation.model_dump()

    def vectors(self, pair: int, progress: StepProgress | None = None) -> xr.Dataset:
        """Measure one pair; see `measure_pair`."""
        step = progress or _ignore
        volumes = self._volumes(pair, part_of(step, PREPARED, RECONSTRUCTED))
        step(RECONSTRUCTED)
        with threadpool_limits(1):  # as in a run, whose numbers do not depend on the threads of BLAS
            if self.experiment.by_links:
                light = [self.work.light_again(frame) for frame in self.experiment.pair_frames(pair)]
                vectors, _, _ = self.work.tracked(pair, light, volumes)
            else:
                vectors = self.work.vectors_between(pair, volumes)
        step(CORRELATED)
        origin = self.work.files(pair).origin
        return vectors.assign_attrs({"experiment": self.experiment.name, **origin})

    def _volumes(self, pair: int, progress: StepProgress) -> PairVolumes:
        files = self.work.files(self._known(pair))
        with threadpool_limits(1):
            return self.work.volumes(files, self.work.frames(), progress)

    def _known(self, pair: int) -> int:
        numbers = self.experiment.numbers
        if isinstance(pair, bool) or not isinstance(pair, int | np.integer) or pair not in numbers:
            noun = self.experiment.noun
            raise ValueError(f"pair: expected the number of a {noun}, {numbers[0]} to {numbers[-1]}, got {pair!r}.")
        return int(pair)


def prepare(
    experiment: Experiment | str | Path,
    calibration: Calibration | None = None,
    *,
    device: str | None = None,
    progress: Progress | None = None,
) -> Rig:
    """Make what all pairs of an experiment share, as `lfpiv run` does before the first pair.

    These are: the light that stands still, the cameras corrected for movements where ``self_calibration.pairs`` demands
    it, guard layers, size of the voxels that are reconstructed, and weights. It takes as long as a run does before its
    first pair; nothing is written.

    Parameters
    ----------
    experiment : Experiment or path
        The experiment, or its file.
    calibration : Calibration, optional
        From `calibrate` or `load_calibration`; default: the cameras are calibrated.
    device : {"auto", "cpu", "cuda"}, optional
        Default: ``compute.device`` of the experiment.
    progress : callable, optional
        Called as ``progress(step, fraction)``.

    Returns
    -------
    Rig
        For `measure_pair`. Its ``weights``, ``light`` and ``volumes`` give the steps between.

    Raises
    ------
    InputError
        If files, keys, memory or device are not as expected, or the calibration is of other cameras.
    """
    with (
        tempfile.TemporaryDirectory(prefix="lfpiv-") as scratch,
        open_run(experiment, scratch, device, progress) as current,
    ):
        if calibration is None:
            calibration = rig.calibrate(current).calibration
        _require_cameras(calibration, current.experiment)
        current, prepared = rig.prepare(current, calibration)
        finest = current.reconstructed_experiment
        worker_plan.require_memory(finest, memory.weights_bytes(finest, current.particle_voxel), 1)
        weights, figures = rig.build_weights(current, prepared, current.numbers[:1])
        work = rig.pair_work(current, weights, keep_volumes=False, figures=figures)
        return Rig(
            experiment=current.experiment,
            calibration=prepared.calibration,
            weights=weights,
            guard=work.inputs.guard,
            refinement=work.inputs.refinement,
            work=work,
        )


def measure_pair(
    rig: Rig | Experiment | str | Path,
    pair: int | None = None,
    *,
    calibration: Calibration | None = None,
    progress: Progress | None = None,
) -> xr.Dataset:
    """Measure the vectors of one pair: read its images, reconstruct both volumes, correlate them.

    The numbers are those that `lfpiv run` writes into the file of the pair. For several pairs give the `Rig` that
    `prepare` returns: an experiment is prepared in every call.

    Parameters
    ----------
    rig : Rig, Experiment or path
        What the pairs share, or the experiment, or its file.
    pair : int, optional
        Number of the pair, in a series of its first instant; default: the first one.
    calibration : Calibration, optional
        For an experiment: as of `prepare`.
    progress : callable, optional
        Called as ``progress(step, fraction)``.

    Returns
    -------
    Dataset
        Vectors as `correlate` returns them, with ``u``, ``v``, ``w`` [m/s] over z, y, x [mm]. Attributes as in the file
        of a run; ``warnings`` is the JSON of the warnings about the images. Particles (table ``[tracking]``) and the
        damping by ghosts (``[bootstrap]``) are left to `lfpiv.run`.

    Raises
    ------
    InputError
        As `prepare`, and if the images of the pair cannot be used or reconstructed.
    ValueError
        If there is no such pair, or `calibration` is given with a rig.

    Examples
    --------
    >>> import lfpiv
    >>> rig = lfpiv.prepare("experiment.toml")  # doctest: +SKIP
    >>> fields = [lfpiv.measure_pair(rig, pair) for pair in range(3)]  # doctest: +SKIP
    """
    if isinstance(rig, Rig):
        if calibration is not None:
            raise ValueError("calibration: expected none with a rig, which has its own. Give it to `prepare`.")
    else:
        rig = prepare(rig, calibration, progress=progress)
    number = rig.experiment.numbers[0] if pair is None else pair
    whole = progress or ignore_progress

    def step(fraction: float) -> None:
        whole(PAIR, fraction)

    vectors = rig.vectors(number, step)
    step(1.0)
    return vectors


def _require_cameras(calibration: Calibration, experiment: Experiment) -> None:
    """Refuse a calibration whose cameras have other names or optics than those of the experiment."""
    stated = {camera.name: camera.optics for camera in experiment.cameras}
    if {name: camera.optics for name, camera in calibration.cameras.items()} != stated:
        raise InputError(
            f"calibration: expected the cameras {', '.join(stated)} with the optics of {experiment.path}, found "
            f"{', '.join(calibration.cameras)}. Calibrate again."
        )


def _ignore(fraction: float) -> None:
    """Do nothing; the default progress of a step."""

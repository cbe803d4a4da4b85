"""`reconstruct_pair`: the volumes of an image pair, each frame by itself or both fitted together with the displacement.

Images of two cameras hardly tell particles from ghosts: SMART keeps what its first guess holds. Particles follow the
flow from one frame to the other, ghosts do not. So one volume and one displacement are fitted to the images of both
frames (`lfpiv.joint.fit`). The volumes of each frame by itself stay with the result: their displacement is independent
evidence (`lfpiv.joint.vectors`).
"""

from __future__ import annotations

import enum
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

from lfpiv.geometry.grid import AXES, Grid
from lfpiv.geometry.resampling import volume_on
from lfpiv.joint.fit import JointFit, fit_pair
from lfpiv.joint.model import JointModel
from lfpiv.joint.spline_field import SPACING_VOXEL
from lfpiv.reconstruction.frame import PreparedFrame
from lfpiv.reconstruction.result import Reconstruction
from lfpiv.reconstruction.settings import SmartSettings
from lfpiv.reconstruction.solver import SmartSolver, Volume
from lfpiv.sequence.motion_field import LEAST_VALID
from lfpiv.settings.processing import Correlation, Smart
from lfpiv.velocity.cross_correlation import correlate
from lfpiv.warn import collected
from lfpiv.weights.operator import Weights
from lfpiv_kernels.transfer import to_host

log = logging.getLogger(__name__)

ALONE_SHARE = 0.3
"""Share of the time of a joint estimate that both frames take by themselves."""

UNSHARED = "unshared"
"""Coordinate of a volume of a joint fit: the volume of the frame by itself."""
MOVED = {axis: f"moved_{axis}" for axis in AXES}
"""Coordinates of the first volume of a joint fit: displacement between the frames at voxels midway in time [voxel]."""


class Estimate(enum.Enum):
    """How the volumes of a pair were made; the text is the advice."""

    ALONE = "each frame reconstructed by itself"
    JOINT = "both frames fitted together with the displacement"
    TOO_THIN = f"the volume is thinner than the distance of the displacement's nodes, {SPACING_VOXEL:g} voxels"
    NOT_STARTED = "too few valid vectors to start a joint fit: look at windows, seeding and displacements"


@dataclass(frozen=True, kw_only=True)
class PairResult:
    """Reconstructions of both frames of a pair."""

    frames: tuple[Reconstruction, Reconstruction]
    unshared: tuple[Reconstruction, Reconstruction]
    """Each frame by itself; the same as `frames` without a joint fit."""
    estimate: Estimate
    model: JointModel | None = None
    fit: JointFit | None = None

    def to_dataarrays(self, grid: Grid | None = None) -> tuple[xr.DataArray, xr.DataArray]:
        """Return both volumes on a grid, by default their own, with what `reconstruct_pair` documents."""
        volumes = []
        for frame, before in zip(self.frames, self.unshared, strict=True):
            volume = frame.to_dataarray()
            volume.attrs["estimate"] = self.estimate.value
            if self.fit is not None:
                about = {"units": "counts", "long_name": "particle intensity, this frame by itself"}
                volume = volume.assign_coords({UNSHARED: (volume.dims, before.volume, about)})
                ratio = round(self.fit.misfit_ratio, 4)
                volume.attrs |= {"rounds": self.fit.rounds, "misfit_ratio": ratio, "lossy": int(self.fit.lossy)}
                volume.attrs["unlike"] = round(self.fit.unlike, 4)
            volumes.append(volume if grid is None else volume_on(volume, grid))
        first, second = volumes
        if self.fit is not None and self.model is not None:
            moved = self.model.field.values_on(self.fit.nodes, grid or self.model.field.grid)
            coordinates = {}
            for axis, values in zip(AXES, moved, strict=True):
                about = {"units": "voxel", "long_name": f"displacement along {axis} midway between the frames"}
                coordinates[MOVED[axis]] = (AXES, values, about)
            first = first.assign_coords(coordinates)
        return first, second


class PairSolver:
    """Reconstruction of image pairs of one rig with fixed settings.

    Parameters
    ----------
    weights : Weights
        The operator. The joint fit starts from vectors between volumes on its attribute ``volume``.
    settings : SmartSettings
        Settings of the reconstruction.
    estimate : {"auto", "correlation", "joint"}
        Whether each frame is reconstructed by itself, or both are fitted together; "auto" fits them together where
        there are two or more cameras.
    correlation : mapping, optional
        Settings of `correlate`, which gives the first displacement; default: those of an experiment without such a
        table.

    Raises
    ------
    ValueError
        If `estimate` is unknown, or "joint" with a single camera.
    """

    def __init__(
        self,
        weights: Weights,
        settings: SmartSettings,
        *,
        estimate: str = Smart().estimate,
        correlation: Mapping[str, Any] | None = None,
    ):
        if estimate not in ("auto", "correlation", "joint"):
            raise ValueError(f"estimate: expected 'auto', 'correlation' or 'joint', got {estimate!r}.")
        several = len(weights.cameras) > 1
        if estimate == "joint" and not several:
            raise ValueError("estimate: 'joint' needs two or more cameras, got one; use 'correlation'.")
        self.smart = SmartSolver(weights, settings)
        self.is_joint = estimate == "joint" or (estimate == "auto" and several)
        self.correlation = Correlation().model_dump() if correlation is None else dict(correlation)

    def solve(
        self,
        images: Sequence[Mapping[str, np.ndarray]],
        floors: Sequence[float | Mapping[str, float] | None] = (None, None),
        progress: Callable[[float], None] | None = None,
        *,
        masks: Sequence[Volume | None] = (None, None),
    ) -> PairResult:
        """Reconstruct both frames of a pair; arguments as of `reconstruct_pair`, `masks` of the frames in order.

        Raises
        ------
        ValueError
            If there are not two frames, or `reconstruct` or `correlate` refuse their arguments.
        """
        if len(images) != 2 or len(floors) != 2:
            raise ValueError(f"images, floor: expected two frames, got {len(images)} and {len(floors)}.")
        if len(masks) != 2:
            raise ValueError(f"mask: expected one for both frames, or two, got {len(masks)}.")
        alone = ALONE_SHARE if self.is_joint else 1.0

        def step(start: float, end: float, fraction: float) -> None:
            if progress is not None:
                progress(start + fraction * (end - start))

        prepared, found = list[PreparedFrame](), list[Reconstruction]()
        for number, (own, floor, mask) in enumerate(zip(images, floors, masks, strict=True)):
            try:
                frame = self.smart.prepare(own, floor=floor, mask=mask)
                one = frame.solve(progress=partial(step, number / 2 * alone, (number + 1) / 2 * alone))
            except ValueError as error:
                raise ValueError(f"frame {number + 1} of the pair: {error}") from error
            prepared.append(frame)
            found.append(one)
        both = (found[0], found[1])
        result = PairResult(frames=both, unshared=both, estimate=Estimate.ALONE)
        if self.is_joint:
            result = self._joint(prepared, result, partial(step, alone, 1.0))
        step(0.0, 1.0, 1.0)
        return result

    def _joint(
        self, prepared: Sequence[PreparedFrame], alone: PairResult, progress: Callable[[float], None]
    ) -> PairResult:
        """Return the joint fit that starts from the frames by themselves, or these if it cannot be better."""
        weights = self.smart.weights
        model = JointModel(weights, prepared)
        if min(weights.grid.shape) < model.field.spacing_voxel:
            return replace(alone, estimate=Estimate.TOO_THIN)
        volumes = [volume_on(frame.to_dataarray(), weights.volume) for frame in alone.frames]
        with collected(quiet=True):
            vectors = correlate(*volumes, **self.correlation)
        if float(vectors.attrs["valid_fraction"]) < LEAST_VALID * float(vectors.attrs["measurable_fraction"]):
            log.warning("joint fit: %.0f %% of the vectors are valid; %s", *_share(vectors))
            return replace(alone, estimate=Estimate.NOT_STARTED)
        fit = fit_pair(model, alone.frames, model.field.fitted_to(vectors), progress)
        log.info("joint fit: %d rounds; misfit %.2f times the misfit of separate frames", fit.rounds, fit.misfit_ratio)
        frames = []
        for own, frame, end in zip(alone.frames, prepared, fit.residuals, strict=True):
            seen = weights.stored.restore(to_host(frame.normalisation.lit)) > 0
            volume = np.where(seen, end.volume, np.float32(0)).astype(np.float32)
            residual, misfit = (*own.residual, end.relative), (*own.misfit, end.misfit)
            frames.append(replace(own, volume=volume, residual=residual, misfit=misfit))
        return PairResult(
            frames=(frames[0], frames[1]), unshared=alone.frames, estimate=Estimate.JOINT, model=model, fit=fit
        )


def _share(vectors: xr.Dataset) -> tuple[float, str]:
    return 100 * float(vectors.attrs["valid_fraction"]), Estimate.NOT_STARTED.value


def reconstruct_pair(
    weights: Weights,
    images: Sequence[Mapping[str, np.ndarray]],
    *,
    estimate: str = Smart().estimate,
    floor: Sequence[float | Mapping[str, float] | None] = (None, None),
    correlation: Mapping[str, Any] | None = None,
    mask: Volume | Sequence[Volume] | None = None,
    grid: Grid | None = None,
    progress: Callable[[float], None] | None = None,
    **smart: Any,
) -> list[xr.DataArray]:
    """Reconstruct the two volumes of an image pair, each by itself or both fitted together with the displacement.

    For many pairs make one `PairSolver`.

    Parameters
    ----------
    weights : Weights
        The operator.
    images : sequence of two mappings of str to ndarray
        Images of the first and the second frame, each as `reconstruct` takes them.
    estimate : {"auto", "correlation", "joint"}
        "correlation" reconstructs each frame by itself. "joint" fits one volume midway in time and its displacement to
        the images of both frames; it needs two or more cameras. "auto" takes "joint" where there are so many.
    floor : sequence of two
        Noise floor of each frame's images, as `reconstruct` takes it.
    correlation : mapping, optional
        Settings of `correlate`, which gives the first displacement of a joint fit; default: those of an experiment
        without such a table.
    mask : ndarray or DataArray, shape (z, y, x), or a tuple or list of two, optional
        Voxels without fluid, as of `reconstruct`; of a body that moves, one mask for each frame.
    grid : Grid, optional
        Voxels of the returned volumes; default: the grid of the weights. See `volume_on`.
    progress : callable, optional
        Called with the finished fraction.
    **smart
        The other settings of `reconstruct`, with its defaults.

    Returns
    -------
    list of two DataArrays, shape (z, y, x), float32
        Volumes as `reconstruct` returns them, with the attribute `estimate`: how they were made. After a joint fit the
        attributes `rounds`, `misfit_ratio` and `lossy` state its rounds, its misfit over that of the frames by
        themselves, and whether brightness differs between the frames, since particles are lost between them. `unlike`
        states how much the cameras ask for unlike light (`lfpiv.reconstruction.unlike_light`). The last
        of `residual` and `misfit` are those of the fit, the coordinate `UNSHARED` is the volume of the frame by itself,
        and the coordinates `MOVED` of the first volume are the displacement. `joint_vectors` makes vectors of them.

    Raises
    ------
    ValueError
        If an argument is out of its range, or `reconstruct` or `correlate` refuse theirs.
    """
    if "first" in smart:
        raise ValueError("first: expected no first guess of a pair; use `reconstruct` for one.")
    solver = PairSolver(weights, SmartSettings(**smart), estimate=estimate, correlation=correlation)
    masks = mask if isinstance(mask, (tuple, list)) else (mask, mask)
    with threadpool_limits(1, "blas"):  # its sums depend on its number of threads
        return list(solver.solve(images, floor, progress, masks=masks).to_dataarrays(grid))

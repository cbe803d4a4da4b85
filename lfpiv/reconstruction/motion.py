"""`reconstruct_pair`: both frames of a pair by SMART, each corrected by what the other one shows of the same particles.

Images of two cameras hardly distinguish particles from ghosts: SMART keeps what its first guess holds. Particles follow
the flow from one frame to the other; ghosts do so only where all particles around move alike. So both frames are
reconstructed, the motion is measured, and each frame is reconstructed again from a first guess that both volumes share
along the motion (`lfpiv.reconstruction.shared_light`), as in motion tracking enhancement [1]_. There both volumes are
averaged; here only the brightness changes (docs/notebook/accuracy.md).

Volumes that share their light have noise in common, which their correlation cannot show. So the volumes of each frame
by itself stay with the result, and `unshared_quality` measures the uncertainty in those.

.. [1] M. Novara, K. J. Batenburg, F. Scarano, "Motion tracking-enhanced MART for tomographic PIV", Meas. Sci. Technol.
   21 (2010) 035401, doi:10.1088/0957-0233/21/3/035401.
"""

from __future__ import annotations

import enum
import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from lfpiv.geometry.grid import AXES
from lfpiv.reconstruction.result import Reconstruction
from lfpiv.reconstruction.settings import DEFAULTS, SmartSettings, require_whole
from lfpiv.reconstruction.shared_light import MotionField, shared_guesses
from lfpiv.reconstruction.solver import SmartSolver, Volume
from lfpiv.settings.processing import Correlation
from lfpiv.velocity.cross_correlation import correlate
from lfpiv.velocity.multi_pass import UndeformedPair, peak_ratio
from lfpiv.velocity.peak_width import peak_reach, refine_search
from lfpiv.velocity.settings import CorrelationSettings
from lfpiv.velocity.systematic import unexplained, with_systematic
from lfpiv.velocity.volume_pair import missing_smoothing, preprocess, solid_voxels, voxel_axes
from lfpiv.velocity.windows import Windows
from lfpiv.weights.operator import Weights
from lfpiv_kernels.correlation.correlate import correlate_windows
from lfpiv_kernels.correlation.uncertainty import displacement_deviation

log = logging.getLogger(__name__)

ITERATION_SHARE = 0.4
"""Iterations of a motion pass, as a share of those of the first reconstruction."""
LEAST_VALID = 0.3
"""Least share of valid vectors, of those that can be measured, with which the motion is followed."""

UNSHARED = "unshared"
"""Coordinate of a volume that shares light with the other frame: the volume of the frame by itself."""


class Motion(enum.Enum):
    """Whether the motion was followed; the text is the advice."""

    OFF = "each frame reconstructed by itself"
    FOLLOWED = "volumes reconstructed anew from what both frames show along the motion"
    LOST = "too few valid vectors to follow the motion: look at windows, seeding and displacements"


@dataclass(frozen=True, kw_only=True)
class PairResult:
    """Reconstructions of both frames of a pair."""

    frames: tuple[Reconstruction, Reconstruction]
    """After all passes, with the history of all passes."""
    unshared: tuple[Reconstruction, Reconstruction]
    """Each frame by itself: the first reconstructions. The same as `frames` if no pass was made."""
    motion: Motion
    valid_fractions: tuple[float, ...]
    """Share of valid vectors measured before each pass."""

    def to_dataarrays(self) -> list[xr.DataArray]:
        """Return both volumes with the attributes and coordinates that `reconstruct_pair` documents."""
        volumes = []
        for frame, before in zip(self.frames, self.unshared, strict=True):
            volume = frame.to_dataarray()
            volume.attrs |= {"motion": self.motion.value, "motion_valid": list(self.valid_fractions)}
            if frame is not before:
                about = {"units": "counts", "long_name": "particle intensity, this frame by itself"}
                volume = volume.assign_coords({UNSHARED: (volume.dims, before.volume, about)})
            volumes.append(volume)
        return volumes


class PairSolver:
    """Reconstruction of image pairs of one rig with fixed settings.

    Parameters
    ----------
    weights : Weights
        The operator.
    settings : SmartSettings
        Settings of the first reconstruction. A motion pass has at most `ITERATION_SHARE` of its iterations.
    motion_passes : int
        How often the motion is measured and followed, >= 0.
    correlation : mapping, optional
        Settings of `correlate`, which measures the motion; default: those of an experiment without such a table.

    Raises
    ------
    ValueError
        If `motion_passes` is out of its range.
    """

    def __init__(
        self,
        weights: Weights,
        settings: SmartSettings,
        *,
        motion_passes: int = DEFAULTS.motion_passes,
        correlation: Mapping[str, Any] | None = None,
    ):
        require_whole("motion_passes", motion_passes)
        self.smart = SmartSolver(weights, settings)
        self.motion_passes = motion_passes
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
            raise ValueError(f"mask: expected one, or one of each frame, got {len(masks)}.")
        iterations = self.smart.settings.iterations
        restart = math.ceil(ITERATION_SHARE * iterations)
        total, done = 2.0 * (iterations + self.motion_passes * restart), 0.0

        def solve_frame(number: int, count: int, first: np.ndarray | None = None) -> Reconstruction:
            nonlocal done

            def step(fraction: float) -> None:
                if progress is not None and total > 0:
                    progress((done + fraction * count) / total)

            found = self.smart.solve(
                images[number],
                floor=floors[number],
                mask=masks[number],
                iterations=count,
                first=first,
                progress=step,
            )
            done += count
            return found

        frames = []
        for number in (0, 1):
            try:
                frames.append(solve_frame(number, iterations))
            except ValueError as error:
                raise ValueError(f"frame {number + 1} of the pair: {error}") from error
        unshared, motion, valid = list(frames), Motion.OFF, list[float]()
        for _ in range(self.motion_passes):
            volumes = [frame.to_dataarray() for frame in frames]
            vectors = correlate(*volumes, dt_s=1.0, **self.correlation)
            valid.append(round(float(vectors.attrs["valid_fraction"]), 4))
            if valid[-1] < LEAST_VALID * float(vectors.attrs["measurable_fraction"]):
                motion = Motion.LOST
                log.warning("motion: %.0f %% of the vectors are valid; %s", 100 * valid[-1], motion.value)
                break
            motion = Motion.FOLLOWED
            for number, guess in enumerate(shared_guesses(volumes, vectors)):
                frames[number] = frames[number].continued_by(solve_frame(number, restart, guess))
        if progress is not None:
            progress(1.0)
        return PairResult(
            frames=(frames[0], frames[1]),
            unshared=(unshared[0], unshared[1]),
            motion=motion,
            valid_fractions=tuple(valid),
        )


def reconstruct_pair(
    weights: Weights,
    images: Sequence[Mapping[str, np.ndarray]],
    *,
    motion_passes: int = DEFAULTS.motion_passes,
    floor: Sequence[float | Mapping[str, float] | None] = (None, None),
    correlation: Mapping[str, Any] | None = None,
    iterations: int = DEFAULTS.iterations,
    mask: Volume | Sequence[Volume] | None = None,
    progress: Callable[[float], None] | None = None,
    **smart: Any,
) -> list[xr.DataArray]:
    """Reconstruct the two volumes of an image pair, and with motion passes again from what they share along the motion.

    The first guesses of a motion pass are those of `lfpiv.reconstruction.shared_light.shared_guesses`. For many pairs
    make one `PairSolver`.

    Parameters
    ----------
    weights : Weights
        The operator.
    images : sequence of two mappings of str to ndarray
        Images of the first and the second frame, each as `reconstruct` takes them.
    motion_passes : int
        How often the motion is measured and followed, >= 0; 0, as in an experiment file without this key, reconstructs
        each frame by itself.
    floor : sequence of two
        Noise floor of each frame's images, as `reconstruct` takes it.
    correlation : mapping, optional
        Settings of `correlate`, which measures the motion; default: those of an experiment without such a table.
    iterations : int
        SMART iterations of the first reconstruction; a pass takes at most `ITERATION_SHARE` of them.
    mask : ndarray or DataArray, shape (z, y, x), or a tuple or list of two, optional
        Voxels without fluid, as of `reconstruct`; of a body that moves those of each frame.
    progress : callable, optional
        Called with the finished fraction.
    **smart
        The other settings of `reconstruct`, with its defaults. With a sieve a pass starts from the volume in place of
        its coefficients.

    Returns
    -------
    list of two DataArrays, shape (z, y, x), float32
        Volumes as `reconstruct` returns them. `residual`, `misfit` and `iterations` cover all passes; `stop` is that of
        the first reconstruction, unless a pass diverged. Further attributes: `motion`, whether the motion was followed;
        `motion_valid`, the share of valid vectors measured before each pass. If a pass was made, the coordinate
        `UNSHARED` is the volume of the first reconstruction: pass the vectors that `correlate` measures, and these
        volumes, to `unshared_quality`.

    Raises
    ------
    ValueError
        If an argument is out of its range, or `reconstruct` or `correlate` refuse theirs.
    """
    if "first" in smart:
        raise ValueError("first: expected no first guess, as each pass makes its own; use `reconstruct` for one.")
    settings = SmartSettings(iterations=iterations, **smart)
    solver = PairSolver(weights, settings, motion_passes=motion_passes, correlation=correlation)
    masks = mask if isinstance(mask, (tuple, list)) else (mask, mask)
    return solver.solve(images, floor, progress, masks=masks).to_dataarrays()


def unshared_quality(vectors: xr.Dataset, volumes: Sequence[xr.DataArray]) -> xr.Dataset:
    """Measure uncertainty, peak ratio and correlation of vectors in the volumes of each frame by itself.

    `correlate` takes for noise what two volumes do not have in common (`lfpiv_kernels.correlation.uncertainty`).
    Volumes that share their light have noise in common, so it states two thirds of the random error.
    The volumes of `UNSHARED` have independent noise. Here they are deformed onto each other by the vectors'
    displacements, and the same statistics are taken of them in the same windows: s. Correlated once more, they show a
    displacement that differs from the vectors' by d: sharing corrected it, or a wrong motion biased it. The uncertainty
    of each component is the larger one, ``max(s, |d|)``, and the systematic part of `lfpiv.velocity.systematic`. Peak
    ratio and correlation are those of this correlation.

    The random error s is the scatter if the same flow were recorded again. Ghosts move with the mean of the particles
    whose lines of sight cross in them [1]_. So they smooth the flow along its gradients in the same way in both frames
    and in every pair, which no statistics of noise show. A uniform flow has no such error. The systematic part
    estimates it. Motion passes reduce both errors, and d shows the reduction.

    Parameters
    ----------
    vectors : Dataset
        From `correlate` of the two volumes.
    volumes : sequence of two DataArrays, shape (z, y, x)
        From `reconstruct_pair`, with the coordinate `UNSHARED`; volumes without it leave the vectors as they are.

    Returns
    -------
    Dataset
        The vectors with other ``uncertainty_z``, ``_y``, ``_x`` and ``uncertainty`` [voxel], NaN where they were
        replaced, where the frames by themselves show no peak within `refine_search`, and after a single pass; with
        other ``peak_ratio`` and ``correlation``, unless after a single pass.

    References
    ----------
    .. [1] G. E. Elsinga, J. Westerweel, F. Scarano, M. Novara, "On the velocity of ghost particles and the bias errors
       in Tomographic-PIV", Exp. Fluids 50 (2011) 825-838, doi:10.1007/s00348-010-0930-0.
    """
    if not all(UNSHARED in volume.coords for volume in volumes):
        if any(volume.attrs.get("motion") == Motion.FOLLOWED.value for volume in volumes):
            log.warning("motion: volumes without those of each frame by itself; the uncertainty is too small")
        return vectors
    settings = CorrelationSettings.of(vectors)
    if len(settings.windows) == 1 or not vectors["valid"].any():
        return vectors
    motion, window = MotionField([volumes[0][axis].values for axis in AXES], vectors), settings.windows[-1]
    missing = missing_smoothing(settings.smoothing_voxel, *volumes)
    unshared = (volume[UNSHARED].values for volume in volumes)  # their scale does not matter
    first, second = (
        preprocess((light - np.median(light)).astype(np.float32), missing, settings.intensity_power)
        for light in unshared
    )
    axes = voxel_axes(volumes[0], volumes[1], None)
    solid = solid_voxels(None, volumes[0], volumes[1], axes)
    (first, second), _ = UndeformedPair((first, second), solid).deformed(motion.midway, window)
    step = tuple(round(at[1] - at[0]) if len(at) > 1 else n for at, n in zip(motion.nodes, first.shape, strict=True))
    windows = Windows.covering(first.shape, window, step)
    scatter = displacement_deviation(
        first, second, window=window, origin=windows.origin, step=step, count=windows.count
    )
    reach = peak_reach(first, second, window)
    search = refine_search(reach)
    left = correlate_windows(first, second, window=window, step=step, search=search, symmetric=True, reach=reach)
    measured = np.stack([vectors[f"displacement_{axis}"].values for axis in "zyx"], -1)
    shown = motion.midway.window_means(windows) + left.displacement
    valid = vectors["valid"].values
    deviation = np.maximum(scatter, np.abs(shown - measured))
    deviation[~valid] = np.nan
    deviation = with_systematic(deviation, measured, valid, unexplained(*volumes))
    stated = {f"uncertainty_{axis}": deviation[..., k] for k, axis in enumerate("zyx")}
    stated["uncertainty"] = np.sqrt((deviation**2).sum(-1))
    stated["correlation"] = left.correlation
    stated["peak_ratio"] = peak_ratio(left)
    return vectors.assign({name: vectors[name].copy(data=values.astype(np.float32)) for name, values in stated.items()})

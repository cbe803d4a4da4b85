"""`reconstruct_pair`: both frames of a pair by SMART, each helped by what the other one shows of the same particles.

Images of two cameras hardly tell particles from ghosts: SMART keeps whatever its first guess holds. Particles follow
the flow from one frame to the other; ghosts do so only where all particles around move alike. So both frames are
reconstructed, the motion is measured, each volume is carried along it to the other's instant, and where the two
disagree the volume is corrected: the first guess of a new reconstruction, as in motion tracking enhancement [1]_.

There both volumes are averaged. Here a volume keeps its own particles in their own places, and only their brightness is
changed, by the ratio of the two volumes after both were smoothed: a displacement that is wrong by a fraction of a voxel
matters less then, and draws the next measurement less towards itself (docs/accuracy.md).

Volumes that share their light are alike beyond what was measured, and their correlation no longer shows how much of it
is noise. So the volumes of each frame by itself stay with them, and `unshared_quality` asks those for the uncertainty.

.. [1] M. Novara, K. J. Batenburg, F. Scarano, "Motion tracking-enhanced MART for tomographic PIV", Meas. Sci. Technol.
   21 (2010) 035401, doi:10.1088/0957-0233/21/3/035401.
"""

from __future__ import annotations

import enum
import logging
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from scipy import ndimage

from lfpiv.reconstruction.volume import Stop, reconstruct
from lfpiv.velocity.cross_correlation import correlate
from lfpiv.velocity.multi_pass import peak_ratio
from lfpiv.velocity.predictor import Predictor
from lfpiv.velocity.settings import REFINE_SEARCH, CorrelationSettings
from lfpiv.velocity.volume_pair import missing_smoothing, preprocess
from lfpiv.velocity.windows import Windows
from lfpiv.weights.operator import Weights
from lfpiv_kernels.correlation import deform
from lfpiv_kernels.correlation.correlate import correlate_windows
from lfpiv_kernels.correlation.uncertainty import displacement_deviation

log = logging.getLogger(__name__)

SMOOTHING_VOXEL = 0.7
"""Standard deviation of the Gaussian that both volumes are smoothed by before they are compared [voxel]: about a
particle's own size, and more than the measured displacement is usually off by."""
DARK_SHARE = 0.02
"""Light added to both before the ratio is taken, as a share of the smoothed volume's brightness, sum E^2 / sum E:
voxels as dark as that agree whatever they hold."""
LARGEST_GAIN = 3.0
"""Largest factor by which the other frame brightens a voxel; particles come by light from their own images."""
FAINTEST = 1e-6
"""Least light of a voxel in the new first guess, as a share of the brightest: SMART can still bring it back."""
ITERATION_SHARE = 0.4
"""Iterations of a pass, as a share of those of the first reconstruction: it starts close to its end."""
LEAST_VALID = 0.3
"""Least part of valid vectors, of those that two cameras see: with fewer there is no motion to follow."""
FOLLOWED = 4
"""Steps of the fixed point that turns displacements midway in time into those of the particles of one frame."""

UNSHARED = "unshared"
"""Coordinate of a volume that shares light with the other frame: the frame's volume by itself."""


class Motion(enum.Enum):
    """What became of the motion; the text is the advice."""

    OFF = "each frame reconstructed by itself"
    FOLLOWED = "volumes reconstructed anew from what both frames show along the motion"
    LOST = "too few valid vectors to follow the motion: look at windows, seeding and displacements"


def reconstruct_pair(
    weights: Weights,
    images: Sequence[Mapping[str, np.ndarray]],
    *,
    motion_passes: int = 1,
    floor: Sequence[float | Mapping[str, float] | None] = (None, None),
    correlation: Mapping[str, Any] | None = None,
    iterations: int = 10,
    progress: Callable[[float], None] | None = None,
    **smart: Any,
) -> list[xr.DataArray]:
    """Reconstruct the two volumes of an image pair, and again from what they share along the motion between them.

    With E and E' the two volumes, d the displacement measured between them, G a Gaussian of `SMOOTHING_VOXEL` and e the
    light of `DARK_SHARE`, a pass takes the first guess ``E min((G E'(x + d) + e) / (G E + e), LARGEST_GAIN)`` for the
    one frame and the like for the other, both volumes scaled to the same light. Where vectors were replaced by the
    validation, or particles left the volume, the volume's own light counts instead, in the logarithm.

    Parameters
    ----------
    weights : Weights
        The operator.
    images : sequence of two mappings of str to ndarray
        Images of the first and the second frame, each as `reconstruct` takes them.
    motion_passes : int
        How often the motion is measured and followed, >= 0; 0 reconstructs each frame by itself.
    floor : sequence of two
        Noise floor of each frame's images, as `reconstruct` takes it.
    correlation : mapping, optional
        Settings of `correlate`, by which the motion is measured; default: those of an experiment without such a table.
    iterations : int
        SMART iterations of the first reconstruction; a pass takes at most `ITERATION_SHARE` of them.
    progress : callable, optional
        Called with the finished fraction.
    **smart
        The other settings of `reconstruct`. With a sieve a pass starts from the volume in place of its coefficients.

    Returns
    -------
    list of two DataArrays, shape (z, y, x), float32
        Volumes as `reconstruct` returns them; `residual`, `misfit` and `iterations` go through all passes, `stop` is
        the first reconstruction's, unless a pass diverged. Attributes beyond those: `motion`, the verdict;
        `motion_valid`, the part of valid vectors measured before each pass. Where a pass was made, the coordinate
        `UNSHARED` holds what the first reconstruction gave: hand the vectors that `correlate` measures, and these
        volumes, to `unshared_quality`.

    Raises
    ------
    ValueError
        If an argument is out of its range, or `reconstruct` or `correlate` refuse theirs.
    """
    for name, value in (("iterations", iterations), ("motion_passes", motion_passes)):
        if not (isinstance(value, (int, np.integer)) and not isinstance(value, bool) and value >= 0):
            raise ValueError(f"{name}: expected a whole number >= 0, got {value!r}.")
    if len(images) != 2 or len(floor) != 2:
        raise ValueError(f"images, floor: expected two frames, got {len(images)} and {len(floor)}.")
    if "first" in smart:
        raise ValueError("first: expected no first guess, as each pass makes its own; use `reconstruct` for one.")
    correlation = _default_correlation() if correlation is None else correlation
    restart = math.ceil(ITERATION_SHARE * iterations)
    total = 2.0 * (iterations + motion_passes * restart)
    done = 0.0

    def run(number: int, count: int, first: np.ndarray | None = None) -> xr.DataArray:
        def step(fraction: float) -> None:
            if progress is not None and total > 0:
                progress((done + fraction * count) / total)

        return reconstruct(
            weights,
            images[number],
            floor=floor[number],
            iterations=count,
            first=first,
            progress=step,
            **smart,
        )

    volumes = []
    for number in (0, 1):
        try:
            volumes.append(run(number, iterations))
        except ValueError as error:
            raise ValueError(f"frame {number + 1} of the pair: {error}") from error
        done += iterations
    alone = list(volumes)
    verdict, valid = Motion.OFF, []
    for _ in range(motion_passes):
        vectors = correlate(*volumes, dt_s=1.0, **correlation)
        valid.append(round(float(vectors.attrs["valid_fraction"]), 4))
        if valid[-1] < LEAST_VALID * float(vectors.attrs["seen_fraction"]):
            verdict = Motion.LOST
            log.warning("motion: %.0f %% of the vectors are valid; %s", 100 * valid[-1], verdict.value)
            break
        verdict = Motion.FOLLOWED
        guesses = shared_guesses(volumes, vectors)
        for number, guess in enumerate(guesses):
            again = run(number, restart, guess)
            again.attrs |= _joined(volumes[number].attrs, again.attrs)
            volumes[number] = again
            done += restart
    if progress is not None:
        progress(1.0)
    for number, (volume, before) in enumerate(zip(volumes, alone, strict=True)):
        volume.attrs |= {"motion": verdict.value, "motion_valid": list(valid)}
        if volume is not before:
            about = {"units": "counts", "long_name": "particle intensity, this frame by itself"}
            volumes[number] = volume.assign_coords({UNSHARED: (volume.dims, before.values, about)})
    return volumes


def unshared_quality(vectors: xr.Dataset, volumes: Sequence[xr.DataArray]) -> xr.Dataset:
    """State uncertainty, peak ratio and correlation of vectors by the volumes of each frame by itself.

    The statistics of `lfpiv_kernels.correlation.uncertainty`, by which `correlate` states it, take what two volumes do not have in
    common for noise. Volumes that share their light have noise in common, too: they state two thirds of the random
    error (docs/accuracy.md). Here the volumes of `UNSHARED`, whose noise is independent, are deformed onto each other
    by the displacement given, and the same statistics are taken of them in the same windows, s. What these volumes
    then show, correlated once more, is off the vector by d, be it that sharing bettered it, or that a wrong motion drew
    it along. The uncertainty of each component is the larger one, ``max(s, |d|)``. Peak ratio and correlation, which
    rise by sharing too, are those of this correlation.

    Without motion passes `correlate` states s: the random part, what would differ were the same flow recorded anew.
    Ghosts move with the mean of the particles whose lines of sight cross in them [1]_, so they smooth the flow along
    its gradients, alike in both frames and in every pair, and no statistics of noise know of it. In a uniform flow
    there is no such error, and s is right; in the vortex ring of docs/accuracy.md it is larger than the random one.
    Motion passes lower both, and d tells of what they took off.

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
        replaced, where the frames by themselves show no peak within `REFINE_SEARCH`, and after a single pass; with
        other ``peak_ratio`` and ``correlation``, unless after a single pass.

    References
    ----------
    .. [1] G. E. Elsinga, J. Westerweel, F. Scarano, M. Novara, "On the velocity of ghost particles and the bias errors
       in Tomographic-PIV", Exp. Fluids 50 (2011) 825-838, doi:10.1007/s00348-010-0930-0.
    """
    if not all(UNSHARED in volume.coords for volume in volumes):
        if any(volume.attrs.get("motion") == Motion.FOLLOWED.value for volume in volumes):
            log.warning("motion: volumes without what each frame shows by itself; the uncertainty is too small")
        return vectors
    settings = CorrelationSettings.of(vectors)
    if len(settings.windows) == 1 or not vectors["valid"].any():
        return vectors
    control, window = _Control(volumes[0], vectors), settings.windows[-1]
    missing = missing_smoothing(settings.smoothing_voxel, *volumes)
    alone = (volume[UNSHARED].values for volume in volumes)  # their scale does not matter
    first, second = (
        deform.spline_coefficients(
            preprocess((light - np.median(light)).astype(np.float32), missing, settings.intensity_power)
        )
        for light in alone
    )
    first, second = deform.deform_pair(first, second, control.midway.field, control.midway.spacing)
    step = tuple(round(at[1] - at[0]) if len(at) > 1 else n for at, n in zip(control.nodes, first.shape, strict=True))
    windows = Windows.covering(first.shape, window, step)
    scatter = displacement_deviation(
        first, second, window=window, origin=windows.origin, step=step, count=windows.count
    )
    search = (REFINE_SEARCH,) * 3
    left = correlate_windows(first, second, window=window, step=step, search=search, symmetric=True)
    measured = np.stack([vectors[f"displacement_{axis}"].values for axis in "zyx"], -1)
    shown = control.midway.window_means(windows) + left.displacement
    deviation = np.maximum(scatter, np.abs(shown - measured))
    deviation[~vectors["valid"].values] = np.nan
    stated = {f"uncertainty_{axis}": deviation[..., k] for k, axis in enumerate("zyx")}
    stated["uncertainty"] = np.sqrt((deviation**2).sum(-1))
    stated["correlation"] = left.correlation
    stated["peak_ratio"] = peak_ratio(left)
    return vectors.assign({name: vectors[name].copy(data=values.astype(np.float32)) for name, values in stated.items()})


def shared_guesses(volumes: Sequence[xr.DataArray], vectors: xr.Dataset) -> list[np.ndarray]:
    """First guesses of both frames from what their volumes share along measured displacements.

    Parameters
    ----------
    volumes : sequence of two DataArrays, shape (z, y, x)
        Both frames, >= 0, with coordinates in mm.
    vectors : Dataset
        From `correlate` of the two: displacements midway in time.

    Returns
    -------
    list of two ndarrays, shape (z, y, x), float32
        See `reconstruct_pair`; each with the light of its volume, zero where that is.
    """
    values = [np.asarray(volume.values, np.float32) for volume in volumes]
    light = [float(value.sum(dtype=np.float64)) for value in values]
    coefficients = [deform.spline_coefficients(value) for value in values]
    everywhere = deform.spline_coefficients(np.ones_like(values[0]))
    control = _Control(volumes[0], vectors)
    guesses = []
    for number, own in enumerate(values):
        field = control.displacement(1 if number == 0 else -1)
        partner = control.carried(coefficients[1 - number], field)
        partner *= np.float32(light[number] / light[1 - number])
        trusted = control.trust * np.clip(control.carried(everywhere, field), 0, 1)
        guess = own * _gain(own, np.maximum(partner, 0)) ** trusted
        np.maximum(guess, FAINTEST * guess.max(), out=guess, where=own > 0)
        guesses.append(guess * np.float32(light[number] / guess.sum(dtype=np.float64)))
    return guesses


def _gain(own: np.ndarray, partner: np.ndarray) -> np.ndarray:
    """Factor by which the other frame's volume, carried to this instant, changes this one's brightness."""
    own, partner = (ndimage.gaussian_filter(volume, SMOOTHING_VOXEL, mode="constant") for volume in (own, partner))
    dark = np.float32(DARK_SHARE * np.square(own, dtype=np.float64).sum() / own.sum(dtype=np.float64))
    return np.minimum((partner + dark) / (own + dark), np.float32(LARGEST_GAIN))


class _Control:
    """The motion between two frames, midway in time, on the points between which a deformation is linear; [voxel]."""

    def __init__(self, volume: xr.DataArray, vectors: xr.Dataset):
        axes = [(volume[axis].values.astype(float), vectors[axis].values) for axis in "zyx"]
        self.nodes = [(centres - own[0]) * (len(own) - 1) / (own[-1] - own[0]) for own, centres in axes]
        """Places of the vectors along each axis [voxel]."""
        nz, ny, nx = volume.shape
        displacement = np.stack([vectors[f"displacement_{axis}"].values for axis in "zyx"], axis=-1).astype(float)
        self.midway = Predictor.between(self.nodes, displacement, (nz, ny, nx))
        """Displacement of what is at a control point midway in time."""
        trust = vectors["valid"].values.astype(float)
        for axis, (nodes, count) in enumerate(zip(self.nodes, volume.shape, strict=True)):
            trust = _linear(trust, nodes, np.arange(count), axis)
        self.trust = trust.astype(np.float32)
        """1 among valid vectors, 0 among replaced ones, on the voxels."""

    def displacement(self, sign: int) -> np.ndarray:
        """From the control points of one frame to the other: 1 from the first to the second, -1 back; (3, z, y, x)."""
        points, spacing = self.midway.points, np.array(self.midway.spacing)[:, None, None, None]
        start = np.stack(np.meshgrid(*points, indexing="ij")) - deform.OFFSET  # the kernel's field at x + OFFSET
        middle = moved = np.moveaxis(self.midway.field.astype(float), -1, 0)
        for _ in range(FOLLOWED):
            halfway = (start + sign * moved / 2) / spacing
            moved = np.stack([ndimage.map_coordinates(part, halfway, order=1, mode="nearest") for part in middle])
        return sign * moved

    def carried(self, coefficients: np.ndarray, field: np.ndarray) -> np.ndarray:
        """Sample a volume, given by its spline, at x + field(x) for all voxels x; 0 outside."""
        half = np.moveaxis(2 * (field - deform.OFFSET), 0, -1)  # the kernel samples at x + OFFSET + half / 2
        return deform.deform_pair(coefficients, coefficients, half.astype(np.float32), self.midway.spacing)[1]


def _linear(values: np.ndarray, nodes: np.ndarray, points: np.ndarray, axis: int) -> np.ndarray:
    """Interpolate linearly between values at nodes along an axis, constant beyond the outer ones."""
    matrix = np.stack([np.interp(points, nodes, unit) for unit in np.eye(len(nodes))], axis=1)
    return np.moveaxis(np.tensordot(matrix, values, (1, axis)), 0, axis)


def _joined(before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, Any]:
    """History through a reconstruction and the one after it, whose first figure stands for the former's last.

    A pass is meant to be short: why the first reconstruction stopped is what tells, unless the pass diverged.
    """
    histories = {name: [*before[name][:-1], *after[name]] for name in ("residual", "misfit")}
    stop = after["stop"] if after["stop"] == Stop.DIVERGED.value else before["stop"]
    return {**histories, "iterations": before["iterations"] + after["iterations"], "stop": stop}


def _default_correlation() -> dict[str, Any]:
    from lfpiv.experiment.settings import Correlation

    return Correlation().model_dump()

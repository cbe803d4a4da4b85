"""The thin-lens camera in any pose (Eqs. 1-3): the DRT mapping, and the baseline that the network corrects.

A network extrapolates badly beyond the dots. A thin lens extrapolates well, but has no aberrations. So the default
mapping is a thin lens fitted to the labels plus a network trained on the residual.

The fit minimises the robust cost sum of r^2 / (1 + (r / c)^2) with c = `OUTLIER` standard deviations, plus a prior, by
Levenberg-Marquardt steps ([1]_).

References
----------
.. [1] S. Geman and D. E. McClure, "Statistical methods for tomographic image reconstruction", Bull. ISI 52, 5-21
       (1987).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lfpiv.errors import InputError
from lfpiv.geometry.optics import Optics
from lfpiv.geometry.orientation import Orientation
from lfpiv.lightfield.decoder import NORMAL_MAD

FIT_SAMPLES = 20_000
"""Largest number of labels in a fit, evenly drawn from all labels."""
PRIOR = np.repeat([1e3, 0.05], [6, 5])
"""Prior standard deviation of each parameter: free for the pose, 5 % for the optics, 0.5 mm for the optical axis."""
ITERATIONS, STEP, CONVERGED = 50, 1e-6, 1e-9
"""Largest number of steps, step of the finite differences, and length of the last step."""
FIRST_DAMPING, LEAST_DAMPING = 1e-4, 1e-12
"""Damping of the first step, and the least damping, relative to the diagonal of the normal equations."""
OUTLIER = 4.0
"""Residual that has a quarter of the full weight [robust standard deviations]."""
SMALLEST_STD_MM = 1e-7
"""Lower limit of the residual's robust standard deviation [mm]."""
LEAST_LABELS = 20
"""Least number of labels of a fit."""
LEAST_DEPTH = 1e-4
"""Smallest extent of the dots relative to their largest extent."""
TRIMMING = 4.0
"""Residual above which the linear start leaves out a label [median residuals]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ThinLensModel:
    """Thin-lens camera in closed form: Eqs. 1-3 with the imaging equations of a thin lens and a free pose.

    With (xc, yc, zc) = rotation (point - offset) and d = object_distance - zc, the magnification is
    m = image_distance / d. A ray through the pupil point (u, v) meets the array at s = array_offset_s + k u - m xc,
    t = array_offset_t + k v - m yc, where k = pupil_scale (1 - image_distance / focal_length + m).
    """

    rotation: np.ndarray
    """Rotation from world to camera axes, shape (3, 3)."""
    offset_mm: np.ndarray
    """World point (x, y, z) on the optical axis at the object distance, shape (3,) [mm]."""
    object_distance_mm: float
    """Distance from the main lens to `offset_mm` [mm]."""
    image_distance_mm: float
    """Distance from the main lens to the microlens array [mm]."""
    focal_length_mm: float
    """Focal length of the main lens [mm]."""
    pupil_scale: float = 1.0
    """True over nominal pupil coordinate. Differs from 1 where f_m / s_i of the data sheet is wrong."""
    array_offset_mm: np.ndarray = field(default_factory=lambda: np.zeros(2))
    """Point (s, t) where the optical axis meets the array, shape (2,) [mm]."""

    def __post_init__(self) -> None:
        for name, shape in (("rotation", (3, 3)), ("offset_mm", (3,)), ("array_offset_mm", (2,))):
            value = np.array(getattr(self, name), float)
            if value.shape != shape:
                raise ValueError(f"thin lens: {name}: expected shape {shape}, got {value.shape}.")
            object.__setattr__(self, name, value)

    def __call__(self, points: np.ndarray, pupil: np.ndarray) -> np.ndarray:
        """Trace rays from object points through pupil positions to the microlens array.

        Parameters
        ----------
        points : array_like, shape (n, 3)
            Object points (x, y, z) in world axes [mm].
        pupil : array_like, shape (n, 2)
            Points (u, v) where the rays cross the pupil [mm].

        Returns
        -------
        ndarray, shape (n, 2)
            Positions (s, t) where the rays meet the array [mm].
        """
        return self.onto_array((np.asarray(points, float) - self.offset_mm) @ self.rotation.T, pupil)

    def onto_array(self, camera: np.ndarray, pupil: np.ndarray) -> np.ndarray:
        """Trace rays as a call does, from points in the axes of the camera [mm], shape (n, 3)."""
        magnification = self.image_distance_mm / (self.object_distance_mm - camera[:, 2:])
        gain = self.pupil_scale * (1 - self.image_distance_mm / self.focal_length_mm + magnification)
        return self.array_offset_mm + gain * np.asarray(pupil, float) - magnification * camera[:, :2]

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the model as named arrays for files and kernels. `from_arrays` is the inverse."""
        return {f"thin_lens_{name}": np.asarray(getattr(self, name), float) for name in self.__dataclass_fields__}

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> ThinLensModel:
        """Build a model from the arrays of `to_arrays`. Ignore other keys.

        Raises
        ------
        ValueError
            If an array is missing or has a wrong shape.
        """
        missing = [name for name in cls.__dataclass_fields__ if f"thin_lens_{name}" not in arrays]
        if missing:
            raise ValueError(f"thin lens: expected arrays as ThinLensModel.to_arrays writes them; missing {missing}.")
        values = {name: np.asarray(arrays[f"thin_lens_{name}"], float) for name in cls.__dataclass_fields__}
        fields: dict[str, Any] = {name: float(value) if value.ndim == 0 else value for name, value in values.items()}
        return cls(**fields)


def thin_lens_model(optics: Optics, orientation: Orientation | float) -> ThinLensModel:
    """Return the DRT mapping: an ideal camera whose axis meets the origin, Eqs. 1-3.

    Parameters
    ----------
    optics : Optics
        Nominal optics.
    orientation : Orientation or float
        Orientation of the camera, or its angle about y [degree]. It includes the angle error of Eqs. 11-12.

    Raises
    ------
    ValueError
        If the angle is not finite.
    """
    if not isinstance(orientation, Orientation):
        if not np.isfinite(orientation):
            raise ValueError(f"angle_deg: expected a finite angle [degree], got {orientation}.")
        orientation = Orientation(float(orientation))
    return ThinLensModel(
        rotation=orientation.rotation,
        offset_mm=np.zeros(3),
        object_distance_mm=optics.object_distance_mm,
        image_distance_mm=optics.image_distance_mm,
        focal_length_mm=optics.focal_length_mm,
    )


def fit_thin_lens(
    points: np.ndarray, pupil: np.ndarray, array: np.ndarray, optics: Optics, *, std: np.ndarray | None = None
) -> ThinLensModel:
    """Fit the thin-lens camera to labelled rays. Any pose is found; no nominal angle is needed.

    Linear least squares of s, t = a + A (x, y, z) + (k + b (x, y, z)) (u, v) start the fit: the rows of A are the
    camera's axes times the magnification, and b is its optical axis times s_i / s_o^2. A robust fit of pose, image
    distance, focal length, pupil scale and optical axis follows. Mislabelled dots have next to no weight in it. The
    data sheet decides only parameters that the labels do not determine.

    Parameters
    ----------
    points : array_like, shape (n, 3)
        Object points (x, y, z) [mm].
    pupil : array_like, shape (n, 2)
        Points (u, v) where the rays cross the pupil [mm].
    array : array_like, shape (n, 2)
        Positions (s, t) where the rays meet the microlens array [mm].
    optics : Optics
        Nominal optics.
    std : array_like, shape (n,), optional
        Standard deviation of each label [mm]. Default: equal, estimated from the residual.

    Raises
    ------
    ValueError
        If shapes do not fit, values are not finite, there are fewer than 20 labels, the points lie in one plane or
        line, or the labels are mirrored.
    """
    points, pupil, array = (np.asarray(value, float) for value in (points, pupil, array))
    std = np.ones(len(points)) if std is None else np.asarray(std, float)
    _check_labels(points, pupil, array, std)
    chosen = np.unique(np.linspace(0, len(points) - 1, min(len(points), FIT_SAMPLES)).astype(int))
    points, pupil, array, std = points[chosen], pupil[chosen], array[chosen], std[chosen] / np.median(std)
    start = _linear_start(points, pupil, array, optics)

    def residual_of(parameters: np.ndarray) -> np.ndarray:
        deviation = moved(start, parameters)(points, pupil) - array
        return (deviation / std[:, None]).ravel()

    return moved(start, robust_minimum(residual_of))


def _check_labels(points: np.ndarray, pupil: np.ndarray, array: np.ndarray, std: np.ndarray) -> None:
    count = len(points)
    if points.shape != (count, 3) or pupil.shape != (count, 2) or array.shape != (count, 2):
        raise ValueError(
            "points, pupil, array: expected shapes (n, 3), (n, 2) and (n, 2), got "
            f"{points.shape}, {pupil.shape} and {array.shape}."
        )
    for name, value in (("points", points), ("pupil", pupil), ("array", array)):
        if not np.isfinite(value).all():
            raise ValueError(f"{name}: expected finite values [mm], got NaN or infinity; leave those labels out.")
    if count < LEAST_LABELS:
        raise InputError(f"points: a thin-lens fit needs at least {LEAST_LABELS} labels, got {count}; find more dots.")
    if std.shape != (count,) or not (np.isfinite(std) & (std > 0)).all():
        raise ValueError(f"std: expected {count} positive finite values, one per label, got shape {std.shape}.")


def robust_minimum(residual_of: Callable[[np.ndarray], np.ndarray], prior: np.ndarray = PRIOR) -> np.ndarray:
    """Return the parameters with the least robust cost, by damped Gauss-Newton steps; those of `moved` come first."""

    def cost(residual: np.ndarray, parameters: np.ndarray, sigma: float) -> float:
        robust = residual**2 / (1 + (residual / (OUTLIER * sigma)) ** 2)
        return float(robust.sum() + ((sigma / prior * parameters) ** 2).sum())

    parameters, damping = np.zeros(prior.size), FIRST_DAMPING
    residual = residual_of(parameters)
    for _ in range(ITERATIONS):
        sigma = max(NORMAL_MAD * float(np.median(np.abs(residual))), SMALLEST_STD_MM)
        weight = 1 / (1 + (residual / (OUTLIER * sigma)) ** 2) ** 2
        steps = STEP * np.eye(prior.size)
        jacobian = np.stack([(residual_of(parameters + step) - residual) / STEP for step in steps], axis=1)
        weighted = jacobian * weight[:, None]
        gram = weighted.T @ jacobian + np.diag((sigma / prior) ** 2)
        gradient = weighted.T @ residual + (sigma / prior) ** 2 * parameters
        present = cost(residual, parameters, sigma)
        while True:  # a step along badly determined parameters can leave the range where the model is linear
            step = np.linalg.solve(gram + damping * np.diag(gram.diagonal()), -gradient)
            trial = residual_of(parameters + step)
            converged = bool(np.abs(step).max() < CONVERGED)
            if converged or cost(trial, parameters + step, sigma) <= present:
                break
            damping *= 10
        parameters, residual, damping = parameters + step, trial, max(damping / 10, LEAST_DAMPING)
        if converged:
            break
    return parameters


def moved(lens: ThinLensModel, p: np.ndarray) -> ThinLensModel:
    """Return a lens changed by eleven parameters of order 0.01.

    They are a rotation (3), a shift (3), relative changes of image distance, focal length and pupil scale (3), and the
    shift of the optical axis on the array (2).
    """
    return replace(
        lens,
        rotation=_rotation(p[:3]) @ lens.rotation,
        offset_mm=lens.offset_mm + 10.0 * p[3:6],
        image_distance_mm=lens.image_distance_mm * (1 + p[6]),
        focal_length_mm=lens.focal_length_mm * (1 + p[7]),
        pupil_scale=lens.pupil_scale * (1 + p[8]),
        array_offset_mm=lens.array_offset_mm + 10.0 * p[9:11],
    )


def _linear_start(points: np.ndarray, pupil: np.ndarray, array: np.ndarray, optics: Optics) -> ThinLensModel:
    """Return the pose of a bilinear fit with the optics of the data sheet."""
    count, middle = len(points), points.mean(axis=0)
    centred = points - middle
    strength = np.linalg.svd(centred, compute_uv=False)
    if strength[2] < LEAST_DEPTH * strength[0]:
        raise InputError(
            "points: a thin-lens fit needs dots that span a volume, these lie in one plane or line; "
            "give board images at two or more depths."
        )
    columns = np.zeros((2, count, 12))
    for axis in range(2):
        columns[axis, :, 4 * axis] = 1
        columns[axis, :, 4 * axis + 1 : 4 * axis + 4] = centred
        columns[axis, :, 8] = pupil[:, axis]
        columns[axis, :, 9:12] = pupil[:, axis : axis + 1] * centred
    matrix, right = columns.reshape(2 * count, 12), array.T.ravel()
    used = np.ones(2 * count, bool)
    for _ in range(4):
        solution = np.linalg.lstsq(matrix[used], right[used], rcond=None)[0]
        deviation = np.abs(right - matrix @ solution)
        used = deviation <= TRIMMING * np.median(deviation) + 1e-12  # without mislabelled dots
    first, second, gain_slope = -solution[1:4], -solution[5:8], solution[9:12]
    axes = [first / np.linalg.norm(first), second / np.linalg.norm(second)]
    axes.append(np.cross(*axes))
    left, _, right_vectors = np.linalg.svd(axes)
    rotation = left @ right_vectors
    if rotation[2] @ gain_slope < -0.5 * np.linalg.norm(gain_slope):
        raise InputError(
            "array: the labels are mirrored: the dots' handedness contradicts the depth at which they are in focus; "
            "check image_flip of this camera and the order of the board's planes."
        )
    magnification = np.sqrt(np.linalg.norm(first) * np.linalg.norm(second))
    depth = optics.object_distance_mm - optics.image_distance_mm / magnification
    camera_middle = np.array([-solution[0] / magnification, -solution[4] / magnification, depth])
    return replace(thin_lens_model(optics, 0.0), rotation=rotation, offset_mm=middle - rotation.T @ camera_middle)


def _rotation(vector: np.ndarray) -> np.ndarray:
    """Return the rotation about `vector` by its length, after Rodrigues."""
    x, y, z = vector
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.linalg.norm(vector)
    return np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * cross @ cross

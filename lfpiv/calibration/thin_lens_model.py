"""The thin-lens mapping of a plenoptic camera in free pose: the DRT mapping, and a baseline fitted to dot labels.

A network knows nothing outside the dots it was trained on; the closed form extrapolates. A network trained on the
residual of the fitted closed form keeps both: aberrations where there are dots, sane rays where there are none.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from lfpiv.geometry.optics import Optics

FIT_SAMPLES = 20_000
"""Labels used by a fit at most, evenly spread: eleven numbers need no more."""
PRIOR = np.repeat([1e3, 0.05], [6, 5])
"""Deviation of each fitted number from its start that costs as much as one label off by its standard deviation: none
to speak of for the pose, 5 % of the data sheet (0.5 mm for the axis) for the optics. Dots in a thin volume hardly tell
some of them apart; where they do, thousands of labels outweigh it."""
ITERATIONS, STEP, CONVERGED = 50, 1e-6, 1e-9
"""Steps at most, the difference step, and the step that ends the fit (numbers of order 0.01)."""
FIRST_DAMPING, LEAST_DAMPING = 1e-4, 1e-12
"""Damping of the first step, and the least, relative to the diagonal of the normal equations (Levenberg, Marquardt)."""
OUTLIER = 4.0
"""Residual, in robust standard deviations, at which a label counts a quarter."""
SMALLEST_STD_MM = 1e-7
"""Residual taken for an exact fit [mm]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ThinLensModel:
    """Thin-lens camera in closed form, Eqs. 1-3 with the imaging equations of a thin lens and a free pose.

    With (xc, yc, zc) = rotation (point - offset) and d = object_distance - zc, a ray through the pupil at (u, v) meets
    the array at s = array_offset_s + k u - m xc, t = array_offset_t + k v - m yc, where m = image_distance / d
    and k = pupil_scale (1 - image_distance / focal_length + m).
    """

    rotation: np.ndarray
    """World to camera, shape (3, 3), orthonormal with determinant 1."""
    offset_mm: np.ndarray
    """World point (x, y, z) that lies on the optical axis at the object distance, shape (3,) [mm]."""
    object_distance_mm: float
    """Main lens to `offset_mm` [mm]."""
    image_distance_mm: float
    """Main lens to the microlens array [mm]."""
    focal_length_mm: float
    """Focal length of the main lens [mm]."""
    pupil_scale: float = 1.0
    """True over nominal pupil coordinate; differs from 1 where f_m / s_i of the data sheet is off."""
    array_offset_mm: np.ndarray = field(default_factory=lambda: np.zeros(2))
    """Where the optical axis meets the array (s, t), shape (2,) [mm]."""

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
            Where each ray crosses the pupil (u, v) [mm].

        Returns
        -------
        ndarray, shape (n, 2)
            Where each ray meets the array (s, t) [mm].
        """
        camera = (np.asarray(points, float) - self.offset_mm) @ self.rotation.T
        magnification = self.image_distance_mm / (self.object_distance_mm - camera[:, 2:])
        gain = self.pupil_scale * (1 - self.image_distance_mm / self.focal_length_mm + magnification)
        array: np.ndarray = self.array_offset_mm + gain * np.asarray(pupil, float) - magnification * camera[:, :2]
        return array

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the model as named arrays, for files and kernels; `from_arrays` is the inverse."""
        return {f"thin_lens_{name}": np.asarray(getattr(self, name), float) for name in self.__dataclass_fields__}

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> ThinLensModel:
        """Build a model from the arrays of `to_arrays`; other keys are ignored.

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


def thin_lens_model(optics: Optics, angle_deg: float) -> ThinLensModel:
    """Return the DRT mapping: an ideal camera turned about y by its angle, Eqs. 1-3.

    Parameters
    ----------
    optics : Optics
        Nominal optics.
    angle_deg : float
        Angle of the camera to the z axis [degree]; add an angle error to it for the paper's DRT contrast (Eqs. 11-12).

    Raises
    ------
    ValueError
        If the angle is not finite.
    """
    if not np.isfinite(angle_deg):
        raise ValueError(f"angle_deg: expected a finite angle [degree], got {angle_deg}.")
    return ThinLensModel(
        rotation=_rotation_y(np.deg2rad(angle_deg)),
        offset_mm=np.zeros(3),
        object_distance_mm=optics.object_distance_mm,
        image_distance_mm=optics.image_distance_mm,
        focal_length_mm=optics.focal_length_mm,
    )


def fit_thin_lens(
    points: np.ndarray, pupil: np.ndarray, array: np.ndarray, optics: Optics, *, std: np.ndarray | None = None
) -> ThinLensModel:
    """Fit the thin-lens camera to labels of rays; needs no angle, any pose is found.

    A fit of s, t = a + A (x, y, z) + (k + b (x, y, z)) (u, v) by linear least squares starts it: A's rows are the
    camera's axes times the magnification, b its optical axis times s_i / s_o^2. A robust Levenberg-Marquardt fit of
    pose, image distance, focal length, pupil scale and axis follows, held near the data sheet only where the labels
    leave it open; mislabelled dots drop out of it.

    Parameters
    ----------
    points : array_like, shape (n, 3)
        Object points (x, y, z) [mm].
    pupil : array_like, shape (n, 2)
        Where the rays cross the pupil (u, v) [mm].
    array : array_like, shape (n, 2)
        Where the rays meet the microlens array (s, t) [mm].
    optics : Optics
        Nominal optics.
    std : array_like, shape (n,), optional
        Standard deviation of each label [mm]; default: equal, estimated from the residual.

    Raises
    ------
    ValueError
        If shapes do not fit, values are not finite, there are fewer than 20 labels, the points do not span the two
        lateral directions, or the labels are mirrored.
    """
    points, pupil, array = (np.asarray(value, float) for value in (points, pupil, array))
    count = len(points)
    if points.shape != (count, 3) or pupil.shape != (count, 2) or array.shape != (count, 2):
        raise ValueError(
            "points, pupil, array: expected shapes (n, 3), (n, 2) and (n, 2), got "
            f"{points.shape}, {pupil.shape} and {array.shape}."
        )
    for name, value in (("points", points), ("pupil", pupil), ("array", array)):
        if not np.isfinite(value).all():
            raise ValueError(f"{name}: expected finite values [mm], got NaN or infinity; leave those labels out.")
    if count < 20:
        raise ValueError(f"points: a thin-lens fit needs at least 20 labels, got {count}; find more dots.")
    if std is not None:
        std = np.asarray(std, float)
        if std.shape != (count,) or not (np.isfinite(std) & (std > 0)).all():
            raise ValueError(f"std: expected {count} positive finite values, one per label, got shape {std.shape}.")
    chosen = np.unique(np.linspace(0, count - 1, min(count, FIT_SAMPLES)).astype(int))
    points, pupil, array = points[chosen], pupil[chosen], array[chosen]
    std = np.ones(len(chosen)) if std is None else std[chosen] / np.median(std)
    start = _linear_start(points, pupil, array, optics)

    def misfit(parameters: np.ndarray) -> np.ndarray:
        deviation: np.ndarray = _moved(start, optics, parameters)(points, pupil) - array
        return (deviation / std[:, None]).ravel()

    def cost(residual: np.ndarray, parameters: np.ndarray, sigma: float) -> float:
        robust = residual**2 / (1 + (residual / (OUTLIER * sigma)) ** 2)  # Geman and McClure: mislabelled dots drop out
        return float(robust.sum() + ((sigma / PRIOR * parameters) ** 2).sum())

    parameters, damping = np.zeros(11), FIRST_DAMPING
    residual = misfit(parameters)
    for _ in range(ITERATIONS):
        sigma = max(1.4826 * float(np.median(np.abs(residual))), SMALLEST_STD_MM)
        weight = 1 / (1 + (residual / (OUTLIER * sigma)) ** 2) ** 2
        columns = np.stack([(misfit(parameters + nudge) - residual) / STEP for nudge in STEP * np.eye(11)], axis=1)
        weighted = columns * weight[:, None]
        gram = weighted.T @ columns + np.diag((sigma / PRIOR) ** 2)
        gradient = weighted.T @ residual + (sigma / PRIOR) ** 2 * parameters
        present = cost(residual, parameters, sigma)
        while True:  # numbers the labels hardly tell apart invite steps far beyond where the fit is linear
            step = np.linalg.solve(gram + damping * np.diag(gram.diagonal()), -gradient)
            trial = misfit(parameters + step)
            small = bool(np.abs(step).max() < CONVERGED)
            if small or cost(trial, parameters + step, sigma) <= present:
                break
            damping *= 10
        parameters, residual, damping = parameters + step, trial, max(damping / 10, LEAST_DAMPING)
        if small:
            break
    return _moved(start, optics, parameters)


def _moved(start: ThinLensModel, optics: Optics, p: np.ndarray) -> ThinLensModel:
    """`start` moved by eleven numbers of order 0.01: turn (3), shift (3), and optics relative to the data sheet (5)."""
    focus = optics.image_distance_mm
    return ThinLensModel(
        rotation=_rotation(p[:3]) @ start.rotation,
        offset_mm=start.offset_mm + 10.0 * p[3:6],
        object_distance_mm=optics.object_distance_mm,
        image_distance_mm=focus * (1 + p[6]),
        focal_length_mm=optics.focal_length_mm * (1 + p[7]),
        pupil_scale=1 + p[8],
        array_offset_mm=10.0 * p[9:11],
    )


def _linear_start(points: np.ndarray, pupil: np.ndarray, array: np.ndarray, optics: Optics) -> ThinLensModel:
    """Pose from the bilinear fit, optics from the data sheet."""
    count, middle = len(points), points.mean(axis=0)
    centred = points - middle
    strength = np.linalg.svd(centred, compute_uv=False)
    if strength[2] < 1e-4 * strength[0]:
        raise ValueError(
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
    keep = np.ones(2 * count, bool)
    for _ in range(4):
        solution = np.linalg.lstsq(matrix[keep], right[keep], rcond=None)[0]
        deviation = np.abs(right - matrix @ solution)
        keep = deviation <= 4 * np.median(deviation) + 1e-12  # without mislabelled dots
    first, second, gain_slope = -solution[1:4], -solution[5:8], solution[9:12]
    axes = [first / np.linalg.norm(first), second / np.linalg.norm(second)]
    axes.append(np.cross(*axes))
    left, _, right_vectors = np.linalg.svd(axes)
    rotation = left @ right_vectors
    if rotation[2] @ gain_slope < -0.5 * np.linalg.norm(gain_slope):
        raise ValueError(
            "array: the labels are mirrored: the dots' handedness contradicts the depth at which they are in focus; "
            "check image_flip of this camera and the order of the board's planes."
        )
    magnification = np.sqrt(np.linalg.norm(first) * np.linalg.norm(second))
    depth = optics.object_distance_mm - optics.image_distance_mm / magnification
    camera_middle = np.array([-solution[0] / magnification, -solution[4] / magnification, depth])
    start = thin_lens_model(optics, 0.0)
    start = replace(start, rotation=rotation, offset_mm=middle - rotation.T @ camera_middle)
    return start


def _rotation_y(angle: float) -> np.ndarray:
    """Return the rotation of Eqs. 1-3."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]])


def _rotation(vector: np.ndarray) -> np.ndarray:
    """Rotation about `vector` by its length, Rodrigues."""
    x, y, z = vector
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.linalg.norm(vector)
    rotation: np.ndarray = (
        np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * cross @ cross
    )
    return rotation

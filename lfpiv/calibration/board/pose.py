"""Thin-lens pose of a camera before its calibration, and raw images carried to a board plane along their rays.

The pose is Eqs. 1-3 with free angles, offset, magnification, object distance and slope: s = k u - m x_c with
x_c = Rz(roll) Rx(pitch) Ry(yaw) R (x - offset), R the nominal rotation. The angles are small, so a camera that looks
down from above has the same parameters as any other. The pose is exact enough to find and name the dots of a board.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage
from scipy.optimize import least_squares

from lfpiv.geometry.optics import Optics
from lfpiv.geometry.orientation import Orientation, camera_rotation
from lfpiv.lightfield.decoder import NORMAL_MAD, LightFieldDecoder

BIN_PITCHES = 0.35
"""Size of an element of a rectified image, in microlens pitches projected on the board."""

_PRIOR = {"angle_deg": 7.0, "tilt_deg": 3.0, "offset_mm": 0.7, "relative": 0.05}  # spread of rigs about their plans
_DEPTH_PRIOR = 0.3  # spread of the logarithm of the apparent depth behind a liquid: from 0.5 (oil, 45 degrees) to 1
_ROBUST_PITCHES = 0.5  # dots that miss the pose by more have less weight
_BLOB_PITCHES = 0.15  # accuracy of a dot in a rectified image, against which the plan weighs
_USED_COVERAGE = 0.9
_PIXELS_ACROSS = 8  # pixels across a microimage that suffice to find dots
_SIGNIFICANT = 6.0  # least contrast of a dot in a rectified image [standard deviations]
_FAINTEST = 0.2  # least contrast of a dot relative to the typical dot of its plane
_STEP_MM = 1e-3  # of a difference quotient on the board


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraPose:
    """Thin-lens camera in the world."""

    parameters: tuple[float, ...]
    """Yaw, pitch, roll about the nominal pose [rad]; offset (x, y, z) [mm]; log ratios to nominal of magnification,
    object distance, slope; behind the surface of a liquid the log ratio of apparent to true z."""
    nominal_rotation: np.ndarray
    """Nominal rotation from world to camera axes, shape (3, 3)."""
    nominal: tuple[float, float]
    """Nominal magnification (positive) and object distance [mm]."""

    @classmethod
    def from_plan(cls, optics: Optics, orientation: Orientation) -> CameraPose:
        """Return the pose of a perfectly aligned camera."""
        nominal = (abs(optics.magnification), optics.object_distance_mm)
        return cls(parameters=9 * (0.0,), nominal_rotation=orientation.rotation, nominal=nominal)

    @property
    def _lens(self) -> tuple[float, float, float]:
        """Return the magnification, the object distance [mm] and the factor of the slope k."""
        ratio = np.exp(self.parameters[6:9])
        return self.nominal[0] * ratio[0], self.nominal[1] * ratio[1], ratio[2]

    @property
    def depth(self) -> float:
        """Ratio of apparent to true z: below 1 behind the surface of a liquid."""
        return float(np.exp(sum(self.parameters[9:])))

    @property
    def is_behind_liquid(self) -> bool:
        """Whether the ratio of apparent to true z is a parameter."""
        return len(self.parameters) > 9

    @property
    def behind_liquid(self) -> CameraPose:
        """The same camera with the ratio of apparent to true z as a further parameter."""
        return replace(self, parameters=(*self.parameters[:9], 0.0))

    @property
    def rotation(self) -> np.ndarray:
        """Rotation from world to camera axes, shape (3, 3)."""
        yaw, pitch, roll = self.parameters[:3]
        return camera_rotation(yaw, pitch, roll) @ self.nominal_rotation

    def rays(self, points_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the array positions of chief rays [mm], (n, 2), and the slopes k = ds/du of the rays, (n,)."""
        magnification, distance, slope = self._lens
        apparent = points_mm * (1, 1, self.depth)
        camera = (apparent - np.array(self.parameters[3:6])) @ self.rotation.T
        m = magnification * distance / (distance - camera[:, 2])
        return -m[:, None] * camera[:, :2], slope * (m - magnification)

    def board_jacobian(self, points_mm: np.ndarray, pupil_radius_mm: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivatives of array positions over a dot's position on the board.

        Returns
        -------
        jacobian : ndarray, shape (n, 2, 2)
            d(s, t)/d(x, y) of the chief ray.
        tilt : ndarray, shape (n, 2, 2, 2)
            Its change from the pupil's centre to its edge along u and v (last axis). It is not zero on a tilted board,
            where one side of a dot is further out of focus than the other.
        """
        sides = [[self.rays(points_mm + sign * _STEP_MM * np.eye(3)[axis]) for sign in (1, -1)] for axis in (0, 1)]
        jacobian = np.stack([(ahead[0] - behind[0]) / (2 * _STEP_MM) for ahead, behind in sides], axis=-1)
        slopes = np.stack([(ahead[1] - behind[1]) / (2 * _STEP_MM) for ahead, behind in sides], axis=-1)
        return jacobian, pupil_radius_mm * slopes[:, None, :, None] * np.eye(2)[None, :, None, :]

    def on_plane(self, array_mm: np.ndarray, pupil_mm: np.ndarray, z_mm: float) -> np.ndarray:
        """Return where the rays (s, t), (u, v) cross the world plane z, as (x, y) [mm], shape (n, 2)."""
        magnification, distance, slope = self._lens
        rotation, dtype = self.rotation, array_mm.dtype
        near: np.ndarray = array_mm @ (-rotation[:2] / magnification).astype(dtype)  # on the focal plane z_c = 0
        far = pupil_mm @ (slope * rotation[:2]).astype(dtype) + (distance * rotation[2]).astype(dtype)
        z = dtype.type(z_mm * self.depth - self.parameters[5])
        share = (z - near[:, 2]) / (far[:, 2] - near[:, 2])
        offset = np.array(self.parameters[3:5], dtype)
        return near[:, :2] + share[:, None] * (far[:, :2] - near[:, :2]) + offset

    def fitted(
        self, points_mm: np.ndarray, array_mm: np.ndarray, optics: Optics, slope: np.ndarray | None = None
    ) -> CameraPose:
        """Return the pose fitted to named dots, with a prior around the nominal rig.

        Parameters
        ----------
        points_mm : ndarray, shape (n, 3)
            World positions of the dots [mm].
        array_mm : ndarray, shape (n, 2)
            Array positions of their chief rays [mm].
        optics : Optics
            Nominal optics.
        slope : ndarray, shape (n,), optional
            Slopes k of their rays.
        """
        angle, tilt = np.radians(_PRIOR["angle_deg"]), np.radians(_PRIOR["tilt_deg"])
        sigma = np.array([angle, tilt, tilt] + 3 * [_PRIOR["offset_mm"]] + 3 * [_PRIOR["relative"]] + [_DEPTH_PRIOR])
        sigma = sigma[: len(self.parameters)]
        accuracy = _ROBUST_PITCHES * optics.microlens_pitch_mm
        plan = _BLOB_PITCHES / _ROBUST_PITCHES / sigma

        def residuals(parameters: np.ndarray) -> np.ndarray:
            chief, k = replace(self, parameters=tuple(parameters)).rays(points_mm)
            misses = [((chief - array_mm) / accuracy).ravel(), plan * parameters]
            if slope is not None:
                misses.append((k - slope) * optics.pupil_radius_mm / accuracy)
            return np.concatenate(misses)

        fit = least_squares(residuals, self.parameters, x_scale=sigma, loss="soft_l1")
        return replace(self, parameters=tuple(float(p) for p in fit.x))


@dataclass(frozen=True, eq=False)
class Blobs:
    """Local extremes of a rectified image."""

    position_mm: np.ndarray
    """Board positions (x, y) [mm], shape (n, 2)."""
    contrast: np.ndarray
    """Their contrasts, shape (n,); 0 where there is no blob."""

    @property
    def strong(self) -> np.ndarray:
        """Blobs that are dots: significant, and not faint against the typical significant blob, bool, shape (n,)."""
        significant = self.contrast > _SIGNIFICANT
        typical = np.median(self.contrast[significant]) if significant.any() else np.inf
        return significant & (self.contrast > _FAINTEST * typical)


@dataclass(frozen=True, eq=False)
class Rectified:
    """Raw image carried along its rays to a board plane and filtered for blobs of the dots' size."""

    contrast: np.ndarray
    """Blob response over its noise [standard deviations], shape (y, x); zero where the camera sees nothing."""
    corner_mm: np.ndarray
    """Board position (x, y) of element (0, 0) [mm]."""
    bin_mm: float
    """Spacing of the elements [mm]."""
    noise: float
    """Standard deviation of the response, in shares of the white image's light."""
    light: np.ndarray
    """Light over the white image's, shape (y, x); nan where the camera sees nothing."""

    def peaks(self, radius_mm: float, sign: int) -> Blobs:
        """Return the significant blobs, at most one within `radius_mm`; `sign` is -1 for dark ones."""
        response = sign * self.contrast
        size = 2 * max(int(radius_mm / self.bin_mm), 1) + 1
        top = (response == ndimage.maximum_filter(response, size)) & (response > _SIGNIFICANT)
        top[[0, -1]], top[:, [0, -1]] = False, False
        row, col = np.nonzero(top)
        return Blobs(self._refined(response, row, col), response[row, col])

    def near(self, position_mm: np.ndarray, radius_mm: float, sign: int) -> Blobs:
        """Return the strongest blob within `radius_mm` of each position; `sign` is -1 for dark ones."""
        response = np.pad(sign * self.contrast, 1, constant_values=-np.inf)
        reach = int(np.ceil(radius_mm / self.bin_mm))
        along = np.arange(-reach, reach + 1)
        step = np.stack(np.meshgrid(along, along, indexing="ij"), -1).reshape(-1, 2)
        step = step[np.hypot(*step.T) * self.bin_mm <= radius_mm]
        at = np.rint((position_mm - self.corner_mm) / self.bin_mm).astype(int)[:, ::-1] + 1
        where = np.clip(at[:, None] + step, 1, np.array(response.shape) - 2)
        values = response[where[..., 0], where[..., 1]]
        best = where[np.arange(len(at)), values.argmax(1)]
        ring = np.stack([response[best[:, 0] + a, best[:, 1] + b] for a in (-1, 0, 1) for b in (-1, 0, 1)])
        contrast = np.where(values.max(1) >= ring.max(0), values.max(1), 0.0)  # 0 on the flank of a blob further out
        inside = np.clip(best - 1, 1, np.array(self.contrast.shape) - 2)
        return Blobs(self._refined(sign * self.contrast, *inside.T), contrast)

    def _refined(self, response: np.ndarray, row: np.ndarray, col: np.ndarray) -> np.ndarray:
        """Return the peak of the parabola through three elements per axis [mm]."""
        centre, shift = response[row, col], []
        for ahead, behind in (
            (response[row, col + 1], response[row, col - 1]),
            (response[row + 1, col], response[row - 1, col]),
        ):
            bend = 2 * centre - ahead - behind
            half = np.divide(ahead - behind, 2 * bend, out=np.zeros(len(row)), where=bend > 0)
            shift.append(np.clip(half, -0.5, 0.5))
        return self.corner_mm + (np.stack([col, row], -1) + np.stack(shift, -1)) * self.bin_mm


class Rectifier:
    """Carries the raw images of one camera to board planes, through a share of the pupil's radius; 1: all of it."""

    def __init__(
        self,
        decoder: LightFieldDecoder,
        half_width_mm: tuple[float, float],
        diameter_mm: float,
        *,
        pupil_share: float,
    ):
        optics = decoder.optics
        self._half_width, self._diameter = half_width_mm, diameter_mm
        stride = max(1, int(optics.microimage_pitch_px / _PIXELS_ACROSS))
        thinned = np.zeros(decoder.coverage.shape, bool)
        thinned[::stride, ::stride] = True
        if pupil_share < 1:  # a small part of the pupil is few pixels: use all of them
            thinned = np.hypot(*np.moveaxis(decoder.pupil_mm, -1, 0)) < pupil_share * optics.pupil_radius_mm
        self._seen = thinned & (decoder.coverage > _USED_COVERAGE) & (decoder.gain > 0)
        self._lens_mm = decoder.lattice.centres_mm(decoder.lens_index[self._seen]).astype(np.float32)
        self._pupil_mm = decoder.pupil_mm[self._seen]
        self._response = (decoder.coverage * decoder.gain)[self._seen] * np.float32(decoder.white_counts)
        self._cell_mm = optics.microlens_pitch_mm / abs(optics.magnification)

    def __call__(self, signal: np.ndarray, pose: CameraPose, z_mm: float) -> Rectified:
        """Rectify one image, dark level subtracted, nan where saturated, and filter it for blobs of the dots' size."""
        bin_mm = BIN_PITCHES * self._cell_mm
        shape = tuple(int(2 * half / bin_mm) + 1 for half in self._half_width[::-1])
        corner = -np.array(self._half_width)
        at = pose.on_plane(self._lens_mm, self._pupil_mm, z_mm) - corner.astype(np.float32)
        at *= np.float32(1 / bin_mm)
        inside = (at > -0.5).all(1) & (at < np.array(shape[::-1], np.float32) - 0.5).all(1)
        element = np.rint(at[inside]).astype(np.intp) @ np.array([1, shape[1]])
        counts = np.nan_to_num(signal[self._seen], nan=np.nanmax(signal))
        light, white = (
            np.bincount(element, values[inside], np.prod(shape)).reshape(shape) for values in (counts, self._response)
        )

        blob = np.hypot(self._diameter / 4, self._cell_mm / 3) / bin_mm
        narrow = [ndimage.gaussian_filter(image, blob) for image in (light, white)]
        wide = [ndimage.gaussian_filter(image, 2.5 * blob) for image in (light, white)]
        lit = (narrow[1] > 0.1 * np.median(wide[1])) & (wide[1] > 0.3 * np.median(wide[1]))
        response = np.zeros(shape)
        response[lit] = narrow[0][lit] / narrow[1][lit] - wide[0][lit] / wide[1][lit]
        response *= np.sqrt(narrow[1] / np.median(narrow[1][lit])) if lit.any() else 0  # noise falls with the light
        noise = NORMAL_MAD * np.median(np.abs(response[lit])) if lit.any() else 0.0
        share = np.divide(narrow[0], narrow[1], out=np.full(shape, np.nan), where=lit)
        return Rectified(response / max(noise, 1e-12), corner, bin_mm, noise, share)

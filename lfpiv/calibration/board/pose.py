"""Where the dots of a board are: a fitted thin-lens camera, images rectified to the board, lattice matching.

This camera only finds and names the dots; nothing of it enters the calibration except as a starting point.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.optimize import least_squares

from lfpiv.geometry.optics import Optics
from lfpiv.lightfield.decoder import LightFieldDecoder

BIN_PITCHES = 0.35
"""Element of a rectified image, in microlens pitches seen on the board."""

_PRIOR = {"angle_deg": 7.0, "tilt_deg": 3.0, "offset_mm": 0.7, "relative": 0.05}  # how far a rig strays from its plan
_ROBUST_PITCHES = 0.5  # dots that miss the pose by more than this count ever less
_USED_COVERAGE = 0.9
_PIXELS_ACROSS = 8  # pixels across a microimage that are enough to find dots
_SIGNIFICANT = 6.0  # a dot stands out of the rectified image by this many standard deviations
_FAINTEST = 0.2  # a dot is at least this bright against the typical dot of its plane
_INLIER_SPACINGS = 0.2  # dots this close to the lattice belong to it
_SEARCH_SPACINGS = 0.35  # dots are searched this far from where the pose puts them


@dataclass(frozen=True, kw_only=True)
class CameraPose:
    """Thin-lens camera in the world: s = k u - m x_c with x_c = Rz(roll) Rx(pitch) Ry(yaw) (x - offset), Eqs. 1-3."""

    parameters: tuple[float, ...]
    """Yaw, pitch, roll [rad]; offset (x, y, z) [mm]; log ratios to nominal of magnification, object distance, slope."""
    nominal: tuple[float, float, float]
    """Nominal yaw [rad], magnification (positive) and object distance [mm]."""

    @classmethod
    def from_plan(cls, optics: Optics, nominal_angle_deg: float) -> CameraPose:
        """Pose of a perfectly aligned camera."""
        yaw = np.radians(nominal_angle_deg)
        nominal = (yaw, abs(optics.magnification), optics.object_distance_mm)
        return cls(parameters=(yaw,) + 8 * (0.0,), nominal=nominal)

    @property
    def _lens(self) -> tuple[float, float, float]:
        """Magnification, object distance [mm] and the factor of the slope k."""
        ratio = np.exp(self.parameters[6:])
        return self.nominal[1] * ratio[0], self.nominal[2] * ratio[1], ratio[2]

    @property
    def rotation(self) -> np.ndarray:
        """Rotation from world to camera axes, shape (3, 3)."""
        (cy, cp, cr), (sy, sp, sr) = np.cos(self.parameters[:3]), np.sin(self.parameters[:3])
        turn = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
        tilt = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
        roll = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
        rotation: np.ndarray = roll @ tilt @ turn
        return rotation

    def rays(self, points_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Array positions of the rays through the pupil's centre [mm], (n, 2), and slopes k = ds/du, (n,)."""
        magnification, distance, slope = self._lens
        camera = (points_mm - np.array(self.parameters[3:6])) @ self.rotation.T
        m = magnification * distance / (distance - camera[:, 2])
        return -m[:, None] * camera[:, :2], slope * (m - magnification)

    def board_jacobian(self, points_mm: np.ndarray, pupil_radius_mm: float) -> tuple[np.ndarray, np.ndarray]:
        """How array positions follow a dot's position on the board.

        Returns
        -------
        jacobian : ndarray, shape (n, 2, 2)
            d(s, t)/d(x, y) of the ray through the pupil's centre.
        tilt : ndarray, shape (n, 2, 2, 2)
            Its change from the pupil's centre to its edge along u and v (last axis): on a tilted board the near side of
            a dot is less in focus than the far side.
        """
        step = 1e-3
        sides = [[self.rays(points_mm + sign * step * np.eye(3)[axis]) for sign in (1, -1)] for axis in (0, 1)]
        jacobian = np.stack([(ahead[0] - behind[0]) / (2 * step) for ahead, behind in sides], axis=-1)
        slopes = np.stack([(ahead[1] - behind[1]) / (2 * step) for ahead, behind in sides], axis=-1)
        return jacobian, pupil_radius_mm * slopes[:, None, :, None] * np.eye(2)[None, :, None, :]

    def on_plane(self, array_mm: np.ndarray, pupil_mm: np.ndarray, z_mm: float) -> np.ndarray:
        """Where the rays (s, t), (u, v) cross the world plane z, as (x, y) [mm], shape (n, 2)."""
        magnification, distance, slope = self._lens
        rotation, dtype = self.rotation, array_mm.dtype
        near: np.ndarray = array_mm @ (-rotation[:2] / magnification).astype(
            dtype
        )  # the ray at the camera's focal plane z_c = 0
        far = pupil_mm @ (slope * rotation[:2]).astype(dtype) + (distance * rotation[2]).astype(dtype)
        z = dtype.type(z_mm - self.parameters[5])
        share = (z - near[:, 2]) / (far[:, 2] - near[:, 2])
        offset = np.array(self.parameters[3:5], dtype)
        crossing: np.ndarray = near[:, :2] + share[:, None] * (far[:, :2] - near[:, :2]) + offset
        return crossing

    def fitted(
        self, points_mm: np.ndarray, array_mm: np.ndarray, optics: Optics, slope: np.ndarray | None = None
    ) -> CameraPose:
        """Pose that best explains the chief rays (and slopes) of named dots, held near the nominal rig by a prior."""
        angle, tilt = np.radians(_PRIOR["angle_deg"]), np.radians(_PRIOR["tilt_deg"])
        sigma = np.array([angle, tilt, tilt] + 3 * [_PRIOR["offset_mm"]] + 3 * [_PRIOR["relative"]])
        mean = np.array((self.nominal[0],) + 8 * (0.0,))
        accuracy = _ROBUST_PITCHES * optics.microlens_pitch_mm

        def residuals(parameters: np.ndarray) -> np.ndarray:
            chief, k = CameraPose(parameters=tuple(parameters), nominal=self.nominal).rays(points_mm)
            misses = [((chief - array_mm) / accuracy).ravel(), 0.1 * (parameters - mean) / sigma]
            if slope is not None:
                misses.append((k - slope) * optics.pupil_radius_mm / accuracy)
            return np.concatenate(misses)

        fit = least_squares(residuals, self.parameters, x_scale=sigma, loss="soft_l1")
        return CameraPose(parameters=tuple(float(p) for p in fit.x), nominal=self.nominal)


@dataclass(frozen=True, eq=False)
class Rectified:
    """Raw image carried along its rays to a board plane; dots respond in `contrast` [standard deviations]."""

    contrast: np.ndarray
    """Blob response over its noise, shape (y, x); zero where the camera sees nothing."""
    corner_mm: np.ndarray
    """Board position (x, y) of element (0, 0) [mm]."""
    bin_mm: float
    """Spacing of the elements [mm]."""

    def peaks(self, radius_mm: float, polarity: int) -> tuple[np.ndarray, np.ndarray]:
        """Significant blobs, at most one within `radius_mm`: positions (x, y) [mm], (n, 2), and contrasts, (n,)."""
        response = polarity * self.contrast
        size = 2 * max(int(radius_mm / self.bin_mm), 1) + 1
        top = (response == ndimage.maximum_filter(response, size)) & (response > _SIGNIFICANT)
        top[[0, -1]], top[:, [0, -1]] = False, False
        row, col = np.nonzero(top)
        return self._refined(response, row, col), response[row, col]

    def near(self, position_mm: np.ndarray, radius_mm: float, polarity: int) -> tuple[np.ndarray, np.ndarray]:
        """Strongest blob within `radius_mm` of each position: positions (x, y) [mm] and contrasts; 0 where none is."""
        response = np.pad(polarity * self.contrast, 1, constant_values=-np.inf)
        reach = int(np.ceil(radius_mm / self.bin_mm))
        along = np.arange(-reach, reach + 1)
        step = np.stack(np.meshgrid(along, along, indexing="ij"), -1).reshape(-1, 2)
        step = step[np.hypot(*step.T) * self.bin_mm <= radius_mm]
        at = np.rint((position_mm - self.corner_mm) / self.bin_mm).astype(int)[:, ::-1] + 1
        where = np.clip(at[:, None] + step, 1, np.array(response.shape) - 2)
        values = response[where[..., 0], where[..., 1]]
        best = where[np.arange(len(at)), values.argmax(1)]
        ring = np.stack([response[best[:, 0] + a, best[:, 1] + b] for a in (-1, 0, 1) for b in (-1, 0, 1)])
        contrast = np.where(values.max(1) >= ring.max(0), values.max(1), 0.0)  # not the flank of something further out
        inside = np.clip(best - 1, 1, np.array(self.contrast.shape) - 2)
        return self._refined(polarity * self.contrast, *inside.T), contrast

    def _refined(self, response: np.ndarray, row: np.ndarray, col: np.ndarray) -> np.ndarray:
        """Peak of the parabola through three elements per axis."""
        centre, shift = response[row, col], []
        for ahead, behind in (
            (response[row, col + 1], response[row, col - 1]),
            (response[row + 1, col], response[row - 1, col]),
        ):
            bend = 2 * centre - ahead - behind
            half = np.divide(ahead - behind, 2 * bend, out=np.zeros(len(row)), where=bend > 0)
            shift.append(np.clip(half, -0.5, 0.5))
        peak: np.ndarray = self.corner_mm + (np.stack([col, row], -1) + np.stack(shift, -1)) * self.bin_mm
        return peak


class Rectifier:
    """Carries the raw images of one camera to board planes."""

    def __init__(self, decoder: LightFieldDecoder, half_width_mm: tuple[float, float], diameter_mm: float):
        optics = decoder.optics
        self._decoder, self._half_width, self._diameter = decoder, half_width_mm, diameter_mm
        stride = max(1, int(optics.microimage_pitch_px / _PIXELS_ACROSS))  # finding dots does not need every pixel
        thinned = np.zeros(decoder.coverage.shape, bool)
        thinned[::stride, ::stride] = True
        self._seen = thinned & (decoder.coverage > _USED_COVERAGE) & (decoder.gain > 0)
        self._lens_mm = decoder.lattice.centres_mm(decoder.lens_index[self._seen]).astype(np.float32)
        self._pupil_mm = decoder.pupil_mm[self._seen]
        self._response = (decoder.coverage * decoder.gain)[self._seen] * np.float32(decoder.white_counts)
        self._cell_mm = optics.microlens_pitch_mm / abs(optics.magnification)

    def __call__(self, signal: np.ndarray, pose: CameraPose, z_mm: float) -> Rectified:
        """Rectify one image, dark level subtracted, nan where saturated, and filter it for blobs of the dots' size."""
        top = np.nanmax(signal)
        bin_mm = BIN_PITCHES * self._cell_mm
        shape = tuple(int(2 * half / bin_mm) + 1 for half in self._half_width[::-1])
        corner = -np.array(self._half_width)
        at = pose.on_plane(self._lens_mm, self._pupil_mm, z_mm) - corner.astype(np.float32)
        at *= np.float32(1 / bin_mm)
        inside = (at > -0.5).all(1) & (at < np.array(shape[::-1], np.float32) - 0.5).all(1)
        element = np.rint(at[inside]).astype(np.intp) @ np.array([1, shape[1]])
        light = np.bincount(element, np.nan_to_num(signal[self._seen], nan=top)[inside], np.prod(shape)).reshape(shape)
        white = np.bincount(element, self._response[inside], np.prod(shape)).reshape(shape)

        blob = np.hypot(self._diameter / 4, self._cell_mm / 3) / bin_mm
        narrow = [ndimage.gaussian_filter(image, blob) for image in (light, white)]
        wide = [ndimage.gaussian_filter(image, 2.5 * blob) for image in (light, white)]
        lit = (narrow[1] > 0.1 * np.median(wide[1])) & (wide[1] > 0.3 * np.median(wide[1]))
        response = np.zeros(shape)
        response[lit] = narrow[0][lit] / narrow[1][lit] - wide[0][lit] / wide[1][lit]
        response *= np.sqrt(narrow[1] / np.median(narrow[1][lit])) if lit.any() else 0  # noise falls with the light
        noise = 1.4826 * np.median(np.abs(response[lit])) if lit.any() else 0.0
        return Rectified(response / max(noise, 1e-12), corner, bin_mm)


def match_lattice(
    peaks_mm: np.ndarray, contrast: np.ndarray, dots: tuple[int, int], spacing_mm: float
) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """Find the lattice in a cloud of blobs that may lack dots and hold false ones.

    The two periods are the wave vectors near (1, 0) and (0, 1) per spacing whose plane waves the blobs follow best; the
    board's middle is the admissible lattice point nearest to the origin.

    Returns
    -------
    index : ndarray, shape (n, 2)
        Column and row of each blob that lies on the board's lattice.
    member : ndarray, shape (n,)
        Which blobs they are.
    score : float
        Sum of the contrasts of the members.
    regular : ndarray of bool, shape (blobs,)
        Which blobs lie on the lattice, on the board or beyond it.
    """
    nothing = np.empty((0, 2), int), np.empty(0, int), 0.0, np.zeros(len(peaks_mm), bool)
    if len(peaks_mm) < 1:
        return nothing
    weight = np.minimum(contrast, 3 * np.median(contrast))
    waves, phases = [], []
    for axis, count in enumerate(dots):
        size, turn = np.meshgrid(np.linspace(0.75, 1.35, 61), np.radians(np.linspace(-9, 9, 37)), indexing="ij")
        wave = np.stack([size * np.cos(turn), size * np.sin(turn)], -1).reshape(-1, 2) / spacing_mm
        wave = wave if axis == 0 else wave[:, ::-1] * (-1, 1)
        sums = np.exp(2j * np.pi * wave @ peaks_mm.T) @ weight
        prior = np.exp(-0.5 * (np.log(size) / 0.3) ** 2 - 0.5 * (turn / np.radians(9)) ** 2).ravel()
        best = np.argmax(np.abs(sums) * prior) if count > 1 else np.argmax(prior)
        waves.append(wave[best])
        phases.append(np.angle(sums[best]) / (2 * np.pi))
    inverse, phase = np.array(waves), np.array(phases)  # index = inverse @ position - phase
    for _ in range(6):
        place = peaks_mm @ inverse.T - phase
        index = np.rint(place)
        close = np.hypot(*(place - index).T) < _INLIER_SPACINGS
        if close.sum() < 3 or np.linalg.matrix_rank(index[close] - index[close].mean(0)) < 2:
            break
        design = np.column_stack([peaks_mm[close], np.ones(close.sum())])
        fit = np.linalg.lstsq(design, index[close], rcond=None)[0]
        inverse, phase = fit[:2].T, -fit[2]
    place = peaks_mm @ inverse.T - phase
    index = np.rint(place).astype(int)
    middle = (np.array(dots) - 1) / 2
    index += np.rint(middle + phase).astype(int)  # the origin's place is -phase: the board's middle lands next to it
    regular = np.hypot(*(place - np.rint(place)).T) < _INLIER_SPACINGS
    member = np.flatnonzero(((index >= 0) & (index < dots)).all(1) & regular)
    member = member[np.argsort(-contrast[member], kind="stable")]  # of two blobs at one place the stronger
    _, first = np.unique(index[member], axis=0, return_index=True)
    member = np.sort(member[first])
    if len(member) < 1:
        return nothing
    return index[member], member, float(contrast[member].sum()), regular


def strong_enough(contrast: np.ndarray) -> np.ndarray:
    """Which blobs are dots: significant, and not faint against the typical significant blob of their plane."""
    significant = contrast > _SIGNIFICANT
    typical = np.median(contrast[significant]) if significant.any() else np.inf
    return significant & (contrast > _FAINTEST * typical)


def search_radius_mm(spacing_mm: float) -> float:
    """How far from its predicted place a dot is searched on the board [mm]."""
    return _SEARCH_SPACINGS * spacing_mm

"""Cameras of a simulated scene: nominal optics, true pose, windows and aberrations, and the true mapping of rays."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from lfpiv.geometry.optics import LensLattice, Optics
from lfpiv.geometry.orientation import Orientation, camera_rotation
from lfpiv.settings import bounds
from lfpiv.settings.bounds import Angle, Coordinate, Direction, Flag, Length, Point, Thickness
from lfpiv.settings.rig import Flip, NominalCamera
from lfpiv.settings.table import Table
from lfpiv.simulation.lens import Lens
from lfpiv.simulation.sensor import Sensor
from lfpiv_kernels.rendering import real_optics

LARGEST_BLUR_PX = 100.0
"""Largest standard deviation of a sensor's point spread function [pixel]."""

Pair = tuple[Coordinate, Coordinate]
Side = Annotated[int, Field(strict=True, ge=1, le=bounds.MOST_SIDE_PX)]
Blur = Annotated[float, Field(strict=True, ge=0, le=LARGEST_BLUR_PX)]
Pitches = Annotated[float, Field(strict=True, ge=-10, le=10)]
Index = Annotated[float, Field(strict=True, ge=1, le=4)]
Drift = Annotated[float, Field(strict=True, ge=-0.05, le=0.05)]

SHARED_TABLES = ("window", "aberrations", "lens", "array", "sensor")
"""Tables of a camera that a scene may state once for all cameras."""

FOCUS_STEPS = 200
"""Largest number of steps that move a camera into focus through its windows."""
FOCUS_MM = 1e-11
"""Length of a step at which the camera is in focus [mm]."""


class Window(Table):
    """Table ``[window]`` or ``[camera.window]``: plane-parallel plates between particles and lens.

    Rays are refracted exactly (Snell's law). Reflection losses are neglected.
    """

    point_mm: Point
    """A point of the surface on the particles' side (x, y, z) [mm]."""
    normal: Direction
    """Normal of the surfaces (x, y, z), of any length and sign."""
    thickness_mm: Thickness
    """Thickness [mm]; 0 for an interface, such as the free surface of a liquid."""
    index: Index
    """Refractive index of the plate (about 1.46 fused silica, 1.52 crown glass, 1.49 acrylic)."""
    medium_index: Index = 1.0
    """Refractive index of the medium around the particles (1.333 water); only in the window next to them."""


def _as_list(value: Any) -> Any:
    return (value,) if isinstance(value, (Mapping, Window)) else value


def _next_to_particles_first(windows: tuple[Window, ...]) -> tuple[Window, ...]:
    if any(window.medium_index != 1 for window in windows[1:]):
        raise ValueError("medium_index only in the first window, the one next to the particles")
    return windows


Windows = Annotated[
    tuple[Window, ...],
    Field(max_length=bounds.MOST_SOLIDS),
    BeforeValidator(_as_list),
    AfterValidator(_next_to_particles_first),
]


class Aberrations(Table):
    """Table ``[aberrations]`` or ``[camera.aberrations]``: third-order (Seidel) aberrations of the main lens.

    Each value is the transverse ray aberration on the microlens array at the edge of the pupil, in microlens pitches.
    The edge of the field is the sensor's corner. The polynomial is in
    `lfpiv_kernels.rendering.real_optics.aberration_mm`.
    """

    spherical_pitch: Pitches = 0.0
    """Spherical aberration, uniform over the field; it grows with the cube of the pupil radius [pitch]."""
    coma_pitch: Pitches = 0.0
    """Tangential coma at the edge of the field, three times the sagittal one [pitch]."""
    astigmatism_pitch: Pitches = 0.0
    """Astigmatism at the edge of the field: tangential minus sagittal [pitch]."""
    field_curvature_pitch: Pitches = 0.0
    """Field curvature (sagittal) at the edge of the field [pitch]."""
    distortion_percent: Annotated[float, Field(strict=True, ge=-10, le=10)] = 0.0
    """Radial displacement of the chief ray at the edge of the field; positive: pincushion [% of the field's radius]."""
    centre_mm: Pair = (0.0, 0.0)
    """Point (s, t) of the array where the field's aberrations vanish [mm]. Outside the sensor's centre for a decentred
    lens, which then has coma on its axis."""


class ArrayFaults(Table):
    """Table ``[array]`` or ``[camera.array]``: faults of the microlens array and of the main lens's mount."""

    dead_share: Annotated[float, Field(strict=True, ge=0, le=0.2)] = 0.0
    """Share of the microlenses that pass no light."""
    pitch_drift: tuple[Drift, Drift] = (0.0, 0.0)
    """Relative growth of the pitch along s and t from the sensor's centre to its edge; it falls as much on the other
    side. The pitch is the stated one in the centre."""
    cats_eye: Annotated[float, Field(strict=True, ge=0, le=1)] = 0.0
    """Shift of a second aperture across the pupil in the sensor's corner, in pupil radii. The pupil seen from there is
    the part that both apertures share, a cat's eye."""


class Moved(Table):
    """Table ``[camera.moved]``: how the camera moved after white image and board were recorded."""

    shift_mm: Point = (0.0, 0.0, 0.0)
    """Shift of the point in focus at the sensor's centre (x, y, z) [mm]."""
    yaw_deg: Angle = 0.0
    """Increase of the camera's angle about y, or with `nominal_direction` about its own y axis [degree]."""
    pitch_deg: Angle = 0.0
    """Increase of the rotation about the camera's x axis [degree]."""
    roll_deg: Angle = 0.0
    """Increase of the rotation about the camera's z axis [degree]."""


class SceneCamera(NominalCamera):
    """Table ``[[camera]]``: nominal optics for the experiment file, and the truth, which is not in that file."""

    sensor_width_px: Side
    """Columns of the sensor."""
    sensor_height_px: Side
    """Rows of the sensor."""
    image_flip: Flip = "none"
    """How pictures show the scene: "none" mirrored left to right, "horizontal" as it is seen."""
    true_yaw_deg: Angle | None = None
    """True camera angle about y, or with `nominal_direction` the departure from it, about the camera's y axis [degree];
    absent: as stated."""
    true_pitch_deg: Angle = 0.0
    """Right-handed rotation about the camera's x axis, after the yaw [degree]."""
    true_roll_deg: Angle = 0.0
    """Right-handed rotation about the camera's z axis, after the pitch, beside `nominal_roll_deg` [degree]."""
    true_offset_mm: Point = (0.0, 0.0, 0.0)
    """World point in focus at the sensor's centre (x, y, z) [mm], through the windows if there are any."""
    true_array_roll_deg: Angle = 0.0
    """Rotation of the microlens array on the sensor [degree]."""
    true_array_offset_mm: Pair = (0.0, 0.0)
    """Centre (s, t) of a lens, relative to the sensor's centre [mm]."""
    true_microlens_pitch_mm: Length | None = None
    """True pitch of the array [mm]; absent: the nominal one."""
    blur_px: Blur = 0.4
    """Standard deviation of the sensor's Gaussian point spread function [pixel]."""
    vignetting: Annotated[float, Field(strict=True, ge=0, lt=1)] = 0.0
    """Fraction of the light lost in the sensor's corners. The loss grows with the square of the distance."""
    lens_gain_sd: Annotated[float, Field(strict=True, ge=0, lt=0.5)] = 0.0
    """Standard deviation of the microlenses' transmission."""
    dark_image: Flag = False
    """Record a dark image."""
    window: Windows | None = None
    """Windows of this camera, from the particles outwards; absent: the scene's."""
    aberrations: Aberrations | None = None
    """Aberrations of this camera's main lens; absent: the scene's."""
    lens: Lens | None = None
    """Surfaces of this camera's main lens; absent: the scene's, or a thin lens."""
    array: ArrayFaults | None = None
    """Faults of this camera's microlens array; absent: the scene's."""
    sensor: Sensor | None = None
    """Sensor of this camera; absent: the scene's."""
    moved: Moved | None = None
    """Movement of this camera between board and particles."""

    @model_validator(mode="after")
    def _is_placed(self) -> SceneCamera:
        if self.nominal_angle_deg is None and self.nominal_direction is None:
            raise ValueError("nominal_angle_deg or nominal_direction")
        return self

    @model_validator(mode="after")
    def _windows_face_the_camera(self) -> SceneCamera:
        for window in self.window or ():
            cosine = abs(self.rotation[2] @ window.normal) / np.linalg.norm(window.normal)
            if cosine < real_optics.STEEPEST:
                raise ValueError(
                    f"a window whose normal is turned towards the camera (camera {self.name!r} meets it at "
                    f"{np.degrees(np.arccos(cosine)):.0f} degrees)"
                )
        return self

    @model_validator(mode="after")
    def _lens_passes_rays(self) -> SceneCamera:
        if self.lens is not None and self.aberrations is not None:
            raise ValueError("either lens or aberrations")
        _ = self.lens_rays
        return self

    @model_validator(mode="after")
    def _rays_do_not_cross(self) -> SceneCamera:
        steepest = real_optics.steepest_aberration(self.seidel)
        if steepest > real_optics.STRONGEST:
            raise ValueError(
                f"aberrations that change by less than {real_optics.STRONGEST:g} mm per mm across the sensor (camera "
                f"{self.name!r} has {steepest:.2g}; lower them, or move centre_mm to the sensor)"
            )
        return self

    def with_shared(self, shared: Mapping[str, Any]) -> SceneCamera:
        """Return this camera with the scene's tables, of `SHARED_TABLES`, in place of missing ones."""
        own = {name: getattr(self, name) for name in type(self).model_fields}
        for name, table in shared.items():
            own[name] = table if own[name] is None else own[name]
        return type(self)(**own)

    @property
    def at_particles(self) -> SceneCamera:
        """The camera where it stood when the particles were recorded."""
        if self.moved is None:
            return self
        offset = tuple(a + b for a, b in zip(self.true_offset_mm, self.moved.shift_mm, strict=True))
        return self.model_copy(
            update={
                "true_offset_mm": offset,
                "true_yaw_deg": self._yaw_deg + self.moved.yaw_deg,
                "true_pitch_deg": self.true_pitch_deg + self.moved.pitch_deg,
                "true_roll_deg": self.true_roll_deg + self.moved.roll_deg,
                "moved": None,
            }
        )

    @property
    def optics(self) -> Optics:
        """Nominal optics."""
        return self.optics_of((self.sensor_height_px, self.sensor_width_px))

    @property
    def _yaw_deg(self) -> float:
        """True angle about y, or the departure from a nominal direction [degree]."""
        return (self.nominal_angle_deg or 0.0) if self.true_yaw_deg is None else self.true_yaw_deg

    @property
    def rotation(self) -> np.ndarray:
        """Rotation from world to camera, shape (3, 3).

        It is Rz Rx Ry with Ry the rotation of Eqs. 1-3, after the rotation to the nominal direction if one is stated.
        """
        roll = self.nominal_roll_deg + self.true_roll_deg
        rotation = camera_rotation(*np.radians([self._yaw_deg, self.true_pitch_deg, roll]))
        if self.nominal_direction is not None:
            rotation = rotation @ Orientation.from_direction(self.nominal_direction).rotation
        return rotation

    @property
    def axis_point_mm(self) -> np.ndarray:
        """World point at the object distance on the camera's axis (x, y, z) [mm]: origin of the camera's frame.

        Without windows it is the point in focus. With windows the camera is moved until that point is in focus. Raise
        ValueError if no such position is found.
        """
        focused = np.asarray(self.true_offset_mm, float)
        if not self.window:
            return focused
        optics, axis_point = self.optics, focused.copy()
        radius, so = optics.pupil_radius_mm / np.sqrt(2), optics.object_distance_mm
        pupil = radius * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
        for _ in range(FOCUS_STEPS):
            local = np.broadcast_to((focused - axis_point) @ self.rotation.T, (5, 3))
            apparent = real_optics.apparent_points(local, pupil, so, self._plates(axis_point))
            # the five rays cross the focal plane around the chief ray's point, at distances given by the mean defocus
            crossing = (apparent[:, :2] * so - pupil * apparent[:, 2:]) / (so - apparent[:, 2:])
            defocus = so * (crossing * pupil).sum() / (pupil**2).sum()
            step = np.array([*crossing[0], -defocus])
            axis_point += step @ self.rotation
            if np.abs(step).max() < FOCUS_MM:
                return axis_point
        raise ValueError(f"camera {self.name!r}: window: no place found from which true_offset_mm is in focus.")

    def local_mm(self, points_mm: np.ndarray) -> np.ndarray:
        """Return points (n, 3) in the camera's frame, shape (n, 3) [mm]."""
        return (points_mm - self.axis_point_mm) @ self.rotation.T

    def _plates(self, axis_point_mm: np.ndarray) -> np.ndarray:
        windows = self.window or ()
        return real_optics.pack_plates(
            np.array([window.normal for window in windows]).reshape(-1, 3) @ self.rotation.T,
            (np.array([window.point_mm for window in windows]).reshape(-1, 3) - axis_point_mm) @ self.rotation.T,
            np.array([window.thickness_mm for window in windows]),
            np.array([window.index for window in windows]),
            np.array([window.medium_index for window in windows]),
            object_distance_mm=self.optics.object_distance_mm,
        )

    @property
    def plates(self) -> np.ndarray:
        """Windows in the camera's frame, in the form of `real_optics.pack_plates`, shape (window, 7)."""
        return self._plates(self.axis_point_mm)

    @property
    def seidel(self) -> np.ndarray:
        """Aberrations in the form of `real_optics.Aberrations`, shape (9,)."""
        optics, lens = self.optics, self.aberrations or Aberrations()
        field = float(np.hypot(*optics.sensor_shape)) * optics.pixel_mm / 2
        edge = (lens.spherical_pitch, lens.coma_pitch, lens.astigmatism_pitch, lens.field_curvature_pitch)
        transverse = [value * optics.microlens_pitch_mm for value in edge]
        transverse.append(lens.distortion_percent / 100 * field)
        return np.array([*lens.centre_mm, 1 / optics.pupil_radius_mm, 1 / field, *transverse])

    @property
    def lens_rays(self) -> np.ndarray:
        """Polynomial of a lens of surfaces for `real_optics.lens_offsets`, shape (term, 4); empty without."""
        if self.lens is None or self.lens.file is not None:  # `open_scene` reads the file
            return real_optics.NO_LENS[:0]
        return self.lens.system(self.optics).ray_polynomial

    @property
    def faults(self) -> np.ndarray:
        """Drift of the pitch and cat's eye in the form of `array_faults.Faults`, shape (3,)."""
        optics, array = self.optics, self.array or ArrayFaults()
        half = np.array(optics.sensor_shape[::-1]) * optics.pixel_mm / 2
        drift = np.asarray(array.pitch_drift, float) / (2 * half)
        return np.array([*drift, array.cats_eye * optics.pupil_radius_mm / np.hypot(*half)])

    @property
    def lattice(self) -> LensLattice:
        """True microlens array in its own plane, without `array.pitch_drift`."""
        pitch = self.true_microlens_pitch_mm or self.microlens_pitch_mm
        roll = np.radians(self.true_array_roll_deg)
        second = np.radians(60 if self.microlens_layout == "hexagonal" else 90)
        basis = [(pitch * np.cos(angle + roll), pitch * np.sin(angle + roll)) for angle in (0.0, second)]
        return LensLattice(
            origin_mm=self.true_array_offset_mm, basis_mm=(basis[0], basis[1]), layout=self.microlens_layout
        )


def true_mapping(camera: SceneCamera | Mapping[str, Any]) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Return the true mapping of a simulated camera from points and pupil coordinates to the microlens array.

    Parameters
    ----------
    camera : SceneCamera or mapping
        A camera of a scene, or its table in ``truth/spec.json``.

    Returns
    -------
    callable
        ``(points_mm (n, 3), pupil_mm (n, 2)) -> (s, t) (n, 2)`` [mm], origin at the sensor's centre: s = k u - m x_c of
        the apparent point behind the windows, plus the aberrations of the lens. Behind a lens of surfaces rays that
        meet the array far beyond the sensor are nan.
    """
    if not isinstance(camera, SceneCamera):
        camera = SceneCamera.model_validate(camera)
    optics, rotation, axis_point = camera.optics, camera.rotation, camera.axis_point_mm
    plates, seidel, lens = camera.plates, camera.seidel, camera.lens_rays
    scales = optics.object_distance_mm, optics.image_distance_mm

    def mapping(points_mm: np.ndarray, pupil_mm: np.ndarray) -> np.ndarray:
        local = (np.asarray(points_mm, float) - axis_point) @ rotation.T
        if len(lens):
            return real_optics.array_places(local, np.asarray(pupil_mm, float), *scales, plates, seidel, lens)
        if len(plates):
            local = real_optics.apparent_points(local, pupil_mm, optics.object_distance_mm, plates)
        m = optics.image_distance_mm / (optics.object_distance_mm - local[..., 2:])
        k = m * local[..., 2:] / optics.object_distance_mm
        array: np.ndarray = k * np.asarray(pupil_mm, float) - m * local[..., :2]
        if np.any(seidel[4:]):
            array += real_optics.aberration_mm(array, pupil_mm, seidel)
        return array

    return mapping

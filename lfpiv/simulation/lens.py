"""Main lenses of published prescriptions: spherical surfaces, traced exactly, and a polynomial of their rays.

A lens is scaled to the camera's focal length f and focused to its magnification M. Its aperture stop is set so that the
cone of rays on the axis is the thin lens's, R / s_i. Rays are named by the paraxial exit pupil: (u, v) is the point at
which a ray crosses it, times s_i over the pupil's distance from the array, and (s, t) is the place on the array, times
the ratio of the microimages' pitches for a pupil at s_i and at the lens's. So u, s and the stated pitches mean to a
calibration what they mean for a thin lens. The aberrations of the pupil itself are left out: it is a disc in (u, v).

`object_rays` traces a ray from the array through all surfaces by Snell's law to the plane in focus. The simulator needs
millions of rays, so `ray_polynomial` fits what they are off the thin lens. By symmetry about the axis an offset is
A h + B p with h on the field, p on the pupil, and A and B polynomials of h.h, h.p and p.p.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from lfpiv.errors import InputError
from lfpiv.geometry.optics import Optics
from lfpiv.settings import bounds
from lfpiv.settings.bounds import Coordinate, Length, Thickness
from lfpiv.settings.table import Table
from lfpiv_kernels.rendering import real_optics

FIELD = real_optics.LENS_FIELD
"""Field that is fitted, in distances from the sensor's centre to its corner."""
PUPIL = 1.02
"""Pupil that is fitted, in pupil radii."""
FITTED = (12, 14, 24)
"""Rays that are fitted: places along the field, rings of the pupil, points of a ring."""

Index = Annotated[float, Field(strict=True, ge=1, le=4)]


class LensSurface(Table):
    """A surface in ``surfaces`` of ``[camera.lens]``, from the particles' side to the array."""

    radius_mm: Coordinate = 0.0
    """Radius of curvature, positive if the centre lies towards the array; 0 for a plane [mm]."""
    thickness_mm: Thickness
    """Distance to the next surface on the axis [mm]; the last one's is not used."""
    index: Index = 1.0
    """Refractive index behind the surface, at the wavelength of the light; 1 for air."""
    semi_diameter_mm: Length | None = None
    """Radius of the surface's clear aperture [mm]; absent: wide enough."""
    stop: Annotated[bool, Field(strict=True)] = False
    """Whether the surface is the aperture stop."""


Row = tuple[float, float, float]

PRESCRIPTIONS: dict[str, tuple[int, tuple[Row, ...]]] = {
    "double_gauss": (  # Double Gauss of 28 degrees, a sample lens of Zemax
        5,
        (
            *((56.20238, 8.75, 1.62229), (152.2858, 0.5, 1.0), (37.68262, 12.5, 1.60738), (0.0, 3.8, 1.60342)),
            *((24.2313, 16.369445, 1.0), (0.0, 13.747957, 1.0), (-28.37731, 3.8, 1.60342), (0.0, 11.0, 1.62041)),
            *((-37.92546, 0.5, 1.0), (177.41176, 7.0, 1.62041), (-79.41143, 0.0, 1.0)),
        ),
    ),
    "cooke_triplet": (  # Cooke triplet of 40 degrees, a sample lens of Zemax
        3,
        (
            *((22.01359, 3.25896, 1.62041), (-435.76044, 6.00755, 1.0), (-22.21328, 0.99997, 1.62004)),
            *((20.29192, 4.75041, 1.0), (79.6836, 2.95208, 1.62041), (-18.39533, 0.0, 1.0)),
        ),
    ),
    "tessar": (  # Tessar f/4.5; M. Laikin, Lens Design, 4th ed., CRC Press, 2007, p. 63
        4,
        (
            *((1.3329, 0.2791, 1.62296), (-9.9754, 0.2054, 1.0), (-2.0917, 0.09, 1.62004), (1.2123, 0.0709, 1.0)),
            *((0.0, 0.1534, 1.0), (-7.5205, 0.09, 1.50137), (1.301, 0.3389, 1.62296), (-1.5218, 0.0, 1.0)),
        ),
    ),
    "heliar": (  # Heliar f/5; M. Laikin, Lens Design, 4th ed., CRC Press, 2007, p. 63
        5,
        (
            *((4.2103, 0.9004, 1.62041), (-3.6208, 0.2999, 1.53172), (29.1869, 0.7587, 1.0), (-3.1715, 0.2, 1.53172)),
            *((3.2083, 0.1264, 1.0), (0.0, 0.2629, 1.0), (43.071, 0.25, 1.53172), (2.4494, 0.8308, 1.62041)),
            (-3.2576, 0.0, 1.0),
        ),
    ),
}
"""Published lenses: number of the stop, then radius, thickness [mm] and index behind each surface, for yellow light."""


class Lens(Table):
    """Table ``[camera.lens]``: surfaces of the main lens, a published lens by its name, or a Zemax file."""

    prescription: Literal["double_gauss", "cooke_triplet", "tessar", "heliar"] | None = None
    """A published lens."""
    surfaces: Annotated[tuple[LensSurface, ...], Field(max_length=bounds.MOST_SOLIDS)] = ()
    """Surfaces in the order in which light meets them, of any scale: they are scaled to ``focal_length_mm``."""
    file: bounds.PathText | None = None
    """Zemax file (.zmx), relative to the scene file; needs optiland."""

    @model_validator(mode="after")
    def _one_source(self) -> Lens:
        if sum((self.prescription is not None, bool(self.surfaces), self.file is not None)) != 1:
            raise ValueError("exactly one of prescription, surfaces and file")
        if self.surfaces and sum(surface.stop for surface in self.surfaces) != 1:
            raise ValueError("exactly one surface with stop = true")
        return self

    def read(self, folder: Path) -> Lens:
        """Return the lens with the surfaces of its file, if it names one."""
        return self if self.file is None else Lens(surfaces=_read_zemax(folder / self.file))

    def system(self, optics: Optics) -> LensSystem:
        """Return the lens, scaled and focused.

        Raises
        ------
        ValueError
            If it forms no real image of the plane in focus, or if a ray of pupil and sensor does not pass.
        """
        if self.prescription is not None:
            stop, rows = PRESCRIPTIONS[self.prescription]
            values = tuple((*row, np.inf) for row in rows)
        else:
            stop = [surface.stop for surface in self.surfaces].index(True)
            values = tuple(
                (one.radius_mm, one.thickness_mm, one.index, one.semi_diameter_mm or np.inf) for one in self.surfaces
            )
        return _system(values, stop, optics)


@dataclass(frozen=True, kw_only=True, eq=False)
class LensSystem:
    """A lens at its scale and focus. Along the axis z grows towards the array, from 0 at the first surface."""

    optics: Optics
    """Nominal optics."""
    place_mm: np.ndarray
    """Place z of each surface [mm]."""
    curvature: np.ndarray
    """Curvature of each surface [1/mm]."""
    index: np.ndarray
    """Refractive index before the first surface and behind each, shape (surfaces + 1,)."""
    semi_diameter_mm: np.ndarray
    """Radius of each surface's clear aperture [mm], infinite where it is wide enough."""
    object_mm: float
    """Place z of the plane in focus [mm]."""
    image_mm: float
    """Place z of the array [mm]."""
    pupil_mm: float
    """Place z of the paraxial exit pupil [mm]."""

    def object_rays(self, array_mm: np.ndarray, pupil_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Trace rays from the array back to the plane in focus, exactly.

        Parameters
        ----------
        array_mm, pupil_mm : ndarray, shape (n, 2)
            Points (s, t) and (u, v) [mm].

        Returns
        -------
        place, slope : ndarray, shape (n, 2)
            Where each ray crosses the plane in focus [mm], and its slope towards the lens; nan for a ray that misses a
            surface, exceeds its clear aperture or is reflected.
        """
        distance = self.image_mm - self.pupil_mm
        start = np.asarray(array_mm, float) / self._pitch_ratio
        across = (np.asarray(pupil_mm, float) * distance / self.optics.image_distance_mm - start) / distance
        point = np.column_stack([start, np.full(len(start), self.image_mm)])
        ray = np.column_stack([across, np.full(len(across), -1.0)])
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        with np.errstate(invalid="ignore"):
            for number in reversed(range(len(self.place_mm))):
                point, ray = self._refract(number, point, ray)
        slope = ray[:, :2] / ray[:, 2:]
        return point[:, :2] + (self.object_mm - point[:, 2:]) * slope, slope

    def _refract(self, number: int, point: np.ndarray, ray: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Carry rays back to a surface and through it."""
        curvature, before, behind = self.curvature[number], self.index[number], self.index[number + 1]
        vertex = np.array([0, 0, self.place_mm[number]])
        point = point + ((vertex[2] - point[:, 2]) / ray[:, 2])[:, None] * ray  # to the plane through the vertex
        arm = point - vertex
        # root of c |arm + x ray|^2 = 2 (arm + x ray)_z next to the vertex
        half = ray[:, 2] - curvature * (arm * ray).sum(1)
        constant = curvature * (arm**2).sum(1)
        length = constant / (half - np.sqrt(half**2 - curvature * constant))  # rays run towards -z, so half < 0
        point = point + length[:, None] * ray
        normal = curvature * (point - vertex) - [0, 0, 1]  # towards the particles, unit length
        cosine, ratio = (ray * normal).sum(1), behind / before
        root = np.sqrt(1 - ratio**2 * (1 - cosine**2))
        ray = ratio * ray + (root - ratio * cosine)[:, None] * normal
        lost = (point[:, :2] ** 2).sum(1) > self.semi_diameter_mm[number] ** 2
        return point, np.where(lost[:, None], np.nan, ray)

    @property
    def _pitch_ratio(self) -> float:
        """Ratio of stated places on the array to true ones: both give the same pitch of the microimages."""
        focal = self.optics.microlens_focal_length_mm
        return (1 + focal / (self.image_mm - self.pupil_mm)) / (1 + focal / self.optics.image_distance_mm)

    @property
    def field_mm(self) -> float:
        """Distance of the sensor's corner from its centre [mm]."""
        return float(np.hypot(*self.optics.sensor_shape)) * self.optics.pixel_mm / 2

    @functools.cached_property
    def ray_polynomial(self) -> np.ndarray:
        """Polynomial of the rays for `real_optics.lens_offsets`; raise ValueError if a ray does not pass."""
        optics = self.optics
        along, rings, turns = FITTED
        far = FIELD * self.field_mm * np.sin(np.pi / 2 * (np.arange(along) + 0.5) / along)  # dense at the edge
        ring = PUPIL * optics.pupil_radius_mm * np.sin(np.pi / 2 * (np.arange(rings) + 0.5) / rings)
        angle = np.pi * (np.arange(turns) + 0.5) / turns  # the other half mirrors it
        far, ring, angle = (part.ravel() for part in np.meshgrid(far, ring, angle, indexing="ij"))
        array = np.column_stack([far, 0 * far])
        pupil = ring[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        place, slope = self.object_rays(array, pupil)
        within = (far <= self.field_mm) & (ring <= optics.pupil_radius_mm)
        if (lost := np.isnan(place[:, 0])).any():
            share = lost[within].mean() if lost[within].any() else lost.mean()
            raise ValueError(
                f"a lens that passes every ray of pupil and sensor, with some room, at f/{optics.f_number:g} (surfaces "
                f"stop {100 * share:.0f} % of those tried; raise f_number, take a smaller sensor or wider surfaces)"
            )
        so, si = optics.object_distance_mm, optics.image_distance_mm
        offset = np.stack([place + array * so / si, slope - pupil / so - array / si], axis=1)
        h, p = array / self.field_mm, pupil / optics.pupil_radius_mm
        terms = real_optics.lens_terms(h, p)
        design = np.concatenate([np.hstack([terms * h[:, [k]], terms * p[:, [k]]]) for k in (0, 1)])
        found = np.linalg.lstsq(design, np.concatenate([offset[..., 0], offset[..., 1]]), rcond=None)[0]
        return found.reshape(2, terms.shape[1], 2).transpose(1, 2, 0).reshape(terms.shape[1], 4)


@functools.lru_cache(maxsize=64)
def _system(rows: tuple[tuple[float, float, float, float], ...], stop: int, optics: Optics) -> LensSystem:
    radius, thickness, behind, clear = np.array(rows, float).T
    curvature = np.divide(1.0, radius, out=np.zeros_like(radius), where=radius != 0)
    index = np.append(1.0, behind)
    first = _Paraxial(curvature, thickness[:-1], index)
    if not np.isfinite(first.focal_length_mm) or first.focal_length_mm <= 0 or index[-1] != 1:
        raise ValueError("surfaces of a converging lens in air")
    scale = optics.focal_length_mm / first.focal_length_mm
    curvature, thickness, clear = curvature / scale, thickness * scale, clear * scale
    lens = _Paraxial(curvature, thickness[:-1], index)
    place = np.append(0.0, np.cumsum(thickness[:-1]))
    system = LensSystem(
        optics=optics,
        place_mm=place,
        curvature=curvature,
        index=index,
        semi_diameter_mm=clear,
        object_mm=lens.front_mm - optics.object_distance_mm,
        image_mm=place[-1] + lens.back_mm + optics.image_distance_mm,
        pupil_mm=place[-1] + _Paraxial(curvature[stop:], thickness[stop:-1], index[stop:]).image_of_first,
    )
    if system.object_mm >= 0 or system.image_mm <= place[-1] or system.pupil_mm >= system.image_mm:
        raise ValueError("a lens whose plane in focus and array lie outside it")
    return system


class _Paraxial:
    """Paraxial rays through surfaces: height and reduced slope (index times slope) behind them."""

    def __init__(self, curvature: np.ndarray, thickness_mm: np.ndarray, index: np.ndarray):
        matrix = np.eye(2)
        for number, one in enumerate(curvature):
            if number:
                matrix = np.array([[1, thickness_mm[number - 1] / index[number]], [0, 1]]) @ matrix
            matrix = np.array([[1, 0], [-(index[number + 1] - index[number]) * one, 1]]) @ matrix
        (self._a, self._b), (self._c, self._d) = matrix

    @property
    def focal_length_mm(self) -> float:
        """Focal length; infinite without power."""
        return float(-1 / self._c) if self._c else np.inf

    @property
    def front_mm(self) -> float:
        """Place of the front principal plane behind the first surface."""
        return float((self._d - 1) / self._c)

    @property
    def back_mm(self) -> float:
        """Place of the back principal plane behind the last surface."""
        return float((1 - self._a) / self._c)

    @property
    def image_of_first(self) -> float:
        """Place of the image of the first surface's vertex, behind the last surface."""
        return float(-self._b / self._d)


def _read_zemax(path: Path) -> tuple[LensSurface, ...]:
    """Read the surfaces of a Zemax file with optiland."""
    try:
        from optiland.fileio import load_zemax_file
    except ImportError as error:
        raise InputError(
            f"{path}: a Zemax file is read by optiland, which could not be imported ({error}). Install it "
            "(pip install 'lfpiv[lenses]'), or state surfaces in place of file."
        ) from None
    if not path.is_file():
        raise InputError(f"{path}: expected a Zemax file (camera.lens.file), found none. Check its path.")
    try:
        return surfaces_of(load_zemax_file(str(path)))
    except Exception as error:  # optiland raises what its parts raise
        raise InputError(f"{path}: expected a lens of spherical surfaces in a Zemax file, found {error}.") from None


def surfaces_of(optic: Any) -> tuple[LensSurface, ...]:
    """Return the surfaces of an optiland lens between object and image; raise ValueError if a surface is no sphere."""
    group, wavelength, found = optic.surfaces, optic.primary_wavelength, []
    places = np.ravel(group.positions)
    for number in range(1, group.num_surfaces - 1):
        surface = group[number]
        radius, conic = float(surface.geometry.radius), float(getattr(surface.geometry, "k", 0.0))
        if conic or type(surface.geometry).__name__ not in ("StandardGeometry", "Plane"):
            raise ValueError(f"another shape than a sphere at surface {number}")
        found.append(
            LensSurface(
                radius_mm=radius if np.isfinite(radius) else 0.0,
                thickness_mm=float(places[number + 1] - places[number]),
                index=float(np.ravel(surface.material_post.n(wavelength))[0]),
                stop=number == group.stop_index,
            )
        )
    return tuple(found)

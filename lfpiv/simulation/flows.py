"""Flows with known displacement, and their mean over interrogation windows.

A flow is a frozen value that is called with points (n, 3) [mm]. It returns the displacement (n, 3) [mm] from the first
frame to the second of particles that are at these points midway in time. Frames at point -+ displacement/2 are
therefore consistent with the flow to second order. Points and displacements are ordered (x, y, z).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_serializer, model_validator
from pydantic_core.core_schema import SerializerFunctionWrapHandler
from scipy.spatial import cKDTree

from lfpiv.settings.bounds import Coordinate, Flag, Length, Name, Number, PathText, Point
from lfpiv.settings.table import Table
from lfpiv.simulation.swirl import injector_profiles
from lfpiv.simulation.tracers import TracerScaling, TracerSet, load_series, load_tracers, tracers_between
from lfpiv.simulation.turbulence import CHUNK, TurbulentFlow, checked_points

Corner = tuple[Number, Number, Number]
Axis = Literal["x", "y", "z"]

LAMB_OSEEN = 1.2564312086261697
"""Root a of exp(a) = 1 + 2 a. It places the largest displacement of a Lamb-Oseen vortex at the core radius."""


class Uniform(Table):
    """Uniform displacement."""

    kind: Literal["uniform"] = "uniform"
    displacement_mm: Point
    """Displacement (x, y, z) [mm]."""

    def __call__(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the displacement (n, 3) at points (n, 3) [mm]."""
        return np.broadcast_to(np.asarray(self.displacement_mm, float), checked_points(points_mm).shape).copy()


class Shear(Table):
    """Displacement along one axis, proportional to the distance along another."""

    kind: Literal["shear"] = "shear"
    along: Axis
    """Axis of the displacement."""
    across: Axis
    """Axis along which the displacement grows."""
    rate: Number
    """Displacement per distance [mm/mm]."""
    centre_mm: Point = (0.0, 0.0, 0.0)
    """Point at rest (x, y, z) [mm]."""

    @model_validator(mode="after")
    def _two_axes(self) -> Shear:
        if self.along == self.across:
            raise ValueError("two different axes in `along` and `across`")
        return self

    def __call__(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the displacement (n, 3) at points (n, 3) [mm]."""
        points_mm = checked_points(points_mm)
        across, along = "xyz".index(self.across), "xyz".index(self.along)
        displacement = np.zeros(points_mm.shape)
        displacement[:, along] = self.rate * (points_mm[:, across] - self.centre_mm[across])
        return displacement


class Ring(Table):
    """Ring vortex with its core line parallel to the x-y plane. The fluid inside the ring moves along -z.

    The magnitude is peak (r/core) exp(1 - r/core), with r the distance from the core line. A negative peak reverses it.
    """

    kind: Literal["ring"] = "ring"
    radius_mm: Length
    """Radius of the core line [mm]."""
    core_mm: Length
    """Distance from the core line where the displacement is largest [mm]."""
    peak_mm: Coordinate
    """Largest displacement [mm]."""
    centre_mm: Point = (0.0, 0.0, 0.0)
    """Centre of the ring (x, y, z) [mm]."""

    def __call__(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the displacement (n, 3) at points (n, 3) [mm]."""
        x, y, z = (checked_points(points_mm) - self.centre_mm).T
        from_axis = np.hypot(x, y)
        outward = from_axis - self.radius_mm
        r = np.hypot(outward, z)
        per_distance = self.peak_mm / self.core_mm * np.exp(1 - r / self.core_mm)
        radial = -per_distance * z / np.where(from_axis > 0, from_axis, 1)  # on the axis x = y = 0 anyway
        return np.stack([radial * x, radial * y, per_distance * outward], axis=1)


class Swirl(Table):
    """Rotation about an axis, right-handed for a positive peak, with a Gaussian jet along it."""

    kind: Literal["swirl"] = "swirl"
    peak_mm: Coordinate
    """Tangential displacement at the core radius [mm]."""
    core_mm: Length
    """Core radius [mm]."""
    profile: Literal["lamb_oseen", "solid"] = "lamb_oseen"
    """Lamb-Oseen vortex, which peaks at the core radius and decays, or solid-body rotation."""
    axis: Axis = "y"
    """Direction of the axis of rotation."""
    centre_mm: Point = (0.0, 0.0, 0.0)
    """A point on the axis (x, y, z) [mm]."""
    axial_mm: Coordinate = 0.0
    """Displacement along the axis, on the axis [mm]."""
    axial_core_mm: Length | None = None
    """Distance from the axis at which the jet falls to 1/e [mm]; absent: the core radius."""

    def __call__(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the displacement (n, 3) at points (n, 3) [mm]."""
        arm = checked_points(points_mm) - self.centre_mm
        axis = "xyz".index(self.axis)
        arm[:, axis] = 0
        square = (arm**2).sum(1) / self.core_mm**2
        rate = np.full(len(arm), self.peak_mm / self.core_mm)  # tangential displacement / distance from the axis
        if self.profile == "lamb_oseen":
            small = square < 1e-12
            decay = np.where(small, LAMB_OSEEN, -np.expm1(-LAMB_OSEEN * square) / np.where(small, 1, square))
            rate = rate * (1 + 1 / (2 * LAMB_OSEEN)) * decay
        displacement = rate[:, None] * np.cross(np.eye(3)[axis], arm)
        width = self.axial_core_mm or self.core_mm
        displacement[:, axis] = self.axial_mm * np.exp(-square * (self.core_mm / width) ** 2)
        return displacement


class SwirlingJet(Table):
    """Mean flow of a low-swirl injector: a rotating, spreading jet without divergence.

    At the outlet it has the profiles of `lfpiv.simulation.swirl.injector_profiles`. Stream surfaces are r / delta =
    constant with delta^2 = 1 + (spreading y / R)^2 and y the distance from the outlet. Along them the axial velocity
    falls as 1 / delta^2, volume flow and circulation are constant, and the radial velocity is r delta' / delta times
    the axial one. The defaults are the paper's injector: S = 0.55, D = 34 mm, central channel of 12 mm radius, and a
    mass ratio of 0.42, which gives that swirl number with 37 degree vanes (Eq. 17).
    """

    kind: Literal["swirling_jet"] = "swirling_jet"
    bulk_mm: Coordinate
    """Displacement at the bulk velocity (volume flow over nozzle area) [mm]; negative: against the axis."""
    swirl_number: Number = 0.55
    """Swirl number S at the outlet; positive: right-handed about the axis."""
    nozzle_radius_mm: Length = 17.0
    """Radius R of the nozzle [mm]."""
    radius_ratio: Annotated[float, Field(strict=True, gt=0.05, lt=0.95)] = 12 / 17
    """Radius of the central channel over the nozzle's."""
    mass_ratio: Annotated[float, Field(strict=True, ge=0, le=20)] = 0.42
    """Mass flow of the central channel over the mass flow of the swirled annulus."""
    shear_layer_mm: Length = 1.7
    """Half thickness of the shear layers, which are tanh profiles [mm]."""
    spreading: Annotated[float, Field(strict=True, ge=0, le=2)] = 0.5
    """Tangent of the half angle of spreading far from the outlet."""
    axis: Axis = "y"
    """Direction of the jet's axis."""
    centre_mm: Point = (0.0, 0.0, 0.0)
    """Centre of the outlet (x, y, z) [mm]."""

    @model_validator(mode="after")
    def _layers_thin(self) -> SwirlingJet:
        if not 0.01 <= self.shear_layer_mm / self.nozzle_radius_mm <= 0.5:
            raise ValueError("shear_layer_mm between 1 and 50 % of nozzle_radius_mm")
        return self

    def __call__(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the displacement (n, 3) at points (n, 3) [mm]."""
        radius, axis = self.nozzle_radius_mm, "xyz".index(self.axis)
        arm = (checked_points(points_mm) - self.centre_mm) / radius
        along = np.eye(3)[axis]
        height = arm[:, axis].copy()
        arm[:, axis] = 0
        spread = 1 + (self.spreading * height) ** 2  # delta squared
        axial, spin = injector_profiles(
            (arm**2).sum(1) / spread,
            self.radius_ratio,
            self.mass_ratio,
            self.shear_layer_mm / radius,
            self.swirl_number,
        )
        outward = axial / spread * self.spreading**2 * height / spread  # radial velocity over radius
        turning = spin / spread  # azimuthal velocity over radius: circulation is constant
        displacement = outward[:, None] * arm + turning[:, None] * np.cross(along, arm)
        displacement[:, axis] = axial / spread
        return self.bulk_mm * displacement


class Tracers(Table):
    """Flow given by tracer positions at two instants, or at those of a series, mapped into a box of the volume.

    Between tracers the displacement is a weighted linear fit to the nearest ones. Outside their bounding box it is that
    of the nearest point of the box. Displacements are stretched with the axes, each of which has its own factor.
    """

    kind: Literal["tracers"] = "tracers"
    file: PathText
    """A .npz file, relative to the scene file."""
    first: Name = "t0"
    """Array (tracer, >= 3) in the file whose first columns are x, y, z at the first instant, in any unit."""
    second: Name = "t1"
    """Array of the same tracers, in the same order, at the second instant."""
    series: Name | None = None
    """Array (instant, tracer, >= 3) of the same tracers at the instants of a time series, in place of `first` and
    `second`; its first instant is the first one of the series."""
    size_mm: tuple[Length, Length, Length]
    """Size (x, y, z) of the box of tracers [mm]."""
    centre_mm: Point = (0.0, 0.0, 0.0)
    """Centre (x, y, z) of the box [mm]."""
    box: tuple[Corner, Corner] | None = None
    """Two opposite corners of the box in the unit of the file; absent: the extent of the tracers."""
    peak_mm: Length | None = None
    """Largest magnitude of the scaled displacement [mm]; absent: as in the file. Not for a series."""
    as_given: Flag = False
    """Render the tracers as particles. False places particles at random and interpolates."""

    @model_validator(mode="after")
    def _box_open(self) -> Tracers:
        if self.box is not None and not all(low < high for low, high in zip(*self.box, strict=True)):
            raise ValueError("a box whose second corner lies above the first along every axis")
        return self

    @model_validator(mode="after")
    def _two_instants_or_series(self) -> Tracers:
        if self.is_series:
            unused = sorted({"first", "second", "peak_mm"} & self.model_fields_set)
            if unused:
                raise ValueError(f"no {unused[0]} with series, whose displacements follow from the positions")
        return self

    @model_serializer(mode="wrap")
    def _keys_of_its_kind(self, serialise: SerializerFunctionWrapHandler) -> dict[str, Any]:
        table: dict[str, Any] = serialise(self)
        unused = ("first", "second", "peak_mm") if self.is_series else ("series",)
        return {key: value for key, value in table.items() if key not in unused}

    @property
    def is_series(self) -> bool:
        """Whether there are positions at the instants of a time series, not at two."""
        return self.series is not None

    def tracers(self) -> tuple[np.ndarray, np.ndarray]:
        """Return tracer positions midway in time and displacements, each of shape (n, 3) [mm].

        Raises
        ------
        InputError
            If the file is missing or does not contain the two arrays.
        """
        loaded = self._loaded()
        return loaded.position_mm, loaded.displacement_mm

    def positions(self) -> np.ndarray:
        """Return the tracer positions at the instants of a series, shape (instant, tracer, 3) [mm].

        Raises
        ------
        InputError
            If the file is missing or does not contain the array.
        """
        if self.series is None:
            raise ValueError("positions: expected tracers with `series`, got two instants. Call tracers().")
        return load_series(self.file, self.series, self._scaling())

    def between(self, start: int, end: int) -> Callable[[np.ndarray], np.ndarray]:
        """Return the displacement from one instant of a series to another as a function of points (n, 3) [mm]."""
        instants = len(self.positions())
        if not 0 <= start < end < instants:
            raise ValueError(f"start, end: expected 0 <= start < end < {instants}, got {start} and {end}.")
        assert self.series is not None
        return tracers_between(self.file, self.series, self._scaling(), start, end).interpolate

    def __call__(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the displacement (n, 3) at points (n, 3) [mm]."""
        return self._loaded().interpolate(checked_points(points_mm))

    def _loaded(self) -> TracerSet:
        if self.is_series:
            raise ValueError("tracers: expected two instants, got a series. Call between(start, end).")
        return load_tracers(self.file, self.first, self.second, self._scaling())

    def _scaling(self) -> TracerScaling:
        return TracerScaling(size_mm=self.size_mm, centre_mm=self.centre_mm, box=self.box, peak_mm=self.peak_mm)


def tracer_series(flow: Flow) -> Tracers | None:
    """Return a flow that is given by tracers at the instants of a time series; None for any other flow."""
    return flow if isinstance(flow, Tracers) and flow.is_series else None


Flow = Uniform | Shear | Ring | Swirl | SwirlingJet | Tracers


def _window(window_mm: float | tuple[float, float, float]) -> np.ndarray:
    window = np.broadcast_to(np.asarray(window_mm, float), 3)
    if not (np.isfinite(window).all() and (window >= 0).all()):
        raise ValueError(f"window_mm: expected sizes (x, y, z) of 0 or more, got {window_mm}.")
    return window


def window_mean(
    flow: Callable[[np.ndarray], np.ndarray],
    centres_mm: np.ndarray,
    window_mm: float | tuple[float, float, float],
    *,
    order: int = 6,
) -> np.ndarray:
    """Average a flow over interrogation windows, as an ideal correlation would.

    Parameters
    ----------
    flow : callable
        Function of points (n, 3) that returns displacements (n, 3) [mm]. The fluctuation of a `TurbulentFlow` is
        averaged exactly.
    centres_mm : ndarray, shape (n, 3)
        Window centres (x, y, z) [mm].
    window_mm : float or tuple of float
        Edges of the windows, one or (x, y, z) [mm].
    order : int
        Gauss-Legendre nodes per axis, exact for polynomials of degree 2 order - 1.

    Returns
    -------
    ndarray, shape (n, 3)
        Mean displacement (x, y, z) [mm].

    Examples
    --------
    A window of 1 mm lowers the peak of a vortex with a core of 0.5 mm:

    >>> from lfpiv.simulation.flows import Swirl, window_mean
    >>> vortex = Swirl(peak_mm=0.2, core_mm=0.5, axis="z")
    >>> vortex([(0.5, 0, 0)]).round(3).tolist()
    [[0.0, 0.2, 0.0]]
    >>> (window_mean(vortex, [(0.5, 0, 0)], 1.0) + 0).round(3).tolist()
    [[0.0, 0.134, 0.0]]
    """
    centres_mm, window = checked_points(centres_mm), _window(window_mm)
    if isinstance(flow, TurbulentFlow):
        turbulent = flow.fluctuation.window_mean(centres_mm, tuple(window))
        return window_mean(flow.mean, centres_mm, tuple(window), order=order) + turbulent
    node, weight = np.polynomial.legendre.leggauss(order)
    nodes = np.stack(np.meshgrid(node, node, node, indexing="ij"), -1).reshape(-1, 3) * window / 2
    weights = np.einsum("i,j,k->ijk", weight, weight, weight).ravel() / 8
    mean = np.empty((len(centres_mm), 3))
    step = max(1, CHUNK // len(nodes))
    for first in range(0, len(mean), step):
        part = centres_mm[first : first + step]
        value = flow((part[:, None] + nodes).reshape(-1, 3)).reshape(len(part), len(nodes), 3)
        mean[first : first + step] = np.einsum("n,cnk->ck", weights, value)
    return mean


def average_truth(
    points_mm: np.ndarray,
    displacement_mm: np.ndarray,
    centres_mm: np.ndarray,
    window_mm: float | tuple[float, float, float],
) -> np.ndarray:
    """Average the displacement of the particles in each interrogation window, for flows known at particles only.

    Parameters
    ----------
    points_mm, displacement_mm : ndarray, shape (particle, 3)
        Positions midway in time and displacements (x, y, z) [mm].
    centres_mm : ndarray, shape (n, 3)
        Window centres (x, y, z) [mm].
    window_mm : float or tuple of float
        Edges of the windows, one or (x, y, z) [mm].

    Returns
    -------
    ndarray, shape (n, 3)
        Mean displacement [mm]; NaN where a window contains no particle.
    """
    points_mm, displacement_mm, centres_mm = (
        checked_points(points_mm),
        checked_points(displacement_mm),
        checked_points(centres_mm),
    )
    if points_mm.shape != displacement_mm.shape:
        raise ValueError(f"displacement_mm: expected one per point, {points_mm.shape}, got {displacement_mm.shape}.")
    half = np.maximum(_window(window_mm) / 2, 1e-12)
    members = cKDTree(points_mm / half).query_ball_point(centres_mm / half, 1.0, p=np.inf)
    mean = np.full((len(centres_mm), 3), np.nan)
    for row, inside in zip(mean, members, strict=True):
        if inside:
            row[:] = displacement_mm[inside].mean(0)
    return mean

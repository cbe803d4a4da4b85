"""Swirling jets: swirl number of profiles, swirl number of a low-swirl injector, and its mean profiles.

The swirl number is S = G_theta / (R G_x): the axial flux of angular momentum over the axial flux of axial momentum and
the nozzle radius. Pressure and turbulence are neglected, so the fluxes are integrals of U W r^2 and of U^2 r.
"""

from __future__ import annotations

import functools

import numpy as np

QUADRATURE = 400
"""Gauss-Legendre nodes over the radius of the jet."""


def swirl_number(radius: np.ndarray, axial: np.ndarray, azimuthal: np.ndarray, *, nozzle_radius: float) -> float:
    """Compute the swirl number of profiles by the trapezoidal rule.

    Parameters
    ----------
    radius : array_like, shape (n,)
        Increasing radii in any unit of length.
    axial, azimuthal : array_like, shape (n,)
        Axial and azimuthal velocity or displacement, both in the same unit.
    nozzle_radius : float
        Radius R of the nozzle, in the unit of `radius`.

    Returns
    -------
    float
        S = int U W r^2 dr / (R int U^2 r dr).

    Raises
    ------
    ValueError
        If the shapes differ, radii are negative or decrease, or there is no axial flow.
    """
    radius, axial, azimuthal = (np.asarray(value, float) for value in (radius, axial, azimuthal))
    if radius.ndim != 1 or len(radius) < 2 or axial.shape != radius.shape or azimuthal.shape != radius.shape:
        raise ValueError(
            "radius, axial, azimuthal: expected three profiles of one length of at least 2, got shapes "
            f"{radius.shape}, {axial.shape} and {azimuthal.shape}."
        )
    if not (np.isfinite([radius, axial, azimuthal]).all() and radius[0] >= 0 and (np.diff(radius) >= 0).all()):
        raise ValueError("radius, axial, azimuthal: expected finite values at radii that rise from 0 or more.")
    if not (np.isfinite(nozzle_radius) and nozzle_radius > 0):
        raise ValueError(f"nozzle_radius: expected a length above 0, got {nozzle_radius}.")
    momentum = np.trapezoid(axial**2 * radius, radius)
    if momentum == 0:
        raise ValueError("axial: expected a flow along the axis, got none: the swirl number is not defined.")
    return float(np.trapezoid(axial * azimuthal * radius**2, radius) / (nozzle_radius * momentum))


def injector_swirl_number(vane_angle_deg: float, radius_ratio: float, mass_ratio: float) -> float:
    """Compute the swirl number of a low-swirl injector with flat profiles, Eq. 17.

    Parameters
    ----------
    vane_angle_deg : float
        Angle between the axis and the flow in the swirled annulus [degree].
    radius_ratio : float
        Radius of the central channel over that of the injector, r.
    mass_ratio : float
        Mass flow of the central channel over that of the annulus, m.

    Examples
    --------
    >>> from lfpiv.simulation.swirl import injector_swirl_number
    >>> round(injector_swirl_number(vane_angle_deg=37, radius_ratio=12 / 17, mass_ratio=0.42), 2)
    0.55
    """
    if not (0 < radius_ratio < 1 and mass_ratio >= 0 and abs(vane_angle_deg) < 90):
        raise ValueError(
            "vane_angle_deg, radius_ratio, mass_ratio: expected -90 to 90, 0 to 1 and 0 or more, got "
            f"{vane_angle_deg}, {radius_ratio} and {mass_ratio}."
        )
    square = radius_ratio**2
    axial_momentum = 1 - square + mass_ratio**2 * square * (1 / square - 1) ** 2
    return float(2 / 3 * np.tan(np.radians(vane_angle_deg)) * (1 - radius_ratio**3) / axial_momentum)


def injector_profiles(
    square: np.ndarray, radius_ratio: float, mass_ratio: float, shear_layer: float, swirl: float
) -> tuple[np.ndarray, np.ndarray]:
    """Compute mean profiles at the outlet of a low-swirl injector: the two streams of Eq. 17 with shear layers.

    The central channel gives a slow stream without swirl. The annulus gives a fast stream with swirl at a nearly
    constant flow angle. The fluid outside is at rest. Shear layers have tanh profiles. The profiles are functions of
    the squared radius, so they are smooth on the axis.

    Parameters
    ----------
    square : ndarray
        Square of the radius over the nozzle radius.
    radius_ratio, mass_ratio : float
        As for `injector_swirl_number`.
    shear_layer : float
        Half thickness of the shear layers over the nozzle radius.
    swirl : float
        Swirl number of the profiles.

    Returns
    -------
    axial, spin : ndarray
        Axial velocity over the bulk velocity (volume flow over nozzle area), and azimuthal velocity over bulk velocity
        and relative radius.
    """
    axial, spin = _raw_profiles(np.asarray(square, float), radius_ratio, mass_ratio, shear_layer)
    bulk, raw_swirl = _profile_scales(radius_ratio, mass_ratio, shear_layer)
    return axial / bulk, spin * swirl / (raw_swirl * bulk)


def _raw_profiles(
    square: np.ndarray, radius_ratio: float, mass_ratio: float, shear_layer: float
) -> tuple[np.ndarray, np.ndarray]:
    channel = mass_ratio * (1 / radius_ratio**2 - 1)  # velocity of the channel over that of the annulus
    swirled = (1 + np.tanh((square - radius_ratio**2) / (2 * radius_ratio * shear_layer))) / 2
    inside = (1 - np.tanh((square - 1) / (2 * shear_layer))) / 2
    return (channel + (1 - channel) * swirled) * inside, swirled * inside / np.sqrt(square + shear_layer**2)


@functools.lru_cache(maxsize=16)
def _profile_scales(radius_ratio: float, mass_ratio: float, shear_layer: float) -> tuple[float, float]:
    """Return the bulk velocity and swirl number of the raw profiles."""
    node, weight = np.polynomial.legendre.leggauss(QUADRATURE)
    outer = 1 + 12 * shear_layer  # the jet is below 1e-10 there
    radius, weight = outer * (node + 1) / 2, outer * weight / 2
    axial, spin = _raw_profiles(radius**2, radius_ratio, mass_ratio, shear_layer)
    momentum = (weight * axial**2 * radius).sum()
    return 2 * float((weight * axial * radius).sum()), float((weight * axial * spin * radius**3).sum() / momentum)

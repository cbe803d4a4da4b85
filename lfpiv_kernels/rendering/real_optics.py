"""Real optics in front of the microlens array: plane-parallel windows, and a main lens that is not thin.

All coordinates are in the camera's frame: main lens at z = object distance, plane in focus at z = 0, pupil (u, v).

*Windows.* A plane-parallel plate of index n displaces a ray along the plate and does not change its direction in air. A
medium of index n0 on the particles' side bends the ray as well. Let N be the unit normal towards the lens, and T the
component along the plate of the ray's direction in air, per unit of N: |T| is the tangent of the angle of incidence. By
Snell's law the same ray advances by T / sqrt(q) per unit of N in an index n, with q = 1 + (n^2 - 1)(1 + |T|^2). So this
ray sees a point h below a plate of thickness t at its *apparent place*

    point - E T,    E = t (1 - 1/sqrt(q_plate)) + h (1 - 1/sqrt(q_medium)).

From there the ray is straight. T depends on the apparent place, which is found by fixed-point iteration. The iteration
contracts by about E / (distance to the lens). From the sensor outwards T is known and nothing is iterated. This is
Snell's law without approximation.

*Aberrations.* A ray that an ideal lens brings to (s, t) on the array lands at (s, t) plus the gradient of Seidel's wave
aberration; see `aberration_mm`. A *lens of surfaces* leads a ray to a place and a slope in the plane in focus that
differ from the ideal lens's by a polynomial; see `lens_offsets`. Such rays are traced from the array outwards. A point
finds its place on the array by iteration, until the ray back meets the point.

These functions compute in float64 and are the reference. `lfpiv_kernels.rendering.traced_rays` has the renderer's.
"""

import numpy as np

from lfpiv_kernels.libraries import ti

NO_PLATE = np.array([[0.0, 0, 1, 0, 0, 0, 0]])
"""A window that does nothing."""

STEPS, TOLERANCE_MM = 200, 1e-12
"""Iterations at most, and the largest step at which they stop [mm], in float64."""
FIELD_STOP = 1.5
"""Largest distance from the sensor's centre at which an ideal ray passes, in radii of the field. Farther out the
third-order polynomial would fold rays back onto the sensor."""
STRONGEST = 0.5
"""Largest change of an aberration per change of the position on the array. Up to it the iteration to the ideal position
at least halves its error in each step, and no two rays through one pupil point cross."""
STEEPEST = 0.05
"""Least cosine between a ray in air and a window's normal: 87 degrees of incidence. Hardly any steeper light enters."""

LENS_FIELD = 1.25
"""Largest distance from the sensor's centre at which a ray passes a lens of surfaces, in radii of the field."""
LENS_STEPS = 6
"""Iterations after which a ray that still lies beyond the field counts as lost."""
LENS_POWERS = tuple((i, j, k) for i in range(4) for j in range(4 - i) for k in range(8 - i - j))
"""Powers of h.h, h.p and p.p in the polynomial of a lens of surfaces: rays to fifteenth order, in the field to
seventh."""
NO_LENS = np.zeros((1, 4))
"""Polynomial that stands in place of a lens of surfaces where there is none."""

Aberrations = ti.types.vector(9, ti.f32)
"""Centre (s, t) [mm], 1 / pupil radius, 1 / field radius [1/mm], then spherical, coma, astigmatism, field curvature,
distortion: transverse aberration at the edge of pupil and field [mm]."""


def pack_plates(
    normals: np.ndarray,
    points_mm: np.ndarray,
    thickness_mm: np.ndarray,
    index: np.ndarray,
    medium_index: np.ndarray,
    *,
    object_distance_mm: float,
) -> np.ndarray:
    """Return windows in the form that the functions of this module take.

    Parameters
    ----------
    normals : ndarray, shape (window, 3)
        Normals in the camera's frame, of any length and either sense.
    points_mm : ndarray, shape (window, 3)
        A point of each window's surface on the particles' side [mm].
    thickness_mm, index, medium_index : ndarray, shape (window,)
        Thickness [mm], refractive index of the plate and of the medium on the particles' side. Only the first window,
        the one next to the particles, may have a medium other than air.
    object_distance_mm : float
        Position of the lens on the z axis [mm].

    Returns
    -------
    ndarray, shape (window, 7), float64
        Unit normal towards the lens (3), its product with a point of the first surface [mm], thickness [mm], and
        n^2 - 1 of plate and medium.
    """
    normals, points_mm = np.asarray(normals, float).reshape(-1, 3), np.asarray(points_mm, float).reshape(-1, 3)
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    towards = ((np.array([0, 0, object_distance_mm]) - points_mm) * normals).sum(1)
    normals = normals * np.where(towards < 0, -1.0, 1.0)[:, None]
    squares = (np.asarray(value, float) ** 2 - 1 for value in (index, medium_index))
    return np.column_stack([normals, (normals * points_mm).sum(1), np.asarray(thickness_mm, float), *squares])


def _shortening(square_less_one, tangent_square):
    """Return 1 - 1/sqrt(q), without cancellation and exactly 0 in air."""
    extra = square_less_one * (1 + tangent_square)
    return extra / (1 + extra + np.sqrt(1 + extra))


def apparent_points(points: np.ndarray, pupil: np.ndarray, object_distance_mm: float, plates: np.ndarray) -> np.ndarray:
    """Return where points appear through windows from points of the pupil, by exact Snell refraction.

    Parameters
    ----------
    points : ndarray, shape (..., 3)
        Points in the camera's frame, on the far side of the windows [mm].
    pupil : ndarray, shape (..., 2)
        Position (u, v) at which each ray crosses the pupil [mm].
    object_distance_mm : float
        Position of the pupil on the z axis [mm].
    plates : ndarray, shape (window, 7)
        From `pack_plates`.

    Returns
    -------
    ndarray, shape (..., 3)
        Points from which straight rays reach the pupil like the real rays [mm], converged to `TOLERANCE_MM`.

    Raises
    ------
    ValueError
        If a ray does not converge: it grazes a window and the medium fills nearly the whole way to the lens.
    """
    points, pupil = np.asarray(points, float), np.asarray(pupil, float)
    aim = np.concatenate([pupil, np.full((*pupil.shape[:-1], 1), float(object_distance_mm))], axis=-1)
    seen = points
    for _ in range(STEPS):
        moved = points
        for plate in plates:
            normal, level, thickness, glass, medium = plate[:3], *plate[3:]
            ray = aim - seen
            tangent = ray / (ray @ normal)[..., None] - normal
            square = (tangent**2).sum(-1)
            depth = level - points @ normal
            shift = thickness * _shortening(glass, square) + depth * _shortening(medium, square)
            moved = moved - shift[..., None] * tangent
        step = np.abs(moved - seen).max(initial=0)
        seen = moved
        if step < TOLERANCE_MM * max(1.0, np.abs(seen).max(initial=0)):
            return seen
    raise ValueError(f"windows: rays through them did not converge, off by {step:.1e} mm. Turn or move the windows.")


def aberration_mm(array_mm: np.ndarray, pupil: np.ndarray, aberrations: np.ndarray) -> np.ndarray:
    """Return the third-order transverse ray aberration on the array: the gradient of Seidel's wave aberration.

    With p the pupil point over the pupil's radius and h the ideal landing point over the field's radius,

        spherical |p|^2 p + coma/3 (|p|^2 h + 2 (h.p) p) + astigmatism (h.p) h + curvature |h|^2 p + distortion |h|^2 h.

    Parameters
    ----------
    array_mm : ndarray, shape (..., 2)
        Position (s, t) to which an ideal lens brings each ray [mm].
    pupil : ndarray, shape (..., 2)
        Position (u, v) at which each ray crosses the pupil [mm].
    aberrations : ndarray, shape (9,)
        In the order of `Aberrations`.

    Returns
    -------
    ndarray, shape (..., 2)
        Displacement from `array_mm` [mm].
    """
    spherical, coma, astigmatism, curvature, distortion = aberrations[4:]
    p, h = np.asarray(pupil, float) * aberrations[2], (np.asarray(array_mm, float) - aberrations[:2]) * aberrations[3]
    pp, hh, hp = ((a * b).sum(-1, keepdims=True) for a, b in ((p, p), (h, h), (h, p)))
    along_p = spherical * pp + coma / 1.5 * hp + curvature * hh
    along_h = coma / 3 * pp + astigmatism * hp + distortion * hh
    return along_p * p + along_h * h


def steepest_aberration(aberrations: np.ndarray) -> float:
    """Return a bound of the aberration's change per change of the position on the array, inside `FIELD_STOP`.

    Parameters
    ----------
    aberrations : ndarray, shape (9,)
        In the order of `Aberrations`.

    Returns
    -------
    float
        Largest spectral norm of the derivative over field and pupil. Rays can be traced back where it is at most
        `STRONGEST`.
    """
    changing, field, pupil = aberrations[5:], 1 / aberrations[3], 1 / aberrations[2]
    if not np.any(changing):
        return 0.0
    turn = 2 * np.pi * np.arange(16) / 16
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    # the derivative is a polynomial of second degree in the field and in the pupil: largest on a boundary
    array = FIELD_STOP * field * np.concatenate([ring, ring / 2, ring[:1] * 0])
    array, at = (part.reshape(-1, 2) for part in np.broadcast_arrays(array[:, None], pupil * ring))
    step = 1e-4 * field
    slopes = [
        (aberration_mm(array + h, at, aberrations) - aberration_mm(array - h, at, aberrations)) / (2 * step)
        for h in step * np.eye(2)
    ]
    return float(np.linalg.norm(np.stack(slopes, axis=-1), 2, axis=(-2, -1)).max())


def lens_terms(h: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return the products of h.h, h.p and p.p with `LENS_POWERS`, shape (..., term); h and p have shape (..., 2)."""
    factors = [(a * b).sum(-1) for a, b in ((h, h), (h, p), (p, p))]
    return np.stack([np.prod([f**e for f, e in zip(factors, one, strict=True)], axis=0) for one in LENS_POWERS], -1)


def lens_offsets(array_mm: np.ndarray, pupil: np.ndarray, aberrations: np.ndarray, lens: np.ndarray) -> np.ndarray:
    """Return how far rays behind a lens of surfaces are off an ideal lens's in the plane in focus.

    Parameters
    ----------
    array_mm, pupil : ndarray, shape (..., 2)
        Positions (s, t) and (u, v) of each ray [mm].
    aberrations : ndarray, shape (9,)
        In the order of `Aberrations`: the radii of pupil and field are used.
    lens : ndarray, shape (term, 4)
        Coefficients of `lens_terms`, with which h and p are multiplied in the place [mm], then in the slope.

    Returns
    -------
    ndarray, shape (..., 2, 2)
        Place [mm], then slope.
    """
    h, p = np.asarray(array_mm, float) * aberrations[3], np.asarray(pupil, float) * aberrations[2]
    factors = lens_terms(h, p) @ np.asarray(lens, float).reshape(-1, 4)
    return factors[..., 0::2, None] * h[..., None, :] + factors[..., 1::2, None] * p[..., None, :]


def object_lines(
    array_mm: np.ndarray,
    pupil: np.ndarray,
    object_distance_mm: float,
    image_distance_mm: float,
    plates: np.ndarray,
    aberrations: np.ndarray,
    lens: np.ndarray = NO_LENS[:0],
) -> tuple[np.ndarray, np.ndarray]:
    """Trace rays from the microlens array back to the particles' side of the windows.

    Parameters
    ----------
    array_mm, pupil : ndarray, shape (n, 2)
        Positions (s, t) and (u, v) at which each ray meets the array and the pupil [mm].
    object_distance_mm, image_distance_mm : float
        Main lens to the plane in focus and to the array [mm].
    plates, aberrations, lens : ndarray
        From `pack_plates`; in the order of `Aberrations`; for `lens_offsets`, empty without a lens of surfaces.

    Returns
    -------
    start, direction : ndarray, shape (n, 3)
        A point of each ray and its direction.
    """
    array_mm, pupil = np.asarray(array_mm, float), np.asarray(pupil, float)
    ideal = array_mm
    for _ in range(STEPS):
        step = array_mm - aberration_mm(ideal, pupil, aberrations) - ideal
        ideal = ideal + step
        if np.abs(step).max(initial=0) < TOLERANCE_MM * max(1.0, np.abs(array_mm).max(initial=0)):
            break
    nought = np.zeros((len(ideal), 1))
    start = np.hstack([-ideal * object_distance_mm / image_distance_mm, nought])
    direction = np.hstack([pupil / object_distance_mm + ideal / image_distance_mm, nought + 1])
    if len(lens):
        offset = lens_offsets(array_mm, pupil, aberrations, lens)
        start, direction = start + np.hstack([offset[:, 0], nought]), direction + np.hstack([offset[:, 1], nought])
    if not len(plates):
        return start, direction
    tangents = [direction / (direction @ plate[:3])[:, None] - plate[:3] for plate in plates]
    for plate, tangent in zip(plates, tangents, strict=True):
        start = start + (plate[4] * _shortening(plate[5], (tangent**2).sum(1)))[:, None] * tangent
    normal, level, medium = plates[0, :3], plates[0, 3], plates[0, 6]
    start = start + ((level - start @ normal) / (direction @ normal))[:, None] * direction
    slower = 1 - _shortening(medium, (tangents[0] ** 2).sum(1))
    return start, normal + slower[:, None] * tangents[0]


def array_places(
    points: np.ndarray,
    pupil: np.ndarray,
    object_distance_mm: float,
    image_distance_mm: float,
    plates: np.ndarray,
    aberrations: np.ndarray,
    lens: np.ndarray,
) -> np.ndarray:
    """Return where rays of points through pupil points meet the array behind a lens of surfaces, shape (n, 2) [mm].

    `points` (n, 3) are in the camera's frame; for the others see `object_lines`. A ray beyond `LENS_FIELD` is nan.

    Raises
    ------
    ValueError
        If a ray does not converge.
    """
    points, pupil = np.asarray(points, float), np.asarray(pupil, float)
    scale = image_distance_mm / (object_distance_mm - points[:, 2:])
    found = scale * points[:, 2:] / object_distance_mm * pupil - scale * points[:, :2]
    limit = LENS_FIELD / aberrations[3]
    for number in range(STEPS):
        far = np.maximum(np.linalg.norm(found, axis=1, keepdims=True) / limit, 1.0)
        start, ray = object_lines(
            found / far, pupil, object_distance_mm, image_distance_mm, plates, aberrations, lens
        )  # at the rim for rays beyond it, where the polynomial is fitted
        step = scale * (start + ((points[:, 2] - start[:, 2]) / ray[:, 2])[:, None] * ray - points)[:, :2]
        found = found / far + step
        inside = np.abs(step[far[:, 0] == 1])
        if number >= LENS_STEPS and inside.max(initial=0) < TOLERANCE_MM * max(1.0, np.abs(found).max(initial=0)):
            break
    else:
        raise ValueError(f"lens: rays through it did not converge, off by {inside.max():.1e} mm.")
    return np.where(far > 1, np.nan, found)

"""Real optics in front of the microlens array: plane-parallel windows and third-order aberrations of the main lens.

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
aberration; see `aberration_mm`.

NumPy functions compute in float64 and are the reference. Taichi functions do the same in float32 inside the renderer.
"""

import numpy as np

from lfpiv_kernels.libraries import ti

NO_PLATE = np.array([[0.0, 0, 1, 0, 0, 0, 0]])
"""A window that does nothing."""

STEPS, TOLERANCE_MM = 200, 1e-12
"""Iterations at most, and the largest step at which they stop [mm], in float64."""
STEPS_F32, TOLERANCE_F32_MM = 40, 2e-6
"""The same in the kernels, in float32. 2e-6 mm is 1/2000 of a small pixel."""
FIELD_STOP = 1.5
"""Largest distance from the sensor's centre at which an ideal ray passes, in radii of the field. Farther out the
third-order polynomial would fold rays back onto the sensor."""
STRONGEST = 0.5
"""Largest change of an aberration per change of the position on the array. Up to it the iteration to the ideal position
at least halves its error in each step, and no two rays through one pupil point cross."""
STEEPEST = 0.05
"""Least cosine between a ray in air and a window's normal: 87 degrees of incidence. Hardly any steeper light enters."""

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


def object_lines(
    array_mm: np.ndarray,
    pupil: np.ndarray,
    object_distance_mm: float,
    image_distance_mm: float,
    plates: np.ndarray,
    aberrations: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Trace rays from the microlens array back to the particles' side of the windows.

    Parameters
    ----------
    array_mm, pupil : ndarray, shape (n, 2)
        Positions (s, t) and (u, v) at which each ray meets the array and the pupil [mm].
    object_distance_mm, image_distance_mm : float
        Main lens to the plane in focus and to the array [mm].
    plates, aberrations : ndarray
        From `pack_plates`; in the order of `Aberrations`.

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
    if not len(plates):
        return start, direction
    tangents = [direction / (direction @ plate[:3])[:, None] - plate[:3] for plate in plates]
    for plate, tangent in zip(plates, tangents, strict=True):
        start = start + (plate[4] * _shortening(plate[5], (tangent**2).sum(1)))[:, None] * tangent
    normal, level, medium = plates[0, :3], plates[0, 3], plates[0, 6]
    start = start + ((level - start @ normal) / (direction @ normal))[:, None] * direction
    slower = 1 - _shortening(medium, (tangents[0] ** 2).sum(1))
    return start, normal + slower[:, None] * tangents[0]


@ti.func
def shortening(square_less_one, tangent_square):
    """Float32 twin of `_shortening`."""
    extra = square_less_one * (1.0 + tangent_square)
    return extra / (1.0 + extra + ti.sqrt(1.0 + extra))


@ti.func
def apparent_shift(place, start, u, v, so, plates: ti.template()):
    """Return the apparent place minus `place` for one ray, iterated from the guess `start`.

    Float32 twin of `apparent_points`. Every other step is lengthened by the ratio of the last two steps (Aitken). The
    error left is about the square of that ratio times the step.
    """
    shift, last = start, ti.Vector([0.0, 0.0, 0.0])
    aim = ti.Vector([u, v, so]) - place
    for number in range(STEPS_F32):
        ray = aim - shift
        found = ti.Vector([0.0, 0.0, 0.0])
        for n in range(plates.shape[0]):
            normal = ti.Vector([plates[n, 0], plates[n, 1], plates[n, 2]])
            tangent = (1.0 / ray.dot(normal)) * ray - normal
            square = tangent.dot(tangent)
            length = plates[n, 4] * shortening(plates[n, 5], square)
            if plates[n, 6] > 0.0:
                length += (plates[n, 3] - normal.dot(place)) * shortening(plates[n, 6], square)
            found -= length * tangent
        step = found - shift
        shift = found
        left = ti.abs(step).max()
        if number % 2 == 1:
            ratio = ti.min(ti.max(step.dot(last) / last.dot(last), 0.0), 0.8)
            shift += ratio / (1.0 - ratio) * step
            left *= ratio * ratio
        if left < TOLERANCE_F32_MM:
            break
        last = step
    return shift


@ti.func
def aberration(s, t, u, v, lens):
    """Float32 twin of `aberration_mm`."""
    p = ti.Vector([u * lens[2], v * lens[2]])
    h = ti.Vector([(s - lens[0]) * lens[3], (t - lens[1]) * lens[3]])
    pp, hh, hp = p.dot(p), h.dot(h), h.dot(p)
    along_p = lens[4] * pp + lens[5] / 1.5 * hp + lens[7] * hh
    along_h = lens[5] / 3.0 * pp + lens[6] * hp + lens[8] * hh
    return along_p * p + along_h * h


@ti.func
def board_hit(s, t, u, v, so, si, plates: ti.template(), lens, normal, level):
    """Return where the ray from (s, t) on the array through (u, v) on the pupil meets the plane normal . place = level.

    Float32 twin of `object_lines`. It has ten parameters because they are numbers of one ray, of the camera and of the
    plane, which Taichi inlines.
    """
    ideal = ti.Vector([s, t])
    for _step in range(STEPS_F32):
        step = ti.Vector([s, t]) - aberration(ideal[0], ideal[1], u, v, lens) - ideal
        ideal += step
        if ti.abs(step).max() < TOLERANCE_F32_MM:
            break
    start = ti.Vector([-ideal[0] * so / si, -ideal[1] * so / si, 0.0])
    direction = ti.Vector([u / so + ideal[0] / si, v / so + ideal[1] / si, 1.0])
    shift = ti.Vector([0.0, 0.0, 0.0])
    for n in range(plates.shape[0]):
        across = ti.Vector([plates[n, 0], plates[n, 1], plates[n, 2]])
        tangent = direction / direction.dot(across) - across
        shift += plates[n, 4] * shortening(plates[n, 5], tangent.dot(tangent)) * tangent
    start += shift
    inner = ti.Vector([plates[0, 0], plates[0, 1], plates[0, 2]])
    tangent = direction / direction.dot(inner) - inner
    slower = 1.0 - shortening(plates[0, 6], tangent.dot(tangent))
    start += (plates[0, 3] - inner.dot(start)) / direction.dot(inner) * direction
    inside = inner + slower * tangent
    return start + (level - normal.dot(start)) / normal.dot(inside) * inside

"""Rays through windows and a main lens that is not thin, in the renderer: float32 twins of `real_optics`."""

from lfpiv_kernels.libraries import ti
from lfpiv_kernels.rendering.real_optics import LENS_FIELD, LENS_POWERS, LENS_STEPS

STEPS_F32, TOLERANCE_F32_MM = 40, 2e-6
"""Iterations at most, and the largest step at which they stop [mm]. 2e-6 mm is 1/2000 of a small pixel."""


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
def board_hit(s, t, u, v, so, si, plates: ti.template(), errors, lens: ti.template(), thick: ti.template(), plane):
    """Return where the ray from (s, t) on the array through (u, v) on the pupil meets a plane: normal (3) and level.

    Float32 twin of `object_lines`; `thick` says whether there is a lens of surfaces. It has eleven parameters because
    they are numbers of one ray, of the camera and of the plane, which Taichi inlines.
    """
    ideal = ti.Vector([s, t])
    if ti.static(not thick):
        for _step in range(STEPS_F32):
            step = ti.Vector([s, t]) - aberration(ideal[0], ideal[1], u, v, errors) - ideal
            ideal += step
            if ti.abs(step).max() < TOLERANCE_F32_MM:
                break
    start = ti.Vector([-ideal[0] * so / si, -ideal[1] * so / si, 0.0])
    direction = ti.Vector([u / so + ideal[0] / si, v / so + ideal[1] / si, 1.0])
    if ti.static(thick):
        offset = lens_offset(s * errors[3], t * errors[3], u * errors[2], v * errors[2], lens)
        start += ti.Vector([offset[0], offset[1], 0.0])
        direction += ti.Vector([offset[2], offset[3], 0.0])
    normal, level = ti.Vector([plane[0], plane[1], plane[2]]), plane[3]
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


@ti.func
def lens_offset(h0, h1, p0, p1, lens: ti.template()):
    """Float32 twin of `lens_offsets`: place, then slope."""
    hh, hp, pp = h0 * h0 + h1 * h1, h0 * p0 + h1 * p1, p0 * p0 + p1 * p1
    of_hh, of_hp, of_pp = ti.Vector([1.0] * 8), ti.Vector([1.0] * 8), ti.Vector([1.0] * 8)
    for power in ti.static(range(1, 8)):
        of_hh[power], of_hp[power] = of_hh[power - 1] * hh, of_hp[power - 1] * hp
        of_pp[power] = of_pp[power - 1] * pp
    factor = ti.Vector([0.0, 0.0, 0.0, 0.0])
    for i in ti.static(range(4)):
        for j in ti.static(range(4 - i)):
            for k in ti.static(range(8 - i - j)):
                n = ti.static(LENS_POWERS.index((i, j, k)))
                factor += of_hh[i] * of_hp[j] * of_pp[k] * ti.Vector([lens[n, o] for o in range(4)])
    return ti.Vector(
        [
            factor[0] * h0 + factor[1] * p0,
            factor[0] * h1 + factor[1] * p1,
            factor[2] * h0 + factor[3] * p0,
            factor[2] * h1 + factor[3] * p1,
        ]
    )


@ti.func
def array_place(place, start, u, v, so, si, plates: ti.template(), errors, lens: ti.template()):
    """Return how far (s, t) is off an ideal lens's for the ray of a point through (u, v), iterated from `start`.

    Float32 twin of `array_places`. The last number is 1 where the ray passes, 0 beyond `LENS_FIELD`.
    """
    m = si / (so - place[2])
    k = m * place[2] / so
    ideal = ti.Vector([k * u - m * place[0], k * v - m * place[1]])
    off, passes = start, 1.0
    limit = LENS_FIELD / errors[3]
    for number in range(STEPS_F32):
        at = ideal + off
        far = ti.max(at.norm() / limit, 1.0)
        at /= far
        plane = ti.Vector([0.0, 0.0, 1.0, place[2]])
        hit = board_hit(at[0], at[1], u, v, so, si, plates, errors, lens, True, plane)
        step = m * ti.Vector([hit[0] - place[0], hit[1] - place[1]])
        off, passes = at + step - ideal, ti.select(far > 1.0, 0.0, 1.0)
        if (far > 1.0 and number >= LENS_STEPS) or (far == 1.0 and ti.abs(step).max() < TOLERANCE_F32_MM):
            break
    return ti.Vector([off[0], off[1], passes])

"""Faults of the microlens array and of the main lens's mount, in the kernels of the renderer (Taichi).

*Drifting pitch.* The pitch grows linearly across the sensor, so lens centres c of a regular lattice move to
c + g c^2, for each axis with its own g [1/mm]. A ray belongs to the lens whose centre is nearest before this shift.

*Cat's eye.* A second aperture of the pupil's size, in front of or behind it, moves across the pupil in proportion to
the position on the array. Rays must pass both.
"""

from lfpiv_kernels.libraries import ti

Faults = ti.types.vector(3, ti.f32)
"""Drift g along s and t [1/mm], and shift of the second aperture on the pupil per distance on the array [mm/mm]."""


@ti.func
def drifted(centre, faults):
    """Return where a lens of the regular lattice really is [mm]."""
    return ti.Vector([centre[0] + faults[0] * centre[0] ** 2, centre[1] + faults[1] * centre[1] ** 2])


@ti.func
def undrifted(s, t, faults):
    """Return the place on the regular lattice of a place on the array [mm]: the inverse of `drifted`."""
    return ti.Vector(
        [
            2.0 * s / (1.0 + ti.sqrt(1.0 + 4.0 * faults[0] * s)),
            2.0 * t / (1.0 + ti.sqrt(1.0 + 4.0 * faults[1] * t)),
        ]
    )


@ti.func
def passes(s, t, u, v, radius, faults):
    """Return whether the second aperture passes the ray from (u, v) on the pupil to (s, t) on the array."""
    return (u - faults[2] * s) ** 2 + (v - faults[2] * t) ** 2 < radius * radius

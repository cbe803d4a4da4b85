"""Taichi functions on a microlens lattice, shared by every kernel that sends rays through the array."""

import numpy as np
import taichi as ti

Lattice = ti.types.vector(10, ti.f32)
"""Origin (s, t), basis vectors a (s, t) and b (s, t) [mm], and the rows of the inverse basis [1/mm]."""


def pack_lattice(origin_mm: np.ndarray, basis_mm: np.ndarray) -> Lattice:
    """Pack a lattice for the kernels: lens (i, j) is centred at origin + i basis[0] + j basis[1] [mm]."""
    basis = np.asarray(basis_mm, float)
    inverse = np.linalg.inv(basis)  # offset @ inverse = (i, j)
    return Lattice(*np.asarray(origin_mm, float), *basis.ravel(), *inverse.T.ravel())


@ti.func
def lens_centre(lattice, i, j):
    """Centre (s, t) [mm] of lens (i, j)."""
    return ti.Vector([lattice[0] + i * lattice[2] + j * lattice[4], lattice[1] + i * lattice[3] + j * lattice[5]])


@ti.func
def nearest_lens(lattice, s, t, hexagonal: ti.template()):
    """Index (i, j) of the lens whose centre is nearest to (s, t); twin: ``LensLattice.nearest``."""
    ds, dt = s - lattice[0], t - lattice[1]
    i = ti.round(lattice[6] * ds + lattice[7] * dt)
    j = ti.round(lattice[8] * ds + lattice[9] * dt)
    if ti.static(hexagonal):
        best_i, best_j = i, j
        best = ti.f32(1e30)
        for a, b in ti.static(ti.ndrange((-1, 2), (-1, 2))):
            centre = lens_centre(lattice, i + a, j + b)
            distance = (s - centre[0]) ** 2 + (t - centre[1]) ** 2
            if distance < best:
                best, best_i, best_j = distance, i + a, j + b
        i, j = best_i, best_j
    return ti.Vector([i, j])

"""The microlens lattice as kernels take it: centres, cells, and Taichi functions that find the lens of a ray."""

import numpy as np
import taichi as ti

Lattice = ti.types.vector(10, ti.f32)
"""Origin (s, t), basis vectors a (s, t) and b (s, t) [mm], and the rows of the inverse basis [1/mm]."""
SLANT_STEPS = 4
"""Steps that stand for a slanted side of a hexagonal cell."""


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


def cell_steps(layout: str) -> np.ndarray:
    """Outline of a lens's cell in its own frame, rows (half width along a, half height along b) [pitch].

    Where |b| is above the height of the row before and at most its own, the cell reaches from -a to a. A square cell
    is one row; the sides of a hexagonal one that face +-b are steps, its flat sides face +-a.
    """
    if layout == "square":
        return np.array([[0.5, 0.5]], np.float32)
    side, tip = 1 / (2 * np.sqrt(3)), 1 / np.sqrt(3)
    heights = np.linspace(side, tip, SLANT_STEPS + 1)
    widths = 0.5 * (tip - (heights[1:] + heights[:-1]) / 2) / (tip - side)
    return np.stack([np.append(0.5, widths), heights], axis=1).astype(np.float32)


def cell_rectangles(layout: str) -> np.ndarray:
    """Rectangles that make up a lens's cell, rows (a_low, a_high, b_low, b_high) in its own frame [pitch]."""
    (a, b), *steps = cell_steps(layout)
    rows, low = [(-a, a, -b, b)], b
    for a, high in steps:
        rows += [(-a, a, low, high), (-a, a, -high, -low)]
        low = high
    return np.array(rows, np.float32)


def cell_frame(basis_mm: np.ndarray, layout: str) -> np.ndarray:
    """Matrix F, shape (2, 2): (a, b) = F (s, t) turns array millimetres into the frame of `cell_rectangles`.

    A hexagonal cell has three such frames. The one nearest to the sensor's axes is taken: the projected edges of voxels
    and pixels lie along these where a camera is upright, and along (a, b) they are integrated apart.
    """
    basis = np.asarray(basis_mm, float)
    if layout == "square":
        return np.linalg.inv(basis).T
    pitch = np.sqrt(abs(np.linalg.det(basis)) * 2 / np.sqrt(3))
    third = basis[1] - basis[0] if basis[0] @ basis[1] > 0 else basis[1] + basis[0]
    neighbours = np.array([*basis, third])
    a = neighbours[np.abs(neighbours).min(1).argmin()]  # equally long: the shorter part grows with the angle to an axis
    a = a / np.linalg.norm(a)
    return np.array([a, [-a[1], a[0]]]) / pitch

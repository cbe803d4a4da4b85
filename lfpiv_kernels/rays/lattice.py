"""The microlens lattice for the kernels: centres and cells of lenses, and Taichi functions that find a ray's lens."""

import numpy as np

from lfpiv_kernels.libraries import ti

Lattice = ti.types.vector(10, ti.f32)
"""Origin (s, t), basis vectors a (s, t) and b (s, t) [mm], and the rows of the inverse basis [1/mm]."""
SLANT_STEPS = 4
"""Steps that replace a slanted side of a hexagonal cell."""


def pack_lattice(origin_mm: np.ndarray, basis_mm: np.ndarray) -> Lattice:
    """Return a lattice as the kernels take it. The centre of lens (i, j) is origin + i basis[0] + j basis[1] [mm]."""
    basis = np.asarray(basis_mm, float)
    inverse = np.linalg.inv(basis)  # offset @ inverse = (i, j)
    return Lattice(*np.asarray(origin_mm, float), *basis.ravel(), *inverse.T.ravel())


@ti.func
def lens_centre(lattice, i, j):
    """Return the centre (s, t) [mm] of lens (i, j)."""
    return ti.Vector([lattice[0] + i * lattice[2] + j * lattice[4], lattice[1] + i * lattice[3] + j * lattice[5]])


@ti.func
def nearest_lens(lattice, s, t, hexagonal: ti.template()):
    """Return the index (i, j) of the lens whose centre is nearest to (s, t). Twin: ``LensLattice.nearest``."""
    ds, dt = s - lattice[0], t - lattice[1]
    along_i = lattice[6] * ds + lattice[7] * dt
    along_j = lattice[8] * ds + lattice[9] * dt
    nearest = ti.Vector([ti.round(along_i), ti.round(along_j)])
    if ti.static(hexagonal):  # one of the four lenses around: no branches, so that rays can be traced side by side
        i, j = ti.floor(along_i), ti.floor(along_j)
        best = ti.f32(1e30)
        for a, b in ti.static(((0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0))):
            centre = lens_centre(lattice, i + a, j + b)
            distance = (s - centre[0]) ** 2 + (t - centre[1]) ** 2
            nearest[0] = ti.select(distance < best, i + a, nearest[0])
            nearest[1] = ti.select(distance < best, j + b, nearest[1])
            best = ti.min(distance, best)
    return nearest


def cell_steps(layout: str) -> np.ndarray:
    """Return the outline of a lens's cell in its own frame: rows (half width along a, half height along b) [pitch].

    Between the height of the row before and its own height |b|, the cell reaches from -a to a. A square cell has one
    row. The flat sides of a hexagonal cell face +-a; its slanted sides, which face +-b, are steps.
    """
    if layout == "square":
        return np.array([[0.5, 0.5]], np.float32)
    side, tip = 1 / (2 * np.sqrt(3)), 1 / np.sqrt(3)
    heights = np.linspace(side, tip, SLANT_STEPS + 1)
    widths = 0.5 * (tip - (heights[1:] + heights[:-1]) / 2) / (tip - side)
    return np.stack([np.append(0.5, widths), heights], axis=1).astype(np.float32)


def cell_rectangles(layout: str) -> np.ndarray:
    """Return the rectangles of a lens's cell: rows (a_low, a_high, b_low, b_high) in its own frame [pitch]."""
    (a, b), *steps = cell_steps(layout)
    rows, low = [(-a, a, -b, b)], b
    for a, high in steps:
        rows += [(-a, a, low, high), (-a, a, -high, -low)]
        low = high
    return np.array(rows, np.float32)


def cell_frame(basis_mm: np.ndarray, layout: str) -> np.ndarray:
    """Return the matrix F, shape (2, 2), of (a, b) = F (s, t): from millimetres on the array to a cell's own frame.

    A hexagonal cell has three such frames. The one nearest to the sensor's axes is taken, because the projected edges
    of voxels and pixels lie along these axes where a camera is upright, and weights are integrated along a and b
    separately.
    """
    basis = np.asarray(basis_mm, float)
    if layout == "square":
        return np.linalg.inv(basis).T
    pitch = np.sqrt(abs(np.linalg.det(basis)) * 2 / np.sqrt(3))
    third = basis[1] - basis[0] if basis[0] @ basis[1] > 0 else basis[1] + basis[0]
    neighbours = np.array([*basis, third])
    a = neighbours[np.abs(neighbours).min(1).argmin()]  # the nearest to an axis: all are equally long
    a = a / np.linalg.norm(a)
    return np.array([a, [-a[1], a[0]]]) / pitch

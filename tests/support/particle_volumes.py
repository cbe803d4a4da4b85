"""Volumes of particles that move with a known flow, and the tolerance of their correlation's peaks."""

import numpy as np

TOLERANCE_PEAK = 2e-3
"""Largest difference of a displacement that rounding explains [voxel]. The peak fit divides differences of logarithms,
which magnifies errors of float32 sums of products, 2e-5, up to a hundredfold."""


def blobs(position, intensity, shape, sigma=0.7):
    """Sum of Gaussian blobs on a voxel grid; positions (n, 3) in voxels, order (z, y, x)."""
    volume = np.zeros(shape)
    reach = np.arange(-4, 5)
    middle = np.rint(position).astype(int)
    index = middle[:, :, None] + reach  # (n, 3, 9)
    profile = np.exp(-((index - position[:, :, None]) ** 2) / (2 * sigma**2))
    profile *= (index >= 0) & (index < np.array(shape)[:, None])
    index = np.clip(index, 0, np.array(shape)[:, None] - 1)
    value = np.einsum("n,nz,ny,nx->nzyx", intensity, profile[:, 0], profile[:, 1], profile[:, 2])
    where = np.broadcast_arrays(index[:, 0, :, None, None], index[:, 1, None, :, None], index[:, 2, None, None, :])
    np.add.at(volume, tuple(where), value)
    return volume.astype(np.float32)


def particle_pair(shape, flow, *, seed, density=0.017, ghosts=0.0, noise=0.0, lost=0.0):
    """Two volumes of the same particles, moved by -+ flow / 2, with what spoils them: ghosts, noise, lost particles."""
    rng = np.random.default_rng(seed)
    margin = 8
    room = np.array(shape) + 2 * margin
    count = rng.poisson(density * room.prod())
    position = rng.random((count, 3)) * room - margin
    displacement = flow(position)
    intensity = rng.lognormal(0, 0.3, count)
    pair = []
    for sign in (-0.5, 0.5):
        kept = rng.random(count) >= lost
        volume = blobs((position + sign * displacement)[kept], intensity[kept], shape)
        number = rng.poisson(ghosts * count)
        volume += blobs(rng.random((number, 3)) * room - margin, 0.7 * rng.lognormal(0, 0.5, number), shape)
        pair.append(volume + noise * rng.standard_normal(shape).astype(np.float32))
    return pair


def uniform(*displacement):
    return lambda position: np.broadcast_to(np.array(displacement, float), position.shape)


def shear(shape, rate=0.06):
    middle = (np.array(shape) - 1) / 2
    return lambda position: rate * (position - middle)[..., [2, 0, 1]] * (0.3, 1, 1)


def ring(shape, peak=2.0, core=10.0):
    """Vortex ring about z: magnitude peak (r/core) exp(1 - r/core) around its core line."""
    middle, radius = (np.array(shape) - 1) / 2, min(shape[1:]) / 4

    def flow(position):
        z, y, x = np.moveaxis(position - middle, -1, 0)
        rho = np.hypot(y, x) + 1e-9
        speed = peak / core * np.exp(1 - np.hypot(rho - radius, z) / core)
        return np.stack([speed * (rho - radius), -speed * z * y / rho, -speed * z * x / rho], -1)

    return flow

"""Reach of correlation peaks: finely sampled particles are validated like those of about a voxel."""

import numpy as np
import pytest
from support import plain_steps
from support.particle_volumes import blobs, ring

from lfpiv.velocity.peak_width import peak_reach, refine_search

WINDOW = (12, 12, 12)
TOLERANCE_FIELD = 0.12  # [voxel] both fields have errors of 0.06 of their own, which differ


def pair_at(factor, shape=(28, 32, 32), sigma=0.7, seed=5, density=0.018):
    """Particles of a ring vortex on voxels that are `factor` times smaller; lengths in the larger voxels."""
    rng = np.random.default_rng(seed)
    position = rng.random((round(density * np.prod(shape)), 3)) * shape - 0.5
    shift = ring(shape, peak=1.5, core=7.0)(position)
    fine = tuple(round(n * factor) for n in shape)
    return [
        blobs((position + sign * shift + 0.5) * factor - 0.5, np.ones(len(position)), fine, sigma * factor)
        for sign in (-0.5, 0.5)
    ]


@pytest.mark.parametrize("sigma", [0.4, 0.55, 0.7, 0.85])
def test_particles_of_about_a_voxel_have_the_least_reach(sigma):
    for power in (0.5, 1.0):
        first, second = (volume**power for volume in pair_at(1, sigma=sigma))
        assert peak_reach(first, second, WINDOW) == 2
    assert refine_search(2) == (3, 3, 3)


@pytest.mark.parametrize("sigma", [0.7, 1.2, 2.0])
def test_blocks_of_a_large_volume_tell_its_reach(sigma):
    first, second = pair_at(1, shape=(48, 72, 72), sigma=sigma, density=0.01)
    middle = (slice(8, 40),) * 3
    assert peak_reach(first, second, WINDOW) == peak_reach(first[middle], second[middle], WINDOW)
    alone = np.zeros_like(first)
    alone[20:28, 30:42, 30:42] = first[20:28, 30:42, 30:42]  # no light in the blocks
    assert peak_reach(alone, second, WINDOW) == peak_reach(second, second, WINDOW)


def test_the_reach_follows_the_narrowest_axis_and_no_slow_light():
    first, second = pair_at(1)
    stretched = [np.stack([volume] * 5).mean(0) for volume in (first, second)]
    for number, volume in enumerate(stretched):
        moved = [np.roll(volume, shift, 0) for shift in range(-4, 5)]
        stretched[number] = np.mean(moved, 0).astype(np.float32)
    assert peak_reach(*stretched, WINDOW) == 2
    sheet = 0.5 * first.max() * np.exp(-(np.linspace(-1, 1, first.shape[0]) ** 2))[:, None, None]
    assert peak_reach(first + sheet.astype(np.float32), second, WINDOW) == 2
    assert peak_reach(np.zeros_like(first), np.zeros_like(first), WINDOW) == 2


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "reach"), [(1.5, 2), (2, 3)])
def test_fine_voxels_validate_as_well_as_larger_ones(factor, reach):
    fields, valid = [], []
    for scale in (1, factor):
        windows = tuple(round(edge * scale) for edge in (24, 16, 12, 12))
        first, second = pair_at(scale)
        vectors = plain_steps.correlate(
            first, second, dt_s=1.0, voxel_mm=1 / scale, windows=windows, intensity_power=0.5
        )
        valid.append(vectors.attrs["valid_fraction"])
        fields.append(np.stack([vectors[f"displacement_{axis}"] for axis in "zyx"], -1) / scale)
    reaches = [peak_reach(*(volume**0.5 for volume in pair_at(scale)), WINDOW) for scale in (1, factor)]
    assert reaches[0] == 2 and reaches[1] >= reach
    one_vector = 1 / fields[0][..., 0].size
    assert valid[1] >= valid[0] - 1.01 * one_vector and valid[0] > 0.95
    assert fields[0].shape == fields[1].shape
    assert np.linalg.norm(fields[1] - fields[0], axis=-1).mean() < TOLERANCE_FIELD

"""A volume and the statistics of its windows stored by phase, against a loop over all places."""

import itertools

import numpy as np
import pytest

from lfpiv_kernels.correlation.layout import Storage
from lfpiv_kernels.correlation.plan import make_plan
from lfpiv_kernels.correlation.sides import make_sides
from lfpiv_kernels.correlation.windows import signal_floor
from lfpiv_kernels.transfer import to_device, to_host

CASES = [
    ((20, 26, 30), (8, 8, 8), (4, 4, 4), (3, 2, 3)),
    ((13, 21, 23), (5, 7, 6), (4, 3, 5), (2, 3, 2)),
    ((12, 30, 47), (4, 4, 6), (7, 9, 13), (2, 2, 2)),  # gaps between windows
    ((10, 24, 70), (8, 8, 24), (8, 4, 20), (2, 3, 4)),  # more phases than a warp moves at once
    ((9, 11, 100), (4, 4, 2), (4, 2, 1), (2, 2, 2)),  # rows of more lanes than a warp has
]
"""Volume, window, step and search, (z, y, x)."""
TOLERANCE_STATISTICS = 1e-5  # float32 sums of some hundred values of order 1


def places(storage, lattice):
    """Yield each place (plane, phase y, phase x, lane) and the voxel (z, y, x) that belongs there."""
    planes, phases_y, phases_x, lanes = storage.shape
    for plane, y, x, lane in itertools.product(range(planes), range(phases_y), range(phases_x), range(lanes)):
        row, column = divmod(lane, lattice.pitch)
        steps = (plane, row * lattice.stride[1] + y, column * lattice.stride[2] + x)
        yield (plane, y, x, lane), tuple(c + s for c, s in zip(lattice.corner, steps, strict=True))


def is_inside(voxel, shape):
    return all(0 <= at < n for at, n in zip(voxel, shape, strict=True))


@pytest.mark.slow(but="shape1")
@pytest.mark.parametrize(("shape", "window", "step", "search"), CASES)
def test_voxels_and_statistics_lie_where_the_layout_says(device, shape, window, step, search):
    volume = np.random.default_rng(0).random(shape, np.float32)
    plan = make_plan(shape, window, step, search)
    moments = float(volume.mean()), float((volume.astype(float) ** 2).sum())
    _, side = make_sides(plan, [to_device(volume, float)] * 2, [moments] * 2, [(0, 0, 0), search])

    voxels = Storage.from_plan(plan, tuple(b + n - 1 for b, n in zip(plan.block, plan.lags, strict=True)))
    stored = to_host(side.surroundings.values).reshape(voxels.shape)
    corner = tuple(o - r for o, r in zip(plan.origin, search, strict=True))
    for place, voxel in places(voxels, voxels.lattice(plan, corner)):
        assert stored[place] == (volume[voxel] if is_inside(voxel, shape) else 0)

    statistics = Storage.from_plan(plan, plan.lags)
    mean, scale = (to_host(of).reshape(statistics.shape) for of in (side.statistics.mean, side.statistics.scale))
    padded = np.pad(volume.astype(float), [(r, r) for r in search])
    windows = np.lib.stride_tricks.sliding_window_view(padded, window).reshape(
        *(n - w + 1 for n, w in zip(padded.shape, window, strict=True)), -1
    )
    means, squares = windows.mean(-1), ((windows - windows.mean(-1, keepdims=True)) ** 2).sum(-1)
    floor, found = signal_floor(*moments, plan), 0
    lattice = statistics.lattice(plan, plan.origin)
    for place, at in places(statistics, lattice):
        row, _ = divmod(place[-1], lattice.pitch)
        if not is_inside(at, means.shape) or (row + 1) * lattice.pitch > lattice.lanes:
            continue
        if place[0] % lattice.stride[0] >= lattice.phases[0]:
            continue
        found += 1
        assert mean[place] == pytest.approx(means[at], abs=TOLERANCE_STATISTICS)
        expected = 1 / np.sqrt(squares[at]) if squares[at] > floor else 0
        assert scale[place] == pytest.approx(expected, rel=TOLERANCE_STATISTICS)
    assert found >= np.prod(plan.count)

"""The model of the correlation's memory traffic: what threads access, and how much kernels move beyond it."""

import gpu_correlation
import numpy as np
import pytest
from gpu_trace import Tracer
from gpu_traffic import trace
from scipy import ndimage

from lfpiv_kernels.correlation import correlate, light, uncertainty
from lfpiv_kernels.correlation.memory import on_device
from lfpiv_kernels.transfer import to_host

ROUNDING = 1e-6
"""Of float32 means of values below 1."""
MOST_TOUCHED = 1.5
"""Sectors that the instructions of a warp touch per sector that their bytes would fill: the goal."""
CORRELATING = {
    "peaks_gpu._find_window_peaks",
    "peaks_gpu._score_windows",
    "blocks_gpu._correlate_lanes",
    "split_gpu._split_voxels",
}
CORRELATING |= {"windows_gpu._sum_rows", "windows_gpu._sum_columns", "windows_gpu._window_statistics"}
"""Kernels that correlate windows; sums over whole volumes take no part."""
UNCERTAINTY = {"uncertainty_gpu._sum_products", "uncertainty_gpu._sum_differences"}


def noted(run, modules):
    """Run something; return the accesses of each launch by kernel."""
    found = {}
    tracer = Tracer(modules, lambda name, accesses: found.setdefault(name, accesses))
    with tracer.running():
        run()
    return found


def test_each_thread_of_a_noted_block_reads_and_writes_its_voxels(device):
    """By the rule: a thread per voxel reads its voxel of a volume and of its mean, and writes their difference."""
    one, results = np.random.default_rng(0).random((7, 9, 11), np.float32), []
    run = lambda: results.append(to_host(light.fluctuation(on_device(one), (3, 3, 3))))  # noqa: E731
    found = noted(run, ["lfpiv_kernels.correlation.voxelwise_gpu"])["voxelwise_gpu._subtract"]
    np.testing.assert_allclose(results[0], one - ndimage.uniform_filter(one, 3), atol=ROUNDING)
    events, kind = found.events, found.events[:, 1] & np.uint64(3)
    assert found.warps == -(-one.size // 32) and found.scale == 1
    assert ((events[:, 1] >> np.uint64(2) & np.uint64(63)) == 4).all()
    address = (events[:, 1] >> np.uint64(8)).astype(np.int64)
    thread = 32 * (events[:, 0] >> np.uint64(40)).astype(np.int64) + (events[:, 0] & np.uint64(255)).astype(np.int64)
    for array in np.unique(address >> 40):
        of = address >> 40 == array
        np.testing.assert_array_equal((address[of] & (1 << 40) - 1) // 4, thread[of])
        np.testing.assert_array_equal(np.sort(thread[of]), np.arange(one.size))
        assert len(np.unique(kind[of])) == 1
    assert len(np.unique(address >> 40)) == 3 and (kind == 1).sum() == one.size


@pytest.mark.slow
def test_kernels_that_correlate_windows_touch_little_more_than_they_need(device):
    rng = np.random.default_rng(0)
    volumes = [rng.random((32, 48, 56), np.float32) for _ in range(2)]
    layout = {"window": (16, 16, 16), "step": (4, 4, 4), "search": (3, 3, 3), "symmetric": True}
    sums = {"window": (8, 8, 8), "origin": (0, 0, 0), "step": (6, 6, 6), "count": (5, 7, 9)}

    def run():
        correlate.correlate_windows(*volumes, **layout)
        uncertainty.displacement_deviation(*volumes, **sums)

    kernels = {one.kernel: one for one, _ in trace(run, gpu_correlation.tracer()).by_kernel()}
    assert set(kernels) >= CORRELATING | UNCERTAINTY
    for name in CORRELATING | UNCERTAINTY:
        assert kernels[name].strict <= MOST_TOUCHED, kernels[name]

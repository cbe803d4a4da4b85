"""What the CUDA compiler makes of the kernels; needs ptxas, from the extra `gpu-check`."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import gpu_static
import pytest
from gpu_static import ARCHITECTURES, Kernel, assembler, measure_all

LEAST_OCCUPANCY = 0.25
"""With fewer threads a multiprocessor waits for memory: a quarter of them hides some 400 clocks of it."""
LEAST_OCCUPANCY_OF_A_PASS = 0.5
"""Of kernels that run in every pass of a reconstruction or a correlation."""
EVERY_PASS = {
    ("blocks_gpu", "_correlate_lanes"),
    ("blur_gpu", "_blur_axis"),
    ("deform_gpu", "_deform"),
    ("depth_planes_gpu", "_collect"),
    ("depth_planes_gpu", "_spread"),
    ("filters_gpu", "_filter"),
    ("line_shares_gpu", "_share"),
    ("neighbours_gpu", "_predict_vectors"),
    ("peaks_gpu", "_find_window_peaks"),
    ("peaks_gpu", "_score_windows"),
    ("pixel_rays_gpu", "_collect"),
    ("pixel_rays_gpu", "_compare"),
    ("pixel_rays_gpu", "_spread"),
    ("projector_gpu", "_gather"),
    ("projector_gpu", "_scatter"),
    ("separable_gpu", "_across"),
    ("separable_gpu", "_across_back"),
    ("separable_gpu", "_down"),
    ("separable_gpu", "_down_back"),
    ("separable_gpu", "_move"),
    ("separable_gpu", "_rim"),
    ("separable_gpu", "_rim_back"),
    ("split_gpu", "_split_voxels"),
    ("sums_gpu", "_sum_products"),
    ("sums_gpu", "_sum_values"),
    ("uncertainty_gpu", "_sum_differences"),
    ("uncertainty_gpu", "_sum_products"),
    ("update", "_sharpen"),
    ("update", "_update"),
    ("windows_gpu", "_sum_columns"),
    ("windows_gpu", "_sum_rows"),
    ("windows_gpu", "_window_statistics"),
}
STORED = Path(__file__).resolve().parents[2] / "docs" / "figures" / "gpu_static.json"
"""The table of the pages; not installed."""


@pytest.fixture(scope="module")
def measured():
    """Measure all architectures; pytest-xdist gives this file to one process."""
    if assembler() is None:
        pytest.skip("ptxas is not installed; pip install 'lfpiv[gpu-check]'")
    return measure_all(ARCHITECTURES)


@pytest.fixture(params=ARCHITECTURES)
def kernels(request, measured):
    return {(one.module, one.name): one for one in measured if one.architecture == request.param}


@pytest.mark.slow
def test_enough_threads_fit_on_a_multiprocessor(kernels):
    assert set(kernels) >= EVERY_PASS
    assert not {(*key, one.architecture) for key, one in kernels.items() if one.occupancy < LEAST_OCCUPANCY}
    assert not {key for key in EVERY_PASS if kernels[key].occupancy < LEAST_OCCUPANCY_OF_A_PASS}


@pytest.mark.slow
def test_registers_are_not_spilled_and_arrays_stay_in_registers(kernels):
    assert {key for key, one in kernels.items() if one.spilled} == set()
    assert {key for key, one in kernels.items() if one.stack} == set()


@pytest.mark.slow
def test_the_table_of_the_pages_has_these_kernels(kernels):
    """Make it again: python perf/gpu_static.py --arch 75 80 90 100 --json docs/figures/gpu_static.json."""
    rows = json.loads(STORED.read_text("utf-8"))
    assert {row["architecture"] for row in rows} == set(ARCHITECTURES)
    assert {(row["module"], row["name"]) for row in rows} == set(kernels)


@pytest.mark.slow
def test_a_signal_to_terminate_leaves_no_file_and_no_process(tmp_path):
    if assembler() is None:
        pytest.skip("ptxas is not installed; pip install 'lfpiv[gpu-check]'")
    command = [sys.executable, gpu_static.__file__, "--arch", "80", "90"]
    running = subprocess.Popen(command, env=os.environ | {"TMPDIR": str(tmp_path)}, stdout=subprocess.DEVNULL)
    for _ in range(600):  # until both architectures have a module in work
        if len([one for one in tmp_path.iterdir() if one.is_dir()]) == 3:
            break
        time.sleep(0.1)
    running.terminate()
    assert running.wait(120) == 128 + signal.SIGTERM
    assert list(tmp_path.iterdir()) == []


def test_occupancy_follows_from_the_registers():
    def occupancy(registers, architecture=90):
        return Kernel("module", "kernel", architecture, registers, stack=0, spilled=0, shared=0).occupancy

    assert [occupancy(n) for n in (16, 32, 64, 65, 128, 255)] == [1.0, 1.0, 0.5, 0.375, 0.25, 0.125]
    assert [occupancy(n, 75) for n in (64, 128)] == [1.0, 0.5]  # half as many threads

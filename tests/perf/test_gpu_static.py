"""What the CUDA compiler makes of the kernels; needs ptxas, from the extra `gpu-check`."""

import pytest
from gpu_static import Kernel, assembler, measure

LEAST_OCCUPANCY = 0.25
"""With fewer threads a multiprocessor waits for memory: a quarter of them hides some 400 clocks of it."""
LEAST_OCCUPANCY_OF_A_PASS = 0.5
"""Of kernels that run in every pass of a reconstruction or a correlation."""
EVERY_PASS = {
    ("blur", "_blur"),
    ("peaks", "_find_peaks"),
    ("pixel_rays", "_collect"),
    ("pixel_rays", "_spread"),
    ("projector", "_back_project"),
    ("projector", "_project_atomic"),
    ("update", "_compare"),
    ("update", "_extrapolate"),
    ("update", "_sharpen"),
    ("update", "_update"),
}
TOO_LARGE = {("footprint", "_fill_blocks")}
"""Known to miss the least occupancy: one thread holds all that a voxel's lenses need."""
STACKS = {("footprint", "_fill_blocks"), ("footprint", "_pack_blocks"), ("projector", "_back_project")}
"""Known to keep arrays in memory."""


@pytest.fixture(scope="module")
def kernels():
    if assembler() is None:
        pytest.skip("ptxas is not installed; pip install 'lfpiv[gpu-check]'")
    return {(kernel.module, kernel.name): kernel for kernel in measure(90)}


@pytest.mark.slow
def test_enough_threads_fit_on_a_multiprocessor(kernels):
    assert set(kernels) >= EVERY_PASS
    assert {key for key, one in kernels.items() if one.occupancy < LEAST_OCCUPANCY} == TOO_LARGE
    assert not {key for key in EVERY_PASS if kernels[key].occupancy < LEAST_OCCUPANCY_OF_A_PASS}


@pytest.mark.slow
def test_registers_are_not_spilled_and_arrays_stay_in_registers(kernels):
    assert {key for key, one in kernels.items() if one.spilled} == set()
    assert {key for key, one in kernels.items() if one.stack} == STACKS


def test_occupancy_follows_from_the_registers():
    def occupancy(registers):
        return Kernel("module", "kernel", 90, registers, stack=0, spilled=0, shared=0).occupancy

    assert [occupancy(n) for n in (16, 32, 64, 65, 128, 255)] == [1.0, 1.0, 0.5, 0.375, 0.25, 0.125]

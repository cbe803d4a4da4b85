"""Weights that are held against as many counted voxels as users have."""

import pytest


@pytest.fixture(scope="module", autouse=True)
def whole_count_of_module(few_counted_voxels):
    """Undo `few_counted_voxels`."""
    from lfpiv.weights import counting  # not before kernels know which loops to take

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(counting, "VOXELS", few_counted_voxels)
        yield

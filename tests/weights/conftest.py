"""Weights that are held against as many counted voxels as users have."""

import pytest

from lfpiv.weights import counting


@pytest.fixture(scope="module", autouse=True)
def whole_count_of_module(one_counted_voxel):
    """Undo `one_counted_voxel`."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(counting, "VOXELS", one_counted_voxel)
        yield

"""The number of vectors is known before the run: it is that of a correlation of the same settings."""

import numpy as np
import pytest

import lfpiv
from lfpiv.settings.processing import Correlation
from lfpiv.velocity import vector_grid
from lfpiv.warn import Code

CASES = {
    "default": ((30, 26, 40), Correlation()),
    "thin": ((9, 26, 40), Correlation()),
    "overlap": ((20, 20, 20), Correlation(windows=(16, 8), overlap=0.75)),
    "window by axis": ((8, 24, 24), Correlation(windows=((8, 12, 16),), overlap=0.3)),
}


@pytest.mark.parametrize(("shape", "settings"), CASES.values(), ids=CASES.keys())
def test_the_planned_vectors_are_those_of_a_correlation(shape, settings):
    volume = np.random.default_rng(0).random(shape, np.float32)
    vectors = lfpiv.correlate(
        volume, volume, windows=settings.windows, overlap=settings.overlap, voxel_mm=0.5, dt_s=1.0
    )
    planned = vector_grid.planned(settings, shape)
    assert planned.count == vectors["valid"].shape
    z, y, x = planned.count
    text = vector_grid.sentence(settings, shape, 0.5)
    assert f"{x} x {y} x {z} vectors (x, y, z)" in text and f"{100 * settings.overlap:.0f} %" in text
    if x > 1:
        assert float(np.diff(vectors["x"])[0]) == pytest.approx(0.5 * planned.step[2])


def test_an_axis_with_too_few_vectors_is_named_with_a_window_that_helps():
    shape = (14, 40, 9)
    (found,) = vector_grid.warnings(Correlation(), shape)
    assert found.code is Code.FEW_VECTORS and "few vectors: 1 along x, 1 along z;" in found.sentence
    assert "vorticity" in found.sentence
    edges = {"x": 5, "z": 6}
    assert "a last window of at most 5 voxels along x, 6 voxels along z" in found.sentence
    better = Correlation(windows=((edges["z"], 12, edges["x"]),))
    assert not vector_grid.warnings(better, shape)
    larger = Correlation(windows=((edges["z"] + 1, 12, edges["x"] + 1),))
    assert "1 along x" not in vector_grid.warnings(larger, shape)[0].sentence
    assert "2 along x, 2 along z" in vector_grid.warnings(larger, shape)[0].sentence


def test_a_volume_too_small_for_any_window_says_so():
    (found,) = vector_grid.warnings(Correlation(), (5, 40, 40))
    assert "a volume of more voxels than 5 along z" in found.sentence

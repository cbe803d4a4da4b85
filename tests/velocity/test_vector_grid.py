"""The number of vectors is known before the run: it is that of a correlation of the same settings."""

import numpy as np
import pytest

import lfpiv
from lfpiv.experiment.settings import Correlation
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
    found = list(vector_grid.warnings(Correlation(), shape))
    assert [(one.code, one.figures["axis"], one.figures["count"]) for one in found] == [
        (Code.FEW_VECTORS, "x", 1),
        (Code.FEW_VECTORS, "z", 1),
    ]
    assert "vorticity" in found[0].sentence and "vectors along x: 1" in found[0].sentence
    edges = {"x": 5, "z": 6}
    for one in found:
        edge = edges[one.figures["axis"]]
        assert f"a last window of {edge} voxels or fewer along {one.figures['axis']} has 3" in one.sentence
    better = Correlation(windows=((edges["z"], 12, edges["x"]),))
    assert not list(vector_grid.warnings(better, shape))
    larger = Correlation(windows=((edges["z"] + 1, 12, edges["x"] + 1),))
    assert len(list(vector_grid.warnings(larger, shape))) == 2


def test_a_volume_too_small_for_any_window_says_so():
    (found,) = vector_grid.warnings(Correlation(), (5, 40, 40))
    assert "more voxels along z than 5" in found.sentence

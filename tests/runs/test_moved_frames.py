"""One camera's frames shifted by a whole microlens, which its own white image does not show."""

import numpy as np
import pytest
import tifffile

import lfpiv
from lfpiv.runs import belonging
from lfpiv.warn import Code, collected

LENS_TOLERANCE = 0.25
"""Peaks of one part of a small volume are off by a tenth or two of a voxel, which is a tenth or two of a microlens."""


@pytest.mark.slow
@pytest.mark.whole_run
@pytest.mark.parametrize(
    ("lenses", "axis", "every", "code", "names"),
    [
        pytest.param(0, 0, 2, None, "", id="0"),
        pytest.param(1, 0, 2, Code.MOVED_FRAMES, "left or right", id="1-rows"),
        pytest.param(1, 1, 2, Code.MOVED_FRAMES, "left", id="1-columns"),
        pytest.param(1, 1, 1, Code.APART, "", id="all-columns"),
    ],
)
def test_frames_shifted_by_whole_microlenses_are_told_with_their_number(
    small_run, tmp_path, lenses, axis, every, code, names
):
    """Along the columns the shift lies in the plane of both lines of sight, and is another depth to both cameras."""
    file = small_run.images(tmp_path / "data")
    experiment = lfpiv.open_experiment(file)
    camera = lfpiv.load_calibration(small_run.out / "calibration.h5").cameras["left"]
    pixels = round(lenses * camera.optics.microimage_pitch_px)
    for path in sorted((file.parent / "particles" / "left").iterdir())[every - 1 :: every]:
        tifffile.imwrite(path, np.roll(tifffile.imread(path), pixels, axis=axis))
    weights = lfpiv.build_weights(lfpiv.load_calibration(small_run.out / "calibration.h5"), experiment.grid)
    with collected(quiet=True) as found:
        agreement = belonging.check(experiment, weights, [0])
    assert not agreement.refusals
    assert [(one.code, one.subject) for one in found] == [(code, names)] * lenses
    if code is Code.MOVED_FRAMES:
        assert abs(found[0].figures["lenses"] - lenses) < LENS_TOLERANCE

"""One camera's second frames shifted by a whole microlens, which its own white image does not show."""

import numpy as np
import pytest
import tifffile

import lfpiv
from lfpiv.runs import belonging
from lfpiv.warn import Code, collected

LENS_TOLERANCE = 0.25
"""Peaks of one part of a small volume are off by a tenth or two of a voxel, which is a tenth or two of a microlens."""


@pytest.mark.whole_run
@pytest.mark.slow(but="1")
@pytest.mark.parametrize("lenses", [0, 1])
def test_second_frames_shifted_by_whole_microlenses_are_told_with_their_number(small_run, tmp_path, lenses):
    file = small_run.images(tmp_path / "data")
    experiment = lfpiv.open_experiment(file)
    camera = lfpiv.load_calibration(small_run.out / "calibration.h5").cameras["left"]
    rows = round(lenses * camera.optics.microimage_pitch_px)
    for path in sorted((file.parent / "particles" / "left").iterdir())[1::2]:
        tifffile.imwrite(path, np.roll(tifffile.imread(path), rows, axis=0))
    weights = lfpiv.build_weights(lfpiv.load_calibration(small_run.out / "calibration.h5"), experiment.grid)
    with collected(quiet=True) as found:
        agreement = belonging.check(experiment, weights, [0])
    assert not agreement.refusals
    told = [one for one in found if one.code is Code.MOVED_FRAMES]
    assert [one.subject for one in told] == ["left or right"] * lenses and len(found) == len(told)
    assert all(abs(one.figures["lenses"] - lenses) < LENS_TOLERANCE for one in told)

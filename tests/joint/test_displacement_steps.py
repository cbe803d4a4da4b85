"""What a step of the displacement measures besides."""

import numpy as np
import pytest

from lfpiv.joint import displacement_steps


def test_cameras_ask_for_unlike_light_beyond_what_all_of_them_ask_for():
    """The reference says what `Residual.unlike` states, voxel by voxel. A voxel that a camera hardly sees is none."""
    rng = np.random.default_rng(2)
    asked, volume = rng.normal(0, 0.2, (3, 50)), rng.uniform(0, 1, 50)
    sums = rng.uniform(1, 2, (3, 50))
    sums[1, 7], volume[9] = 1e-3, 0.0
    whole = light = 0.0
    for voxel in set(range(50)) - {7, 9}:
        logs = asked[:, voxel]
        between = sum((one - logs.mean()) ** 2 for one in logs) / 2
        whole, light = whole + volume[voxel] * (between - logs.mean() ** 2), light + volume[voxel]
    found = displacement_steps.unlike_light(list(asked * sums), list(sums), volume)
    assert found == pytest.approx(np.sqrt(whole / light), rel=1e-6)
    same = [own * asked[0] for own in sums]
    assert displacement_steps.unlike_light(same, list(sums), volume) == 0
    assert displacement_steps.unlike_light(same, list(sums), np.zeros(50)) == 0

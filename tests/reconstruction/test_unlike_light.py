"""How much cameras ask for unlike light."""

import numpy as np
import pytest

from lfpiv.reconstruction.unlike_light import unlike_light


def test_cameras_ask_for_unlike_light_beyond_what_all_of_them_ask_for():
    """The reference says what `unlike_light` states, voxel by voxel. A voxel that a camera hardly sees is none."""
    rng = np.random.default_rng(2)
    asked, volume = rng.normal(0, 0.2, (3, 50)), rng.uniform(0, 1, 50)
    sums = rng.uniform(1, 2, (3, 50))
    sums[1, 7], volume[9] = 1e-3, 0.0
    whole = light = 0.0
    for voxel in set(range(50)) - {7, 9}:
        logs = asked[:, voxel]
        between = sum((one - logs.mean()) ** 2 for one in logs) / 2
        whole, light = whole + volume[voxel] * (between - logs.mean() ** 2), light + volume[voxel]
    found = unlike_light(list(asked * sums), list(sums), volume)
    assert found == pytest.approx(np.sqrt(whole / light), rel=1e-6)
    same = [own * asked[0] for own in sums]
    assert unlike_light(same, list(sums), volume) == 0
    assert unlike_light(same, list(sums), np.zeros(50)) == 0
    assert unlike_light([asked[0]], [sums[0]], volume) == 0  # a single camera

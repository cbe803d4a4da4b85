"""Sensor of simulated cameras: fixed patterns, bad pixels, range, and dark images that contain them."""

import numpy as np
import pytest
import tifffile
from support.simulated_cameras import MONTE_CARLO, camera, small_scene

from lfpiv.simulation.camera_images import expose, white_image
from lfpiv.simulation.scene import Noise
from lfpiv.simulation.sensor import Sensor, draw_pattern
from lfpiv.simulation.simulator import simulate

SHAPE = (400, 500)
SILENT = Noise(background=40.0, read_noise=0.0, full_well_e=0.0)


def pattern(seed=0, **keys):
    return draw_pattern(Sensor(**keys), SHAPE, np.random.default_rng(seed))


def exposed(level, noise=SILENT, **keys):
    return expose(
        np.full(SHAPE, level),
        camera(blur_px=0.0),
        noise,
        np.random.default_rng(1),
        sensor=Sensor(**keys),
        pattern=pattern(**keys),
    ).astype(float)


def test_patterns_have_the_stated_statistics():
    made = pattern(
        gain_sd=0.02, column_sd_counts=6.0, dark_counts=12.0, dark_log_sd=0.5, hot_share=0.01, dead_share=0.02
    )
    size = made.gain.size
    good = ~(made.hot | made.dead)
    assert made.gain[good].std() == pytest.approx(0.02, rel=MONTE_CARLO / np.sqrt(2 * size))
    assert made.gain[good].mean() == pytest.approx(1, abs=MONTE_CARLO * 0.02 / np.sqrt(size))
    assert np.ptp(made.offset, axis=0).max() == 0  # a column has one offset
    assert made.offset[0].std() == pytest.approx(6, rel=MONTE_CARLO / np.sqrt(2 * SHAPE[1]))
    assert made.dark[good].mean() == pytest.approx(12, rel=0.01)
    assert np.log(made.dark[good]).std() == pytest.approx(0.5, rel=0.01)
    for mask, share in ((made.hot, 0.01), (made.dead, 0.02)):
        assert abs(mask.mean() - share) < MONTE_CARLO * np.sqrt(share / size)
    assert not (made.hot & made.dead).any() and (made.gain[made.dead] == 0).all() and (made.dark[made.dead] == 0).all()
    assert made.dark[made.hot].mean() == pytest.approx(4095 / 2 + 12, rel=0.05)


def test_keys_draw_the_same_whatever_the_others_are():
    alone, beside = pattern(gain_sd=0.02), pattern(gain_sd=0.02, column_sd_counts=3.0, dark_counts=9.0)
    assert np.array_equal(alone.gain, beside.gain) and not alone.hot.any() and not alone.dark.any()
    assert np.array_equal(pattern(hot_share=0.01).hot, pattern(hot_share=0.01, dark_counts=5.0, dead_share=0.01).hot)


def test_light_meets_gain_and_dark_current_meets_none():
    made = pattern(gain_sd=0.05, dark_counts=100.0, column_sd_counts=5.0)
    keys = {"gain_sd": 0.05, "dark_counts": 100.0, "column_sd_counts": 5.0}
    dark, light = exposed(0.0, **keys), exposed(1000.0, **keys)
    assert np.abs(dark - (140 + made.offset)).max() <= 0.5  # rounding: no trace of the gain
    assert np.abs(light - dark - 1000 * made.gain).max() <= 1
    noisy = exposed(0.0, noise=Noise(background=40.0, read_noise=0.0, full_well_e=8190.0), dark_counts=100.0)
    assert noisy.var() == pytest.approx(100 / 2 + 1 / 12, rel=0.05)  # shot noise of the dark current, 2 electrons/count


@pytest.mark.parametrize(("bits", "saturation", "largest"), [(8, None, 255), (10, 800.0, 800), (16, None, 65535)])
def test_pixels_end_at_their_range(bits, saturation, largest):
    keys = {"bits": bits, "saturation_counts": saturation}
    assert exposed(1e5, **keys).max() == largest and exposed(1e5, **keys).min() == largest
    assert exposed(100.0, **keys).max() == 140
    noise = Noise(background=0.0, read_noise=0.0, full_well_e=1000.0)  # at full scale, whatever the bits
    level = 0.5 * (2**bits - 1)
    image = exposed(level, noise=noise, bits=bits)
    assert image.std() / level == pytest.approx(1 / np.sqrt(500), rel=0.02)


def test_a_dark_image_contains_what_it_would_and_the_truth_fits(device, tmp_path):
    keys = {"gain_sd": 0.1, "column_sd_counts": 6.0, "dark_counts": 30.0, "hot_share": 0.01, "dead_share": 0.01}
    table = {"image_flip": "horizontal"}
    scene = small_scene(sensor=keys)
    scene = scene.model_copy(update={"camera": tuple(c.model_copy(update=table) for c in scene.camera)})
    folder = simulate(scene, tmp_path / "set").parent
    with np.load(folder / "truth" / "sensor_two.npz") as file:
        truth = dict(file)
    dark = tifffile.imread(folder / "dark" / "two.tif").astype(float)
    expected = np.clip(40 + truth["offset"] + truth["dark"], 0, 4095)
    noise = np.sqrt(9 + truth["dark"] * 4095 / 10_000 + 1 / 12)
    score = ((dark - expected) / noise)[expected < 3900]
    assert abs(score.mean()) < MONTE_CARLO / np.sqrt(score.size) and score.std() == pytest.approx(1, abs=0.03)
    assert truth["hot"].sum() > 50 and dark[truth["hot"]].mean() > 1000
    image = tifffile.imread(folder / "particles/two/pair_0000_a.tif").astype(float)
    assert np.abs(image[truth["dead"]] - (40 + truth["offset"])[truth["dead"]]).max() < MONTE_CARLO * 3 + 1
    white = 2700 * white_image(scene, 1)[:, ::-1]
    flat = (white > 0.98 * np.percentile(white, 99)) & ~truth["hot"] & ~truth["dead"]
    recorded = tifffile.imread(folder / "white/two.tif").astype(float)
    gain = (recorded - 70 - truth["offset"])[flat] / white[flat]
    assert np.corrcoef(gain[recorded[flat] < 4095], truth["gain"][flat][recorded[flat] < 4095])[0, 1] > 0.9

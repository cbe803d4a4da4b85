"""Whether the images of a camera stand in the order in which they were recorded."""

import numpy as np
from scipy import ndimage

from lfpiv.selfcalibration.paired_frames import out_of_order


def moving(count, step, noise=0.02, seed=0):
    """Images of smooth random light that moves by `step` pixels from each to the next, less their means."""
    rng = np.random.default_rng(seed)
    light = ndimage.gaussian_filter(rng.standard_normal((60, 60 + 2 * count)), 1.5)
    images = [ndimage.shift(light, (0, -step * number), mode="wrap")[:, :60] for number in range(count)]
    images = [image + noise * image.std() * rng.standard_normal(image.shape) for image in images]
    return [image - image.mean() for image in images]


def disorders(images):
    return [n for n in range(1, len(images) - 1) if out_of_order(*images[max(n - 2, 0) : n + 2])]


def test_exchanged_and_repeated_images_are_told():
    for step in (0.3, 1.0):
        images = moving(9, step)
        assert disorders(images) == []
        neighbours = [*images[:3], images[4], images[3], *images[5:]]
        assert disorders(neighbours) == [3, 4]
        apart = [*images[:2], images[6], *images[3:6], images[2], *images[7:]]
        assert {2, 6} <= set(disorders(apart))


def test_lasers_that_take_turns_and_light_other_particles_are_in_order():
    weak = [0.3 * image for image in moving(12, 0.3, seed=1)]
    turns = [
        image + (other if at % 2 else 0) for at, (image, other) in enumerate(zip(moving(12, 0.3), weak, strict=True))
    ]
    assert disorders(turns) == []


def test_light_at_rest_and_light_that_is_other_every_time_have_no_order():
    assert all(disorders(moving(40, 0.0, noise, seed)) == [] for seed in range(4) for noise in (0.02, 0.5))
    rng = np.random.default_rng(1)
    others = [ndimage.gaussian_filter(rng.standard_normal((60, 60)), 1.5) for _ in range(40)]
    assert disorders(others) == []

"""Find images that repeat an image of another pair but for some pixels, as a file that was stored once more does.

Equal files are found by their hashes. For others the structure of the images tells candidates: it is stored with each
pair, and a few other pixels hardly change it. Candidates are read once more and compared.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from itertools import pairwise

import numpy as np

from lfpiv.damping.bootstrap import evenly_spread
from lfpiv.errors import InputError
from lfpiv.experiment.experiment import Experiment
from lfpiv.experiment.recording import Frame
from lfpiv.lightfield.frame_comparison import same_light
from lfpiv.runs.pair_figures import PairFigures

NEAR = 2e-3
"""Largest difference of the structures of two images that are compared."""
MOST = 5000
"""Largest number of pairs whose images are candidates; of more, these are evenly spread."""
READ_PIXELS = 1 << 26
"""Pixels that are read for it."""


def repeated_images(
    figures: Mapping[int, PairFigures], experiment: Experiment, known: Mapping[int, int]
) -> dict[int, int]:
    """Return the pairs with an image that repeats an image of an earlier pair, each with that pair.

    Of many candidates the nearest ones are compared. `known` are pairs that are known to repeat another one.
    """
    found: dict[int, int] = {}
    left = READ_PIXELS
    for _, name, earlier, later in sorted(_candidates(figures, experiment), key=lambda one: one[0]):
        (first, one), (pair, other) = earlier, later
        left -= 2 * int(np.prod(experiment.camera(name).optics.sensor_shape))
        if left < 0:
            break
        if pair in known or pair in found:
            continue
        with contextlib.suppress(InputError):  # images may be gone
            if same_light(experiment.frame_image(name, one), experiment.frame_image(name, other)):
                found[pair] = first
    return found


_Image = tuple[int, Frame]


def _candidates(figures: Mapping[int, PairFigures], experiment: Experiment) -> list[tuple[float, str, _Image, _Image]]:
    """Return images of near structure and of different pairs: difference, camera, the earlier and the later one."""
    shown: dict[str, dict[int, tuple[float, int, Frame]]] = {}
    for pair in evenly_spread(list(figures), MOST):
        of_frames = (figures[pair].structure or {}).values()
        for frame, structure in zip(experiment.pair_frames(pair), of_frames, strict=False):
            for name, value in structure.items():
                shown.setdefault(name, {}).setdefault(frame.number, (value, pair, frame))
    found = []
    for name, images in shown.items():
        ordered = sorted(images.values(), key=lambda image: image[0])
        for one, other in pairwise(ordered):
            if one[1] != other[1] and other[0] - one[0] < NEAR:
                earlier, later = sorted((one[1:], other[1:]), key=lambda image: image[0])
                found.append((other[0] - one[0], name, earlier, later))
    return found

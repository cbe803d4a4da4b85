"""Draw the middle of a recorded image of each camera: what the volumes are made of."""

from __future__ import annotations

import numpy as np
from matplotlib.colors import Normalize

from lfpiv.errors import InputError
from lfpiv.experiment.experiment import Experiment
from lfpiv.report import markup
from lfpiv.report.svg import colour_bar, new_panel, style, to_svg

MICROIMAGES = 12
"""Microimages along each side of the part that is drawn."""
PERCENTILE = 99.9
"""Share of the pixels that are darker than white [%]."""


def figure(experiment: Experiment, pair: int) -> str:
    """Return the images of the first frame of a pair, as HTML; empty where one cannot be read any more."""
    frame = experiment.pair_frames(pair)[0]
    try:
        images = {setup.name: experiment.frame_image(setup.name, frame) for setup in experiment.cameras}
    except InputError:
        return ""
    shown = [
        _panel(name, images[name], experiment.camera(name).optics.microimage_pitch_px, frame.label) for name in images
    ]
    return markup.figure(
        shown,
        f"{frame.label.capitalize()} as it was recorded, the middle of each sensor. Each spot is the light that one "
        "microlens lets through, and a particle lights the spots of several.",
    )


def _panel(name: str, image: np.ndarray, pitch_px: float, label: str) -> str:
    half = round(MICROIMAGES * pitch_px / 2)
    (top, bottom), (left, right) = ((max(n // 2 - half, 0), min(n // 2 + half, n)) for n in image.shape)
    part = image[top:bottom, left:right]
    panel, axes = new_panel(4.2)
    scale = Normalize(float(part.min()), max(float(np.percentile(part, PERCENTILE)), float(part.min()) + 1))
    picture = axes.imshow(part, cmap="gray", norm=scale, extent=(left, right, bottom, top), interpolation="none")
    style(axes, title=f"{name}, {label}", xlabel="column [px]", ylabel="row [px]")
    colour_bar(panel, picture, axes, "counts", location="bottom")
    return to_svg(panel, f"Middle of the image of camera {name}, {label}.")

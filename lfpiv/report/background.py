"""Write the report's section on light that stands still: the subtracted light of each camera and frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.colors import Normalize

from lfpiv.experiment.experiment import Experiment
from lfpiv.report import markup
from lfpiv.report.markup import number, percent
from lfpiv.report.svg import colour_bar, new_panel, style, to_svg

if TYPE_CHECKING:
    from lfpiv.calibration.camera import Calibration
    from lfpiv.lightfield.standing_light import StandingLight

LARGEST_PX = 600
"""Largest edge of a picture in the page [pixel]; larger ones are the brightest pixels of squares."""


def section(experiment: Experiment, calibration: Calibration) -> str:
    """Return the section on the subtracted light, as HTML; empty where nothing is subtracted."""
    cameras = {name: found for name, camera in calibration.cameras.items() if (found := camera.standing) is not None}
    if not cameras:
        return ""
    rows = [
        [
            name,
            percent(float(found.region.mean()), 1),
            percent(float(found.unusable.mean()), 2),
            number(found.stray, 1),
            markup.NONE if found.ratio is None else number(found.ratio, 3),
        ]
        for name, found in cameras.items()
    ]
    heads = ["camera", "part of the sensor", "unusable pixels", "stray light [counts]", "second frame over first"]
    parts = ['<h2 id="background">Light that stands still</h2>']
    for name, found in cameras.items():
        lasers = experiment.laser_names
        titles = [name] if len(lasers) == 1 else [f"{name}, frame {frame}" for frame in lasers]
        shown = [_picture(light, found, title) for title, light in zip(titles, found.light, strict=False)]
        parts.append(
            markup.figure(
                shown,
                f"Light that stands still in the images of {name} and is subtracted from them. It should show walls, "
                "windows and stray light, and no particles. Unusable pixels, bright here, have no weight.",
            )
        )
    parts.append(markup.table(heads, rows, caption="Light that stands still, by camera"))
    return "\n".join(parts)


def _picture(light: np.ndarray, found: StandingLight, title: str) -> str:
    """Draw the standing light of one frame, unusable pixels as bright as the brightest."""
    step = -(-max(light.shape) // LARGEST_PX)
    rows, columns = (n // step * step for n in light.shape)
    top = max(float(np.percentile(light, 99.9)), 1.0)
    shown = np.where(found.unusable, top, light)[:rows, :columns]
    small = shown.reshape(rows // step, step, columns // step, step).max((1, 3))
    figure, axes = new_panel(float(np.clip(3.0 * rows / columns, 1.0, 3.6)) + 0.8)
    picture = axes.imshow(
        small, cmap="magma", norm=Normalize(0, top), extent=(0, columns, rows, 0), interpolation="none"
    )
    style(axes, title=title, xlabel="column [px]", ylabel="row [px]")
    colour_bar(figure, picture, axes, "light [counts]", location="bottom")
    return to_svg(figure, f"Light that stands still in {title}, over the sensor.")

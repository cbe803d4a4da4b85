"""Counted rays (Eq. 10): of a few voxels, the judge of integrated weights and of their form; of all, weights."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from lfpiv.lightfield.microimage_layout import plain
from lfpiv.warn import Code, Warning, warn
from lfpiv.weights.blocks import (
    WHOLE,
    Cuts,
    Progress,
    StoredGrid,
    blocks_of,
    count_voxels,
    pack_camera,
    require_numbers,
)
from lfpiv.weights.ray_fit import fit_rays, ray_models
from lfpiv_kernels.rays.count import POWERS
from lfpiv_kernels.reconstruction.projector import Blocks
from lfpiv_kernels.weights.ray_model import LANES, LEVELS

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera

log = logging.getLogger(__name__)

PROFILES_MEAN, PROFILES_WORST = 0.015, 0.025
"""Largest relative L2 difference from counted rays, mean and worst voxel of the sample, with which profiles serve:
three quarters of the aims below, for a small sample may miss the worst; straight rays have about 0.010, 0.017."""
AIM_MEAN, AIM_WORST = 0.02, 0.035
"""Difference from counted rays, mean and worst voxel of the sample, above which a warning is due."""
CLEARLY = 0.8
"""Pixels, of three times the memory, are taken where their mean difference is at most this part of that of profiles."""
CUTS: tuple[Cuts, ...] = (
    *(WHOLE, (2, 2, 1), (2, 1, 2), (1, 2, 2), (2, 2, 2), (3, 3, 1), (3, 1, 3), (1, 3, 3)),
    *((4, 4, 1), (4, 1, 4), (1, 4, 4), (3, 3, 3), (4, 4, 4)),
)
"""Cuts of a voxel, in the order of their cost. One edge alone is never cut: its projection has a covariance, only all
three together have none, or two where the third lies along an axis of the lenses."""
CUT_NEAR = 0.0125
"""Mean relative L2 difference from the finest cut with which a coarser one serves: with the 0.8 % that straight rays
have anyway it stays below `PROFILES_MEAN`."""
BENT, WIDE = 0.01, 2.0
"""Rays beyond second order, and a voxel's projected edge [microlens pitch], above which they explain a difference: rays
off by a hundredth change weights by about 2 %."""
@dataclass(frozen=True, kw_only=True)
class Choice:
    """How one camera's footprints are computed and stored."""

    form: str
    """"profiles" or "pixels"."""
    cuts: Cuts = WHOLE
    """Parts of the voxels, where the form is "pixels"."""
    profile_errors: list[float] = field(default_factory=list)
    """Difference of profiles from counted rays, where these decided."""


def choose_form(counted: CountedVoxels) -> Choice:
    """Profiles where they are near enough to counted rays, or pixels hardly nearer; says why, and warns."""
    profiles = errors = counted.errors_of_form("profiles")
    choice = Choice(form="profiles", profile_errors=profiles)
    if not profiles_serve(profiles):
        cuts = choose_cuts(counted.stored, counted.camera)
        pixels = counted.errors_of_form("pixels", cuts)
        if np.mean(pixels) <= CLEARLY * np.mean(profiles):
            choice, errors = Choice(form="pixels", cuts=cuts, profile_errors=profiles), pixels
        log.info("%s: pixel by pixel weights differ by %.1f %%", counted.camera.name, 100 * np.mean(pixels))
    if profiles:
        log.info(
            "%s: profiles differ from counted rays by %.1f %% (worst voxel %.1f %%): weights %s",
            *(counted.camera.name, 100 * np.mean(profiles), 100 * max(profiles)),
            "as products of profiles" if choice.form == "profiles" else "pixel by pixel",
        )
    counted.warn(choice.form, errors, asked=False)
    return choice


def profiles_serve(errors: Sequence[float]) -> bool:
    """Whether profiles are near enough to counted rays; where no voxel is seen, the smaller form does."""
    return not errors or bool(np.mean(errors) <= PROFILES_MEAN and max(errors) <= PROFILES_WORST)


def choose_cuts(stored: StoredGrid, camera: CalibratedCamera) -> Cuts:
    """Cut of the voxels that footprints pixel by pixel need: the cheapest one near the finest, in a few voxels."""
    voxels = draw_seen(stored, camera)
    if not len(voxels):
        return WHOLE
    model, pack = ray_models(camera, stored.centres_mm(voxels), stored.grid.voxel_mm), pack_camera(camera)
    finest = blocks_of(pack, [model], "pixels", (0, 0), CUTS[-1])
    for cuts in CUTS[:-1]:
        blocks = blocks_of(pack, [model], "pixels", (0, 0), cuts)
        if np.mean([_difference(blocks, finest, voxel) for voxel in range(len(model))]) <= CUT_NEAR:
            break
    else:
        cuts = CUTS[-1]
    if cuts != WHOLE:
        text = "%s: voxels lie aslant to the microlenses: footprints of %d x %d x %d parts along x, y, z are added"
        log.info(text, camera.name, *cuts)
    return cuts


def _difference(blocks: Blocks, others: Blocks, voxel: int) -> float:
    """Relative L2 difference of one voxel's weights on the sensor."""
    pixels, weights = [], []
    for part, sign in ((blocks, -1), (others, 1)):
        ray, weight = part.entries(voxel)
        pixels.append(part.microimages.pixel[ray])
        weights.append(sign * weight * part.microimages.share[ray])
    _, place = np.unique(np.concatenate(pixels), return_inverse=True)
    difference = np.bincount(place, np.concatenate(weights))
    light = np.bincount(place[len(pixels[0]) :], weights[1])
    return float(np.linalg.norm(difference) / max(np.linalg.norm(light), np.finfo(float).tiny))



"""Choice of the form in which a camera's integrated weights are stored.

Products of profiles are small and fast, and suit straight rays and upright square microlenses. Values pixel by pixel
suit any optics and take three times the memory. A few counted voxels (`CountedVoxels`) measure the error of each form;
`choose_form` returns the smaller form if its error is small enough. `choose_cuts` finds into how many parts a voxel
must be cut if its edges lie oblique to the microlenses.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from lfpiv.warn import Code, Warning, warn
from lfpiv.weights.blocks import WHOLE, Cuts, PackedCamera, blocks_of
from lfpiv.weights.counting import CountedVoxels, draw_seen
from lfpiv.weights.ray_fit import bent_pitch, ray_models
from lfpiv.weights.stored_grid import StoredGrid
from lfpiv_kernels.reconstruction.projector import Blocks

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera

log = logging.getLogger(__name__)

AIM_MEAN, AIM_WORST = 0.02, 0.035
"""Relative L2 error of weights, mean and worst voxel of the sample, up to which profiles are chosen, and above which a
warning is logged."""
PIXELS_GAIN = 0.8
"""Largest ratio of the mean error of pixels to that of profiles with which pixels are chosen."""
CUTS: tuple[Cuts, ...] = (
    *(WHOLE, (2, 2, 1), (2, 1, 2), (1, 2, 2), (2, 2, 2), (3, 3, 1), (3, 1, 3), (1, 3, 3)),
    *((4, 4, 1), (4, 1, 4), (1, 4, 4), (3, 3, 3), (4, 4, 4)),
)
"""Cuts of a voxel, cheapest first."""
CUT_ERROR = 0.0125
"""Largest mean relative L2 difference from the finest cut with which a coarser cut is chosen."""
BENT, WIDE = 0.01, 2.0
"""Departure of rays from third order, and projected voxel edge, above which they are named as the cause of an error
[microlens pitch]."""


@dataclass(frozen=True, kw_only=True)
class Choice:
    """How one camera's footprints are computed and stored."""

    form: str
    """"profiles" or "pixels"."""
    cuts: Cuts = WHOLE
    """Parts of a voxel along x, y, z, with the form "pixels"."""
    profile_errors: tuple[float, ...] | None = None
    """Relative L2 error of profiles per counted voxel. None if the form was not chosen by counted rays."""
    pixel_errors: tuple[float, ...] | None = None
    """The same of pixels. None if they were not compared, or not chosen."""


def choose_forms(
    stored: StoredGrid, cameras: Mapping[str, CalibratedCamera], form: str
) -> tuple[dict[str, Choice], dict[str, CountedVoxels]]:
    """Choose the form of each camera's footprints; return the voxels, too, that were counted for it.

    The form "auto" is chosen by counted rays where the microlenses are square. Where a camera needs pixels, all cameras
    take them, since SMART can take rows of pixels alone only if all cameras have rows.
    """
    choices, counted = {}, {}
    for name, camera in cameras.items():
        if form == "auto" and camera.lattice.layout == "square":
            counted[name] = CountedVoxels(stored, camera)
            choices[name] = choose_form(counted[name])
        else:
            choices[name] = choose_uncounted(stored, camera, form)
    alone = choices
    if any(choice.form == "pixels" for choice in choices.values()):
        choices = {name: _as_pixels(stored, cameras[name], choice) for name, choice in choices.items()}
    for name, voxels in counted.items():
        _tell(voxels, choices[name], alone[name])
    return choices, counted


def _as_pixels(stored: StoredGrid, camera: CalibratedCamera, choice: Choice) -> Choice:
    """Return a choice with weights pixel by pixel."""
    return choice if choice.form == "pixels" else replace(choice, form="pixels", cuts=choose_cuts(stored, camera))


def choose_form(counted: CountedVoxels) -> Choice:
    """Choose profiles unless their error is too large and that of pixels is clearly smaller."""
    profiles = form_errors(counted, "profiles")
    choice = Choice(form="profiles", profile_errors=tuple(profiles))
    if profiles_serve(profiles):
        return choice
    cuts = choose_cuts(counted.stored, counted.camera)
    pixels = form_errors(counted, "pixels", cuts)
    log.info(
        "weights of camera %s pixel by pixel differ from counted rays by %.1f %%",
        counted.camera.name, 100 * np.mean(pixels),
    )  # fmt: skip
    if np.mean(pixels) > PIXELS_GAIN * np.mean(profiles):
        return choice
    return replace(choice, form="pixels", cuts=cuts, pixel_errors=tuple(pixels))


def _tell(counted: CountedVoxels, choice: Choice, alone: Choice) -> None:
    """Log why a form was chosen, and warn if its weights are not accurate. `alone` is the camera's choice by itself."""
    name, profiles = counted.camera.name, choice.profile_errors
    if profiles:
        so = "so" if choice.form == "profiles" else "pixel by pixel"
        log.info(
            "weights of camera %s as products of profiles differ from counted rays by %.1f %% (worst voxel %.1f %%): "
            "they are stored %s",
            *(name, 100 * np.mean(profiles), 100 * max(profiles)),
            so if choice.form == alone.form else f"{so}, as the other cameras' are",
        )
    errors = profiles if choice.form == "profiles" else choice.pixel_errors
    if errors is None:
        errors = tuple(form_errors(counted, choice.form, choice.cuts))
    warn_of_errors(counted, choice.form, errors, requested=False)


def choose_uncounted(stored: StoredGrid, camera: CalibratedCamera, form: str) -> Choice:
    """Choose a camera's form without counted rays: the requested one, or pixels for hexagonal microlenses."""
    if form == "profiles":
        return Choice(form="profiles")
    if form == "auto":
        text = "weights of camera %s are stored pixel by pixel: products of profiles need square microlenses"
        log.info(text, camera.name)
    return Choice(form="pixels", cuts=choose_cuts(stored, camera))


def form_errors(counted: CountedVoxels, form: str, cuts: Cuts = WHOLE) -> list[float]:
    """Return the errors of footprints in a form, one per counted voxel. Only these voxels are integrated."""
    if not len(counted.voxels):
        return []
    model = ray_models(counted.camera, counted.centres_mm, counted.stored.grid.voxel_mm, form)
    blocks = blocks_of(PackedCamera.from_camera(counted.camera), [model], form, cuts=cuts)
    return counted.errors(blocks, range(len(model)))


def profiles_serve(errors: Sequence[float]) -> bool:
    """Return whether profiles are near enough to counted rays. True if the camera sees no voxel."""
    return not errors or bool(np.mean(errors) <= AIM_MEAN and max(errors) <= AIM_WORST)


def choose_cuts(stored: StoredGrid, camera: CalibratedCamera) -> Cuts:
    """Choose the cheapest cut of a voxel whose footprints pixel by pixel are near those of the finest cut."""
    voxels = draw_seen(stored, camera)
    if not len(voxels):
        return WHOLE
    model, packed = (
        ray_models(camera, stored.centres_mm(voxels), stored.grid.voxel_mm),
        PackedCamera.from_camera(camera),
    )
    finest = blocks_of(packed, [model], "pixels", cuts=CUTS[-1])
    for cuts in CUTS[:-1]:
        blocks = blocks_of(packed, [model], "pixels", cuts=cuts)
        if np.mean([_difference(blocks, finest, voxel) for voxel in range(len(model))]) <= CUT_ERROR:
            break
    else:
        cuts = CUTS[-1]
    if cuts != WHOLE:
        text = "camera %s sees voxels obliquely: their weights are sums over %d x %d x %d parts along x, y, z"
        log.info(text, camera.name, *cuts)
    return cuts


def _difference(blocks: Blocks, others: Blocks, voxel: int) -> float:
    """Return the relative L2 difference of one voxel's weights on the sensor."""
    pixels, weights = [], []
    for part, sign in ((blocks, -1), (others, 1)):
        ray, weight = part.entries(voxel)
        pixels.append(part.microimages.pixel[ray])
        weights.append(sign * weight * part.microimages.share[ray])
    _, place = np.unique(np.concatenate(pixels), return_inverse=True)
    difference = np.bincount(place, np.concatenate(weights))
    light = np.bincount(place[len(pixels[0]) :], weights[1])
    return float(np.linalg.norm(difference) / max(np.linalg.norm(light), np.finfo(float).tiny))


def warn_of_errors(counted: CountedVoxels, form: str, errors: Sequence[float], *, requested: bool) -> None:
    """Warn if no voxel could be compared, or if the weights' error exceeds the aim; name the likely cause.

    `requested` is true if the user chose the form, and false if counted rays did.
    """
    camera = counted.camera
    if not errors:
        warn(log, Warning(code=Code.WEIGHTS_UNCHECKED, subject=camera.name))
    elif np.mean(errors) > AIM_MEAN or max(errors) > AIM_WORST:
        bent, wide = bent_pitch(camera, counted.centres_mm, 3), _wide(camera, counted)
        if form == "profiles" and requested:
            cause = "profiles suit straight rays and upright arrays; set compute.weights_form to 'auto'"
        elif bent > BENT:
            cause = "aberrations beyond the third order in the pupil point; compute.weights = 'count' follows them"
        elif wide > WIDE:
            cause = "voxels larger than microlenses; lower volume.voxel_mm"
        else:
            cause = "not known, neither aberrations nor the voxels' size; compare compute.weights = 'count'"
        figures = {"form": form, "mean": float(np.mean(errors)), "worst": max(errors), "cause": cause}
        figures |= {"aim_mean": AIM_MEAN, "aim_worst": AIM_WORST, "bent_pitch": bent, "wide_pitch": wide}
        warn(log, Warning(code=Code.WEIGHTS_DIFFER, subject=camera.name, figures=figures))


def _wide(camera: CalibratedCamera, counted: CountedVoxels) -> float:
    """Return the longest projected edge of a counted voxel on the microlens array [microlens pitch]."""
    edges = ray_models(camera, counted.centres_mm, counted.stored.grid.voxel_mm)[:, 12:18].reshape(-1, 2)
    return float(np.hypot(*edges.T).max() / camera.lattice.pitch_mm)

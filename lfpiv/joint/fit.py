"""The joint fit of a pair: rounds of the light and the displacement, started from the frames by themselves.

The light keeps what the displacement was when it was made, so in the first rounds it is made anew. A wrong first
displacement is forgotten so. Where the fit explains the images much less than the frames by themselves do, particles
are lost between the frames, and their brightness may differ from there on.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from lfpiv.joint.displacement_steps import DisplacementSteps, Residual
from lfpiv.joint.light_steps import Light, LightSteps
from lfpiv.joint.model import JointModel
from lfpiv.reconstruction.ordered_subsets import Subset, whole_subset
from lfpiv.reconstruction.result import Reconstruction

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Round:
    """One change of the light and of the displacement."""

    fresh: bool
    """Whether the light is made anew from the frames by themselves."""
    epochs: int
    """Epochs over the subsets."""
    steps: int
    """Conjugate gradient steps of the displacement."""
    relaxation: float
    """Factor of the displacement's step: the light hides a part of it."""

    @property
    def settled(self) -> bool:
        """Whether the displacement is near enough to its end to set its own prior: steps are not lengthened."""
        return self.relaxation == 1


ROUNDS = (
    Round(True, 1, 3, 1.5),
    Round(True, 1, 3, 1.5),
    Round(True, 1, 3, 1.5),
    Round(True, 2, 6, 1.0),
    Round(False, 3, 6, 1.0),
)
"""Rounds of the fit."""
SETTLED_VOXEL = 0.02
"""End the fit after a round with a smaller mean change of the displacement [voxel]."""
LOST, JUDGED = 3.2, 2
"""Particles may be lost between the frames if the misfit over the misfit of separate frames is larger. The second value
is the number of rounds after which this is judged.
"""
UNEQUAL = 0.13
"""Particles are lost if the rms of rho, weighted by the light, is larger. The fit then begins again, and the brightness
of the frames may differ."""
PART = 4
"""The curvature is taken from one subset of the rays in so many."""


@dataclass(frozen=True)
class JointFit:
    """Result of the fit."""

    light: np.ndarray
    """Light midway in time, shape (z, y, x), float32."""
    nodes: np.ndarray
    """Displacement on the nodes of `lfpiv.joint.spline_field.SplineField` [voxel]."""
    rounds: int
    misfit_ratio: float
    """Misfit over that of the frames by themselves."""
    lossy: bool
    """Whether brightness may differ between the frames."""
    unlike: float
    """How much the cameras ask for unlike light, root mean square over the frames."""
    residuals: Sequence[Residual]
    """Of both frames of the result."""


def fit_pair(
    model: JointModel,
    found: Sequence[Reconstruction],
    nodes: np.ndarray,
    progress: Callable[[float], None] | None,
) -> JointFit:
    """Fit the light and the displacement of a pair.

    Parameters
    ----------
    model : JointModel
        The model of the frames.
    found : sequence of two Reconstruction
        Frames by themselves.
    nodes : ndarray
        First displacement [voxel].
    progress : callable, optional
        Called with the finished fraction.
    """
    steps = LightSteps(model)
    movement = DisplacementSteps(model, _curvature_rays(steps, len(model.weights.cameras)))
    alone = sum(one.misfit[-1] for one in found)
    first, number, done, spent, light = nodes, 0, 0, 0, Light(model.lit)
    while number < len(ROUNDS):
        now = ROUNDS[number]
        if now.fresh:
            light = Light(model.start(found, nodes))
        light = steps.epochs(light, model.transports(nodes), now.epochs)
        step = movement.step(light.values, nodes, now.relaxation, now.steps, settled=now.settled)
        nodes, ratio, number = nodes + step.change, step.misfit / alone, number + 1
        done, spent = done + 1, spent + now.epochs
        moved = float(np.abs(model.field.values(step.change)).mean())
        log.debug("round %d: misfit ratio %.3f, moved by %.3f voxel", number, ratio, moved)
        if number == JUDGED and ratio > LOST and model.sieve_voxel > 0 and model.rho is None:
            model.rho = _loss(model, found, nodes)
            if model.rho is not None:
                nodes, number = first, 0
        if progress is not None:  # epochs take the time of a round
            progress(spent / (spent + sum(coming.epochs for coming in ROUNDS[number:])))
        if not now.fresh and moved < SETTLED_VOXEL:
            break
    residuals = movement.residuals(light.values, model.transports(nodes), unlike=True)
    ratio = sum(one.misfit for one in residuals) / alone
    unlike = float(np.sqrt(np.mean([one.unlike**2 for one in residuals])))
    return JointFit(light.values, nodes, done, ratio, model.rho is not None, unlike, residuals)


def _loss(model: JointModel, found: Sequence[Reconstruction], nodes: np.ndarray) -> np.ndarray | None:
    """Return rho from the frames by themselves; None if they are about equally bright."""
    model.rho = np.zeros_like(model.lit)
    light = model.start(found, nodes)
    rms = float(np.sqrt((light * model.rho**2).sum(dtype=np.float64) / light.sum(dtype=np.float64)))
    log.debug("brightness of the frames differs by %.3f", rms)
    return model.rho if rms > UNEQUAL else None


def _curvature_rays(steps: LightSteps, cameras: int) -> Subset:
    """Return the rays whose curvature stands for all rays: some subsets of all cameras, or every ray."""
    subsets = steps.partitions[0].subsets
    if len(subsets) >= PART and len(subsets[0].parts) >= cameras:
        return Subset(tuple(part for subset in subsets[: len(subsets) // PART] for part in subset.parts))
    return whole_subset(cameras)

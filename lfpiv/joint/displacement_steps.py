"""Gauss-Newton steps of the displacement through the weights, with the light fixed.

Both frames have the misfit of SMART. Its gradient by the displacement d of a voxel is
``-s/2 c grad(T^T G' e_f)``, with the exponent e_f of SMART. Its curvature takes the derivative of the moved light to
the images, divides by P + b, and takes it back. The curvature of some subsets and of the brightest voxels stands for
all, since it changes slowly with both. The prior is a weight times twice the misfit per lit pixel times the squared
second differences of the nodes: first `ROUGH`, then, for each component along each axis, the inverse of the mean square
that the nodes have, so that smooth flows are fitted smoothly. Conjugate gradients, preconditioned by the light near
each node, solve for the step.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lfpiv.joint.conjugate_gradients import conjugate_gradients
from lfpiv.joint.model import JointModel
from lfpiv.reconstruction.image_preparation import PreparedImage
from lfpiv.reconstruction.ordered_subsets import Subset
from lfpiv.weights.operator import Weights
from lfpiv_kernels.reconstruction.transport import Transport

ROUGH = 0.3
"""Weight of the squared second differences of the nodes, in units of twice the misfit per lit pixel, as long as theirs
are not known."""
STIFFEST = 30.0
"""Largest weight, of a displacement without second differences."""
SMALL_REST = 1e-3
"""Share of the first residual below which conjugate gradients end."""
LARGEST_MOVE = 1.0
"""Largest change of the displacement by a step [voxel]."""
LEAST_SHARE, LEAST_CURVATURE = 0.05, 1e-3
"""Least light of a node in the preconditioner, relative to the mean, and least curvature, relative to the mean."""
SECOND_DIFFERENCES = 18.0
"""Largest diagonal element of the prior: 6 of the squared second differences along each of three axes."""
BRIGHT = 0.9
"""Share of the light whose voxels make the curvature."""


@dataclass(frozen=True)
class Residual:
    """Images of a frame by the model beside the recorded ones."""

    volume: np.ndarray
    """Volume of the frame, shape (z, y, x), float32."""
    exponent: np.ndarray
    """G' e_f, shape (z, y, x), float32."""
    relative: float
    """||I - P|| / ||I||."""
    misfit: float
    """SMART's misfit [counts]."""
    unlike: float
    """How much the cameras ask for unlike light, see `lfpiv.reconstruction.unlike_light`; NaN where it is not asked."""


@dataclass(frozen=True)
class Step:
    """Change of the nodes."""

    change: np.ndarray
    misfit: float
    """Before the step [counts]."""


class RayPart:
    """A part of the rays of all cameras that stands for all of them.

    Parameters
    ----------
    subset : Subset
        Sets of the rays; every ray where they are ``ALL``.
    """

    def __init__(self, weights: Weights, subset: Subset):
        self.weights = weights
        names = list(weights.cameras)
        self._sets: dict[str, list[int]] = {name: [] for name in names}
        for camera, ray_set in subset.parts:
            self._sets[names[camera]].append(ray_set)
        self._pixels = {
            name: np.concatenate([weights.projector(name).exclusive_pixels(one) for one in sets])
            for name, sets in self._sets.items()
            if sets
        }

    def share(self, images: Mapping[str, PreparedImage]) -> float:
        """Return the part of the light of a frame's images that lies in pixels which see these rays only."""
        whole = sum(float(one.image.sum(dtype=np.float64)) for one in images.values())
        own = sum(float(images[name].image[at].sum(dtype=np.float64)) for name, at in self._pixels.items())
        return own / whole

    def curvatures(self, volume: np.ndarray, images: Mapping[str, PreparedImage]) -> dict[str, np.ndarray]:
        """Return gain^2 / (P + b) of the pixels that see these rays only; 0 for pixels that do not count."""
        found = {}
        for name, seen in self._seen(volume).items():
            one, at = images[name], self._pixels[name]
            gain = self.weights.gain(name)[at] * np.float32(one.camera_gain)
            expected = seen * gain
            counts = (one.image[at] > 0) | (expected > 0)
            found[name] = np.where(counts, gain**2 / np.where(counts, expected + np.float32(one.floor), 1), 0)
        return found

    def normal(self, volume: np.ndarray, curvatures: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return sum over the pixels of w curvature (W volume), shape (z, y, x), float32."""
        stored = self.weights.stored
        back = np.zeros(stored.size, np.float32)
        for name, seen in self._seen(volume).items():
            weighted = np.zeros(self.weights.gain(name).size, np.float32)
            weighted[self._pixels[name]] = seen * curvatures[name]
            self.weights.projector(name).back_project(weighted, back, *self._sets[name])
        return stored.restore(back)

    def _seen(self, volume: np.ndarray) -> dict[str, np.ndarray]:
        """Return W volume of the pixels that see these rays only."""
        flat, seen = self.weights.stored.store(volume), {}
        for name, at in self._pixels.items():
            image = np.empty(self.weights.gain(name).size, np.float32)
            seen[name] = self.weights.projector(name).project(flat, image, *self._sets[name])[at]
        return seen


class DisplacementSteps:
    """Steps of the displacement of a model.

    Parameters
    ----------
    model : JointModel
        The model of the frames.
    part : Subset
        Rays whose curvature stands for all rays.
    """

    def __init__(self, model: JointModel, part: Subset):
        self.model = model
        self._part = RayPart(model.weights, part)
        self._scale: np.ndarray | None = None

    def residuals(
        self, light: np.ndarray, transports: tuple[Transport, Transport], *, unlike: bool = False
    ) -> list[Residual]:
        """Compare the images of both frames by the model with the recorded ones, and with `unlike` the cameras."""
        return [self._residual(number, light, transport, unlike) for number, transport in enumerate(transports)]

    def _residual(self, frame: int, light: np.ndarray, transport: Transport, unlike: bool) -> Residual:
        model, prepared = self.model, self.model.frames[frame]
        volume = model.volume(frame, light, transport)
        stored = model.weights.stored.store(volume)
        exponents, misfit = prepared.exponents(stored)
        norm = sum(float(np.square(one.image, dtype=np.float64).sum()) for one in prepared.images.values())
        return Residual(
            volume=volume,
            exponent=model.sieved(model.weights.stored.restore(np.sum(exponents, axis=0))),
            relative=float(np.sqrt(misfit.squares / norm)),
            misfit=misfit.divergence,
            unlike=prepared.unlike_light(exponents, stored) if unlike else math.nan,
        )

    def gradient(
        self, light: np.ndarray, transports: tuple[Transport, Transport], residuals: Sequence[Residual]
    ) -> np.ndarray:
        """Return the derivative of the misfit by the nodes."""
        model, total = self.model, np.zeros((3, *light.shape), np.float32)
        for number, transport in enumerate(transports):
            total -= transport.pull_slope(residuals[number].exponent, model.light_of(number, light))
        return model.field.adjoint(total)

    def curvature(
        self, light: np.ndarray, transports: tuple[Transport, Transport], residuals: Sequence[Residual]
    ) -> Callable[[np.ndarray], np.ndarray]:
        """Return the map from a change of the nodes to a change of the gradient."""
        model, light = self.model, brightest(light, BRIGHT)
        own = [model.light_of(number, light) for number in range(2)]
        shares = [self._part.share(frame.images) for frame in model.frames]
        curvatures = [
            self._part.curvatures(one.volume, frame.images) for one, frame in zip(residuals, model.frames, strict=True)
        ]

        def change(nodes: np.ndarray) -> np.ndarray:
            direction, total = model.field.values(nodes), np.zeros((3, *light.shape), np.float32)
            for number, transport in enumerate(transports):
                moved = model.sieved(transport.push_change(own[number], direction))
                back = self._part.normal(moved, curvatures[number]) / np.float32(shares[number])
                total += transport.pull_slope(model.sieved(back), own[number])
            return model.field.adjoint(total)

        return change

    def step(self, light: np.ndarray, nodes: np.ndarray, relaxation: float, steps: int, *, settled: bool) -> Step:
        """Return a step of the nodes by some conjugate gradient steps, times a factor, and at most `LARGEST_MOVE`.

        The second differences of nodes that are settled set the weight of the prior, else it is `ROUGH`.
        """
        model = self.model
        transports = model.transports(nodes)
        residuals = self.residuals(light, transports)
        misfit = sum(one.misfit for one in residuals)
        gradient = self.gradient(light, transports, residuals)
        curvature = self.curvature(light, transports, residuals)
        weights = 1 / (model.field.bends(nodes) + 1 / STIFFEST) if settled else np.full((3, 3), ROUGH)
        rough = weights * 2 * misfit / self._lit_pixels
        scale = self._curvature_scale(curvature, nodes)
        floor = LEAST_CURVATURE * float(scale.mean())
        near = model.field.adjoint(np.broadcast_to(light, (3, *light.shape)))
        near = np.maximum(near / near.mean(), LEAST_SHARE)
        preconditioner = 1 / (scale * near + rough.mean(1)[:, None, None, None] * SECOND_DIFFERENCES + floor)
        change = conjugate_gradients(
            lambda part: curvature(part) + model.field.penalty(part, rough) + floor * part,
            -(gradient + model.field.penalty(nodes, rough)),
            steps=steps,
            tolerance=SMALL_REST,
            preconditioner=preconditioner,
        )
        change *= relaxation
        largest = float(np.abs(model.field.values(change)).max())
        if largest > LARGEST_MOVE:
            change *= LARGEST_MOVE / largest
        return Step(change, misfit)

    @property
    def _lit_pixels(self) -> int:
        images = (one.image for frame in self.model.frames for one in frame.images.values())
        return sum(int(np.count_nonzero(image > 0)) for image in images)

    def _curvature_scale(self, curvature: Callable[[np.ndarray], np.ndarray], nodes: np.ndarray) -> np.ndarray:
        """Return the mean curvature along each axis, from the first light: shape (3, 1, 1, 1)."""
        if self._scale is None:
            draw = np.random.default_rng(0).standard_normal(nodes.shape)
            mean = (draw * curvature(draw)).sum((1, 2, 3)) / (draw**2).sum((1, 2, 3))
            self._scale = np.maximum(mean, LEAST_CURVATURE * mean.max())[:, None, None, None]
        return self._scale


def brightest(light: np.ndarray, share: float) -> np.ndarray:
    """Return the brightest voxels, which hold a share of the light; 0 elsewhere."""
    falling = np.sort(light, axis=None)[::-1]
    sums = falling.cumsum(dtype=np.float64)
    least = falling[np.searchsorted(sums, share * sums[-1])]
    return np.where(light >= least, light, np.float32(0))

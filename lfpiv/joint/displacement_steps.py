"""Gauss-Newton steps of the displacement through the weights, with the light fixed.

Both frames have the misfit of SMART. Its gradient by the displacement d of a voxel is
``-s/2 c grad(T^T G' e_f)``, with the exponent e_f of SMART. Its curvature takes the derivative of the moved light to
the images, divides by P + b, and takes it back. The curvature of a part of the subsets stands for all, since it changes
slowly with the rays. The prior is `ROUGH` times the misfit per lit pixel times the squared second differences of the
nodes. Conjugate gradients, preconditioned by the light near each node, solve for the step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lfpiv.joint.conjugate_gradients import conjugate_gradients
from lfpiv.joint.model import JointModel
from lfpiv.reconstruction.ordered_subsets import Subset
from lfpiv.weights.operator import Weights
from lfpiv_kernels.reconstruction.pixel_rays import ALL
from lfpiv_kernels.reconstruction.transport import Transport

ROUGH = 0.3
"""Weight of the squared second differences of the nodes, in units of twice the misfit per lit pixel."""
SMALL_REST = 1e-3
"""Share of the first residual below which conjugate gradients end."""
LARGEST_MOVE = 1.0
"""Largest change of the displacement by a step [voxel]."""
LEAST_SHARE, LEAST_CURVATURE = 0.05, 1e-3
"""Least light of a node in the preconditioner, relative to the mean, and least curvature, relative to the mean."""
SECOND_DIFFERENCES = 18.0
"""Largest diagonal element of the prior: 6 of the squared second differences along each of three axes."""


@dataclass(frozen=True)
class Residual:
    """Images of a model beside the recorded ones."""

    misfit: float
    """Sum of the misfits of both frames [counts]."""
    exponents: tuple[np.ndarray, np.ndarray]
    """G' e_f of each frame, shape (z, y, x), float32."""
    curvatures: tuple[dict[str, np.ndarray], dict[str, np.ndarray]]
    """gain^2 / (P + b) of the pixels of each frame's cameras; 0 for pixels that do not count."""
    of_frame: tuple[tuple[float, float], tuple[float, float]]
    """||I - P|| / ||I|| and misfit [counts] of each frame."""


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
    weights : Weights
        The operator.
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
            name: np.concatenate([weights.projector(name).see_only(one) for one in sets])
            for name, sets in self._sets.items()
            if sets
        }

    def share(self, images: dict[str, np.ndarray]) -> float:
        """Return the part of some images that lies in pixels which see these rays only."""
        whole = sum(float(image.sum(dtype=np.float64)) for image in images.values())
        own = sum(float(images[name].reshape(-1)[at].sum(dtype=np.float64)) for name, at in self._pixels.items())
        return own / whole

    def normal(self, volume: np.ndarray, curvatures: dict[str, np.ndarray]) -> np.ndarray:
        """Return sum over the pixels of w curvature (W volume), shape (z, y, x), float32."""
        stored = self.weights.stored
        flat, back = stored.store(volume), np.zeros(stored.size, np.float32)
        for name, at in self._pixels.items():
            projector, gain = self.weights.projector(name), self.weights.gain(name)
            image, part = np.zeros(gain.size, np.float32), np.empty(gain.size, np.float32)
            for ray_set in self._sets[name]:
                seen = projector.see_only(ray_set)
                image[seen] = projector.project(flat, part, ray_set)[seen]
            weighted = np.zeros_like(image)
            weighted[at] = image[at] * gain[at] ** 2 * curvatures[name].reshape(-1)[at]
            projector.back_project(weighted, back, *(one for one in self._sets[name] if one != ALL))
        return stored.restore(back)


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

    def residual(self, light: np.ndarray, transports: tuple[Transport, Transport]) -> Residual:
        """Compare the images of the model with the recorded ones."""
        model, exponents, curvatures, figures = self.model, [], [], []
        for number, (frame, transport) in enumerate(zip(model.frames, transports, strict=True)):
            projected = model.weights(model.volume(number, light, transport))
            logs, curves, misfit, squares, norm = {}, {}, 0.0, 0.0, 0.0
            for name, one in frame.images.items():
                gain, floor = np.float32(one.camera_gain), np.float32(one.floor)
                expected = projected[name] * gain
                image = one.image.reshape(expected.shape)
                counts = (image > 0) | (expected > 0)
                logarithm = np.where(counts, np.log((image + floor) / (expected + floor)), 0).astype(np.float32)
                terms = np.where(counts, image - expected - (expected + floor) * logarithm, 0)
                misfit += float(terms.sum(dtype=np.float64))
                squares += float(np.square(image - expected, dtype=np.float64).sum())
                norm += float(np.square(image, dtype=np.float64).sum())
                logs[name] = logarithm * gain
                curves[name] = np.where(counts, gain**2 / (expected + floor), 0).astype(np.float32)
            exponents.append(model.sieved(model.weights.T(logs)))
            curvatures.append(curves)
            figures.append((float(np.sqrt(squares / norm)), misfit))
        first, second = figures
        return Residual(
            first[1] + second[1], (exponents[0], exponents[1]), (curvatures[0], curvatures[1]), (first, second)
        )

    def gradient(self, light: np.ndarray, transports: tuple[Transport, Transport], residual: Residual) -> np.ndarray:
        """Return the derivative of the misfit by the nodes."""
        model, total = self.model, np.zeros((3, *light.shape), np.float32)
        for number, transport in enumerate(transports):
            total -= transport.pull_slope(residual.exponents[number], model.light_of(number, light))
        return model.field.adjoint(total)

    def curvature(
        self, light: np.ndarray, transports: tuple[Transport, Transport], residual: Residual
    ) -> Callable[[np.ndarray], np.ndarray]:
        """Return the map from a change of the nodes to a change of the gradient."""
        model = self.model
        own = [model.light_of(number, light) for number in range(2)]
        shares = [self._part.share({name: one.image for name, one in frame.images.items()}) for frame in model.frames]

        def change(nodes: np.ndarray) -> np.ndarray:
            direction, total = model.field.values(nodes), np.zeros((3, *light.shape), np.float32)
            for number, transport in enumerate(transports):
                moved = model.sieved(transport.push_change(own[number], direction))
                back = self._part.normal(moved, residual.curvatures[number]) / np.float32(shares[number])
                total += transport.pull_slope(model.sieved(back), own[number])
            return model.field.adjoint(total)

        return change

    def step(self, light: np.ndarray, nodes: np.ndarray, relaxation: float, steps: int) -> Step:
        """Return a step of the nodes by some conjugate gradient steps, times a factor, and at most `LARGEST_MOVE`."""
        model = self.model
        transports = model.transports(nodes)
        residual = self.residual(light, transports)
        gradient = self.gradient(light, transports, residual)
        curvature = self.curvature(light, transports, residual)
        rough = ROUGH * 2 * residual.misfit / self._lit_pixels
        scale = self._curvature_scale(curvature, nodes)
        floor = LEAST_CURVATURE * float(scale.mean())
        near = model.field.adjoint(np.broadcast_to(light, (3, *light.shape)))
        near = np.maximum(near / near.mean(), LEAST_SHARE)
        inverse = 1 / (scale * near + rough * SECOND_DIFFERENCES + floor)
        change = conjugate_gradients(
            lambda way: curvature(way) + rough * model.field.penalty(way) + floor * way,
            -(gradient + rough * model.field.penalty(nodes)),
            steps=steps,
            least=SMALL_REST,
            inverse=inverse,
        )
        change *= relaxation
        largest = float(np.abs(model.field.values(change)).max())
        if largest > LARGEST_MOVE:
            change *= LARGEST_MOVE / largest
        return Step(change, residual.misfit)

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

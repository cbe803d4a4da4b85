"""Look for particles that one camera shows along its line of sight, in the images of the other cameras.

A particle that starts beside its place finds none of its light in a camera that sees it sharply. Its light there falls
to zero, and nothing holds it on the line of sight of the camera that still shows it. A second candidate may explain the
light of the other camera, off its place as well. So the light of all particles that some camera does not confirm is
taken as unexplained. Each of them is moved along the line of sight of the camera that shows it best, to where all
cameras together show most light. The brightest place is taken first, and its light is explained for all others then.

Light of other particles lies on the same line. A place between them and the particle's own shows less light in some
pixels than its image has. Such places are left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from lfpiv.tracking.confirmation import SEEN, SIGNIFICANCE
from lfpiv.tracking.particle_images import ParticleImages
from lfpiv.tracking.refinement import Cloud, Normal, Scene, rendered

REACH_VOXEL = 5.0
"""Largest distance by which a particle is moved [voxel]."""
STEP_VOXEL = 0.25
"""Distance of the places that are tried [voxel]."""
LARGEST_LACK = 0.3
"""Largest light that images may lack of a particle's at a new place, relative to it."""
AT_ONCE = 64
"""Lines whose images are made at once."""
REFINED = 2
"""Iterations by which moved particles are refined."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Line:
    """Places on a line of sight, the particle's own place first. Arrays have a row for each place."""

    positions_mm: np.ndarray
    """Places (x, y, z) [mm], shape (place, 3)."""
    images: list[sparse.csr_array]
    """Images of particles of unit light by camera, shape (place, pixel)."""
    information: np.ndarray
    """Information about their light, shape (place, camera) [1 / counts^2]."""

    def look(self, left: list[np.ndarray], weights: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Fit the light to what is left of each camera's image, both weighted.

        Returns
        -------
        light : ndarray, shape (place, camera)
            Light [counts].
        score : ndarray, shape (place,)
            Squared residual that the light explains [noise^2], 0 at a place that some camera does not show.
        """
        shown = np.stack([image @ residual for image, residual in zip(self.images, left, strict=True)], axis=1)
        light = np.maximum(shown, 0) / self.information
        root = np.sqrt(self.information)
        signal = light * root
        seen = root > SEEN * root.max(1, keepdims=True)
        own = float(np.square(signal[0]).max())
        score = np.where(((signal > SIGNIFICANCE) | ~seen).all(1), np.square(signal).sum(1) - SIGNIFICANCE**2, 0)
        better = np.flatnonzero(score > own)
        for camera in range(len(left)):
            lacking = self._lack(camera, better, light, left, weights) >= LARGEST_LACK**2
            score[better[lacking & seen[better, camera]]] = 0
        score[0] = own
        return light, score

    def _lack(
        self, camera: int, places: np.ndarray, light: np.ndarray, left: list[np.ndarray], weights: list[np.ndarray]
    ) -> np.ndarray:
        """Return the square of the light that an image lacks relative to the particle's, beyond noise, as `misfits`."""
        image, weight = self.images[camera][places], weights[camera]
        place = np.repeat(np.arange(len(places)), np.diff(image.indptr))
        known, share = weight[image.indices], np.square(image.data)
        own = light[places[place], camera] * image.data
        dark = np.minimum(left[camera][image.indices] / np.maximum(known, 1e-30) - own, 0)
        below, above = (
            np.bincount(place, share * values, minlength=len(places))
            for values in (known * np.square(own), known * np.square(dark) - 0.5)
        )
        return above / np.maximum(below, 1e-30)


def follow_lines(images: ParticleImages, scene: Scene, cloud: Cloud, normal: Normal, chosen: np.ndarray) -> Cloud:
    """Move particles along the line of sight of the camera that shows them, to where all cameras show light.

    Parameters
    ----------
    images : ParticleImages
        Model of the images.
    chosen : ndarray, shape (particle,), bool
        Particles that some camera which sees them does not confirm.

    Returns
    -------
    Cloud
        The particles that are not chosen, then the chosen ones with the light that the images show: where all cameras
        show them, or in their places. Those whose light is explained by others now are left out.
    """
    if not chosen.any() or len(images.cameras) < 2:
        return cloud
    spans = [slice(*images.first_pixel[camera : camera + 2]) for camera in range(len(images.cameras))]
    others = cloud[~chosen]
    residual = scene.residual(rendered(images, images.lists(others.positions_mm), others.light)).astype(float)
    weight = scene.known(normal.model) / scene.variance(normal.model).astype(float)
    weights, left = [weight[span] for span in spans], [weight[span] * residual[span] for span in spans]
    lines = _lines(images, weights, _places(images, weights, cloud[chosen]))
    crossing = [_crossing(lines, camera) for camera in range(len(weights))]
    looked = {number: line.look(left, weights) for number, line in enumerate(lines)}
    positions, lights = [], []
    while looked:
        number = max(looked, key=lambda one: looked[one][1].max())
        light, score = looked.pop(number)
        place = int(score.argmax())
        if not score[place] > SIGNIFICANCE**2:
            break
        positions.append(lines[number].positions_mm[place])
        lights.append(light[place])
        changed = set[int]()
        for camera, image in enumerate(lines[number].images):
            one = image[[place]]
            left[camera][one.indices] -= weights[camera][one.indices] * light[place, camera] * one.data
            changed.update(crossing[camera][:, one.indices].indices.tolist())
        for other in sorted(changed & looked.keys()):
            looked[other] = lines[other].look(left, weights)
    if not positions:
        return others
    return others.joined(Cloud(positions_mm=np.array(positions), light=np.array(lights)))


def _places(images: ParticleImages, weights: list[np.ndarray], cloud: Cloud) -> list[np.ndarray]:
    """Return places on the line of sight of the camera that shows each particle best, shape (place, 3) [mm].

    The image changes least along it.
    """
    lists = images.lists(cloud.positions_mm)
    along = np.arange(STEP_VOXEL, REACH_VOXEL + STEP_VOXEL / 2, STEP_VOXEL)
    steps = np.concatenate([[0.0], along, -along])[:, None] * images.voxel_mm
    found = []
    for number, position in enumerate(cloud.positions_mm):
        most, line = -1.0, np.zeros(3)
        for camera, own in enumerate(lists):
            part = slice(own.first[number], own.first[number + 1])
            values, known = own.values[part].astype(float), weights[camera][own.pixel[part]]
            shown = cloud.light[number, camera] ** 2 * float(known @ np.square(values[:, 3]))
            if shown > most:
                change = (known[:, None] * values[:, :3]).T @ values[:, :3]
                most, line = shown, np.linalg.eigh(change)[1][:, 0]
        found.append(position + steps * line)
    return found


def _crossing(lines: list[Line], camera: int) -> sparse.csc_array:
    """Return which lines light which pixels of a camera, shape (line, pixel)."""
    pixels = [np.unique(line.images[camera].indices) for line in lines]
    line = np.repeat(np.arange(len(lines)), [len(own) for own in pixels])
    shape = len(lines), lines[0].images[camera].shape[1]
    return sparse.csc_array((np.ones(len(line), bool), (line, np.concatenate(pixels))), shape=shape)


def _lines(images: ParticleImages, weights: list[np.ndarray], places: list[np.ndarray]) -> list[Line]:
    """Return the lines of such places."""
    lines = []
    for start in range(0, len(places), AT_ONCE):
        some = places[start : start + AT_ONCE]
        found, first = images.matrices(np.concatenate(some)), 0
        information = [image.power(2) @ weight for image, weight in zip(found, weights, strict=True)]
        every = np.maximum(np.stack(information, axis=1), 1e-30)
        for positions in some:
            own_places = slice(first, first + len(positions))
            parts = [image[own_places] for image in found]
            lines.append(Line(positions_mm=positions, images=parts, information=every[own_places]))
            first = own_places.stop
    return lines

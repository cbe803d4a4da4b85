"""Parts of a volume: the run's own steps on some voxels of the real rig, with simulated particles, and their cost.

Everything that the steps do grows in proportion to the slices of a volume, beside a fixed cost: voxels, nodes between
them, the lenses and the pixels that they light. So two parts, one thicker than the other, give the cost of the whole.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from lfpiv.experiment.experiment import Experiment
from lfpiv.geometry.grid import Grid, Layers
from lfpiv.geometry.resampling import volume_on
from lfpiv.planning.cost import NOTHING, Cost, timed
from lfpiv.reconstruction.particle_size import VOXEL_VARIANCE, ParticleSizer
from lfpiv.runs.guard import with_guard
from lfpiv.runs.pair_volumes import Reconstructor
from lfpiv.runs.refinement import refined
from lfpiv.selfcalibration.disparity import CameraVolumes
from lfpiv.weights.blocks import (
    BLOCK_BYTES,
    VOXEL_BYTES,
    PackedCamera,
    footprint_blocks,
    require_numbers,
    sample_blocks,
)
from lfpiv.weights.choice import Choice, choose_forms
from lfpiv.weights.depth_planes import NodeGrid, choose_planes, line_of_sight
from lfpiv.weights.device_share import DeviceShare
from lfpiv.weights.operator import Weights, build_weights
from lfpiv.weights.separable import choose_separable, possible_planes, ray_sets
from lfpiv.weights.separable_planes import Planes
from lfpiv.weights.stored_grid import StoredGrid
from lfpiv_kernels.reconstruction.projector import Projector
from lfpiv_kernels.reconstruction.projector_gpu import device_bytes
from lfpiv_kernels.reconstruction.projector_separable import SeparableProjector
from lfpiv_kernels.reconstruction.ray_projector import RayProjector

if TYPE_CHECKING:
    import xarray as xr

    from lfpiv.calibration.camera import CalibratedCamera, Calibration

PER_MICROLENS = 0.5
"""Simulated particles per microlens: a seeding that cameras of this kind resolve."""
SHARE_NOISE = 0.01
"""Standard deviation of the simulated noise, relative to the brightest pixel."""
BRIGHTEST = 1000.0
"""Light of the brightest pixel [counts]."""
SHIFT_VOXEL = 1.3
"""Displacement of the simulated particles along each axis [voxel of the experiment]."""
LEAST_POINT = 0.3
"""Standard deviation of simulated particles that stand for points [reconstructed voxel]."""
THIN_VOXELS = 120_000
"""Reconstructed voxels of a slab one voxel thick, with its guard layers, above which its slices are cut."""
LEAST_EDGE = 8
"""Least edge of a slice [voxel of the experiment]."""
CHECKED_VOXELS = 200_000
"""Voxels of a part in which the accuracy of shared profiles is measured."""
CUBE_EDGE = 10
"""Largest edge of the part that loads the kernels [voxel of the experiment]."""
SEED = 18


@dataclass(frozen=True, kw_only=True)
class Form:
    """How the weights of one camera are stored for the whole volume."""

    choice: Choice
    separable: bool = False
    """Whether planes of voxels share profiles."""
    distance: int | None = None
    """Layers from one plane of nodes to the next; None where the weights of all voxels are stored."""
    lines: tuple[bool, bool] = (False, False)
    """Whether voxels are shared among lines of sight before, along rows and along columns."""
    stored_bytes: int
    """Memory of the stored weights [byte]."""
    device_bytes: int = 0
    """Memory of the same on a GPU [byte]."""


@dataclass(frozen=True, kw_only=True)
class Volume:
    """The whole volume as it is reconstructed."""

    experiment: Experiment
    """With the grid that is written."""
    guard: Layers
    refinement: float
    """Edge of a voxel over that of the reconstructed ones."""
    calibration: Calibration
    particle_voxel: float
    """Standard deviation of the simulated particles [reconstructed voxel]."""

    @property
    def finest(self) -> Experiment:
        """The experiment with the grid that is reconstructed."""
        return refined(with_guard(self.experiment, self.guard), self.refinement)

    def of_edges(self, shape: tuple[int, int, int]) -> Volume:
        """Return a part around the same centre, with another number of voxels (z, y, x) of the experiment."""
        grid = self.experiment.grid
        first = (
            at + (n - own) / 2 * grid.voxel_mm
            for at, n, own in zip(grid.first_centre_mm, grid.shape, shape, strict=True)
        )
        z, y, x = first
        part = Grid(shape=shape, voxel_mm=grid.voxel_mm, first_centre_mm=(z, y, x))
        return replace(self, experiment=replace(self.experiment, grid=part, mask=None))

    def part(self, voxels: int) -> Volume:
        """Return a part of about a number of reconstructed voxels: a slab of slices around the middle.

        Slices follow each other along the outermost axis in memory, which crosses the rows of the sensors. They are
        whole, as memory is read slice after slice, unless a slab one voxel thick has more than `THIN_VOXELS`. A volume
        that has no more voxels is returned as it is.
        """
        if self.finest.grid.size <= voxels:
            return self
        outer, middle, inner = StoredGrid.for_cameras(self.finest.grid, self.cameras.values()).order
        shape = list(self.experiment.grid.shape)
        whole, shape[outer] = shape[outer], 1
        for axis in (inner, middle):
            thin = self.of_edges(_triple(shape)).finest.grid.size
            shape[axis] = max(min(LEAST_EDGE, shape[axis]), min(shape[axis], round(shape[axis] * THIN_VOXELS / thin)))
        slab = self.of_edges(_triple(shape)).finest.grid
        layers = voxels / (slab.size / slab.shape[outer]) / self.refinement - sum(self.guard[outer])
        shape[outer] = min(max(round(layers), 1), whole)
        return self.of_edges(_triple(shape))

    @property
    def cube(self) -> Volume:
        """A small part that loads the kernels."""
        z, y, x = (min(n, CUBE_EDGE) for n in self.experiment.grid.shape)
        return self.of_edges((z, y, x))

    def with_known_particles(self) -> Experiment:
        """Return the experiment with the sieve of the simulated particles, which a thin part does not show."""
        smart, known = self.experiment.smart, {}
        if smart.sieve_voxel == "auto":
            sigma = math.sqrt(max(self.particle_voxel**2 - VOXEL_VARIANCE, 0.0)) / self.refinement
            known["sieve_voxel"] = sigma if self.particle_voxel > LEAST_POINT else 0.0
        if smart.intensity_cap == "auto":
            known["intensity_cap"] = 0.0
        return replace(self.experiment, smart=smart.model_copy(update=known)) if known else self.experiment

    @property
    def cameras(self) -> Mapping[str, CalibratedCamera]:
        """Cameras by name."""
        return self.calibration.cameras

    def forms(self) -> dict[str, Form]:
        """Choose how the weights of each camera are stored, as `build_weights` does, and count them in a sample."""
        stored = StoredGrid.for_cameras(self.finest.grid, self.cameras.values())
        if self.experiment.compute.weights == "count":
            counted = Choice(form="pixels")
            return {name: self._blocks_form(stored, camera, counted, None) for name, camera in self.cameras.items()}
        choices, _ = choose_forms(stored, self.cameras, self.experiment.compute.weights_form)
        profiles = all(choice.form == "profiles" for choice in choices.values())
        if profiles and (shared := self._shared_profiles()) is not None:
            return {
                name: Form(
                    choice=choices[name],
                    separable=True,
                    stored_bytes=planes.stored_bytes,
                    device_bytes=planes.device_bytes,
                )
                for name, planes in shared.items()
            }
        found = {}
        for name, camera in self.cameras.items():
            choice = choices[name]
            nodes = choose_planes(stored, camera, choice.form, choice.cuts, particle_voxel=self.particle_voxel)
            found[name] = self._blocks_form(stored, camera, choice, nodes)
        return found

    def _shared_profiles(self) -> dict[str, Planes] | None:
        """Return the planes of voxels if they share profiles, as `build_weights` finds out.

        Their accuracy is that of a part.
        """
        cameras = self.cameras

        def free(grid: Grid) -> tuple[StoredGrid, Mapping[str, CalibratedCamera], DeviceShare]:
            stored = StoredGrid.for_cameras(grid, cameras.values(), columns_inmost=True)
            return stored, cameras, DeviceShare(cameras.values(), grid)

        planes = possible_planes(*free(self.finest.grid))
        if planes is None or choose_separable(*free(self.part(CHECKED_VOXELS).finest.grid), math.inf, _ignore) is None:
            return None
        return planes

    def _blocks_form(
        self, stored: StoredGrid, camera: CalibratedCamera, choice: Choice, nodes: NodeGrid | None
    ) -> Form:
        """Return how the weights of a camera's voxels, or nodes, are stored in blocks."""
        places = nodes or stored
        blocks, values = sample_blocks(PackedCamera.of(camera), places, choice.form, choice.cuts)
        require_numbers(blocks * places.size, self.finest.grid.shape)
        distance, lines = (None, (False, False)) if nodes is None else (nodes.distance, nodes.lines)
        counts = int(places.size * blocks), int(places.size * values)
        return Form(
            choice=choice,
            distance=distance,
            lines=lines,
            stored_bytes=int(places.size * (BLOCK_BYTES * blocks + values + VOXEL_BYTES)),
            device_bytes=device_bytes(choice.form, places.size, *counts, edge=camera.microimages.edge),
        )

    def weights(self, forms: Mapping[str, Form]) -> Weights:
        """Build the weights of these voxels in the forms that the whole volume has, and their sums."""
        grid = self.finest.grid
        if self.experiment.compute.weights == "count":
            built = build_weights(self.calibration, grid, "count")
        else:
            separable = all(form.separable for form in forms.values())
            stored = StoredGrid.for_cameras(grid, self.cameras.values(), columns_inmost=separable)
            projectors = {name: self._projector(forms[name], stored, camera) for name, camera in self.cameras.items()}
            built = Weights(stored, self.cameras, projectors, "footprint")
        built.volume = self.experiment.grid
        _ = built.camera_sums
        return built

    def _projector(self, form: Form, stored: StoredGrid, camera: CalibratedCamera) -> RayProjector:
        """Build the weights of one camera on these voxels in a form."""
        if form.separable:
            profiles = Planes(stored, camera).weights(_ignore)
            assert profiles is not None  # those of the whole volume were possible
            return SeparableProjector(profiles, ray_sets(self.cameras))
        nodes = None if form.distance is None else NodeGrid.of(stored, camera, form.distance, lines=form.lines)
        choice = form.choice
        blocks = footprint_blocks(nodes or stored, camera, choice.form, _ignore, _ignore, choice.cuts)
        return Projector(blocks, None if nodes is None else nodes.shares)

    def per_voxel(self) -> float:
        """Return the number of particles per reconstructed voxel at which there are `PER_MICROLENS`."""
        edges = np.array(self.finest.grid.shape[::-1]) * self.finest.grid.voxel_mm
        faces = edges.prod() / edges
        density = []
        for camera in self.cameras.values():
            optics = camera.optics
            direction = np.abs(line_of_sight(camera, self.finest.grid.centre_mm))
            depth_mm = edges.prod() / float(direction @ faces)
            density.append(PER_MICROLENS * (optics.magnification / optics.microlens_pitch_mm) ** 2 / depth_mm)
        return float(np.mean(density)) * self.finest.grid.voxel_mm**3


@dataclass(frozen=True, kw_only=True)
class Measured:
    """Costs of the steps on a part."""

    stored_bytes: int
    """Memory of the part's weights [byte]."""
    voxels: int
    """Number of reconstructed voxels."""
    weights: Cost
    """Build the weights and their sums."""
    check: Cost
    """Compare where the cameras show the particles, with the images of one pair; nothing where it was not asked for."""
    once: Cost
    """What only the first frame needs: sums of subsets, the estimator of the particles' size."""
    frame: Cost
    """Reconstruct one frame and sample it on the voxels that are written."""
    volume: xr.DataArray
    """A volume as it is written."""
    images: tuple[dict[str, np.ndarray], ...]
    """Simulated images of both frames."""


def measure(part: Volume, forms: Mapping[str, Form], per_voxel: float, *, check_cameras: bool = False) -> Measured:
    """Do the steps on a part with simulated particles and measure their cost."""
    weights, built = timed(lambda: part.weights(forms))
    known = part.with_known_particles()
    frames = [_images(part, weights, per_voxel, shift) for shift in (0.0, SHIFT_VOXEL)]
    reconstructor = Reconstructor(
        experiment=known,
        weights=weights,
        guard=part.guard,
        refinement=part.refinement,
    )

    def solve(number: int) -> xr.DataArray:
        images, floor = frames[number]
        found = reconstructor.solver.smart.solve(images, floor=floor)
        return volume_on(found.to_dataarray(), part.experiment.grid)

    def look(number: int) -> None:
        seen = sizer.fluctuations(frames[number][0])
        sizer.matching_sieve(seen)
        sizer.brightness_scatter(seen, part.particle_voxel)

    _, first = timed(lambda: solve(0))
    runs = [timed(lambda: solve(1)) for _ in range(2)]  # the faster one: other programs disturb
    volume, frame = min(runs, key=lambda one: one[1].cpu_s)
    first, sizing = first - frame, NOTHING
    if known != part.experiment:
        sizer, made = timed(lambda: ParticleSizer(weights))
        _, sizing = timed(lambda: look(1))
        first += made
    check = NOTHING
    if check_cameras:
        _, check = timed(lambda: _compare_cameras(weights, [images for images, _ in frames]))
    return Measured(
        stored_bytes=weights.memory_bytes,
        voxels=weights.grid.size,
        weights=built,
        check=check,
        once=first,
        frame=frame + sizing,
        volume=volume,
        images=tuple(images for images, _ in frames),
    )


def blobs(shape: tuple[int, int, int], per_voxel: float, sd: float, shift: float = 0.0) -> np.ndarray:
    """Draw Gaussian particles of a standard deviation [voxel] at random places, moved by `shift` along each axis."""
    rng = np.random.default_rng(SEED)
    reach = math.ceil(3 * sd)
    at = rng.random((max(int(per_voxel * math.prod(shape)), 1), 3)) * shape + shift
    steps = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 3, indexing="ij"), -1).reshape(-1, 3)
    volume = np.zeros(math.prod(shape))
    for some in np.array_split(at, -(-len(at) // 4096)):
        voxel = np.rint(some).astype(int)[:, None] + steps
        light = np.exp(-((voxel - some[:, None]) ** 2).sum(-1) / (2 * sd**2))
        inside = ((voxel >= 0) & (voxel < shape)).all(-1)
        volume += np.bincount(np.ravel_multi_index(tuple(voxel[inside].T), shape), light[inside], len(volume))
    return volume.reshape(shape).astype(np.float32)


def _images(
    part: Volume, weights: Weights, per_voxel: float, shift: float
) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Return noisy images of the same particles at a place, and the noise of each camera."""
    light = blobs(weights.grid.shape, per_voxel, part.particle_voxel, shift * part.refinement)
    rng, images, noise = np.random.default_rng(SEED), {}, {}
    for name, image in weights(light).items():
        image *= BRIGHTEST / max(float(image.max()), 1e-30)
        noise[name] = SHARE_NOISE * BRIGHTEST
        images[name] = image + np.float32(noise[name]) * rng.standard_normal(image.shape, np.float32)
    return images, noise


def _compare_cameras(weights: Weights, frames: list[dict[str, np.ndarray]]) -> None:
    if len(weights.cameras) < 2 or weights.method != "footprint":
        return
    volumes = CameraVolumes(weights)
    for images in frames:
        volumes.add(images)
    volumes.disparities()


def _triple(shape: list[int]) -> tuple[int, int, int]:
    z, y, x = shape
    return z, y, x


def _ignore(_: float) -> None:
    pass

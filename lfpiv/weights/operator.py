"""`build_weights`: calibrated mapping and grid -> the weights of Eq. 10 as a linear operator W.

``weights(volume)`` projects a volume onto images (Eq. 4), ``weights.T(images)`` is the adjoint. Two methods give the
weights: "footprint" integrates them in closed form, "count" traces rays and counts them, as the paper does. They are
stored in one of the forms of `lfpiv.weights.forms.table`.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Hashable, Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from lfpiv.calibration.coverage import SEEN_SHARE, warn_seen_by_one
from lfpiv.files import size_text
from lfpiv.geometry.grid import Grid
from lfpiv.geometry.volume import in_order
from lfpiv.lightfield.microimage_layout import microimages_of
from lfpiv.progress import StepProgress, part_of
from lfpiv.prompt import Card, Shown
from lfpiv.settings.processing import Compute
from lfpiv.weights.adjoint import Adjoint, checked_out
from lfpiv.weights.blocks import Cuts
from lfpiv.weights.card import card_of
from lfpiv.weights.choice import Choice, choose_forms
from lfpiv.weights.counting import CountedVoxels, add_entries
from lfpiv.weights.even_light import EvenLight, project_even_light
from lfpiv.weights.forms import table
from lfpiv.weights.forms.form import Rig
from lfpiv.weights.memory_left import MemoryLeft
from lfpiv.weights.stored_grid import StoredGrid
from lfpiv_kernels import runtime
from lfpiv_kernels.reconstruction.ray_projector import RayProjector
from lfpiv_kernels.weights import footprint

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera, Calibration

log = logging.getLogger(__name__)

DEFAULTS = Compute()
"""Computation and form of the weights where none are stated."""
METHODS = ("footprint", "count")
FORMS = ("auto", *footprint.FORMS)

Images = dict[str, np.ndarray]


class Weights(Shown):
    """Weights of a grid's voxels on every camera's pixels: a linear operator.

    `build_weights` makes it from a calibration. ``weights(volume)`` returns a dict camera -> image,
    ``weights.T(images)`` a volume.

    Parameters
    ----------
    stored : StoredGrid
        Grid and the order of its voxels in memory.
    cameras : mapping of str to CalibratedCamera
        The cameras.
    projectors : mapping of str to RayProjector
        Weights of each camera.
    method : {"footprint", "count"}
        How the weights were made.
    choices : mapping of str to Choice, optional
        How each camera's footprints were computed.
    counted : mapping of str to CountedVoxels, optional
        Voxels that were counted to choose the form.
    camera_sums : ndarray, shape (camera, voxel), float32, optional
        Known sums of each voxel's weights; default: computed when first needed.
    """

    def __init__(
        self,
        stored: StoredGrid,
        cameras: Mapping[str, CalibratedCamera],
        projectors: Mapping[str, RayProjector],
        method: str,
        *,
        choices: Mapping[str, Choice] | None = None,
        counted: Mapping[str, CountedVoxels] | None = None,
        camera_sums: np.ndarray | None = None,
    ):
        self.stored = stored
        self.cameras = dict(cameras)
        self.method = method
        self._projectors = dict(projectors)
        self._choices = dict(choices or {})
        self._counted = dict(counted or {})
        self._camera_sums = camera_sums
        self.volume = stored.grid
        """Voxels that users see, about which warnings are: without guard layers, perhaps larger; default: the grid."""
        self.derived: dict[tuple[Hashable, ...], Any] = {}
        """What is derived from the weights and kept as long as they are, by its kind and what else it depends on."""

    def card(self) -> Card:
        """Return what matters of the weights, for people."""
        shapes = {name: camera.optics.sensor_shape for name, camera in self.cameras.items()}
        return card_of(self.stored.grid, shapes, self.forms, self.method, self.memory_bytes)

    def of_camera(self, name: str) -> Weights:
        """Return the weights of one of the cameras. They share memory with these."""
        return Weights(self.stored, {name: self.cameras[name]}, {name: self.projector(name)}, self.method)

    def without(self, name: str) -> Weights:
        """Return the weights of all cameras but one. They share memory with these."""
        others = {other: camera for other, camera in self.cameras.items() if other != name}
        return Weights(self.stored, others, {other: self.projector(other) for other in others}, self.method)

    def __call__(self, volume: np.ndarray, out: Images | None = None) -> Images:
        """Project a volume: image[pixel] = sum over voxels of weight * volume (Eq. 4).

        Parameters
        ----------
        volume : array_like, shape (z, y, x)
            Voxel intensities; ndarray or xarray.DataArray.
        out : dict of ndarray, optional
            Images to overwrite, as returned by an earlier call.

        Returns
        -------
        dict of ndarray
            Camera name -> image, shape (rows, columns), float32.

        Raises
        ------
        ValueError
            If a shape does not fit the grid or the sensors.
        """
        flat = self.stored.store(in_order(volume, "volume"))
        images = {}
        for name, camera in self.cameras.items():
            projector = self.projector(name)
            target = np.empty(camera.optics.sensor_shape, np.float32) if out is None else checked_out(out, name, camera)
            projector.project(flat, target.reshape(-1))
            images[name] = np.multiply(target, camera.gain, out=target)
        return images

    @property
    def T(self) -> Adjoint:
        """Adjoint operator: ``weights.T(images)`` sums weight * image over each voxel's pixels."""
        return Adjoint(self)

    def image(self, camera: str, voxel: tuple[int, int, int]) -> np.ndarray:
        """Return the sensor image of one voxel's weights (Fig. 10), white-image gain included.

        Parameters
        ----------
        camera : str
            Camera name.
        voxel : tuple of int
            Index (iz, iy, ix).

        Returns
        -------
        ndarray, shape (rows, columns), float32

        Raises
        ------
        ValueError
            If the camera is unknown or the voxel lies outside the grid.
        """
        if camera not in self.cameras:
            raise ValueError(f"camera: expected one of {', '.join(self.cameras)}, got {camera!r}.")
        setup = self.cameras[camera]
        if len(voxel) != 3 or any(not 0 <= i < n for i, n in zip(voxel, self.grid.shape, strict=True)):
            raise ValueError(f"voxel: expected (iz, iy, ix) inside the grid {self.grid.shape}, got {tuple(voxel)}.")
        image = np.zeros(setup.optics.sensor_shape, np.float32)
        add_entries(image, self._projectors[camera], self.stored.index(voxel))
        return image * setup.gain

    def projector(self, name: str) -> RayProjector:
        """Return one camera's stored weights, without white-image gain."""
        return self._projectors[name]

    @property
    def rows(self) -> int:
        """Sets of rows of pixels under each lens that all cameras can take alone; 1 where they take lenses."""
        return min(projector.rows for projector in self._projectors.values())

    @property
    def grid(self) -> Grid:
        """The voxels."""
        return self.stored.grid

    @property
    def forms(self) -> dict[str, str]:
        """Camera name -> form in which its weights are stored."""
        return {name: projector.form for name, projector in self._projectors.items()}

    def choice(self, name: str) -> Choice:
        """Return how a camera's footprints were computed."""
        return self._choices.get(name) or Choice(form=self._projectors[name].form)

    @property
    def cuts(self) -> dict[str, Cuts]:
        """Camera name -> parts of a voxel along x, y, z whose footprints were added."""
        return {name: choice.cuts for name, choice in self._choices.items()}

    @property
    def profile_errors(self) -> dict[str, list[float]]:
        """Camera name -> relative L2 error of profiles per counted voxel, if counted rays chose the form."""
        return {
            name: list(choice.profile_errors)
            for name, choice in self._choices.items()
            if choice.profile_errors is not None
        }

    @property
    def camera_sums(self) -> np.ndarray:
        """Sum of each voxel's weights over all pixels of each camera, stored order, shape (camera, voxel), float32.

        The first call computes it, and warns if some voxels are seen by only one of several cameras.
        """
        if self._camera_sums is None:
            sums = np.zeros((len(self.cameras), self.grid.size), np.float32)
            for own, name in zip(sums, self.cameras, strict=True):
                self.projector(name).back_project(self.gain(name), own)
            self._camera_sums = sums
            warn_seen_by_one(self.views[self.volume.nearest_in(self.grid)], self.volume, len(self.cameras))
        return self._camera_sums

    def sums_of_set(self, name: str, ray_set: int) -> np.ndarray:
        """Sum each voxel's weights over one camera's pixels that see one set of rays only: (voxel,), stored order."""
        projector, gain = self.projector(name), self.gain(name)
        pixels = projector.exclusive_pixels(ray_set)
        image, sums = np.zeros_like(gain), np.zeros(self.grid.size, np.float32)
        image[pixels] = gain[pixels]
        return projector.back_project(image, sums, ray_set)

    def light_of_sets(self, name: str) -> np.ndarray:
        """Return the light of an evenly lit volume in a camera's pixels that see one set of rays only, shape (set,)."""
        projector, gain = self.projector(name), self.gain(name)
        image = projector.project(np.ones(self.grid.size, np.float32), np.zeros_like(gain))
        pixels = [projector.exclusive_pixels(number) for number in range(projector.ray_sets)]
        return np.array([(gain[own] * image[own]).sum(dtype=np.float64) for own in pixels])

    @property
    def column_sum(self) -> np.ndarray:
        """Sum of each voxel's weights over all pixels of all cameras, shape (z, y, x), float32."""
        total: np.ndarray = sum(self.camera_sums)
        return self.stored.restore(total)

    def gain(self, name: str) -> np.ndarray:
        """Return a camera's white-image gain, shape (pixel,), float32."""
        return np.ascontiguousarray(self.cameras[name].gain, np.float32).reshape(-1)

    @property
    def views(self) -> np.ndarray:
        """Number of cameras that see each voxel, shape (z, y, x), uint8."""
        sums = self.camera_sums
        seen = sums > SEEN_SHARE * sums.max(axis=1, keepdims=True)
        return self.stored.restore(seen.sum(axis=0, dtype=np.uint8))

    @cached_property
    def even_light(self) -> dict[str, EvenLight]:
        """Camera name -> its record of an evenly lit volume. Empty if the cameras share too little of it."""
        projectors = {name: self.projector(name) for name in self.cameras}
        gains = {name: self.gain(name) for name in self.cameras}
        return project_even_light(projectors, gains, self._white_sums())

    def _white_sums(self) -> np.ndarray:
        """Return `camera_sums` with pixels that standing light makes unusable: they hide no part of the volume."""
        sums = self.camera_sums
        for number, (name, camera) in enumerate(self.cameras.items()):
            standing = getattr(camera, "standing", None)  # other models of cameras need none
            if standing is not None and standing.unusable.any():
                sums = sums.copy() if sums is self.camera_sums else sums
                gain = np.ascontiguousarray(camera.white_gain, np.float32).reshape(-1)
                sums[number] = 0
                self.projector(name).back_project(gain, sums[number])
        return sums

    @property
    def affected_pixels(self) -> np.ndarray:
        """Number of pixels that each voxel lights, N_i of Eq. 5, over all cameras, shape (z, y, x), int64.

        A pixel that a voxel reaches through two lenses counts twice.
        """
        total = np.zeros(self.grid.size, np.int64)
        for name in self.cameras:
            total += self.projector(name).count_lit()
        return self.stored.restore(total)

    @cached_property
    def largest(self) -> float:
        """Largest weight, to which Eq. 5 is scaled, without white-image gain.

        A pixel that a voxel reaches through two lenses counts as two pixels.
        """
        return max(self.projector(name).largest_weight() for name in self.cameras)

    @property
    def memory_bytes(self) -> int:
        """Memory of the stored weights [byte]."""
        return sum(projector.nbytes for projector in self._projectors.values())

    def counted(self, name: str) -> CountedVoxels:
        """Return a few voxels of a camera, counted when first needed."""
        if name not in self._counted:
            self._counted[name] = CountedVoxels(self.stored, self.cameras[name])
        return self._counted[name]


def build_weights(
    calibration: Calibration,
    grid: Grid,
    method: str = DEFAULTS.weights,
    *,
    form: str = DEFAULTS.weights_form,
    planes: bool = True,
    particle_voxel: float = 0.0,
    rays: int = DEFAULTS.count_rays,
    limit_bytes: float = math.inf,
    progress: StepProgress | None = None,
) -> Weights:
    """Build the weights of every voxel of a grid on every pixel of every camera (Eq. 10).

    Parameters
    ----------
    calibration : Calibration
        From `calibrate`, `load_calibration` or `thin_lens`.
    grid : Grid
        Voxels.
    method : {"footprint", "count"}
        Area-integrated weights, or counted rays.
    form : {"auto", "profiles", "pixels"}
        How footprints are stored. "profiles": products of a profile along the sensor's columns and one along its rows
        (rank 1), for every voxel and lens or shared by planes of voxels, small and fast, for straight rays and square
        microlenses. "pixels": one value per pixel, for any optics. "auto": profiles for each camera where they agree
        with counted rays.
    planes : bool
        Store profiles that planes of voxels share where that is accurate, see `lfpiv.weights.forms.shared_profiles`, or
        the weights of nodes on planes across each camera's line of sight, see `lfpiv.weights.forms.nodes`. False: the
        weights of every voxel.
    particle_voxel : float
        Standard deviation of the particles [voxel], 0 if unknown. Below 0.85 only cameras near 0, 45 and 90 degrees to
        the grid's axes have planes.
    rays : int
        Rays that are counted per voxel and camera, one of ``compute.count_rays``.
    limit_bytes : float
        Memory that the weights may take [byte]; default: no limit.
    progress : callable, optional
        Called with the finished fraction.

    Raises
    ------
    ValueError
        If `method`, `form` or `rays` is unknown, or profiles are requested for a hexagonal microlens layout.
    InputError
        If the weights would not fit into `limit_bytes`, raised before they are computed. If they do
        not fit into the memory of the GPU beside volumes and images.
    """
    if method not in METHODS:
        raise ValueError(f"method: expected one of {', '.join(METHODS)}, got {method!r}.")
    if form not in FORMS:
        raise ValueError(f"form: expected one of {', '.join(FORMS)}, got {form!r}.")
    cameras = calibration.cameras
    for camera in cameras.values():
        if not hasattr(camera, "microimages"):  # a model of a user's own
            camera.microimages = microimages_of(camera.optics, camera.lattice)
    hexagonal = [name for name, camera in cameras.items() if camera.lattice.layout != "square"]
    if form == "profiles" and hexagonal:
        raise ValueError(f"form: 'profiles' need square microlenses, those of camera {hexagonal[0]!r} are hexagonal.")
    stored = StoredGrid.for_cameras(grid, cameras.values())
    runtime.device()
    footprints = method == "footprint"
    choices, counted = choose_forms(stored, cameras, form) if footprints else ({}, {})
    rig = Rig(
        stored=stored,
        cameras=cameras,
        memory=MemoryLeft(cameras.values(), grid, limit_bytes),
        choices=choices,
        rays=0 if footprints else rays,
        shared=planes and footprints,
        particle_voxel=particle_voxel,
    )
    whole, order = progress or (lambda fraction: None), list(cameras)

    def step(name: str) -> StepProgress:
        return part_of(whole, order.index(name) / len(order), (order.index(name) + 1) / len(order))

    stored, projectors = table.build(rig, step)
    weights = Weights(stored, cameras, projectors, method, choices=choices, counted=counted)
    log.info("weights: %d voxels, %d cameras, %s", grid.size, len(cameras), size_text(weights.memory_bytes))
    return weights

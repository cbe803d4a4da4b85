"""`build_weights`: calibrated mapping x grid -> the weights of Eq. 10 as a linear operator.

``weights(volume)`` projects a volume to images, ``weights.T(images)`` is its adjoint. Two methods give the weights:
"footprint" integrates them over voxel, pupil pixel and microlens in closed form; "count" traces rays and counts them,
as the paper does, and judges the other. Both are stored as 8-bit blocks with a scale per voxel; the footprint in one of
two forms, chosen for each camera by a few counted voxels: products of profiles, or one value per pixel.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from lfpiv.calibration.coverage import SEEN_SHARE, warn_seen_by_one
from lfpiv.errors import InputError
from lfpiv.geometry.grid import Grid
from lfpiv.geometry.volume import in_order
from lfpiv.weights.blocks import (
    BLOCK_BYTES,
    CHUNK_VOXELS,
    VOXEL_BYTES,
    Cuts,
    StoredGrid,
    count_voxels,
    footprint_blocks,
    largest_weight,
    pack_camera,
    sample_blocks,
)
from lfpiv.weights.choice import Choice, CountedVoxels, add_entries, add_window, choose_cuts, choose_form, count_blocks
from lfpiv_kernels import runtime
from lfpiv_kernels.reconstruction.projector import Blocks, Projector
from lfpiv_kernels.weights import footprint
from lfpiv_kernels.weights.ray_model import MODEL_SIZE

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera, Calibration

log = logging.getLogger(__name__)

METHODS = ("footprint", "count")
FORMS = ("auto", *footprint.FORMS)
COUNT_SAMPLES_ONE = 144
"""Pupil points per axis for one voxel's image: the paper's 0.05 degrees."""

Images = dict[str, np.ndarray]
Progress = Callable[[float], None]


class Weights:
    """The weights of a grid's voxels on every camera's pixels, a linear operator.

    Made by `build_weights`. ``weights(volume)`` returns a dict camera -> image, ``weights.T(images)`` a volume.
    """

    _camera_sums: np.ndarray | None = None
    _largest: float | None = None

    def __init__(
        self,
        cameras: Mapping[str, CalibratedCamera],
        grid: Grid,
        method: str,
        form: str = "auto",
        limit_bytes: float = math.inf,
        progress: Progress | None = None,
    ):
        self.cameras = dict(cameras)
        self.grid = grid
        self.method = method
        self.stored = StoredGrid.for_cameras(grid, self.cameras.values())
        self.forms: dict[str, str] = {}
        """Camera name -> form in which its weights are stored."""
        self.cuts: dict[str, Cuts] = {}
        """Camera name -> parts of a voxel along x, y, z whose footprints were added."""
        self.profile_errors: dict[str, list[float]] = {}
        """Camera name -> difference of profiles from counted rays, where these decided the form."""
        self._asked, self._limit_bytes = form, limit_bytes
        self._counted: dict[str, CountedVoxels] = {}
        self._projectors: dict[str, Projector] = {}
        if method == "footprint":  # counting a whole grid takes long: it waits until the operator is applied
            self._build(progress)

    @classmethod
    def from_blocks(
        cls,
        cameras: Mapping[str, CalibratedCamera],
        stored: StoredGrid,
        method: str,
        blocks: Mapping[str, Blocks],
        camera_sums: np.ndarray | None = None,
    ) -> Weights:
        """Weights of blocks that were built before, one per camera: see `lfpiv.weights.storage`."""
        weights = cls(cameras, stored.grid, "count")  # builds nothing yet
        weights.stored, weights.method, weights._camera_sums = stored, method, camera_sums
        weights.forms = {name: part.form for name, part in blocks.items()}
        weights._projectors = {name: Projector(part) for name, part in blocks.items()}
        return weights

    def of_camera(self, name: str) -> Weights:
        """Weights of one of the cameras; its blocks are shared."""
        one = Weights({name: self.cameras[name]}, self.grid, "count")  # builds nothing
        one.stored, one.method = self.stored, self.method
        one._projectors = {name: self.projector(name)}
        if name in self.forms:
            one.forms = {name: self.forms[name]}
        return one

    # -- the operator ----------------------------------------------------------------------------------------------

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
            target = (
                np.empty(camera.optics.sensor_shape, np.float32) if out is None else _checked_out(out, name, camera)
            )
            projector.project(flat, target.reshape(-1))
            images[name] = np.multiply(target, camera.gain, out=target)
        return images

    @property
    def T(self) -> Adjoint:
        """The adjoint operator: ``weights.T(images)`` sums weight * image over each voxel's pixels."""
        return Adjoint(self)

    def image(self, camera: str, voxel: tuple[int, int, int]) -> np.ndarray:
        """Sensor image of one voxel's weights (Fig. 10), white-image gain included.

        Parameters
        ----------
        camera : str
            Camera name.
        voxel : tuple of int
            Index (iz, iy, ix).

        Returns
        -------
        ndarray, shape (rows, columns), float32
        """
        setup = self._camera(camera)
        if len(voxel) != 3 or any(not 0 <= i < n for i, n in zip(voxel, self.grid.shape, strict=True)):
            raise ValueError(f"voxel: expected (iz, iy, ix) inside the grid {self.grid.shape}, got {tuple(voxel)}.")
        image = np.zeros(setup.optics.sensor_shape, np.float32)
        index = self.stored.place(voxel)
        if self.method == "count" and not self._projectors:
            centre = self.stored.centres_mm(np.array([index]))
            counts, total, corner = count_voxels(setup, centre, self.grid.voxel_mm, samples=COUNT_SAMPLES_ONE)
            add_window(image, counts[0] / max(int(total[0]), 1), corner[0])
        else:
            add_entries(image, self.projector(camera).blocks, index)
        weights: np.ndarray = image * setup.gain
        return weights

    @property
    def camera_sums(self) -> np.ndarray:
        """Sum of each voxel's weights over all pixels of each camera, stored order, shape (camera, voxel), float32.

        Where they are made, voxels that but one of several cameras sees are warned of.
        """
        if self._camera_sums is None:
            self._camera_sums = np.zeros((len(self.cameras), self.grid.size), np.float32)
            for own, (name, camera) in zip(self._camera_sums, self.cameras.items(), strict=True):
                self.projector(name).back_project(np.asarray(camera.gain, np.float32).reshape(-1), own)
            warn_seen_by_one(self.views, self.grid, len(self.cameras))
        return self._camera_sums

    @property
    def column_sum(self) -> np.ndarray:
        """Sum of each voxel's weights over all pixels of all cameras, shape (z, y, x), float32."""
        total: np.ndarray = sum(self.camera_sums)
        return self.stored.restore(total)

    @property
    def views(self) -> np.ndarray:
        """Number of cameras that see each voxel, shape (z, y, x), uint8."""
        sums = self.camera_sums
        seen = sums > SEEN_SHARE * sums.max(axis=1, keepdims=True)
        return self.stored.restore(seen.sum(axis=0, dtype=np.uint8))

    @property
    def affected_pixels(self) -> np.ndarray:
        """Number of pixels that each voxel lights, N_i of Eq. 5, over all cameras, shape (z, y, x), int64.

        A pixel that a voxel reaches through two lenses counts twice.
        """
        self._build()
        total = np.zeros(self.grid.size, np.int64)
        for projector in self._projectors.values():
            total += projector.count_lit()
        return self.stored.restore(total)

    @property
    def largest(self) -> float:
        """Largest weight of all, which Eq. 5 is scaled by; white-image gain left out.

        That of a pixel that a voxel reaches through two lenses counts as two.
        """
        if self._largest is None:
            self._build()
            self._largest = max(largest_weight(projector.blocks) for projector in self._projectors.values())
        return self._largest

    @property
    def memory_bytes(self) -> int:
        """Memory of the stored weights [byte]."""
        return sum(projector.blocks.nbytes for projector in self._projectors.values())

    # -- what reconstruction works on: voxels in stored order ---------------------------------------------------------

    def projector(self, name: str) -> Projector:
        """One camera's stored weights, white-image gain left out; built where they are not yet."""
        self._build()
        return self._projectors[name]

    def counted(self, name: str) -> CountedVoxels:
        """Return a few voxels of a camera, counted."""
        if name not in self._counted:
            self._counted[name] = CountedVoxels(self.stored, self.cameras[name])
        return self._counted[name]

    def _camera(self, name: str) -> CalibratedCamera:
        if name not in self.cameras:
            raise ValueError(f"camera: expected one of {', '.join(self.cameras)}, got {name!r}.")
        return self.cameras[name]

    def _build(self, progress: Progress | None = None) -> None:
        if len(self._projectors) == len(self.cameras):
            return
        runtime.device()
        for number, name in enumerate(self.cameras):

            def step(fraction: float, number: int = number) -> None:
                if progress is not None:
                    progress((number + fraction) / len(self.cameras))

            self._projectors[name] = Projector(self._blocks(name, step))

    def _blocks(self, name: str, progress: Progress) -> Blocks:
        camera = self.cameras[name]
        if self.method == "count":
            return count_blocks(self.stored, camera, progress)
        choice = self._choose(name, camera)
        self.forms[name], self.cuts[name] = choice.form, choice.cuts
        return footprint_blocks(self.stored, camera, choice.form, progress, self._allow(name), choice.cuts)

    def _allow(self, name: str) -> Callable[[int], None]:
        """Check of one camera's memory before it is taken."""
        form, errors, other = self.forms[name], self.profile_errors.get(name), ""
        if errors and form == "pixels":
            other = f", or set compute.weights_form to 'profiles', {100 * np.mean(errors):.0f} % from counted rays here"
        what = f"{' x '.join(map(str, self.grid.shape))} voxels (z, y, x) on camera {name!r}"

        def allow(needed: int) -> None:
            left = self._limit_bytes - self.memory_bytes
            if needed > left:
                raise InputError(
                    f"volume: the weights of {what} need {needed / 2**30:.1f} GiB as {form}, "
                    f"{max(left, 0) / 2**30:.1f} GiB are left. Raise volume.voxel_mm, shrink volume.size_mm{other}."
                )

        return allow

    def _choose(self, name: str, camera: CalibratedCamera) -> Choice:
        """Form of a camera's weights: profiles where counted rays say that they serve."""
        if self._asked == "profiles":
            return Choice(form="profiles")
        if self._asked == "pixels" or camera.lattice.layout != "square":
            if self._asked == "auto":
                log.info("%s: weights pixel by pixel: profiles need a square microlens layout", name)
            return Choice(form="pixels", cuts=choose_cuts(self.stored, camera))
        choice = choose_form(self.counted(name))
        self.profile_errors[name] = choice.profile_errors
        return choice


class Adjoint:
    """The adjoint of `Weights`; ``adjoint.T`` is the operator itself."""

    def __init__(self, weights: Weights):
        self.T = weights

    def __call__(self, images: Mapping[str, np.ndarray], out: np.ndarray | None = None) -> np.ndarray:
        """Back-project images: volume[voxel] = sum over cameras and pixels of weight * image.

        Parameters
        ----------
        images : mapping of str to ndarray
            Camera name -> image, shape (rows, columns); every camera of the operator.
        out : ndarray, shape (z, y, x), float32, optional
            Volume to overwrite.

        Returns
        -------
        ndarray, shape (z, y, x), float32

        Raises
        ------
        ValueError
            If a camera is missing or a shape does not fit.
        """
        weights = self.T
        flat = np.zeros(weights.grid.size, np.float32)
        for name, camera in weights.cameras.items():
            image = np.multiply(_checked_image(images, name, camera), camera.gain, dtype=np.float32)
            weights.projector(name).back_project(image.reshape(-1), flat)
        volume = weights.stored.restore(flat)
        if out is None:
            return volume
        if out.shape != volume.shape:
            raise ValueError(f"out: expected shape {volume.shape} (z, y, x), got {out.shape}.")
        out[:] = volume
        return out


def build_weights(
    calibration: Calibration,
    grid: Grid,
    method: str = "footprint",
    *,
    form: str = "auto",
    limit_bytes: float = math.inf,
    progress: Progress | None = None,
) -> Weights:
    """Weights of every voxel of a grid on every pixel of every camera (Eq. 10).

    Parameters
    ----------
    calibration : Calibration
        From `calibrate`, `load_calibration` or `thin_lens`.
    grid : Grid
        Voxels.
    method : {"footprint", "count"}
        Area-integrated weights, or counted rays: slow on a whole grid, where nothing is computed before the operator or
        `Weights.image` is called.
    form : {"auto", "profiles", "pixels"}
        How footprints are stored. "profiles": products of a profile along the sensor's columns and one along its rows
        for every voxel and lens (rank 1), small and fast, for straight rays and square microlenses. "pixels": one value
        per pixel, for any optics. "auto": profiles for each camera where they agree with counted rays.
    limit_bytes : float
        Memory that the weights may take [byte]; default: no limit.
    progress : callable, optional
        Called with the finished fraction.

    Returns
    -------
    Weights

    Raises
    ------
    ValueError
        If `method` or `form` is unknown, profiles are asked for a hexagonal microlens layout, or the weights do not fit
        into `limit_bytes`: before they are stored.
    """
    if method not in METHODS:
        raise ValueError(f"method: expected one of {', '.join(METHODS)}, got {method!r}.")
    if form not in FORMS:
        raise ValueError(f"form: expected one of {', '.join(FORMS)}, got {form!r}.")
    hexagonal = [name for name, camera in calibration.cameras.items() if camera.lattice.layout != "square"]
    if form == "profiles" and hexagonal:
        raise ValueError(f"form: 'profiles' need square microlenses, those of camera {hexagonal[0]!r} are hexagonal.")
    weights = Weights(calibration.cameras, grid, method, form, limit_bytes, progress)
    if method == "footprint":
        log.info(
            "weights of %d voxels on %d cameras: %.0f MiB",
            grid.size,
            len(weights.cameras),
            weights.memory_bytes / 2**20,
        )
    return weights


def estimate_memory(calibration: Calibration, grid: Grid, form: str = "auto") -> int:
    """Memory that the weights of a grid will need [byte], from a sample of its voxels; nothing large is allocated.

    With the form "auto" that of profiles where the microlens layout allows them: what will do for straight rays.
    """
    runtime.device()
    total = 0.0
    stored = StoredGrid(grid, (0, 1, 2))
    for camera in calibration.cameras.values():
        chosen = form if form != "auto" else "profiles" if camera.lattice.layout == "square" else "pixels"
        pack = pack_camera(camera)
        blocks, values = sample_blocks(pack, stored, chosen)
        rays = 4 * (5 + 2) * camera.microimages.size + 24 * runtime.CHUNKS
        total += (BLOCK_BYTES * blocks + values + VOXEL_BYTES) * grid.size + 4 * MODEL_SIZE * CHUNK_VOXELS + rays
    return int(total)


def compare_with_count(weights: Weights) -> dict[str, list[float]]:
    """Relative L2 difference of stored weights from counted rays, for a few random voxels of every camera.

    Returns camera name -> one figure per voxel that the camera sees; the count's own noise is subtracted. Warns where
    weights whose form the counts did not choose are further from them than aimed at.
    """
    errors = {name: weights.counted(name).errors(weights.projector(name).blocks) for name in weights.cameras}
    for name, some in errors.items():
        if name not in weights.profile_errors and weights.method == "footprint":
            weights.counted(name).warn(weights.forms[name], some, asked=True)
    return errors


def _checked_image(images: Mapping[str, np.ndarray], name: str, camera: CalibratedCamera) -> np.ndarray:
    if name not in images:
        raise ValueError(f"images: camera {name!r} is missing; found {', '.join(images) or 'none'}.")
    image = np.asarray(images[name])
    if image.shape != camera.optics.sensor_shape:
        raise ValueError(f"images[{name!r}]: expected shape {camera.optics.sensor_shape}, got {image.shape}.")
    return image


def _checked_out(images: Mapping[str, np.ndarray], name: str, camera: CalibratedCamera) -> np.ndarray:
    image = _checked_image(images, name, camera)
    if image is not images[name] or image.dtype != np.float32 or not image.flags.c_contiguous:
        raise ValueError(f"out[{name!r}]: expected a C-contiguous float32 array to write into.")
    return image

"""Scene files of the simulator: cameras, board, particles and flow with their true values, as frozen models."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, ValidationError, ValidationInfo, field_validator, model_serializer, model_validator
from pydantic_core.core_schema import SerializerFunctionWrapHandler

from lfpiv.errors import InputError
from lfpiv.experiment.toml import read_toml
from lfpiv.settings import bounds
from lfpiv.settings.bounds import (
    Flag,
    Interval,
    Length,
    Name,
    NonNegative,
    Point,
    Positive,
    Rays,
    Seed,
    Thickness,
)
from lfpiv.settings.processing import Compute, Correlation, Network, Smart
from lfpiv.settings.rig import NominalBoard
from lfpiv.settings.table import Table
from lfpiv.settings.volume import Volume
from lfpiv.simulation.board_errors import BoardErrors
from lfpiv.simulation.flows import Flow, Tracers, tracer_series
from lfpiv.simulation.image_files import check_pattern
from lfpiv.simulation.lens import Lens
from lfpiv.simulation.light import Brightness, Sheet, StrayLight
from lfpiv.simulation.scene_camera import (
    SHARED_TABLES,
    Aberrations,
    ArrayFaults,
    SceneCamera,
    Windows,
    true_mapping,
)
from lfpiv.simulation.sensor import Noise, Sensor
from lfpiv.simulation.surfaces import Surfaces, Walls, solid
from lfpiv.simulation.turbulence import Turbulence, TurbulentFlow

__all__ = ["Noise", "Scene", "SceneCamera", "open_scene", "true_mapping"]


class SceneBoard(NominalBoard):
    """Table ``[board]``: the calibration board and its depths."""

    inverted: Flag = False
    """Dark dots on a bright board."""
    errors: BoardErrors | None = None
    """Errors of stage, dots and light."""

    @model_validator(mode="after")
    def _errors_of_bright_dots(self) -> SceneBoard:
        if self.inverted and self.errors is not None:
            raise ValueError("no table errors with inverted = true: errors are simulated of bright dots only")
        return self

    @model_validator(mode="after")
    def _mark_of_bright_dots(self) -> SceneBoard:
        if self.inverted and self.mark:
            raise ValueError("no mark with inverted = true: a mark is simulated of bright dots only")
        return self

    def dots_mm(self, plane_mm: float) -> np.ndarray:
        """Return the dot centres (x, y, z) at one depth, x fastest, without the mark's, shape (dot, 3) [mm]."""
        x, y = ((np.arange(n) - (n - 1) / 2) * self.spacing_mm for n in self.dots)
        y, x = np.meshgrid(y, x, indexing="ij")
        dot = np.ones((self.dots[1], self.dots[0]), bool)
        for column, row in self.mark:
            dot[row, column] = False
        return np.stack([x[dot], y[dot], np.full(dot.sum(), float(plane_mm))], axis=1)


class SceneVolume(Volume):
    """Table ``[volume]``: the volume to reconstruct, (x, y, z) order."""

    centre_mm: Point = (0.0, 0.0, 0.0)
    """Centre (x, y, z) of the volume [mm]."""


LARGEST_SEEDING = 1e4
"""Largest number of particles per microlens."""
LARGEST_FILL = 1e3
"""Largest edge of the seeded region relative to the volume's."""


class SceneParticles(Table):
    """Table ``[particles]``: number, intensity and size of the particles."""

    per_microlens: Annotated[float, Field(strict=True, gt=0, le=LARGEST_SEEDING)] | None = None
    """Particles per microlens of the seeded region's x-y face (the paper's ppm). Alternative to `count`."""
    count: Annotated[int, Field(strict=True, ge=1, le=bounds.MOST_PARTICLES)] | None = None
    """Particles of each pair or instant, before those in walls are removed."""
    pairs: Annotated[int, Field(strict=True, ge=1, le=bounds.MOST_SIMULATED_PAIRS)] = 1
    """Number of image pairs, each with other particles."""
    instants: Annotated[int, Field(strict=True, ge=2, le=bounds.MOST_SIMULATED_PAIRS)] | None = None
    """Number of instants of a time series, in place of `pairs`: the same particles are carried by the flow, enter and
    leave through the faces of the seeded region, and keep their brightness."""
    first: Annotated[int, Field(strict=True, ge=0, le=bounds.MOST)] = 0
    """Number of a series' first instant."""
    step: bounds.Count = 1
    """Number of instants between the two that are correlated, `dt_s` apart."""
    images: bounds.PathText = "particles/{camera}/instant_{instant:06d}.tif"
    """Path of a series' images with ``{camera}`` and ``{instant}``. Behind `#` it names a page of a TIFF file or an
    image of an HDF5 dataset: ``{camera}.tif#{instant}`` or ``{camera}.h5#images[{instant}]``."""
    fill: Annotated[float, Field(strict=True, gt=0, le=LARGEST_FILL)] = 1.0
    """Edges of the seeded region relative to the volume's. Above 1, particles are outside the volume too."""
    margin_mm: tuple[Thickness, Thickness, Thickness] | None = None
    """Distance by which the seeded region reaches beyond `fill` times the volume on each side (x, y, z), for light that
    reaches farther than the volume. `per_microlens` then holds within the volume, `count` in all [mm]."""
    intensity_sd: NonNegative = 0.0
    """Standard deviation of the particles' intensity about 1."""
    sigma_mm: Length | None = None
    """Standard deviation of Gaussian particles [mm]."""
    radius_mm: Length | None = None
    """Radius of spheres that emit evenly from their volume [mm]. Without `sigma_mm` and this, particles are points."""

    @model_validator(mode="after")
    def _one_of_each(self) -> SceneParticles:
        if (self.per_microlens is None) == (self.count is None):
            raise ValueError("either per_microlens or count")
        if self.sigma_mm is not None and self.radius_mm is not None:
            raise ValueError("at most one of sigma_mm and radius_mm")
        return self

    @model_validator(mode="after")
    def _pairs_or_series(self) -> SceneParticles:
        if self.instants is None:
            unused = sorted({"first", "step", "images"} & self.model_fields_set)
            if unused:
                raise ValueError(f"{unused[0]} only with instants, the number of instants of a time series")
            return self
        if "pairs" in self.model_fields_set:
            raise ValueError("either pairs or instants")
        if self.step >= self.instants:
            raise ValueError(f"step below the {self.instants} instants, so that one has a partner")
        check_pattern(self.images, range(self.first, self.first + self.instants))
        return self

    @model_serializer(mode="wrap")
    def _keys_of_its_kind(self, serialise: SerializerFunctionWrapHandler) -> dict[str, Any]:
        table: dict[str, Any] = serialise(self)
        unused = ("instants", "first", "step", "images") if self.instants is None else ("pairs",)
        return {key: value for key, value in table.items() if key not in unused}


class Exposure(Table):
    """Table ``[exposure]``: levels of pixels above the background [count]."""

    white_counts: Positive = 2700.0
    """Level of a pixel that is completely inside a microimage of the white image."""
    dot_counts: Positive = 3500.0
    """Level of a pixel of a microlens that only the bright part of the board lights."""
    particle_counts: Positive = 600.0
    """Level of a pixel lit by one point-like particle of intensity 1, whose light covers the area of a microimage."""


class Background(Table):
    """Table ``[background]``: images of each camera and frame without particles (`background_image` of experiments)."""

    averaged: Annotated[int, Field(strict=True, ge=1, le=1000)] = 1
    """Number of recordings whose mean is written, rounded to whole counts."""


class Quality(Table):
    """Table ``[quality]``: numbers of rays, rounded up to powers of two."""

    particle_rays: Rays = 32_768
    """Rays of each particle."""
    dot_rays: Rays = 131_072
    """Rays of each board dot."""
    pixel_rays: Rays = 256
    """Rays of each pixel of white images and of boards with dark dots."""


class Scene(Table):
    """Scene file. `smart`, `correlation`, `network` and `compute` are copied into the experiment file."""

    name: Name
    """Name of the experiment."""
    seed: Seed = 0
    """Seed of all random numbers."""
    dt_s: Interval
    """Time between the two frames of a pair, or between instants k and k + step of a series [s]."""
    camera: Annotated[tuple[SceneCamera, ...], Field(min_length=1, max_length=bounds.MOST_CAMERAS)]
    window: Windows = ()
    """Windows of all cameras that state none."""
    aberrations: Aberrations | None = None
    """Aberrations of all cameras that state none."""
    lens: Lens | None = None
    """Main lens of all cameras that state none."""
    array: ArrayFaults | None = None
    """Faults of the microlens arrays of all cameras that state none."""
    sensor: Sensor | None = None
    """Sensor of all cameras that state none."""
    board: SceneBoard
    volume: SceneVolume
    particles: SceneParticles
    flow: Annotated[Flow, Field(discriminator="kind")]
    """Displacement within `dt_s`, equal for all pairs, steady in a series but for tracers at several instants. With
    turbulence it is the mean."""
    turbulence: Turbulence | None = None
    """Fluctuation added to the flow, different for each pair, steady in a series."""
    sheet: Sheet | None = None
    """Light sheet; absent: both pulses light all particles alike."""
    brightness: Brightness | None = None
    """Scatter of the particles' brightness."""
    stray_light: StrayLight | None = None
    """Light in the particle images that is not from particles."""
    surface: Surfaces | None = None
    """Bright surfaces in the particle images."""
    wall: Walls | None = None
    """Solid regions without particles."""
    background: Background | None = None
    """Images without particles."""
    exposure: Exposure = Exposure()
    noise: Noise = Noise()
    quality: Quality = Quality()
    smart: Smart = Smart()
    correlation: Correlation = Correlation()
    network: Network = Network()
    compute: Compute = Compute()

    @field_validator("camera")
    @classmethod
    def _names_differ(cls, cameras: tuple[SceneCamera, ...]) -> tuple[SceneCamera, ...]:
        if len({camera.name for camera in cameras}) != len(cameras):
            raise ValueError("a different name for each camera")
        return cameras

    @field_validator("window", "aberrations", "lens")
    @classmethod
    def _suit_every_camera(cls, value: Any, info: ValidationInfo) -> Any:
        try:
            for camera in info.data.get("camera", ()):
                camera.with_shared({"window": (), "aberrations": None, "lens": None} | {str(info.field_name): value})
        except ValidationError as error:
            raise error.errors()[0]["ctx"]["error"] from None
        return value

    @field_validator("turbulence")
    @classmethod
    def _not_on_given_tracers(cls, turbulence: Turbulence | None, info: ValidationInfo) -> Turbulence | None:
        if turbulence is not None and getattr(info.data.get("flow"), "as_given", False):
            raise ValueError("no turbulence on top of tracers that move as_given")
        return turbulence

    @model_validator(mode="after")
    def _series_of_one_kind(self) -> Scene:
        particles, flow = self.particles, self.flow
        of_series = tracer_series(flow) is not None
        if particles.instants is None:
            if of_series:
                raise ValueError("particles.instants with flow.series, tracers at several instants")
            return self
        if isinstance(flow, Tracers) and flow.as_given and not of_series:
            raise ValueError("flow.series for tracers that move as_given in a time series: first and second are two")
        if self.smart.estimate == "joint":
            raise ValueError("smart.estimate = 'correlation' with a time series")
        return self

    @model_validator(mode="after")
    def _hand_optics_to_cameras(self) -> Scene:
        shared = {name: getattr(self, name) for name in SHARED_TABLES}
        cameras = tuple(camera.with_shared(shared) for camera in self.camera)
        object.__setattr__(self, "camera", cameras)
        return self

    def solid(self, points_mm: np.ndarray) -> np.ndarray:
        """Return which points (n, 3) [mm] are in a wall, shape (n,)."""
        return solid(self.wall, points_mm)

    def flow_of(self, pair: int) -> Callable[[np.ndarray], np.ndarray]:
        """Return the flow of one pair, mean and turbulence, as a function of points (n, 3) [mm].

        A pair of a series has the number of its first instant.
        """
        flow, series = self.flow, self.particles.instants is not None
        mean: Callable[[np.ndarray], np.ndarray] = flow
        if (tracers := tracer_series(flow)) is not None:
            instant = pair - self.particles.first
            mean = tracers.between(instant, instant + self.particles.step)
        if self.turbulence is None:
            return mean
        return TurbulentFlow(mean, self.turbulence.realisation(seed=(self.seed, 7, 0 if series else pair)))


def open_scene(path: str | Path) -> Scene:
    """Read a scene file.

    Parameters
    ----------
    path : str or Path
        TOML file with the tables of `Scene`. The path of a tracer file is relative to it.

    Raises
    ------
    InputError
        If the file cannot be read, or a key is unknown, missing or out of range.
    """
    path = Path(path)
    scene = read_toml(path, Scene)
    if isinstance(scene.flow, Tracers):
        flow = scene.flow.model_copy(update={"file": str((path.parent / scene.flow.file).absolute())})
        # refuse a missing or unsuitable file before any work
        if flow.is_series:
            flow.positions()
        else:
            flow.tracers()
        scene = scene.model_copy(update={"flow": flow})
    if any(camera.lens is not None and camera.lens.file is not None for camera in scene.camera):
        scene = scene.model_copy(update={"camera": tuple(_with_lens(path, camera) for camera in scene.camera)})
    return scene


def stored_scene(folder: str | Path) -> Scene:
    """Read the scene that a simulated experiment keeps in its folder ``truth``.

    Parameters
    ----------
    folder : str or Path
        The folder ``truth``. The path of a tracer file is relative to it.

    Raises
    ------
    OSError
        If there is no file ``spec.json``, or it cannot be read.
    ValueError
        If it is no scene.
    """
    folder = Path(folder)
    scene = Scene.model_validate(json.loads((folder / "spec.json").read_text("utf-8")))
    if isinstance(scene.flow, Tracers):  # an absolute path stays as it is
        flow = scene.flow.model_copy(update={"file": str(folder.absolute() / scene.flow.file)})
        scene = scene.model_copy(update={"flow": flow})
    return scene


def _with_lens(path: Path, camera: SceneCamera) -> SceneCamera:
    """Return a camera with the surfaces that its lens's file states."""
    if camera.lens is None:
        return camera
    lens = camera.lens.read(path.parent)
    try:
        return SceneCamera.model_validate(dict(camera) | {"lens": lens})
    except ValidationError as error:
        raise InputError(f"{path}: camera {camera.name!r}: lens.file: {error.errors()[0]['msg']}.") from None

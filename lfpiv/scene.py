"""Scene files of the simulator: what the cameras, the board, the particles and the flow truly are, as frozen models."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from lfpiv.flows import KINDS, Flow, Tracers
from lfpiv.rig import LensLattice, Optics
from lfpiv.settings import Compute, Correlation, Count, Flag, Network, Number, Positive, Smart, Table
from lfpiv.toml import read_toml

NonNegative = Annotated[float, Field(strict=True, ge=0)]
Pair = tuple[Number, Number]
Point = tuple[Number, Number, Number]


class SceneCamera(Table):
    """Table ``[[camera]]``: nominal optics, which the user is told, and what is true, which the user is not."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")]
    focal_length_mm: Positive
    magnification: Number
    f_number: Positive
    microlens_pitch_mm: Positive
    microlens_focal_length_mm: Positive
    pixel_um: Positive
    sensor_width_px: Count
    sensor_height_px: Count
    microlens_layout: Literal["square", "hexagonal"] = "square"
    nominal_angle_deg: Annotated[float, Field(strict=True, ge=-180, le=180)]
    true_yaw_deg: Number | None = None
    """True camera angle about y [degree]; absent: the nominal one."""
    true_pitch_deg: Number = 0.0
    true_roll_deg: Number = 0.0
    """Right-handed rotations about the camera's x and z axis, after the yaw [degree]."""
    true_offset_mm: Point = (0.0, 0.0, 0.0)
    """World point that lies on the camera's axis and in focus (x, y, z) [mm]."""
    true_array_roll_deg: Number = 0.0
    """Rotation of the microlens array on the sensor [degree]."""
    true_array_offset_mm: Pair = (0.0, 0.0)
    """Centre (s, t) of a lens, relative to the sensor's centre [mm]."""
    true_microlens_pitch_mm: Positive | None = None
    """True pitch of the array [mm]; absent: the nominal one."""
    blur_px: NonNegative = 0.4
    """Standard deviation of the sensor's Gaussian point spread [pixel]."""
    vignetting: Annotated[float, Field(strict=True, ge=0, lt=1)] = 0.0
    """Fraction of the light lost in the sensor's corners; the loss grows with the square of the distance."""
    lens_gain_sd: Annotated[float, Field(strict=True, ge=0, lt=0.5)] = 0.0
    """Standard deviation of the microlenses' transmission."""
    dark_image: Flag = False
    """Whether a dark image is recorded."""
    image_flip: Literal["none", "horizontal", "vertical", "both"] = "none"
    """How the recorded images are mirrored."""

    @field_validator("magnification")
    @classmethod
    def _not_zero(cls, value: float) -> float:
        if value == 0:
            raise ValueError("a number other than 0")
        return value

    @property
    def optics(self) -> Optics:
        """Nominal optics."""
        return Optics(
            focal_length_mm=self.focal_length_mm,
            magnification=self.magnification,
            f_number=self.f_number,
            microlens_pitch_mm=self.microlens_pitch_mm,
            microlens_focal_length_mm=self.microlens_focal_length_mm,
            pixel_mm=self.pixel_um / 1000,
            sensor_shape=(self.sensor_height_px, self.sensor_width_px),
            layout=self.microlens_layout,
        )

    @property
    def rotation(self) -> np.ndarray:
        """World to camera, Rz Rx Ry with Ry the rotation of Eqs. 1-3, shape (3, 3)."""
        yaw = self.nominal_angle_deg if self.true_yaw_deg is None else self.true_yaw_deg
        (cy, sy), (cx, sx), (cz, sz) = (
            (np.cos(angle), np.sin(angle)) for angle in np.radians([yaw, self.true_pitch_deg, self.true_roll_deg])
        )
        about_y = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
        about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
        about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
        return about_z @ about_x @ about_y

    @property
    def lattice(self) -> LensLattice:
        """The true microlens array in its own plane."""
        pitch = self.true_microlens_pitch_mm or self.microlens_pitch_mm
        roll = np.radians(self.true_array_roll_deg)
        second = np.radians(60 if self.microlens_layout == "hexagonal" else 90)
        basis = [(pitch * np.cos(angle + roll), pitch * np.sin(angle + roll)) for angle in (0.0, second)]
        return LensLattice(origin_mm=self.true_array_offset_mm, basis_mm=tuple(basis), layout=self.microlens_layout)


class SceneBoard(Table):
    """Table ``[board]``: the calibration board and its depths."""

    dots: tuple[Annotated[int, Field(strict=True, ge=2)], Annotated[int, Field(strict=True, ge=2)]]
    spacing_mm: Positive
    dot_diameter_mm: Positive
    planes_mm: Annotated[tuple[Number, ...], Field(min_length=2)]
    inverted: Flag = False
    """Dark dots on a bright board."""

    @model_validator(mode="after")
    def _dots_apart(self) -> SceneBoard:
        if self.dot_diameter_mm >= self.spacing_mm:
            raise ValueError("dot_diameter_mm smaller than spacing_mm")
        return self

    def dots_mm(self, plane_mm: float) -> np.ndarray:
        """Dot centres (x, y, z) at one depth, x fastest, shape (dot, 3) [mm]."""
        x, y = ((np.arange(n) - (n - 1) / 2) * self.spacing_mm for n in self.dots)
        y, x = np.meshgrid(y, x, indexing="ij")
        return np.stack([x.ravel(), y.ravel(), np.full(x.size, float(plane_mm))], axis=1)


class SceneVolume(Table):
    """Table ``[volume]``: the volume to reconstruct, (x, y, z) order."""

    centre_mm: Point = (0.0, 0.0, 0.0)
    size_mm: tuple[Positive, Positive, Positive]
    voxel_mm: Positive


class SceneParticles(Table):
    """Table ``[particles]``: how many, how bright, how large."""

    per_microlens: Positive | None = None
    """Particles per microlens of the seeded region's x-y face (the paper's ppm); give this or `count`."""
    count: Count | None = None
    """Particles of each pair."""
    pairs: Count = 1
    fill: Positive = 1.0
    """Edges of the seeded region relative to the volume's; above 1 there are particles outside the volume too."""
    intensity_sd: NonNegative = 0.0
    """Standard deviation of the particles' intensity about 1."""
    sigma_mm: Positive | None = None
    """Standard deviation of Gaussian particles [mm]."""
    radius_mm: Positive | None = None
    """Radius of spheres that shine evenly from their volume [mm]; without either, particles are points."""

    @model_validator(mode="after")
    def _one_of_each(self) -> SceneParticles:
        if (self.per_microlens is None) == (self.count is None):
            raise ValueError("either per_microlens or count")
        if self.sigma_mm is not None and self.radius_mm is not None:
            raise ValueError("at most one of sigma_mm and radius_mm")
        return self


class Exposure(Table):
    """Table ``[exposure]``: brightness as the level of a pixel above the background [count]."""

    white_counts: Positive = 2700.0
    """A pixel wholly inside a microimage of the white image."""
    dot_counts: Positive = 3500.0
    """A pixel of a microlens that sees nothing but the bright part of the board."""
    particle_counts: Positive = 600.0
    """A pixel lit by one point-like particle of intensity 1 (its light fills as many pixels as one microimage)."""


class Noise(Table):
    """Table ``[noise]``: the camera's noise."""

    background: NonNegative = 40.0
    """Level without light [count]."""
    read_noise: NonNegative = 3.0
    """Standard deviation of the read-out [count]."""
    full_well_e: NonNegative = 10_000.0
    """Electrons at full scale, which set the shot noise; 0 switches it off."""


class Quality(Table):
    """Table ``[quality]``: rays of the renderer, rounded up to powers of two."""

    particle_rays: Count = 32_768
    """Rays of each particle."""
    dot_rays: Count = 131_072
    """Rays of each board dot."""
    pixel_rays: Count = 256
    """Rays of each pixel of white images and of boards with dark dots."""


class Scene(Table):
    """The whole scene file. `smart`, `correlation`, `network`, `compute` are copied into the experiment file."""

    name: Annotated[str, Field(min_length=1)]
    seed: Annotated[int, Field(strict=True, ge=0)] = 0
    dt_s: Positive
    camera: Annotated[tuple[SceneCamera, ...], Field(min_length=1)]
    board: SceneBoard
    volume: SceneVolume
    particles: SceneParticles
    flow: Annotated[Flow, Field(discriminator="kind")]
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

    @field_validator("flow", mode="before")
    @classmethod
    def _known_flow(cls, table: Any) -> Any:
        if isinstance(table, Mapping):
            kind = table.get("kind")
            if kind not in KINDS:
                raise ValueError(f"a flow with kind = {' or '.join(map(repr, KINDS))}")
            known = KINDS[kind].model_fields
            unknown = [key for key in table if key not in known]
            if unknown:
                raise ValueError(f"for kind {kind!r} only the keys {', '.join(known)} (not {unknown[0]!r})")
        return table


def open_scene(path: str | Path) -> Scene:
    """Read a scene file.

    Parameters
    ----------
    path : str or Path
        TOML file with the tables of `Scene`; a tracer file is looked up relative to it.

    Returns
    -------
    Scene

    Raises
    ------
    InputError
        If the file cannot be read, or a key is unknown, missing or out of range.
    """
    path = Path(path)
    scene = read_toml(path, Scene)
    if isinstance(scene.flow, Tracers):
        flow = scene.flow.model_copy(update={"file": str((path.parent / scene.flow.file).absolute())})
        flow.tracers()  # a missing or unsuitable file is refused here, before any work
        scene = scene.model_copy(update={"flow": flow})
    return scene


def true_mapping(camera: SceneCamera | Mapping[str, Any]) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Return the true mapping of a simulated camera from points and pupil coordinates to the microlens array.

    Parameters
    ----------
    camera : SceneCamera or mapping
        A camera of a scene, or its table in ``truth/spec.json``.

    Returns
    -------
    callable
        ``(points_mm (n, 3), pupil_mm (n, 2)) -> (s, t) (n, 2)`` [mm], origin at the sensor's centre: s = k u - m x_c.
    """
    if not isinstance(camera, SceneCamera):
        camera = SceneCamera.model_validate(camera)
    optics, rotation, offset = camera.optics, camera.rotation, np.asarray(camera.true_offset_mm)

    def mapping(points_mm: np.ndarray, pupil_mm: np.ndarray) -> np.ndarray:
        seen = (np.asarray(points_mm, float) - offset) @ rotation.T
        m = optics.image_distance_mm / (optics.object_distance_mm - seen[..., 2:])
        k = m * seen[..., 2:] / optics.object_distance_mm
        return k * np.asarray(pupil_mm, float) - m * seen[..., :2]

    return mapping

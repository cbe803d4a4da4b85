"""Cases of `reconstruction_bench`: ideal cameras with known rays, their images of known particles, and the truth.

No board is recorded and nothing is calibrated, so a case takes seconds. The volume is small: its errors are larger than
those of a whole measurement, and only differences between methods count.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from lfpiv import metrics
from lfpiv.calibration.camera import CalibratedCamera, Calibration
from lfpiv.calibration.thin_lens_model import thin_lens_model
from lfpiv.geometry.grid import Grid
from lfpiv.lightfield.decoder import LightFieldDecoder
from lfpiv.reproduce import store
from lfpiv.reproduce.rigs import BLOB_VOXEL, OPTICS, VOXEL_MM
from lfpiv.simulation.camera_images import expose, render_camera
from lfpiv.simulation.flows import Ring, Shear, Swirl, Uniform, window_mean
from lfpiv.simulation.light import Brightness, Sheet, StrayLight
from lfpiv.simulation.scene_camera import SceneCamera
from lfpiv.simulation.sensor import Noise
from lfpiv.simulation.turbulence import Turbulence, TurbulentFlow
from lfpiv_kernels.rendering import collect, render

SIZE_MM = {"small": (3.2, 3.2, 2.8), "flat": (4.0, 4.0, 2.4), "paper": (10.0, 10.0, 5.0)}
"""Size of the volume (x, y, z)."""
PIXEL_UM = {"small": 11.0, "flat": 11.0, "paper": 5.5}
WINDOWS = {"small": (24, 16, 12, 12), "flat": (24, 16, 12, 12), "paper": None}
"""Windows of the correlation; None: its default."""
MARGIN_MM = 0.6
"""Width that the sensor images beyond the volume, both sides together."""
ANGLES_DEG = {1: (0.0,), 2: (45.0, -45.0), 3: (45.0, 0.0, -45.0), 4: (45.0, 15.0, -15.0, -45.0)}
"""Angles about y by number of cameras."""
ARRAYS_MM = ((0.031, -0.022), (-0.02, 0.04), (0.01, 0.013), (-0.037, -0.009))
"""Offsets of the cameras' microlens arrays, so that no two sample the volume alike."""
RAYS = 16_384
"""Rays per particle."""
WHITE_RAYS, WHITE_COUNTS = 256, 3000.0
WAVE = "wave"
"""Start of the name of a transverse wave along x, followed by its length [voxel]."""
WAVE_STRAIN = 0.25
"""Largest strain of a wave, whatever its length."""
FLOWS = ("ring", "swirl", "shear", "uniform", "turbulent", "abc", f"{WAVE}16")
ABC_MM = 0.092
"""Amplitude of the flow of Arnold, Beltrami and Childress, whose components are sheared along two axes each."""
TRACERS, TRACERS_MM = "dns", 8.0
"""Flow of a series, not of a pair, that moves tracers of the sample data, and the edge of their cube [mm]."""
TRACERS_FILE = Path(__file__).resolve().parents[3] / "shared" / "data" / "dns-tracers" / "rayleigh_benard_series.npz"
IMAGES_FORM = 1
"""Raised when the same case is recorded otherwise, so that stored images are made anew."""


@dataclass(frozen=True, kw_only=True)
class Condition:
    """Light, brightness and noise of the images."""

    counts: float
    """Level of a pixel lit by one particle in focus [count]."""
    noise: Noise
    brightness: Brightness = field(default_factory=Brightness)
    sheet: tuple[float, float] | None = None
    """Thickness of a Gaussian sheet [depth of the volume], and power of the second pulse relative to the first."""
    dark: float = 0.0
    """Share of the particles without light in the first frame, and of others in the second one."""
    flicker: float = 0.0
    """Standard deviation of the logarithm of a particle's light between the frames."""
    beyond: float = 0.0
    """Depth beyond the faces in which there are particles [depth of the volume]; sideways 0.5 mm."""
    stray: StrayLight | None = None


CONDITIONS = {
    "clean": Condition(counts=400.0, noise=Noise()),
    "poly": Condition(counts=400.0, noise=Noise(), brightness=Brightness(camera_log_sd=1.0, size_log_sd=0.35)),
    "poly0": Condition(
        counts=400.0, noise=Noise(background=0.0), brightness=Brightness(camera_log_sd=1.0, size_log_sd=0.35)
    ),
    "lose": Condition(counts=400.0, noise=Noise(), dark=0.2),
    "flicker": Condition(counts=400.0, noise=Noise(), flicker=0.5),
    "real": Condition(
        counts=16.0,  # 39 electrons
        noise=Noise(read_noise=0.82),  # 2 electrons
        brightness=Brightness(camera_log_sd=0.5, size_log_sd=0.25),
        sheet=(1.33, 0.8),
        beyond=0.4,
        stray=StrayLight(lens_counts=1.6, ambient_counts=0.32, variation=0.3),
    ),
}
"""Clean: shot noise of a thousand electrons per pixel and particle, and read-out noise. Poly: the same, light unlike by
a factor of e in each camera and of 2 from particle to particle. Poly0: the same without an offset, so that counts below
0 are cut off. Real: 39 electrons, particles of unlike size that are unlike bright in the cameras, a Gaussian sheet
wider than the volume, stray light."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """One recording: a pair of frames, or a series of equally spaced ones."""

    flow: str = "ring"
    ppm: float = 0.5
    """Particles per microlens of the volume's x-y face."""
    seed: int = 1
    blob_voxel: float = BLOB_VOXEL
    """Standard deviation of the Gaussian particles [voxel]; 0 for points."""
    condition: str = "clean"
    angles_deg: tuple[float, ...] = ANGLES_DEG[2]
    scale: str = "small"
    frames: int = 2
    speed: float = 1.0
    """Displacements relative to those of the flow."""

    @property
    def windows(self) -> tuple[int, ...] | None:
        return WINDOWS[self.scale]

    @property
    def label(self) -> str:
        kind = f"blobs {self.blob_voxel:g}" if self.blob_voxel else "points"
        angles = " ".join(f"{angle:g}" for angle in self.angles_deg)
        more = ("" if self.frames == 2 else f", {self.frames} frames") + (", paper" if self.scale == "paper" else "")
        speed = "" if self.speed == 1 else f", {self.speed:g} times as fast"
        return f"{self.flow} {self.ppm:g} ppm {kind} {self.condition}, cameras {angles}{more}{speed}"


@dataclass(frozen=True, kw_only=True, eq=False)
class Rig:
    """Ideal cameras: as the simulator renders them, and as the reconstruction knows them, with the same rays."""

    cameras: tuple[SceneCamera, ...]
    calibration: Calibration
    grid: Grid
    """The volume's voxels."""
    white: Mapping[str, np.ndarray]
    """White images relative to a fully lit pixel."""

    def light(self, name: str, image: np.ndarray) -> np.ndarray:
        """Return a camera's image above its dark level [count]."""
        return image - np.float32(self.calibration.cameras[name].decoder.background(image)[0])

    def noise(self, name: str, image: np.ndarray) -> float:
        """Return the noise of a camera's image where it is dark [count]."""
        return self.calibration.cameras[name].decoder.background(image)[1]


@cache
def make_rig(scale: str, angles_deg: tuple[float, ...]) -> Rig:
    """Make the cameras at angles about y around a volume."""
    size, cameras, calibrated, whites = SIZE_MM[scale], [], {}, {}
    for number, angle in enumerate(angles_deg):
        camera = _scene_camera(scale, number, angle)
        renderer = render_camera(camera)
        white = collect.render_white(renderer, samples=WHITE_RAYS, seed=number)
        decoder = LightFieldDecoder.from_white(camera.optics, camera.lattice, (WHITE_COUNTS * white).astype(np.float32))
        lens = thin_lens_model(camera.optics, angle)
        cameras.append(camera)
        whites[camera.name] = white
        calibrated[camera.name] = CalibratedCamera(
            name=camera.name, optics=camera.optics, lattice=camera.lattice, decoder=decoder, baseline=lens
        )
    grid = Grid.from_extent(centre_mm=(0.0, 0.0, 0.0), size_mm=size, voxel_mm=VOXEL_MM)
    return Rig(cameras=tuple(cameras), calibration=Calibration(calibrated), grid=grid, white=whites)


def _scene_camera(scale: str, number: int, angle_deg: float) -> SceneCamera:
    size, pixel_mm = SIZE_MM[scale], PIXEL_UM[scale] / 1000
    sine, cosine = abs(np.sin(np.radians(angle_deg))), abs(np.cos(np.radians(angle_deg)))
    columns, rows = (size[0] * cosine + size[2] * sine + MARGIN_MM) / pixel_mm, (size[1] + MARGIN_MM) / pixel_mm
    return SceneCamera.model_validate(
        OPTICS
        | {
            "name": f"camera{number + 1}",
            "pixel_um": PIXEL_UM[scale],
            "sensor_width_px": 2 * int(columns / 2),
            "sensor_height_px": 2 * int(rows / 2),
            "nominal_angle_deg": angle_deg,
            "true_array_offset_mm": ARRAYS_MM[number % len(ARRAYS_MM)],
            "true_array_roll_deg": 0.05 - 0.07 * number,
        }
    )


def make_flow(case: Case):
    """Return the flow of a case. Lengths grow with the volume, displacements with the root of its size."""
    size = SIZE_MM[case.scale][0] / SIZE_MM["small"][0]
    speed = case.speed * size**0.5
    if case.flow == "ring":
        return Ring(radius_mm=0.9 * size, core_mm=0.7 * size, peak_mm=0.16 * speed)
    if case.flow == "swirl":
        return Swirl(peak_mm=0.18 * speed, core_mm=0.8 * size, axis="y", axial_mm=0.12 * speed)
    if case.flow == "shear":
        return Shear(along="z", across="x", rate=0.07 * speed / size)
    if case.flow == "uniform":
        return Uniform(displacement_mm=(0.073 * speed, -0.038 * speed, 0.111 * speed))
    if case.flow == "turbulent":
        law = Turbulence(rms_mm=0.06 * speed, integral_scale_mm=1.0 * size, smallest_mm=1.2 * size, modes=200)
        still = Uniform(displacement_mm=(0.0, 0.0, 0.0))
        return TurbulentFlow(still, law.realisation(seed=[case.seed, 41]))
    if case.flow == "abc":
        return Abc(ABC_MM * case.speed, SIZE_MM[case.scale][0])
    if case.flow.startswith(WAVE):
        return Wave(float(case.flow.removeprefix(WAVE)) * VOXEL_MM)
    raise ValueError(f"flow: expected one of {', '.join(FLOWS)}, got {case.flow!r}.")


@dataclass(frozen=True)
class Abc:
    """Flow of Arnold, Beltrami and Childress."""

    amplitude_mm: float
    wave_mm: float

    def __call__(self, points_mm: np.ndarray) -> np.ndarray:
        x, y, z = np.asarray(points_mm, float).T * (2 * np.pi / self.wave_mm)
        sums = (np.sin(z) + np.cos(y), np.sin(x) + np.cos(z), np.sin(y) + np.cos(x))
        return self.amplitude_mm * np.stack(sums, axis=1)


@dataclass(frozen=True)
class Wave:
    """Displacement along y and z that oscillates along x."""

    wave_mm: float

    def __call__(self, points_mm: np.ndarray) -> np.ndarray:
        phase = np.asarray(points_mm, float)[:, 0] * (2 * np.pi / self.wave_mm)
        amplitude = WAVE_STRAIN * self.wave_mm / (2 * np.pi)
        return amplitude * np.stack([np.zeros_like(phase), np.sin(phase), np.cos(phase)], axis=1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Recorded:
    """Images of a case, and its particles."""

    images: tuple[dict[str, np.ndarray], ...]
    """Raw images of each frame by camera [count], float32."""
    positions_mm: tuple[np.ndarray, ...]
    """Particles of each frame (n, 3) [mm]."""
    light: tuple[np.ndarray, ...]
    """Light of each particle in each frame, mean of the cameras, relative to the mean."""


@lru_cache(maxsize=16)
def record(case: Case, folder: Path) -> Recorded:
    """Record a case, or read its images from a folder."""
    rig, condition = make_rig(case.scale, case.angles_deg), CONDITIONS[case.condition]
    positions, light = _particles(case, condition, len(rig.cameras))
    angles = "_".join(f"{angle:g}" for angle in case.angles_deg)
    name = f"{case.scale}_{case.flow}_{case.ppm:g}_{case.seed}_{case.blob_voxel:g}_{case.condition}_{angles}"
    if case.speed != 1:
        name += f"_{case.speed:g}"
    settings = {"case": asdict(case), "condition": _plain(condition), "form": IMAGES_FORM}

    def images_of(frame: int) -> dict[str, np.ndarray]:
        return {
            camera.name: _image(case, rig, number, frame, positions[frame], light[frame][number])
            for number, camera in enumerate(rig.cameras)
        }

    images = [
        store.cached_arrays(folder / f"{name}_{case.frames}_{frame}.npz", settings, partial(images_of, frame))
        for frame in range(case.frames)
    ]
    return Recorded(
        images=tuple({key: value.astype(np.float32) for key, value in one.items()} for one in images),
        positions_mm=positions,
        light=tuple(one.mean(0) for one in light),
    )


def _plain(condition: Condition) -> dict[str, Any]:
    values = {name: getattr(condition, name) for name in ("counts", "noise", "brightness", "sheet", "beyond", "stray")}
    return {name: value.model_dump() if hasattr(value, "model_dump") else value for name, value in values.items()}


def _particles(case: Case, condition: Condition, cameras: int) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """Return each frame's positions (n, 3) [mm], and their light in each camera (camera, n)."""
    size = np.array(SIZE_MM[case.scale])
    seeded = size + (2 * np.array([0.5, 0.5, condition.beyond * size[2]]) if condition.beyond else 0.0)
    count = round(case.ppm * size[0] * size[1] / VOXEL_MM**2 * float(np.prod(seeded / size)))
    rng = np.random.default_rng([case.seed, 31, round(1000 * case.ppm)])
    if case.flow == TRACERS:
        tracers = _tracers(case, count / float(np.prod(seeded)), seeded, rng)
        return tracers, _light(condition, cameras, size, tracers, rng)
    middle, flow = rng.uniform(-0.5, 0.5, (count, 3)) * seeded, make_flow(case)
    if case.frames == 2:
        half = flow(middle) / 2
        positions = [middle - half, middle + half]
    else:
        positions = [middle]
        for _ in range(case.frames - 1):
            before = positions[-1]
            positions.append(before + flow(before + flow(before) / 2))
    return tuple(positions), _light(condition, cameras, size, positions, rng)


def _tracers(case: Case, per_mm3: float, seeded: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Return the positions [mm] at successive instants of the sample data's tracers that come into a region."""
    with np.load(TRACERS_FILE) as stored:
        every = (stored["positions"][: case.frames].astype(float) - 0.5) * TRACERS_MM
    if len(every) < case.frames:
        raise ValueError(f"frames: expected at most {len(every)} with the flow {TRACERS!r}, got {case.frames}.")
    chosen = rng.random(every.shape[1]) < per_mm3 * TRACERS_MM**3 / every.shape[1]
    chosen &= (np.abs(every) < seeded / 2).all(2).any(0)
    return tuple(every[:, chosen])


def _light(
    condition: Condition, cameras: int, size: np.ndarray, positions: Sequence[np.ndarray], rng: np.random.Generator
) -> tuple[np.ndarray, ...]:
    """Return the light of each particle in each camera (camera, n), at each frame."""
    scatter, count = condition.brightness, len(positions[0])
    equal = scatter.intensity_of(scatter.diameters(count, rng)) * scatter.camera_factors(cameras, count, rng)
    if condition.dark or condition.flicker:
        draw, frames = rng.random(count), []
        for frame in range(len(positions)):
            lit = draw > condition.dark if frame == 0 else draw < 1 - condition.dark
            frames.append(equal * lit * np.exp(condition.flicker * rng.standard_normal(count)))
        return tuple(frames)
    if condition.sheet is None:
        return (equal,) * len(positions)
    thickness, second = condition.sheet
    sheet = Sheet(profile="gaussian", thickness_mm=float(thickness * size[2]), power=(1.0, second))
    return tuple(equal * sheet.power[frame % 2] * sheet.light(at, frame % 2) for frame, at in enumerate(positions))


def _image(case: Case, rig: Rig, number: int, frame: int, positions_mm: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Record one image of one camera."""
    condition, camera = CONDITIONS[case.condition], rig.cameras[number]
    renderer, rng = render_camera(camera), np.random.default_rng([case.seed, 32, number, frame])
    counts = condition.counts * renderer.microimage_px * light
    rays = render.ray_table(RAYS, "gaussian", case.seed)
    image = render.render_sources(renderer, positions_mm, counts, case.blob_voxel * VOXEL_MM, rays, rng=rng)
    if condition.stray is not None:
        fixed = np.random.default_rng([case.seed, 33, number])
        lens, ambient = condition.stray.fields(image.shape, renderer.pixel_mm, fixed)
        image = image + condition.stray.lens_counts * lens * rig.white[camera.name]
        image = image + condition.stray.ambient_counts * ambient
    return expose(image, camera, condition.noise, rng)


def true_volume(case: Case, recorded: Recorded, frame: int) -> xr.DataArray:
    """Return the particles of a frame as blobs on the voxels; points as blobs of the usual size."""
    grid = make_rig(case.scale, case.angles_deg).grid
    size = case.blob_voxel or BLOB_VOXEL
    return metrics.truth_volume(recorded.positions_mm[frame], recorded.light[frame], grid, size)


def true_field(case: Case, axes_mm: list[np.ndarray], edge_voxel: tuple[int, int, int]) -> np.ndarray:
    """Return the flow's mean over windows with centres on axes (z, y, x) and edges (z, y, x), (z, y, x, 3) [voxel]."""
    z, y, x = np.meshgrid(*axes_mm, indexing="ij")
    edge = tuple(float(VOXEL_MM * n) for n in edge_voxel[::-1])
    mean = window_mean(make_flow(case), np.stack([x, y, z], axis=-1).reshape(-1, 3), edge)
    return mean.reshape(*x.shape, 3) / VOXEL_MM

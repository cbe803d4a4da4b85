"""Simulate the low-swirl injector (section 5): its flow, recorded and measured by light-field and by planar PIV."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import xarray as xr

from lfpiv.calibration.coverage import warn_outside
from lfpiv.geometry.grid import Grid
from lfpiv.progress import Progress
from lfpiv.reproduce import store
from lfpiv.reproduce.planar_piv import SheetCamera, correlate_frames, sheet_images
from lfpiv.reproduce.rigs import VOXEL_MM, Rig, reconstruct_images, recorded_images, true_field, volume_grid
from lfpiv.settings.processing import Correlation, Smart
from lfpiv.simulation.flows import SwirlingJet
from lfpiv.simulation.particles import LEAST_INTENSITY
from lfpiv.simulation.scene import Noise
from lfpiv.simulation.turbulence import Turbulence, TurbulentFlow
from lfpiv.velocity.cross_correlation import correlate
from lfpiv.velocity.settings import cut_windows
from lfpiv.weights.operator import Weights
from lfpiv_kernels.rendering import render

DIAMETER_MM = 34.0
"""Diameter D of the injector."""
BULK_M_S = 3.67
"""Bulk velocity."""
SWIRL_NUMBER = 0.55
DEPTHS_D = (-0.45, -0.30, -0.15)
"""Depths of the planes, z/D."""
PROFILE_D = 0.2
"""Place of the profiles, x/D."""
CENTRE_HEIGHT_MM = 0.35 * DIAMETER_MM + 5.0
"""Middle of the volume above the outlet: its lower edge is 0.35 D downstream, its height 10 mm."""
BULK_VOXEL = 2.5
"""Displacement at the bulk velocity between the frames [voxel]. It gives the time between the frames."""
PLANAR_SHARE = 0.4
"""Displacement of planar PIV relative to it: 7 pixels, a quarter of its windows."""
TURBULENCE_SHARE, TURBULENCE_SCALE_MM = 0.1, 3.0
"""Turbulence: rms of a component over the bulk velocity, and integral scale. The perforated plate has 2 mm holes."""
PARTICLES_PER_MICROLENS = 0.5
"""Seeding. The paper does not state it."""
PARTICLE_RADIUS_MM = 2.5e-3
"""Titanium dioxide of 5 um."""
PARTICLE_RAYS = 32_768
"""Rays per particle."""
LIT = 1.05
"""Edges of the lit region over those of the volume. The edges of the slits are not sharper."""
ITERATIONS = 10
"""SMART iterations, as in the paper."""
WINDOWS = (32, 16, 16)
"""Windows of the passes [voxel]; the last one is the paper's, with half overlap."""
PLANAR_MARGIN_MM = 1.0
"""Width of planar PIV's field beyond the light-field volume at "small"."""


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """Sizes of the recording at one scale."""

    volume_mm: tuple[float, float, float]
    """Size (x, y, z) of the reconstructed volume."""
    centre_x_mm: float
    """Distance of its middle from the injector's axis along x."""
    pairs: int
    planar_pairs: int
    """Pairs of planar PIV at each depth."""
    same_instants: bool
    """Whether planar PIV records the same instants as the light field. The paper recorded others."""
    field_mm: tuple[tuple[float, float], tuple[float, float]] | None
    """Corners of planar PIV's field relative to axis and outlet. None: those of the volume with a margin."""


@dataclass(frozen=True)
class Twin:
    """The flow in the coordinates of the cameras, whose origin is the middle of the volume."""

    sizes: Sizes
    seed: int

    @property
    def settings(self) -> dict[str, Any]:
        """Flow and timing of the measurement."""
        return {
            "seed": self.seed,
            "sizes": vars(self.sizes) | {"pairs": None, "planar_pairs": None},
            "windows": WINDOWS,
        }

    @property
    def outlet_mm(self) -> tuple[float, float, float]:
        """Centre of the injector's outlet (x, y, z)."""
        return (-self.sizes.centre_x_mm, -CENTRE_HEIGHT_MM, -DEPTHS_D[1] * DIAMETER_MM)

    @property
    def depths_mm(self) -> list[float]:
        """Depths z of the planes."""
        return [depth * DIAMETER_MM + self.outlet_mm[2] for depth in DEPTHS_D]

    @property
    def profile_x_mm(self) -> float:
        """Position x of the profiles."""
        return PROFILE_D * DIAMETER_MM + self.outlet_mm[0]

    @property
    def bulk_mm(self) -> float:
        """Displacement at the bulk velocity between the frames."""
        return BULK_VOXEL * VOXEL_MM

    @property
    def dt_s(self) -> float:
        """Time between the frames."""
        return self.bulk_mm / 1000 / BULK_M_S

    @property
    def mean(self) -> SwirlingJet:
        """Mean displacement."""
        return SwirlingJet(bulk_mm=self.bulk_mm, swirl_number=SWIRL_NUMBER, centre_mm=self.outlet_mm)

    def instant(self, number: int, *, planar: bool = False) -> TurbulentFlow:
        """Return the displacement of one instant: mean and turbulence. Planar PIV may see other instants."""
        stream = 8 if planar and not self.sizes.same_instants else 7
        turbulence = Turbulence(rms_mm=TURBULENCE_SHARE * self.bulk_mm, integral_scale_mm=TURBULENCE_SCALE_MM)
        return TurbulentFlow(self.mean, turbulence.realisation(seed=(self.seed, stream, number)))


class LightField(TypedDict):
    """Mean of the light field's vectors; arrays (z, y, x), components (x, y, z) last [mm]."""

    axes_mm: list[np.ndarray]
    """Middles of the windows along z, y, x."""
    displacement_mm: np.ndarray
    """Mean displacement, shape (z, y, x, 3)."""
    truth_mm: np.ndarray
    """True mean displacement over the windows, shape (z, y, x, 3)."""
    departures_mm: np.ndarray
    """Measured minus true displacement of each pair, shape (pair, z, y, x, 3); NaN where not valid."""
    valid: float
    """Part of the vectors."""


class Sheet(TypedDict):
    """Mean of planar PIV's vectors at one depth."""

    y_mm: np.ndarray
    x_mm: np.ndarray
    displacement_mm: np.ndarray
    """Over the light field's time between frames, shape (y, x, 2)."""
    valid: float
    """Part of the vectors."""


def particle_frames(rig: Rig, twin: Twin, pair: int) -> list[dict[str, np.ndarray]]:
    """Record both frames of a pair: camera -> image (rows, columns), 12 bits with noise."""
    size = LIT * np.array(twin.sizes.volume_mm)
    rng = np.random.default_rng([twin.seed, 21, pair])
    count = round(PARTICLES_PER_MICROLENS * size[0] * size[1] / VOXEL_MM**2)
    position = rng.uniform(-0.5, 0.5, (count, 3)) * size
    intensity = np.maximum(LEAST_INTENSITY, 1 + 0.2 * rng.standard_normal(count))
    displacement = twin.instant(pair)(position)
    rays = render.ray_table(PARTICLE_RAYS, "ball", pair)
    counts = rig.scene.exposure.particle_counts * intensity
    return [
        recorded_images(
            rig,
            position + sign * displacement,
            counts,
            rays,
            PARTICLE_RADIUS_MM,
            seed=[twin.seed, 22, pair],
            frame=frame,
        )
        for frame, sign in enumerate((-0.5, 0.5))
    ]


def light_field_mean(rig: Rig, twin: Twin, work: Path, progress: Progress) -> LightField:
    """Measure all pairs and average their vectors."""
    grid = volume_grid(twin.sizes.volume_mm)
    weights: Weights | None = None
    total: tuple[np.ndarray, ...] = ()
    departures = []
    for pair in range(twin.sizes.pairs):
        progress("light-field PIV", pair / twin.sizes.pairs)

        def measure(pair: int = pair) -> dict[str, np.ndarray]:
            nonlocal weights
            if weights is None:  # built once, when the first pair is measured
                warn_outside(rig.calibration, grid)
                weights = rig.weights(grid, "network")
            volumes = [
                reconstruct_images(weights, images, Smart(iterations=ITERATIONS))
                for images in particle_frames(rig, twin, pair)
            ]
            return _measure(volumes, twin, grid, pair)

        found = store.cached_arrays(work / "light_field" / f"pair_{pair:04d}.npz", twin.settings, measure)
        usable = np.where(found["valid"][..., None], found["displacement_mm"], np.nan)
        terms = np.nan_to_num(usable), np.isfinite(usable[..., 0]).astype(int), found["truth_mm"]
        total = tuple(a + b for a, b in zip(total, terms, strict=True)) if total else terms
        departures.append((usable - found["truth_mm"]).astype(np.float32))
    displacement, count, truth = total
    return {
        "axes_mm": [found[f"{axis}_mm"] for axis in "zyx"],
        "displacement_mm": displacement / np.where(count > 0, count, np.nan)[..., None],
        "truth_mm": truth / twin.sizes.pairs,
        "departures_mm": np.array(departures),
        "valid": count.sum() / (count.size * twin.sizes.pairs),
    }


def window_mm(twin: Twin) -> tuple[float, float, float]:
    """Return the edges (x, y, z) of the light field's last windows [mm]."""
    x, y, z = (min(WINDOWS[-1] * VOXEL_MM, edge) for edge in twin.sizes.volume_mm)
    return x, y, z


def _measure(volumes: Sequence[xr.DataArray], twin: Twin, grid: Grid, pair: int) -> dict[str, np.ndarray]:
    settings = Correlation(windows=cut_windows(WINDOWS, volumes[0].shape)).model_dump()
    vectors = correlate(*volumes, dt_s=twin.dt_s, **settings)
    displacement = np.stack([vectors[f"displacement_{axis}"].values for axis in "xyz"], axis=-1)
    return {
        "displacement_mm": displacement * grid.voxel_mm,
        "valid": vectors["valid"].values,
        "truth_mm": true_field(twin.instant(pair), [vectors[axis].values for axis in "zyx"], window_mm(twin)),
        **{f"{axis}_mm": vectors[axis].values for axis in "zyx"},
    }


def planar_mean(twin: Twin, work: Path, progress: Progress) -> list[Sheet]:
    """Measure all pairs of planar PIV and average their vectors at each depth."""
    sizes, (x, y, _) = twin.sizes, twin.outlet_mm
    if sizes.field_mm is None:
        half_x, half_y = (edge / 2 + PLANAR_MARGIN_MM for edge in sizes.volume_mm[:2])
        field = (-half_x, -half_y), (half_x, half_y)
    else:
        (left, bottom), (right, top) = sizes.field_mm
        field = (left + x, bottom + y), (right + x, top + y)
    camera = SheetCamera(axis_mm=(x, y + 15.0))  # the middle of a field 30 mm high
    planes: list[Sheet] = []
    for depth in twin.depths_mm:
        total: tuple[np.ndarray, ...] = ()
        for pair in range(sizes.planar_pairs):
            progress(f"planar PIV at z = {depth:.1f} mm", pair / sizes.planar_pairs)

            def measure(pair: int = pair, depth: float = depth) -> dict[str, np.ndarray]:
                flow = twin.instant(pair, planar=True)
                frames = sheet_images(
                    camera,
                    lambda points: PLANAR_SHARE * flow(points),
                    plane_mm=depth,
                    field_mm=field,
                    noise=Noise(),
                    rng=np.random.default_rng([twin.seed, 23, pair, round(10 * (depth + 100))]),
                )
                return vars(correlate_frames(*frames, camera, field))

            name = f"z_{depth:+.1f}_pair_{pair:04d}.npz"
            found = store.cached_arrays(work / "planar" / name, twin.settings, measure)
            good = np.isfinite(found["displacement_mm"][..., 0])
            terms = np.nan_to_num(found["displacement_mm"]), good.astype(int)
            total = tuple(a + b for a, b in zip(total, terms, strict=True)) if total else terms
        displacement, count = total
        planes.append(
            {
                "y_mm": found["y_mm"],
                "x_mm": found["x_mm"],
                "displacement_mm": displacement / np.where(count > 0, count, np.nan)[..., None] / PLANAR_SHARE,
                "valid": count.sum() / (count.size * sizes.planar_pairs),
            }
        )
    return planes

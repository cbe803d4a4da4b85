"""Truth of a simulated data set: its flow and particles, and the region in which a result is scored."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv.benchmark.plain_truth import WINDOW_VOXEL
from lfpiv.errors import InputError
from lfpiv.geometry.grid import Grid
from lfpiv.simulation.flows import average_truth, window_mean
from lfpiv.simulation.scene import Scene, stored_scene

ABOUT = "benchmark.json"
"""File in which a case of the benchmark says what it is."""
TRUTH = "truth"
"""Folder of the truth in a data set."""
SLACK_VOXEL = 0.5
"""Distance by which a vector may lie outside the measurable region [voxel]: programs place windows differently."""
SAMPLES = 40
"""Sample points along the longest edge of the measurable region; at least 8 along the others."""
FLOW, PARTICLES = "the flow", "true particles"
"""What a displacement is taken from: the flow itself, or the particles where the flow's file is missing."""

Point = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class TrueParticles:
    """Particles of one pair, or of an instant and the next one, midway in time."""

    positions_mm: np.ndarray
    """Positions (x, y, z) [mm], shape (particle, 3)."""
    displacement_mm: np.ndarray
    """Displacements between the two frames [mm], shape (particle, 3)."""
    intensity: np.ndarray
    """Intensities relative to the mean, shape (particle,)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Truth:
    """Truth of a data set, from `open_truth`."""

    scene: Scene
    folder: Path
    numbers: tuple[int, ...]
    """Numbers of the pairs, or of the first instants of a time series."""
    about: Mapping[str, Any] = field(default_factory=dict)
    """What a case of the benchmark says of itself: version, name, checksums; empty for other data sets."""

    @property
    def is_series(self) -> bool:
        """Whether the data set is a time series."""
        return self.scene.particles.instants is not None

    @property
    def noun(self) -> str:
        """Return what a number counts."""
        return "instant" if self.is_series else "pair"

    @cached_property
    def grid(self) -> Grid:
        """Voxels of the volume."""
        volume = self.scene.volume
        return Grid.from_extent(centre_mm=volume.centre_mm, size_mm=volume.size_mm, voxel_mm=volume.voxel_mm)

    @property
    def voxel_mm(self) -> float:
        """Edge of a voxel [mm]."""
        return self.grid.voxel_mm

    @cached_property
    def reference_window_mm(self) -> Point:
        """Edges (x, y, z) of the reference window, at most half of the volume's [mm].

        It is the window of the recommended settings. The measurable region, in which a result is scored, holds the
        centres of all such windows that lie in the volume.
        """
        x, y, z = (min(WINDOW_VOXEL * self.voxel_mm, size / 2) for size in self.scene.volume.size_mm)
        return x, y, z

    def inside(self, points_mm: np.ndarray, margin_windows: float = 0.0, slack_voxel: float = 0.0) -> np.ndarray:
        """Return which points (n, 3) lie in the fluid and away from the faces of the volume, shape (n,).

        The least distance is `margin_windows` reference windows less `slack_voxel`; 0.5 gives the measurable region.
        """
        half = np.asarray(self.scene.volume.size_mm) / 2 - margin_windows * np.asarray(self.reference_window_mm)
        half += (slack_voxel + 1e-6) * self.voxel_mm  # points on the limit are inside in spite of rounding
        near = np.all(np.abs(points_mm - self.scene.volume.centre_mm) <= half, axis=1)
        if self.scene.wall is not None:
            near[near] = ~self.scene.solid(points_mm[near])
        return near

    @cached_property
    def samples_mm(self) -> np.ndarray:
        """Evenly spaced points (n, 3) of the measurable region: half a reference window inside the faces [mm]."""
        size = np.asarray(self.scene.volume.size_mm) - self.reference_window_mm
        counts = np.maximum(np.ceil(SAMPLES * size / size.max() - 1e-9), 8).astype(int)
        axes = [
            centre + edge * ((np.arange(count) + 0.5) / count - 0.5)
            for centre, edge, count in zip(self.scene.volume.centre_mm, size, counts, strict=True)
        ]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        return points[self.inside(points, 0.5)]

    def displacement(
        self, number: int, points_mm: np.ndarray, window_mm: Point | None = None
    ) -> tuple[np.ndarray, str]:
        """Return the true displacement at points, and what it is taken from.

        Parameters
        ----------
        number : int
            Pair or instant.
        points_mm : ndarray, shape (n, 3)
            Points (x, y, z) midway in time [mm].
        window_mm : tuple of float, optional
            Edges (x, y, z) of a window over which the displacement is averaged [mm]. Default: the value at the point;
            where only the particles are known, the mean over the reference window.

        Returns
        -------
        displacement : ndarray, shape (n, 3)
            Displacements (x, y, z) [mm]; NaN where they are not known.
        source : str
            `FLOW` or `PARTICLES`.
        """
        try:
            flow = self._flow(number)
        except InputError:  # the file of tracers is not at hand
            particles = self.particles(number)
            window = self.reference_window_mm if window_mm is None else window_mm
            mean = average_truth(particles.positions_mm, particles.displacement_mm, points_mm, window)
            return mean, PARTICLES
        if window_mm is None:
            return np.asarray(flow(points_mm), float), FLOW
        return window_mean(flow, points_mm, window_mm), FLOW

    def _flow(self, number: int) -> Callable[[np.ndarray], np.ndarray]:
        """Return the flow as a function of points; raise InputError if its file cannot be read."""
        flow = self.scene.flow_of(number)
        flow(np.asarray([self.scene.volume.centre_mm]))  # reads the tracers' file where there is one
        return flow

    @cached_property
    def peak_mm(self) -> float:
        """Largest displacement at sample points of the measurable region, over all pairs [mm]."""
        points = self.samples_mm[::8]
        lengths = [np.linalg.norm(self.displacement(one, points)[0], axis=1) for one in self.numbers]
        return float(np.nanmax(np.concatenate(lengths)))

    def particles(self, number: int) -> TrueParticles:
        """Return the particles of a pair midway in time, in the volume and around it."""
        kind = f"instant_{number:06d}" if self.is_series else f"pair_{number:04d}"
        with np.load(self.folder / "particles.npz", allow_pickle=False) as stored:
            position, displacement = stored[f"{kind}_positions_mm"], stored[f"{kind}_displacement_mm"]
            intensity = stored[f"{kind}_intensity"]
        # a series stores positions at the instant, pairs store them midway
        middle = position + displacement / 2 if self.is_series else position
        return TrueParticles(positions_mm=middle, displacement_mm=displacement, intensity=intensity)

    def frame(self, number: int, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Return positions (n, 3) [mm] and intensities (n,) of the particles in frame 0 or 1 of a pair."""
        found = self.particles(number)
        return found.positions_mm + (frame - 0.5) * found.displacement_mm, found.intensity


def open_truth(folder: str | Path, apart: str | Path | None = None) -> Truth:
    """Open the truth of a simulated data set.

    Parameters
    ----------
    folder : str or Path
        The data set, or its folder `TRUTH`. With `apart` the data set.
    apart : str or Path, optional
        Folder of the truth where the data set does not hold it.

    Raises
    ------
    InputError
        If there is no truth, it is damaged, or it belongs to other images.
    """
    given = Path(folder if apart is None else apart)
    place = given if (given / "spec.json").is_file() else given / TRUTH
    spec, particles = place / "spec.json", place / "particles.npz"
    for path in (spec, particles):
        if not path.is_file():
            raise InputError(
                f"{path}: expected the truth of a simulated data set, found no such file. State the folder of the "
                "data set, or the one of its truth as --truth."
            )
    try:
        scene = stored_scene(place)
        with np.load(particles, allow_pickle=False) as stored:
            numbers = tuple(sorted({_number(name) for name in stored.files if name.endswith("_displacement_mm")}))
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        text = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{place}: expected the truth of a simulated data set, found it damaged ({text}).") from None
    if not numbers:
        raise InputError(f"{particles}: expected particles with displacements, found none.")
    about, data = _about(place), _about(Path(folder))
    if apart is not None and about.get("images_sha256") != data.get("images_sha256"):
        raise InputError(
            f"{place}: expected the truth of the images in {folder} ({data.get('case', 'of no case')}), found that of "
            f"others ({about.get('case', 'of no case')})."
        )
    return Truth(scene=scene, folder=place, numbers=numbers, about=about)


def _about(folder: Path) -> dict[str, Any]:
    """Return what a case of the benchmark says of itself; nothing for another data set."""
    try:
        found = json.loads((folder / ABOUT).read_text("utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _number(name: str) -> int:
    """Return the number in the name of an array, such as pair_0000_displacement_mm."""
    return int(name.split("_")[1])

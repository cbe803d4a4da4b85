"""Write the truth of a simulated experiment: the scene, its particles, and what differs from the ideal images.

============================  =========================================================================================
file                          content
============================  =========================================================================================
``truth/spec.json``           the scene, with all defaults
``truth/particles.npz``       particles of each pair or instant; light of each in each camera and frame, and power of
                              the pulses, where the scene has a table ``[sheet]`` or ``[brightness]``
``truth/light_CAMERA.npz``    light that is not from particles, where the scene has ``[[surface]]`` or ``[stray_light]``
``truth/sensor_CAMERA.npz``   fixed pattern, where the camera has a table ``sensor``
``truth/array_CAMERA.npz``    dead lenses, where the camera has a table ``array``
``truth/board.npz``           true dots, where the scene has a table ``[board.errors]``
``truth/walls.npz``           solid voxels, where the scene has a ``[[wall]]``
============================  =========================================================================================

Images in these files are oriented as the stored images. Positions of a pair, ``pair_0000_positions_mm``, are midway in
time. Those of a series, ``instant_000000_positions_mm``, are at the instant, ``instant_000000_index`` has the constant
numbers of the particles, and ``instant_000000_displacement_mm`` is the displacement to `step` instants later, which the
last instants do not have.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv.experiment.images import FLIPS
from lfpiv.geometry.grid import AXES, Grid
from lfpiv.simulation.camera_images import StaticLight, board_truth, render_camera
from lfpiv.simulation.particles import LitParticles, PlacedParticles
from lfpiv.simulation.scene import Scene
from lfpiv.simulation.sensor import SensorPattern
from lfpiv.simulation.series import SeriesInstant


def write_scene(scene: Scene, placed: Sequence[LitParticles | SeriesInstant], folder: Path) -> None:
    """Write the scene, its particles, its board and its walls.

    Parameters
    ----------
    placed : sequence of LitParticles or SeriesInstant
        Particles of each pair, or of each instant of a series.
    folder : Path
        Existing folder.
    """
    np.savez_compressed(folder / "particles.npz", **particle_arrays(scene, placed))
    spec = scene.model_dump(mode="json", exclude={"smart", "correlation", "network", "compute"}, exclude_none=True)
    (folder / "spec.json").write_text(json.dumps(spec, indent=1) + "\n", "utf-8")
    board = board_truth(scene)
    if board is not None:
        np.savez_compressed(folder / "board.npz", dots_mm=board.dots_mm, present=board.present, light=board.light)
    if scene.wall is not None:
        np.savez_compressed(folder / "walls.npz", **_walls(scene))


def particle_arrays(scene: Scene, placed: Sequence[LitParticles | SeriesInstant]) -> dict[str, Any]:
    """Return the arrays of ``truth/particles.npz``.

    Parameters
    ----------
    placed : sequence of LitParticles or SeriesInstant
        Particles of each pair, or of each instant of a series.

    Returns
    -------
    dict
        Arrays by their names.
    """
    arrays: dict[str, Any] = {}
    for number, light in enumerate(placed):
        own: dict[str, Any] = {}
        if isinstance(light, SeriesInstant):
            name = f"instant_{scene.particles.first + number:06d}"
            particles: SeriesInstant | PlacedParticles = light
            own["index"] = light.index
        else:
            name, particles = f"pair_{number:04d}", light.placed
        own |= {"positions_mm": particles.position_mm, "intensity": particles.intensity}
        if particles.displacement_mm is not None:
            own["displacement_mm"] = particles.displacement_mm
            own["velocity_m_s"] = particles.displacement_mm / scene.dt_s / 1000
        if scene.brightness is not None:
            own["diameter"] = particles.diameter
        if scene.brightness is not None or scene.sheet is not None:
            own |= {"brightness": light.brightness, "power": light.power}
        arrays |= {f"{name}_{key}": value for key, value in own.items()}
    return arrays


def _walls(scene: Scene) -> dict[str, Any]:
    """Return the voxels whose centres are in a wall, (z, y, x), and the centres along each axis [mm]."""
    volume = scene.volume
    grid = Grid.from_extent(centre_mm=volume.centre_mm, size_mm=volume.size_mm, voxel_mm=volume.voxel_mm)
    axes = {f"{name}_mm": grid.axis_mm(number) for number, name in enumerate(AXES)}
    return {"solid": scene.solid(grid.centres_mm()).reshape(grid.shape), **axes}


def write_camera(
    scene: Scene, number: int, folder: Path, *, static: StaticLight | None, pattern: SensorPattern | None
) -> None:
    """Write what one camera's images contain that ideal ones do not.

    Parameters
    ----------
    number : int
        Number of the camera.
    folder : Path
        Existing folder.
    static : StaticLight or None
        Its light that is not from particles.
    pattern : SensorPattern or None
        Fixed pattern of its sensor.
    """
    camera = scene.camera[number]
    flip = FLIPS[camera.image_flip]
    if static is not None:
        images = {f"surface_{index}": image for index, (_, image) in enumerate(static.surfaces)}
        images |= {"stray": static.stray, "ambient": static.ambient}
        stored: dict[str, Any] = {name: image[flip].astype(np.float32) for name, image in images.items()}
        np.savez_compressed(folder / f"light_{camera.name}.npz", **stored)
    if pattern is not None:
        arrays = {name: value[flip] for name, value in vars(pattern).items()}
        stored = {name: value if value.dtype == bool else value.astype(np.float32) for name, value in arrays.items()}
        np.savez_compressed(folder / f"sensor_{camera.name}.npz", **stored)
    if camera.array is not None:
        renderer = render_camera(camera, seed=[scene.seed, 3, number])
        index = np.argwhere(renderer.lens_gain == 0) + renderer.first_lens
        np.savez_compressed(
            folder / f"array_{camera.name}.npz", dead_index=index, dead_centre_mm=_centres_mm(scene, number, index)
        )


def _centres_mm(scene: Scene, number: int, index: np.ndarray) -> np.ndarray:
    """Return the centres (s, t) of lenses (n, 2), drift of the pitch included [mm]."""
    camera = scene.camera[number]
    regular = camera.lattice.centres_mm(index)
    return regular + camera.faults[:2] * regular**2

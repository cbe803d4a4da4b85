"""Text of ``README.txt`` in a data set of the benchmark: what to measure, and in which form to hand it in."""

from __future__ import annotations

import textwrap

import numpy as np

from lfpiv.benchmark.cases import Case, case_list
from lfpiv.benchmark.plain_truth import measured_numbers, recommended_grid
from lfpiv.simulation.scene import Scene
from lfpiv.version import __version__

README = "README.txt"
"""Name of the file."""

WIDTH = 100
"""Longest line."""


def readme(case: Case, scene: Scene) -> str:
    """Return the text for one case.

    Parameters
    ----------
    scene : Scene
        Its scene. The text says nothing of the truth.
    """
    sequence = scene.particles.instants is not None
    title = f"Light-field PIV benchmark {case_list().version}, case {case.name}"
    parts = [
        f"{title}\n{'=' * len(title)}",
        _wrapped(case.purpose),
        _wrapped(
            "The images are simulated. experiment.toml states the rig as an experimenter knows it: nominal optics and "
            "angles, dots and depths of the calibration board, volume and time between frames. The true places of the "
            "cameras differ from it. white/ has a white image of each camera, board/ an image of the board at each "
            "depth, particles/ the images of the particles: counts of 12 bits in TIFF files of 16 bits. Rays, axes and "
            "flips are defined on the page `conventions` of lfpiv's documentation."
        ),
        "What to measure\n---------------",
        _wrapped(_task(scene, sequence)),
        _grid(scene),
        "Form of the result\n------------------",
        _wrapped(
            "One NetCDF file, one CSV file, or a folder with one file for each "
            + ("instant" if sequence else "pair")
            + " in ascending order of its name. NetCDF: coordinates x, y, z with the attribute `units` (mm or m), "
            "velocities u, v, w (m/s or mm/s) or displacements dx, dy, dz (voxel or mm), NaN where there is no vector. "
            "CSV: columns `x [mm]`, `y [mm]`, `z [mm]`, `u [m/s]`, `v [m/s]`, `w [m/s]`. Say in the attribute "
            "`window_mm` over which box a vector is an average. Other grids, scattered vectors of single particles, "
            "and other names are understood too: see the page `benchmark` of the documentation."
        ),
        "Score\n-----",
        "    pip install lfpiv\n    lfpiv benchmark score DIR RESULT.nc",
        _wrapped(
            "DIR is this folder. Where the truth lies in another folder, the one who has it adds --truth DIR2. The "
            "truth is also there in plain form: flow.nc has the true vectors on the recommended grid, particles.csv "
            "the true particles."
        ),
        "Citation and licence\n--------------------",
        _wrapped(
            f"Made by lfpiv {__version__}. Cite lfpiv (CITATION.cff in its repository), the version of the benchmark "
            f"({case_list().version}) and the name of the case. Licence of the data: BSD-3-Clause, as of lfpiv."
        ),
    ]
    if case.tracers is not None:
        parts.append(_wrapped(f"Flow: {case.tracers.source}. Licence: {case.tracers.licence}."))
    return "\n\n".join(parts) + "\n"


def _task(scene: Scene, sequence: bool) -> str:
    numbers = measured_numbers(scene)
    which = f"{numbers[0]} to {numbers[-1]}" if len(numbers) > 1 else f"{numbers[0]}"
    if sequence:
        return (
            f"The velocity at the instants {which}: from each to the next one, {scene.dt_s:g} s later, at the places "
            "midway between both. All instants may be used for each."
        )
    return (
        f"The velocity of the pairs {which}: from frame a to frame b, {scene.dt_s:g} s later, at the places midway "
        "between both. Each pair has other particles."
    )


def _grid(scene: Scene) -> str:
    """Return the recommended grid as lines of text."""
    grid, volume = recommended_grid(scene), scene.volume
    size = " x ".join(f"{edge:g}" for edge in volume.size_mm)
    lines = [
        f"Volume:  {size} mm (x, y, z), centre at {', '.join(f'{place:g}' for place in volume.centre_mm)} mm",
        f"Voxel:   {volume.voxel_mm:g} mm, the unit of errors",
        f"Vectors: averages over cubes of {grid.window_mm:g} mm, centres {grid.spacing_mm:g} mm apart (recommended):",
    ]
    for axis in "xyz":
        places: np.ndarray = getattr(grid, axis)
        lines.append(f"         {axis} = {places[0]:g} to {places[-1]:g} mm, {len(places)} centres")
    return "\n".join(lines)


def _wrapped(text: str) -> str:
    return textwrap.fill(text, WIDTH, break_on_hyphens=False)

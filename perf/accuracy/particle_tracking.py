"""Measure what particle tracking finds against seeding, cameras and quality of the images.

    python perf/accuracy/particle_tracking.py --out docs/figures/particle_tracking.json

Cases are those of `reconstruction_cases`: ideal cameras, a ring vortex, clean and realistic images. The smooth stray
light is subtracted, as a run subtracts what stands still in all of its images. Rows that the file has are not measured
again.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import xarray as xr
from reconstruction_bench import CACHE
from reconstruction_cases import ANGLES_DEG, CONDITIONS, Case, Recorded, Rig, make_flow, make_rig, record
from reconstruction_ways import weights_of

from lfpiv import files
from lfpiv.geometry.grid import Layers
from lfpiv.geometry.volume import lies_in
from lfpiv.metrics.particles import match_particles
from lfpiv.reproduce.rigs import VOXEL_MM
from lfpiv.simulation.camera_images import render_camera
from lfpiv.tracking.finding import ParticleSearch
from lfpiv.tracking.found import FoundParticles
from lfpiv.tracking.linking import link_particles
from lfpiv.tracking.pairing import exchange

PPM = {"clean": (0.02, 0.05, 0.1, 0.2, 0.3), "real": (0.02, 0.05, 0.1)}
"""Seedings of each condition."""
CAMERAS = (2, 1, 3)
BRIGHT = 0.4
"""Least light of a particle, relative to the mean of all particles at the centre of the sheet, of a bright one."""
SPREAD_VOXEL = 1.5
"""Spread of displacements that links assume: no correlation predicts them."""
ASIDE_VOXEL = 5
"""Width of the lit region beside the volume in realistic images [voxel]."""
WRONG_VOXEL = 1.0
"""Error of a displacement above which a link joins two particles [voxel]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Measured:
    """What tracking makes of a recording."""

    found: tuple[FoundParticles, ...]
    """Particles of each frame."""
    links: xr.Dataset
    """Links from the first frame to the second."""
    cpu_s: float
    """CPU time of a frame."""


def search(case: Case, rig: Rig, recorded: Recorded, **settings: float) -> Measured:
    """Find the particles of both frames with settings of `ParticleSearch`, and link them."""
    grid = rig.grid.padded(lit_layers(case, rig))
    particles = ParticleSearch(weights_of(rig, grid), rig.grid, **settings)
    start = time.process_time()
    fits = [
        particles.fit(
            subtracted_light(case, rig, one), noise={name: rig.noise(name, image) for name, image in one.items()}
        )
        for one in recorded.images
    ]
    found = exchange(particles, fits, spread_voxel=SPREAD_VOXEL)
    cpu_s = (time.process_time() - start) / len(found)
    links = link_particles(found[0], found[1], dt_s=1.0, spread_voxel=SPREAD_VOXEL)
    return Measured(found=found, links=links, cpu_s=cpu_s)


def measure(case: Case, folder: Path) -> dict[str, float]:
    """Find the particles of both frames, link them, and compare them with the truth; see `figures_of`."""
    rig, recorded = make_rig(case.scale, case.angles_deg), record(case, folder / "images")
    return figures_of(case, rig, recorded, search(case, rig, recorded))


def figures_of(case: Case, rig: Rig, recorded: Recorded, measured: Measured) -> dict[str, float]:
    """Compare particles and links with the truth.

    Returns
    -------
    dict
        `particles` in the volume; `found`, share of them with a found particle within a voxel, and `found_bright`, of
        the bright particles; `false`, share of found particles in the volume without a true particle; `position_x`,
        `_y`, `_z`,
        `position`, root mean square errors, `median_z` [voxel]; `linked`, valid links per particle; `wrong`, share of
        valid links off by more than a voxel; `moved_x`, `_y`, `_z`, mean errors of the displacement [voxel]; `within`,
        share of their components within two standard errors; `crowding`; `yield`, links per found particle; `cpu_s` of
        a frame.
    """
    rows = [_positions(rig, recorded, frame, one) for frame, one in enumerate(measured.found)]
    figures = {"cpu_s": measured.cpu_s} | {name: float(np.nanmean([row[name] for row in rows])) for name in rows[0]}
    return figures | _displacements(case, rig, measured.links, figures["particles"])


def lit_layers(case: Case, rig: Rig) -> Layers:
    """Return guard layers as wide as particles are lit beyond the volume, which a user knows from the light sheet."""
    beyond = CONDITIONS[case.condition].beyond
    along_z, aside = (max(1, round(count)) for count in (beyond * rig.grid.shape[0], ASIDE_VOXEL if beyond else 0))
    return (along_z, along_z), (aside, aside), (aside, aside)


def subtracted_light(case: Case, rig: Rig, images: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the light of each camera above the dark level and smooth stray light."""
    light = {name: rig.light(name, image) for name, image in images.items()}
    stray = CONDITIONS[case.condition].stray
    for number, camera in enumerate(rig.cameras if stray is not None else ()):
        fixed = np.random.default_rng([case.seed, 33, number])
        lens, _ = stray.fields(light[camera.name].shape, render_camera(camera).pixel_mm, fixed)
        light[camera.name] = light[camera.name] - np.float32(stray.lens_counts * lens * rig.white[camera.name])
    return light


def _positions(rig: Rig, recorded: Recorded, frame: int, found: FoundParticles) -> dict[str, float]:
    true, light = recorded.positions_mm[frame], recorded.light[frame]
    pairs = match_particles(found.positions_mm, true, VOXEL_MM) if len(found) else np.zeros((0, 2), int)
    hit, right = np.zeros(len(true), bool), np.zeros(len(found), bool)
    right[pairs[:, 0]], hit[pairs[:, 1]] = True, True
    there, here = lies_in(true, rig.grid), lies_in(found.positions_mm, rig.grid)
    inner = pairs[there[pairs[:, 1]]]
    miss = (found.positions_mm[inner[:, 0]] - true[inner[:, 1]]) / VOXEL_MM
    rms = np.sqrt(np.square(miss).mean(0)) if len(inner) else np.full(3, np.nan)
    return {
        "particles": float(there.sum()),
        "found": float(hit[there].mean()),
        "found_bright": float(hit[there & (light >= BRIGHT)].mean()),
        "false": float((~right[here]).mean()) if here.any() else float("nan"),
        **{f"position_{axis}": float(value) for axis, value in zip("xyz", rms, strict=True)},
        "position": float(np.sqrt(np.square(rms).sum())),
        "median_z": float(np.median(np.abs(miss[:, 2]))) if len(inner) else float("nan"),
        "crowding": found.crowding,
        "size_voxel": found.sigma_voxel,
    }


def _displacements(case: Case, rig: Rig, links: xr.Dataset, particles: float) -> dict[str, float]:
    middle = np.stack([links[axis].values for axis in "xyz"], axis=1)
    chosen = links["valid"].values & lies_in(middle, rig.grid)
    moved = np.stack([links[f"displacement_{axis}"].values for axis in "xyz"], axis=1)[chosen]
    error = np.stack([links[f"uncertainty_{axis}"].values for axis in "xyz"], axis=1)[chosen]
    miss = moved - make_flow(case)(middle[chosen]) / VOXEL_MM
    wrong = np.linalg.norm(miss, axis=1) > WRONG_VOXEL
    mean = np.abs(miss).mean(0) if len(miss) else np.full(3, np.nan)
    return {
        "linked": float(len(miss) / particles),
        "wrong": float(wrong.mean()) if len(miss) else float("nan"),
        **{f"moved_{axis}": float(value) for axis, value in zip("xyz", mean, strict=True)},
        "within": float((np.abs(miss) < 2 * error).mean()) if len(miss) else float("nan"),
        "yield": float(links.sizes["particle"] / max(np.mean(links.attrs["found"]), 1)),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="JSON file of the figures")
    parser.add_argument("--conditions", default="clean,real", help=", ".join(CONDITIONS))
    parser.add_argument("--cameras", default=",".join(map(str, CAMERAS)), help="numbers of cameras, 1 to 4")
    parser.add_argument("--ppm", help="particles per microlens; default: by condition")
    parser.add_argument("--seeds", default="1")
    parser.add_argument("--cache", type=Path, default=CACHE, help="folder of images")
    options = parser.parse_args(arguments)
    rows = json.loads(options.out.read_text("utf-8"))["rows"] if options.out.exists() else []
    known = {(row["condition"], row["cameras"], row["ppm"], row["seed"]) for row in rows}
    seeds = [int(seed) for seed in options.seeds.split(",")]
    counts = [int(count) for count in options.cameras.split(",")]
    for seed, count, condition in product(seeds, counts, options.conditions.split(",")):
        for ppm in [float(value) for value in options.ppm.split(",")] if options.ppm else PPM[condition]:
            if (condition, count, ppm, seed) in known:
                continue
            case = Case(ppm=ppm, seed=seed, condition=condition, angles_deg=ANGLES_DEG[count])
            figures = measure(case, options.cache)
            rows.append({"condition": condition, "cameras": count, "ppm": ppm, "seed": seed, "figures": figures})
            shown = ("found", "found_bright", "false", "position", "position_z", "linked", "wrong", "moved_z", "yield")
            print(case.label, *(f"{name} {figures[name]:.3f}" for name in (*shown, "crowding", "cpu_s")), flush=True)
            files.write_json(files.plain({"rows": rows}), options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())

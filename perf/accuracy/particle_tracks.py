"""Measure tracks over a time series against links between two instants: found, false, position, velocity.

    python perf/accuracy/particle_tracks.py --seeds 1,2

Cases are those of `reconstruction_cases`, as in `particle_tracking`, with several instants. The flow `dns` moves
tracers of the sample data's Rayleigh-Benard convection. True velocities and accelerations are those of splines through
the true positions. `inner_velocity` is that of rows beside which their track has others, before and after.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from itertools import pairwise, product
from pathlib import Path

import numpy as np
import xarray as xr
from particle_tracking import lit_layers, subtracted_light
from reconstruction_bench import BLOBS, CACHE
from reconstruction_cases import ANGLES_DEG, CONDITIONS, Case, Recorded, Rig, make_rig, record
from reconstruction_ways import weights_of
from scipy.interpolate import CubicSpline

from lfpiv import files
from lfpiv.geometry.volume import lies_in
from lfpiv.metrics.particles import match_particles
from lfpiv.reproduce.rigs import VOXEL_MM
from lfpiv.tracking.finding import ParticleSearch
from lfpiv.tracking.fit import Fit
from lfpiv.tracking.following import Candidates, TrackedParticles, follow
from lfpiv.tracking.found import FoundParticles
from lfpiv.tracking.linking import link_particles
from lfpiv.tracking.pairing import exchange
from lfpiv.tracking.refinement import Cloud
from lfpiv.tracking.tracks import SHORTEST, track_table

SPREAD_VOXEL = 1.5
"""Spread of displacements that links assume: no correlation predicts them."""


def links_of(search: ParticleSearch, fits: Sequence[Fit]) -> list[xr.Dataset]:
    """Return the links of successive instants."""
    tables = []
    for pair in pairwise(fits):
        first, second = exchange(search, [copy(fit) for fit in pair], spread_voxel=SPREAD_VOXEL)
        tables.append(link_particles(first, second, dt_s=1.0, spread_voxel=SPREAD_VOXEL))
    return tables


def followed(
    search: ParticleSearch, tables: Sequence[xr.Dataset], images: Sequence[dict[str, np.ndarray]], noise: list
) -> TrackedParticles:
    """Follow the particles over all instants."""
    size = float(np.median([table.attrs["sigma_voxel"] for table in tables]))
    sized = replace(search, sigma_voxel=size)
    cameras = len(search.weights.cameras)

    def look(instant: int, positions: np.ndarray, light: np.ndarray) -> FoundParticles:
        cloud = Cloud(positions_mm=positions * VOXEL_MM, light=np.repeat(light[:, None], cameras, axis=1))
        return sized.look(images[instant], cloud, noise=noise[instant])

    def candidates(instant: int) -> Candidates:
        frames = [(tables[pair], instant - pair) for pair in (instant, instant - 1) if 0 <= pair < len(tables)]
        return Candidates.from_links(frames, 1)

    return follow(((instant, candidates(instant)) for instant in range(len(images))), look)


def measure(case: Case, folder: Path, **settings: float) -> dict[str, dict[str, float]]:
    """Return the figures of links between two instants and of tracks."""
    rig, recorded = make_rig(case.scale, case.angles_deg), record(case, folder / "images")
    search = ParticleSearch(weights_of(rig, rig.grid.padded(lit_layers(case, rig))), rig.grid, **settings)
    images = [subtracted_light(case, rig, one) for one in recorded.images]
    noise = [{name: rig.noise(name, image) for name, image in one.items()} for one in recorded.images]
    start = time.process_time()
    fits = [search.fit(one, noise=of) for one, of in zip(images, noise, strict=True)]
    tables = links_of(search, fits)
    between = time.process_time()
    table = track_table(followed(search, tables, images, noise), voxel_mm=VOXEL_MM, dt_s=1.0)
    end = time.process_time()
    cost = {"links": between - start, "tracks": end - between}
    rows = {"links": _link_rows(tables), "tracks": _track_rows(table)}
    figures = {name: _figures(rig, recorded, *row) | {"cpu_s": cost[name] / case.frames} for name, row in rows.items()}
    chosen = table["valid"].values
    raw = np.stack([table[f"found_{axis}"].values for axis in "xyz"], axis=1)[chosen]
    instants = table["instant"].values[chosen]
    moved = np.full((len(raw), 3), np.nan)
    figures["unfiltered"] = _figures(rig, recorded, instants, raw, instants, moved, moved, moved)
    number = table["track"].values[chosen]
    inner = np.concatenate([[False], (number[2:] == number[:-2]) & (number[1:-1] == number[:-2]), [False]])
    within = _figures(rig, recorded, *(one[inner] for one in rows["tracks"]))
    figures["tracks"] |= {f"inner_{name}": within[name] for name in ("velocity", "median_velocity")}
    figures["tracks"] |= {"tracks": float(len(np.unique(table["track"].values[chosen])))}
    figures["tracks"] |= _accelerations(rig, recorded, table)
    return figures


def _link_rows(tables: Sequence[xr.Dataset]) -> tuple[np.ndarray, ...]:
    """Return instant, position [mm], time of the velocity, velocity and its error [voxel] of both ends of links."""
    rows = []
    for pair, table in enumerate(tables):
        chosen = table["valid"].values
        middle, moved, error = (
            np.stack([table[f"{name}{axis}"].values for axis in "xyz"], axis=1)[chosen]
            for name in ("", "displacement_", "uncertainty_")
        )
        start = middle - moved * VOXEL_MM / 2
        rows.append(
            (
                np.full(len(start), pair),
                start,
                np.full(len(start), pair + 0.5),
                moved,
                error,
                np.full_like(moved, np.nan),
            )
        )
    return tuple(np.concatenate(one) for one in zip(*rows, strict=True))


def _track_rows(table: xr.Dataset) -> tuple[np.ndarray, ...]:
    chosen = table["valid"].values
    place, error = (
        np.stack([table[f"{name}{axis}"].values for axis in "xyz"], axis=1)[chosen] for name in ("", "uncertainty_")
    )
    moved, moved_error = (
        np.stack([table[name].values for name in names], axis=1)[chosen] * 1e3 / VOXEL_MM
        for names in ("uvw", ("uncertainty_u", "uncertainty_v", "uncertainty_w"))
    )
    instants = table["instant"].values[chosen]
    return instants, place, instants.astype(float), moved, moved_error, error


def _figures(
    rig: Rig,
    recorded: Recorded,
    instants: np.ndarray,
    positions_mm: np.ndarray,
    times: np.ndarray,
    moved: np.ndarray,
    moved_error: np.ndarray,
    error: np.ndarray,
) -> dict[str, float]:
    """Compare positions and velocities with the truth; counts are of all instants together."""
    truth = CubicSpline(np.arange(len(recorded.positions_mm)), np.stack(recorded.positions_mm) / VOXEL_MM)
    true, hit, here, right, miss, off, told, sure = 0, 0, 0, 0, [], [], [], []
    for instant in np.unique(instants):
        own = np.flatnonzero(instants == instant)
        places = recorded.positions_mm[instant]
        inside = lies_in(places, rig.grid)
        pairs = match_particles(positions_mm[own], places, VOXEL_MM)
        true += int(inside.sum())
        hit += int(inside[pairs[:, 1]].sum())
        in_volume = lies_in(positions_mm[own], rig.grid)
        here += int(in_volume.sum())
        right += int(in_volume[pairs[:, 0]].sum())
        pairs = pairs[inside[pairs[:, 1]]]
        rows, particle = own[pairs[:, 0]], pairs[:, 1]
        wrong = (positions_mm[rows] - places[particle]) / VOXEL_MM
        velocity = truth(times[rows[0]], 1)[particle] if len(rows) else np.zeros((0, 3))
        miss.append(wrong)
        off.append(moved[rows] - velocity)
        told.append(np.abs(off[-1]) < 2 * moved_error[rows])
        sure.append(np.abs(wrong) < 2 * error[rows])
    every, moves = np.concatenate(miss), np.concatenate(off)
    distance, speed = np.linalg.norm(every, axis=1), np.linalg.norm(moves, axis=1)
    return {
        "particles": float(true),
        "found": hit / max(true, 1),
        "false": 1 - right / max(here, 1),
        "position": float(np.sqrt(np.mean(distance**2))),
        "median_position": float(np.median(distance)),
        "velocity": float(np.sqrt(np.mean(speed**2))),
        "median_velocity": float(np.median(speed)),
        "velocity_z": float(np.sqrt(np.mean(moves[:, 2] ** 2))),
        "within_position": float(np.concatenate(sure).mean()),
        "within_velocity": float(np.concatenate(told).mean()),
    }


def _accelerations(rig: Rig, recorded: Recorded, table: xr.Dataset) -> dict[str, float]:
    """Compare accelerations with the truth [voxel/instant^2]."""
    truth = CubicSpline(np.arange(len(recorded.positions_mm)), np.stack(recorded.positions_mm) / VOXEL_MM)
    off, told, size = [], [], []
    for instant in range(len(recorded.positions_mm)):
        one = table.isel(particle=table["valid"].values & (table["instant"].values == instant))
        place, found, error = (
            np.stack([one[f"{name}{axis}"].values for axis in "xyz"], axis=1)
            for name in ("", "acceleration_", "uncertainty_acceleration_")
        )
        pairs = match_particles(place, recorded.positions_mm[instant], VOXEL_MM)
        pairs = pairs[lies_in(recorded.positions_mm[instant], rig.grid)[pairs[:, 1]]]
        true = truth(instant, 2)[pairs[:, 1]]
        scale = 1e3 / VOXEL_MM
        off.append(found[pairs[:, 0]] * scale - true)
        told.append(np.abs(off[-1]) < 2 * error[pairs[:, 0]] * scale)
        size.append(true)
    of = {"acceleration": np.concatenate(off), "true_acceleration": np.concatenate(size)}
    figures = {name: float(np.sqrt(np.square(one).sum(1).mean())) for name, one in of.items()}
    return figures | {"within_acceleration": float(np.concatenate(told).mean())}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--conditions", default="clean,real", help=", ".join(CONDITIONS))
    parser.add_argument("--flows", default="swirl,dns")
    parser.add_argument("--kinds", default="blobs", help=", ".join(BLOBS))
    parser.add_argument("--cameras", default="2")
    parser.add_argument("--ppm", default="0.05")
    parser.add_argument("--instants", type=int, default=8, help=f"at least {SHORTEST}")
    parser.add_argument("--seeds", default="1,2")
    parser.add_argument("--rounds", type=int, default=5, help="key of [tracking]")
    parser.add_argument("--cache", type=Path, default=CACHE, help="folder of images")
    parser.add_argument("--json", type=Path, help="file for the figures")
    options = parser.parse_args(arguments)
    stored = []
    texts = (options.conditions, options.flows, options.kinds, options.cameras, options.ppm, options.seeds)
    for condition, flow, kind, cameras, ppm, seed in product(*(text.split(",") for text in texts)):
        case = Case(
            flow=flow,
            ppm=float(ppm),
            seed=int(seed),
            condition=condition,
            blob_voxel=BLOBS[kind],
            angles_deg=ANGLES_DEG[int(cameras)],
            frames=options.instants,
        )
        figures = measure(case, options.cache, rounds=options.rounds)
        stored.append({"case": case.label, "seed": case.seed, "figures": figures})
        print(f"{case.label}, seed {seed}", flush=True)
        for name, row in figures.items():
            print(f"    {name}:", *(f"{key} {value:.4g}" for key, value in row.items()), flush=True)
        if options.json is not None:
            files.write_json(files.plain({"rows": stored}), options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())

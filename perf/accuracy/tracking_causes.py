"""Tell why particle tracking reports false particles and misses true ones, and what links tell about both.

    python perf/accuracy/tracking_causes.py --conditions poly --weakest 0.01 --seeds 1,2,3

A false particle is a `piece` where it overlaps a true particle in all cameras that is found as well, `displaced` where
this particle is not found, a `ghost` where it overlaps another true particle in each camera, `partial`
where it overlaps true particles in some cameras only, and `dark` where it overlaps none. A missed particle is `dim`
below a signal to noise of `CLEAR`, `hidden` where a brighter one covers half of its image in some camera, `displaced`
where a false one stands for it, and `clear` otherwise.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
import particle_tracking
from reconstruction_bench import BLOBS, CACHE
from reconstruction_cases import ANGLES_DEG, CONDITIONS, Case, Recorded, Rig, make_rig, record
from scipy import sparse

from lfpiv import files
from lfpiv.geometry.volume import lies_in
from lfpiv.metrics.particles import match_particles
from lfpiv.reproduce.rigs import VOXEL_MM
from lfpiv.simulation.camera_images import render_camera
from lfpiv.tracking.found import FoundParticles
from lfpiv.tracking.particle_images import ParticleImages

CLEAR = 10.0
"""Signal to noise in the weaker camera from which on a particle is bright enough to be found: a particle must show five
standard errors in each camera, with its place unknown."""
COVERED = 0.5
"""Cosine between images above which two particles overlap."""
COUNTED = ("piece", "displaced", "ghost", "partial", "dark"), ("dim", "hidden", "displaced", "clear")
"""Causes of false and of missed particles."""


@dataclass(frozen=True, kw_only=True)
class Truth:
    """True particles of a frame as the cameras see them."""

    positions_mm: np.ndarray
    light: np.ndarray
    """Light [counts], shape (particle, camera)."""
    signal: np.ndarray
    """Signal to noise of an isolated particle of known place, shape (particle, camera)."""
    images: ParticleImages


def truth_of(case: Case, rig: Rig, recorded: Recorded, frame: int) -> Truth:
    """Return the true particles of a frame and their signal to noise."""
    condition, noise = CONDITIONS[case.condition], CONDITIONS[case.condition].noise
    areas = [render_camera(camera).microimage_px for camera in rig.cameras]
    light = (condition.counts * np.array(areas)[:, None] * recorded.camera_light[frame]).T
    images = ParticleImages(cameras=rig.calibration.cameras, voxel_mm=VOXEL_MM, sigma_voxel=case.blob_voxel)
    per_count = 4095 / noise.full_well_e if noise.full_well_e else 0.0
    signal = np.zeros_like(light)
    for camera, own in enumerate(images.lists(recorded.positions_mm[frame])):
        particle = np.repeat(np.arange(len(light)), np.diff(own.first))
        share = own.values[:, 3].astype(float)
        variance = noise.read_noise**2 + per_count * light[particle, camera] * share
        signal[:, camera] = light[:, camera] * np.sqrt(np.bincount(particle, share**2 / variance, len(light)))
    return Truth(positions_mm=recorded.positions_mm[frame], light=light, signal=signal, images=images)


def overlaps(images: ParticleImages, some_mm: np.ndarray, others_mm: np.ndarray) -> np.ndarray:
    """Return the cosines between images of particles and of others, shape (particle, other, camera)."""
    found = np.zeros((len(some_mm), len(others_mm), len(images.cameras)))
    sizes = np.diff(images.first_pixel)
    one, other = images.lists(some_mm), images.lists(others_mm)
    for camera, size in enumerate(sizes):
        a, b = (
            sparse.csr_array((own.values[:, 3].astype(float), own.pixel, own.first), shape=(len(own.first) - 1, size))
            for own in (one[camera], other[camera])
        )
        norm = [np.sqrt(np.maximum(lists.multiply(lists).sum(1), 1e-30)) for lists in (a, b)]
        found[:, :, camera] = (a @ b.T).toarray() / norm[0][:, None] / norm[1]
    return found


def false_causes(truth: Truth, found: FoundParticles, pairs: np.ndarray, chosen: np.ndarray) -> list[str]:
    """Return the cause of each chosen false particle."""
    overlap = overlaps(truth.images, found.positions_mm[chosen], truth.positions_mm)
    hit = np.zeros(len(truth.positions_mm), bool)
    hit[pairs[:, 1]] = True
    causes = []
    for one in overlap:
        every = one.min(1)
        covered = (one > COVERED).any(0)
        if every.max(initial=0) > COVERED:
            causes.append("piece" if hit[every.argmax()] else "displaced")
        else:
            causes.append("ghost" if covered.all() else "partial" if covered.any() else "dark")
    return causes


def missed_causes(truth: Truth, found: FoundParticles, chosen: np.ndarray, false: np.ndarray) -> list[str]:
    """Return the cause of each chosen missed particle."""
    overlap = overlaps(truth.images, truth.positions_mm[chosen], truth.positions_mm)
    stand_in = overlaps(truth.images, truth.positions_mm[chosen], found.positions_mm[false]).min(2)
    causes = []
    for number, particle in enumerate(chosen):
        brighter = (truth.light > truth.light[particle]) & (overlap[number] > COVERED)
        if truth.signal[particle].min() < CLEAR:
            causes.append("dim")
        elif stand_in[number].max(initial=0) > COVERED:
            causes.append("displaced")
        else:
            causes.append("hidden" if brighter.any() else "clear")
    return causes


def frame_figures(
    case: Case, rig: Rig, recorded: Recorded, frame: int, found: FoundParticles, partner: np.ndarray
) -> dict[str, float]:
    """Return counts of one frame; `partner` tells the found particles that have a valid link."""
    truth = truth_of(case, rig, recorded, frame)
    pairs = match_particles(found.positions_mm, truth.positions_mm, VOXEL_MM) if len(found) else np.zeros((0, 2), int)
    right, hit = np.zeros(len(found), bool), np.zeros(len(truth.light), bool)
    right[pairs[:, 0]], hit[pairs[:, 1]] = True, True
    here, there = lies_in(found.positions_mm, rig.grid), lies_in(truth.positions_mm, rig.grid)
    bright = there & (truth.signal.min(1) >= CLEAR)
    linked_hit = np.zeros(len(hit), bool)
    linked_hit[pairs[partner[pairs[:, 0]], 1]] = True
    false = np.flatnonzero(here & ~right)
    counts = {
        "true": there.sum(),
        "hit": (hit & there).sum(),
        "bright": bright.sum(),
        "bright_hit": (hit & bright).sum(),
        "bright_linked": (linked_hit & bright).sum(),
        "found": here.sum(),
        "false": len(false),
        "linked": (here & partner).sum(),
        "linked_false": (here & partner & ~right).sum(),
    }
    causes = Counter(f"false {cause}" for cause in false_causes(truth, found, pairs, false))
    causes += Counter(
        f"linked false {cause}" for cause in false_causes(truth, found, pairs, np.flatnonzero(here & ~right & partner))
    )
    missed = np.flatnonzero(there & ~hit)
    causes += Counter(f"missed {cause}" for cause in missed_causes(truth, found, missed, np.flatnonzero(~right)))
    return {name: float(value) for name, value in {**counts, **causes}.items()}


def measure(case: Case, folder: Path, **settings: float) -> tuple[dict[str, float], dict[str, float]]:
    """Return counts of both frames by cause, and the figures of `particle_tracking`."""
    rig, recorded = make_rig(case.scale, case.angles_deg), record(case, folder / "images")
    measured = particle_tracking.search(case, rig, recorded, **settings)
    valid = measured.links["valid"].values
    total: Counter[str] = Counter()
    for frame, found in enumerate(measured.found):
        partner = np.zeros(len(found), bool)
        partner[measured.links[("first", "second")[frame]].values[valid]] = True
        total.update(frame_figures(case, rig, recorded, frame, found, partner))
    return dict(total), particle_tracking.figures_of(case, rig, recorded, measured)


def summary(total: dict[str, float]) -> str:
    """Return the counts of one or several cases as text."""

    def share(part: str, whole: str) -> str:
        return f"{100 * total.get(part, 0) / max(total.get(whole, 0), 1):.1f} %"

    parts = [
        f"found {share('hit', 'true')} of {total['true']:.0f}, bright {share('bright_hit', 'bright')} of "
        f"{total['bright']:.0f}, bright and linked {share('bright_linked', 'bright')}; false {share('false', 'found')} "
        f"of {total['found']:.0f}, of linked {share('linked_false', 'linked')} of {total['linked']:.0f}"
    ]
    for kind, causes in zip(("false", "missed"), COUNTED, strict=True):
        parts.append(f"{kind}: " + ", ".join(f"{cause} {total.get(f'{kind} {cause}', 0):.0f}" for cause in causes))
    linked = {name: value for name, value in total.items() if name.startswith("linked false ")}
    parts.append(", ".join(f"{name} {value:.0f}" for name, value in linked.items()))
    return "\n    ".join(part for part in parts if part)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--conditions", default="poly,real", help=", ".join(CONDITIONS))
    parser.add_argument("--kinds", default="blobs,points", help=", ".join(BLOBS))
    parser.add_argument("--cameras", default="2")
    parser.add_argument("--ppm", default="0.05")
    parser.add_argument("--seeds", default="1,2,3")
    parser.add_argument("--weakest", type=float, default=0.05, help="key of [tracking]")
    parser.add_argument("--cache", type=Path, default=CACHE, help="folder of images")
    parser.add_argument("--json", type=Path, help="file for the counts")
    options = parser.parse_args(arguments)
    stored = []
    cases = product(options.conditions.split(","), options.kinds.split(","), options.cameras.split(","))
    for condition, kind, cameras in cases:
        for ppm in options.ppm.split(","):
            total: Counter[str] = Counter()
            for seed in options.seeds.split(","):
                case = Case(
                    ppm=float(ppm),
                    seed=int(seed),
                    condition=condition,
                    blob_voxel=BLOBS[kind],
                    angles_deg=ANGLES_DEG[int(cameras)],
                )
                counts, figures = measure(case, options.cache, weakest=options.weakest)
                total.update(counts)
                stored.append({"case": case.label, "seed": case.seed, "counts": counts, "figures": figures})
                shown = ("position", "size_voxel", "wrong", "linked", "cpu_s")
                print(f"{case.label}, seed {seed}:", *(f"{name} {figures[name]:.3f}" for name in shown), flush=True)
                print("    " + summary(counts), flush=True)
                if options.json is not None:
                    files.write_json(files.plain({"rows": stored}), options.json)
            print(f"TOTAL {condition} {kind} {cameras} cameras {ppm}\n    {summary(total)}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())

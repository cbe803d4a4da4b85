"""Volumes, vectors and particles for some thirty settings: `python bits.py OUT.npz CORES` stores them as arrays."""

import dataclasses
import functools
import os
import sys
from pathlib import Path

import numpy as np

if __name__ == "__main__":
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: int(sys.argv[2])])  # before anything counts the cores
    sys.path.insert(0, str(Path(__file__).parents[1]))

from contract.ideal import Camera, Rig, pair_of_cameras

import lfpiv

MOVED_VOXEL = (0.7, -0.4, 0.3)
"""Displacement of the particles along x, y, z [voxel]."""
VECTORS = ("displacement_x", "displacement_y", "displacement_z", "valid", "peak_ratio", "correlation", "uncertainty")
PARTICLES = ("x", "y", "z", "displacement_x", "displacement_y", "displacement_z", "intensity", "valid")


def rigs():
    """Return rigs by name, each with its weights made when first asked for."""
    two, profiles = pair_of_cameras(), {"form": "profiles"}
    third, fourth = Camera("third", 1.3), Camera("fourth", 178.0)
    return {
        "two cameras": Rig(two),
        "pixels": Rig(two, options={"form": "pixels"}),
        "each voxel": Rig(two, options={**profiles, "planes": False}),
        "counted": Rig(two, (6, 8, 8), options={"method": "count", "rays": 1024}),
        "small particles": Rig(two, options={"form": "pixels", "particle_voxel": 0.4}),
        "hexagonal": Rig(pair_of_cameras(layout="hexagonal")),
        "rolled": Rig(pair_of_cameras(roll_deg=4.0), options=profiles),
        "coma": Rig(pair_of_cameras(coma=0.05), options={"form": "pixels"}),
        "one camera": Rig(two[:1], options=profiles),
        "three cameras": Rig((*two, third), options=profiles),
        "four cameras": Rig((*two, third, fourth), options=profiles),
        "unlike light": Rig((two[0], Camera("right", -45.4, light=0.3)), options=profiles),
        "shared profiles": Rig(two, (20, 32, 32), profiles, voxel_mm=0.06, particles=150),
        "steep": Rig((Camera("left", 20.0), Camera("right", -33.0)), options=profiles),
    }


SETTINGS = {
    "whole passes": {"subsets": 1},
    "four subsets": {"subsets": 4},
    "plain": {"accelerate": False, "iterations": 5},
    "paper": {"normalisation": "paper", "relaxation": 2.0, "iterations": 4},
    "relaxed": {"relaxation": 0.6},
    "sieve": {"sieve_voxel": 0.7},
    "no sieve": {"sieve_voxel": 0.0},
    "capped": {"intensity_cap": 1.0},
    "floor": {"floor": 4.0, "floor_share": 0.0},
    "all iterations": {"tolerance": 0.0, "iterations": 12},
}
"""Settings of `lfpiv.reconstruct` on the rig of two cameras."""


def pictures(rig, *, noise=1.0):
    """Return the images of both frames."""
    return [
        rig.images(rig.blobs(1, moved_voxel=moved), noise=noise, seed=number)
        for number, moved in enumerate([(0.0, 0.0, 0.0), MOVED_VOXEL])
    ]


def arrays_of(volumes, **settings):
    """Return arrays of two volumes, if they are reconstructed their misfits, and the vectors between them."""
    arrays = {f"volume {number}": np.asarray(volume) for number, volume in enumerate(volumes)}
    if hasattr(volumes[0], "misfit"):
        arrays["misfit"] = np.array([figure for volume in volumes for figure in volume.misfit])
    vectors = lfpiv.correlate(*volumes, **({"windows": (6, 6)} | settings))
    return arrays | {name: vectors[name].values for name in VECTORS}


def measured(rig, **settings):
    """Reconstruct both frames and correlate them."""
    return arrays_of([lfpiv.reconstruct(rig.weights, images, **settings) for images in pictures(rig)])


def cut_off(rig):
    """Reconstruct noisy images of a camera that stores no counts below 0."""
    frames = [{n: np.maximum(image, 0) for n, image in images.items()} for images in pictures(rig, noise=6.0)]
    return arrays_of([lfpiv.reconstruct(rig.weights, images) for images in frames])


def started(rig):
    """Start from a guess of the caller's."""
    first = np.full(rig.shape, 5.0, np.float32)
    first[0] = 0
    return measured(rig, first=first)


def tracked(rig):
    """Find the particles of both frames and link them."""
    linked = lfpiv.link_particles(*(lfpiv.find_particles(rig.weights, images) for images in pictures(rig)), dt_s=1e-3)
    return {name: linked[name].values for name in PARTICLES}


def solid(rig):
    """Return a mask of the lowest layers of voxels."""
    mask = np.zeros(rig.shape, bool)
    mask[:, :4] = True
    return mask


def correlated(rig, **settings):
    """Correlate volumes that need no reconstruction."""
    dense = dataclasses.replace(rig, particles=30)
    return arrays_of([dense.blobs(2, moved_voxel=moved) for moved in [(0, 0, 0), MOVED_VOXEL]], **settings)


def cases():
    """Return functions by name; each returns arrays by name."""
    every = rigs()
    two, many = every["two cameras"], every["shared profiles"]
    made = {name: functools.partial(measured, rig) for name, rig in every.items()}
    made |= {name: functools.partial(measured, two, **settings) for name, settings in SETTINGS.items()}
    return made | {
        "shared profiles, no sieve": functools.partial(measured, many, sieve_voxel=0.0),
        "shared profiles, four subsets": functools.partial(measured, many, subsets=4),
        "cut-off images": functools.partial(cut_off, every["unlike light"]),
        "masked": functools.partial(measured, two, mask=solid(two)),
        "first guess": functools.partial(started, two),
        "particles": functools.partial(tracked, two),
        "one pass": functools.partial(correlated, two, windows=6, voxel_mm=0.1),
        "oblong windows": functools.partial(correlated, two, windows=[(8, 12, 10), (4, 8, 6)]),
        "plain correlation": functools.partial(correlated, two, intensity_power=1.0, smoothing_voxel=0.0),
        "masked vectors": functools.partial(correlated, two, mask=solid(two)),
        "wide search": functools.partial(correlated, two, max_displacement_voxel=3.0, overlap=0.75),
    }


NAMES = tuple(cases())


if __name__ == "__main__":
    np.savez(sys.argv[1], **{f"{name}/{key}": a for name, compute in cases().items() for key, a in compute().items()})

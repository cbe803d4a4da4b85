"""Measure the vectors of linked particles beside the correlation's.

    python perf/accuracy/link_vectors.py --flows ring,swirl,turbulent --ppm 0.05,0.1 --seeds 1,2 --cameras 2

`reconstruction_cases` has the cases. Errors are root mean squares along x, y, z over all vectors [voxel].
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np
import xarray as xr
from particle_tracking import lit_layers, subtracted_light
from reconstruction_bench import CACHE
from reconstruction_cases import ANGLES_DEG, Case, make_rig, record, true_field
from reconstruction_ways import by_smart, weights_of

from lfpiv.settings.processing import Correlation
from lfpiv.tracking.finding import ParticleSearch
from lfpiv.tracking.link_vectors import vectors_from_links
from lfpiv.tracking.linking import link_particles
from lfpiv.tracking.pairing import exchange
from lfpiv.velocity.cross_correlation import correlate


def measure(case: Case, folder: Path) -> dict[str, xr.Dataset]:
    """Return the vectors of the correlation, and of the links that it predicts."""
    rig, recorded = make_rig(case.scale, case.angles_deg), record(case, folder / "images")
    volumes = by_smart(rig, recorded, {}).volumes
    options = Correlation(windows=(24, 16, 12, 12)).model_dump() | {"dt_s": 1.0}
    correlated = correlate(volumes[0], volumes[1], **options)
    search = ParticleSearch(weights_of(rig, rig.grid.padded(lit_layers(case, rig))), rig.grid)
    fits = [
        search.fit(
            subtracted_light(case, rig, images), noise={name: rig.noise(name, image) for name, image in images.items()}
        )
        for images in recorded.images
    ]
    links = link_particles(*exchange(search, fits, correlated), correlated, dt_s=1.0)
    return {"correlation": correlated, "links": vectors_from_links(correlated, links)}


def figures(case: Case, vectors: xr.Dataset) -> str:
    """Return errors, share within two stated standard deviations, and share of valid vectors, as text."""
    edge = json.loads(vectors.attrs["settings"])["windows"][-1]
    exact = true_field(case, [vectors[axis].values for axis in "zyx"], edge)
    error = np.stack([vectors[f"displacement_{axis}"].values for axis in "xyz"], axis=-1) - exact
    stated = np.stack([vectors[f"uncertainty_{axis}"].values for axis in "xyz"], axis=-1)
    valid = vectors["valid"].values
    rms, within = np.sqrt(np.mean(error**2, (0, 1, 2))), (np.abs(error) < 2 * stated)[valid].mean(0)
    return (
        f"rms {' '.join(f'{one:.3f}' for one in rms)} within {' '.join(f'{one:.2f}' for one in within)} "
        f"valid {valid.mean():.2f} {vectors.attrs.get('links', '')}"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the figures of each case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flows", default="ring,swirl,turbulent")
    parser.add_argument("--ppm", default="0.05,0.1", help="particles per microlens")
    parser.add_argument("--seeds", default="1,2")
    parser.add_argument("--conditions", default="clean")
    parser.add_argument("--cameras", type=int, default=1)
    parser.add_argument("--cache", type=Path, default=CACHE, help="folder of images")
    options = parser.parse_args(arguments)
    lists = (options.flows, options.conditions, options.ppm, options.seeds)
    angles = ANGLES_DEG[options.cameras]
    for flow, condition, ppm, seed in product(*(text.split(",") for text in lists)):
        case = Case(flow=flow, condition=condition, ppm=float(ppm), seed=int(seed), angles_deg=angles)
        for way, vectors in measure(case, options.cache).items():
            print(f"{flow} {condition} {ppm} {seed} {way:12s} {figures(case, vectors)}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())

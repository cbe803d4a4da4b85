"""Measure time and memory of a pair against the volume's size and the number of cameras, for docs/performance.md.

    python perf/scaling.py --out docs/figures/scaling.json
    python perf/scaling.py --case 100 2 --angles=30,-30

Every case is a process of its own: weights, both volumes and vectors of blobs of 0.7 voxel with the default settings,
on voxels as fine as these particles demand; then, of two and more cameras, volumes and vectors by the joint fit. Images
are projections of known particles with noise.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

EDGES = (32, 48, 64, 100)
"""Edges of the cubic volume with two cameras [voxel]."""
CAMERAS = (1, 2, 3)
"""Numbers of cameras at the edge `CAMERAS_EDGE`."""
CAMERAS_EDGE = 64
WARM_EDGE = 24
BLOB_VOXEL = 0.7
SHIFT = 1.3
"""Displacement along each axis [voxel]."""
PER_VOXEL = 0.005
"""Particles per voxel: 0.5 per microlens at the published size."""
SHARE_NOISE = 0.01
"""Standard deviation of the noise, relative to the brightest pixel."""


def measure(edge: int, cameras: int, angles_deg: Sequence[float] = ()) -> dict[str, Any]:
    """Measure one case in this process, after a small one that loads all kernels."""
    os.environ.update(ENABLE_TAICHI_HEADER_PRINT="0")
    _pair(WARM_EDGE, cameras, angles_deg)
    return _pair(edge, cameras, angles_deg)


def _pair(edge: int, cameras: int, angles_deg: Sequence[float]) -> dict[str, Any]:
    """Measure weights, volumes and vectors of one pair."""
    import inputs

    import lfpiv
    from lfpiv.reconstruction.refinement import needed_refinement
    from lfpiv.settings.processing import Correlation, Smart

    rows, columns = (int(edge * 0.1 * stretch / 0.0055) + 200 for stretch in (1, 2**0.5))
    calibration, user = (
        inputs.rig((rows, columns), cameras=cameras, angles_deg=angles_deg),
        inputs.grid({"voxels": edge}),
    )
    factor = needed_refinement(BLOB_VOXEL)
    weights, weights_s = _timed(
        lambda: _weights(calibration, user.padded(((1, 1),) * 3).refined(factor), factor * BLOB_VOXEL)
    )
    weights.volume = user
    settings, windows = Smart().of_one_frame(factor), Correlation().model_dump()
    images = [_images(weights, factor, number * SHIFT) for number in (0, 1)]
    frames, volumes_s = _timed(
        lambda: [lfpiv.volume_on(lfpiv.reconstruct(weights, one, **settings), user) for one in images]
    )
    _, vectors_s = _timed(lambda: lfpiv.correlate(*frames, dt_s=1e-4, **windows))

    def fitted() -> None:
        volumes = lfpiv.reconstruct_pair(weights, images, estimate="joint", correlation=windows, grid=user, **settings)
        lfpiv.joint_vectors(volumes, dt_s=1e-4, **windows)

    joint_s = _timed(fitted)[1] if cameras > 1 else None
    return {
        "voxels": edge,
        "cameras": cameras,
        "refinement": factor,
        "weights_s": weights_s,
        "weights_gib": weights.memory_bytes / 2**30,
        "volumes_s": volumes_s,
        "vectors_s": vectors_s,
        "joint_s": joint_s,
        "peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }


def _weights(calibration, grid, particle_voxel):
    """Build weights and their sums, which a run needs once."""
    import lfpiv

    weights = lfpiv.build_weights(calibration, grid, particle_voxel=particle_voxel)
    weights.camera_sums  # noqa: B018 - computed on first use
    return weights


def _timed(run: Callable[[], Any]) -> tuple[Any, float]:
    start = time.perf_counter()
    result = run()
    return result, time.perf_counter() - start


def _images(weights, factor: float, shift: float) -> dict[str, np.ndarray]:
    """Return noisy images of the same particles at a place."""
    import work

    light = work.particles(weights.grid.shape, factor * shift, per_voxel=PER_VOXEL / factor**3, sd=factor * BLOB_VOXEL)
    rng = np.random.default_rng(1)
    images = {}
    for name, image in weights(light).items():
        noise = SHARE_NOISE * image.max() * rng.standard_normal(image.shape, np.float32)
        images[name] = image + noise
    return images


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="JSON file of the figures")
    parser.add_argument("--case", type=int, nargs=2, metavar=("EDGE", "CAMERAS"), help="one case in this process")
    parser.add_argument("--angles", default="", help="with --case: angles of the cameras, such as --angles=30,-30")
    options = parser.parse_args(arguments)
    if options.case:
        angles_deg = [float(angle) for angle in options.angles.split(",") if angle]
        print(json.dumps(measure(*options.case, angles_deg)))
        return 0
    cases = sorted({*((edge, 2) for edge in EDGES), *((CAMERAS_EDGE, count) for count in CAMERAS)})
    rows = []
    for case in cases:
        done = subprocess.run(
            [sys.executable, __file__, "--case", *map(str, case)], stdout=subprocess.PIPE, text=True, check=True
        )
        rows.append(json.loads(done.stdout.splitlines()[-1]))
        print(json.dumps(rows[-1]), flush=True)
    if options.out:
        options.out.write_text(
            json.dumps({"cores": len(os.sched_getaffinity(0)), "rows": rows}, indent=1) + "\n", "utf-8"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())

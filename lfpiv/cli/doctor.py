"""`lfpiv doctor`: versions, devices and memory for a bug report, and a self-test of the kernels on this machine."""

from __future__ import annotations

import platform
import time
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from lfpiv.geometry.grid import AXES
from lfpiv.runs import memory
from lfpiv.version import versions
from lfpiv_kernels import runtime

TOLERANCE_MAPPING = 1e-4
"""Largest error of the network on the device: rounding of sums of 20 terms of size 1, and of the device's exp."""

TOLERANCE_SHIFT_VOXEL = 0.05
"""Largest error of the displacement in the self-test [voxel]; its particles are noise-free."""

SHIFT_VOXEL = (0.7, -0.4, 1.3)
"""Displacement (z, y, x) of the self-test [voxel]."""


class Finding(NamedTuple):
    """Result for an item: a package, a device or a self-test."""

    item: str
    finding: str
    good: bool
    """False if it is a fault."""


def examine(device: str = "auto") -> Iterator[Finding]:
    """Yield the findings one by one. The last ones test the kernels and take some seconds.

    Parameters
    ----------
    device : {"auto", "cpu", "cuda"}
        Device to test.
    """
    yield Finding("system", f"{platform.system()} {platform.release()}, {platform.machine()}", True)
    for name, version in versions().items():
        yield Finding(name, version, True)
    yield Finding("CPU cores", str(runtime.cores()), True)
    yield Finding("memory available", f"{memory.available_bytes() / memory.GIB:.1f} GiB", True)
    try:
        running = runtime.start(device)
    except (RuntimeError, ValueError) as error:
        yield Finding("kernels", str(error), False)
        return
    yield from _cuda()
    yield Finding("kernels run on", running.sentence, True)
    for name, test in (("ray mapping (Taichi)", _test_mapping), ("correlation (Warp)", _test_correlation)):
        start = time.perf_counter()
        try:
            finding, good = test()
        except Exception as error:  # any failure of a kernel is the finding
            finding, good = f"{type(error).__name__}: {error}", False
        yield Finding(name, f"{finding}, {time.perf_counter() - start:.1f} s with compilation", good)


def _cuda() -> Iterator[Finding]:
    """Yield the name and the memory of each visible GPU."""
    import warp as wp

    devices = wp.get_cuda_devices()
    if not devices:
        yield Finding("CUDA", "no device visible", True)
    for device in devices:
        free, total = device.free_memory / memory.GIB, device.total_memory / memory.GIB
        yield Finding(f"CUDA {device.alias}", f"{device.name}, {free:.1f} of {total:.1f} GiB free", True)


def _blobs(shape: tuple[int, int, int], centres: np.ndarray) -> np.ndarray:
    """Return a volume of Gaussian particles at `centres` (particle, 3) [voxel], standard deviation 1 voxel."""
    axes = np.ogrid[tuple(slice(n) for n in shape)]
    volume = np.zeros(shape, np.float32)
    for centre in centres:
        volume += np.exp(-sum((axis - at) ** 2 for axis, at in zip(axes, centre, strict=True)) / 2)
    return volume


def _test_mapping() -> tuple[str, bool]:
    """Compare a random network on the device with NumPy, and return the finding and whether it is good."""
    from lfpiv.calibration.network import Network
    from lfpiv_kernels.rays import mapping

    rng = np.random.default_rng(0)
    network = Network(
        weights=(rng.normal(size=(5, 20)), rng.normal(size=(20, 2))),
        biases=(rng.normal(size=20), rng.normal(size=2)),
        input_centre=np.zeros(5),
        input_scale=np.ones(5),
        output_centre=np.zeros(2),
        output_scale=np.ones(2),
    )
    points = rng.uniform(-1, 1, (10_000, 5)).astype(np.float32)
    miss = float(np.abs(mapping.evaluate(network.to_arrays(), points) - network(points)).max())
    return f"network evaluated to {miss:.1e}", miss < TOLERANCE_MAPPING


def _test_correlation() -> tuple[str, bool]:
    """Correlate particles with a known shift, and return the finding and whether it is good."""
    from lfpiv.velocity.cross_correlation import correlate

    rng, shape = np.random.default_rng(0), (24, 32, 32)
    centres = rng.uniform(-3, np.add(shape, 3), (400, 3))
    half = np.asarray(SHIFT_VOXEL) / 2
    first, second = _blobs(shape, centres - half), _blobs(shape, centres + half)
    vectors = correlate(first, second, windows=(16, 16), voxel_mm=1.0, dt_s=1.0)
    names = [f"displacement_{axis}" for axis in AXES]
    middle = tuple(slice(1, -1) if n > 2 else slice(None) for n in vectors["u"].shape)
    miss = max(abs(float(np.median(vectors[n].values[middle])) - d) for n, d in zip(names, SHIFT_VOXEL, strict=True))
    return f"known shift recovered to {miss:.3f} voxel", miss < TOLERANCE_SHIFT_VOXEL

"""Model the memory traffic and time of a pair's kernels on a GPU, on a machine without one.

    python perf/gpu_model.py [--scale small|medium|paper] [--form profiles|pixels] [--json FILE]
    python perf/gpu_model.py --cases CASE ...  # of the benchmark: their times

The kernels' own C++ runs here, lane after lane, on the real arrays of a rig, and notes the address of every access to
the GPU's memory (`LFPIV_TRACE` in ``lanes.h``). A sample of thread blocks stands for a launch.

``gpu_traffic`` says how sectors are counted and times follow. ``gpu_correlation`` models the correlation. The work of
the arithmetic units is left out.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import gpu_correlation
import numpy as np
import warp as wp
from cases import CASES, SCALES, prepare
from gpu_traffic import LAUNCH_S, MEMORY_BYTES_S, Traffic, count_sectors, total
from inputs import grid, rig

import lfpiv
from lfpiv.reconstruction.ordered_subsets import WHOLE_PASSES
from lfpiv.reconstruction.settings import SmartSettings
from lfpiv.reconstruction.sieve import TRUNCATE
from lfpiv.reconstruction.steps import SHARPENED_VOXEL
from lfpiv_kernels import native, runtime
from lfpiv_kernels.lanes import LANES
from lfpiv_kernels.reconstruction import depth_planes_gpu
from lfpiv_kernels.reconstruction.blur import GaussianBlur
from lfpiv_kernels.reconstruction.blur_layout import Axis
from lfpiv_kernels.reconstruction.depth_planes import DepthPlanes
from lfpiv_kernels.reconstruction.pixel_layout import PixelRays
from lfpiv_kernels.reconstruction.pixel_rays import RayMap
from lfpiv_kernels.reconstruction.pixel_rays_gpu import WARPS
from lfpiv_kernels.reconstruction.plane_layout import PlaneMap
from lfpiv_kernels.reconstruction.projector import ALL, Projector
from lfpiv_kernels.reconstruction.projector_gpu import SECTOR, TiledMatrix, TiledProjector
from lfpiv_kernels.transfer import to_device, to_host

HEADERS = ("projector_gpu.h", "pixel_rays_gpu.h", "blur_gpu.h", "depth_planes_gpu.h")
wp.set_module_options(
    native.quiet_options()
    | {
        "extra_build_options": wp.ModuleBuildOptions(
            extra_cpu_include_dirs=[native.FOLDER],
            extra_cpu_preamble="\n".join(["#define LFPIV_TRACE", *(f'#include "{name}"' for name in HEADERS)]),
            extra_build_dependencies=sorted(native.FOLDER.glob("*.h")),
        )
    }
)

WARPS_OF_BLOCK: int = native.constant("projector_gpu.h", "WARPS_OF_BLOCK")
SAMPLED_BLOCKS = 32
"""Thread blocks that stand for a launch."""
EVENTS = 1 << 24
"""Accesses of a sample at most."""
SWEEPS_OF_STEP, BYTES_OF_SWEEP = 6, 12
"""Element-wise sweeps over the volume in one step of SMART, and bytes per voxel of each."""


@wp.func_native("""
    lfpiv::trace = {events.data, (int64_t)events.shape[0] / 2};
    for (int k = 0; k < (int)warps.shape[0]; ++k) {
        lfpiv::trace.warp = k, lfpiv::trace.phase = 0;
        const int warp = warps.data[k];
        if (kernel == 0) lfpiv::gather_voxel(matrix, warp, lenses, rays.data, volume.data, out.data);
        if (kernel == 1) lfpiv::scatter_tile(matrix, warp, lenses, volume.data, rays.data);
    }
    used_out.data[0] = lfpiv::trace.used, used_out.data[1] = lfpiv::trace.exchanges;
""")
def _projector_of(
    kernel: int,
    matrix: TiledMatrix,
    lenses: int,
    volume: wp.array(dtype=float),
    warps: wp.array(dtype=int),
    rays: wp.array(dtype=float),
    out: wp.array(dtype=float),
    events: wp.array(dtype=wp.uint64),
    used_out: wp.array(dtype=wp.int64),
): ...


@wp.func_native("""
    lfpiv::trace = {events.data, (int64_t)events.shape[0] / 2};
    for (int k = 0; k < (int)warps.shape[0]; ++k) {
        lfpiv::trace.warp = k, lfpiv::trace.phase = 0;
        const int warp = warps.data[k];
        if (kernel == 0)
            lfpiv::compare_pixels(map, warp, image.data, image.data, image.data, 1.0f, rays.data, sums.data, sums.data);
        if (kernel == 1) lfpiv::collect_pixels(map, warp, rays.data, image.data);
        if (kernel == 2) lfpiv::spread_pixels(map, warp, image.data, rays.data);
    }
    used_out.data[0] = lfpiv::trace.used, used_out.data[1] = lfpiv::trace.exchanges;
""")
def _pixels_of(
    kernel: int,
    map: PixelRays,
    warps: wp.array(dtype=int),
    image: wp.array(dtype=float),
    rays: wp.array(dtype=float),
    sums: wp.array(dtype=wp.float64),
    events: wp.array(dtype=wp.uint64),
    used_out: wp.array(dtype=wp.int64),
): ...


@wp.func_native("""
    lfpiv::trace = {events.data, (int64_t)events.shape[0] / 2};
    for (int k = 0; k < (int)warps.shape[0]; ++k) {
        lfpiv::trace.warp = k, lfpiv::trace.phase = 0;
        lfpiv::blur_lanes(lfpiv::axis_blur(axis), stride, warps.data[k], (int)volume.shape[0], volume.data, out.data);
    }
    used_out.data[0] = lfpiv::trace.used, used_out.data[1] = lfpiv::trace.exchanges;
""")
def _blur_of(
    axis: Axis,
    stride: int,
    volume: wp.array(dtype=float),
    warps: wp.array(dtype=int),
    out: wp.array(dtype=float),
    events: wp.array(dtype=wp.uint64),
    used_out: wp.array(dtype=wp.int64),
): ...


@wp.func_native("""
    lfpiv::trace = {events.data, (int64_t)events.shape[0] / 2};
    for (int k = 0; k < (int)warps.shape[0]; ++k) {
        lfpiv::trace.warp = k, lfpiv::trace.phase = 0;
        const int warp = warps.data[k];
        if (kernel == 0)
            lfpiv::spread_nodes(lfpiv::plane_map(map), layers_of.data, warp, false, volume.data, out.data);
        if (kernel == 1) lfpiv::collect_voxels(lfpiv::plane_map(map), warp, volume.data, out.data);
    }
    used_out.data[0] = lfpiv::trace.used, used_out.data[1] = lfpiv::trace.exchanges;
""")
def _planes_of(
    kernel: int,
    map: PlaneMap,
    layers_of: wp.array(dtype=int),
    volume: wp.array(dtype=float),
    warps: wp.array(dtype=int),
    out: wp.array(dtype=float),
    events: wp.array(dtype=wp.uint64),
    used_out: wp.array(dtype=wp.int64),
): ...


@wp.kernel
def _trace_projector(
    # in
    kernel: int,
    matrix: TiledMatrix,
    lenses: int,
    volume: wp.array(dtype=float),
    warps: wp.array(dtype=int),
    # out
    rays_out: wp.array(dtype=float),
    volume_out: wp.array(dtype=float),
    events_out: wp.array(dtype=wp.uint64),
    used_out: wp.array(dtype=wp.int64),
):
    _projector_of(kernel, matrix, lenses, volume, warps, rays_out, volume_out, events_out, used_out)


@wp.kernel
def _trace_pixels(
    # in
    kernel: int,
    map: PixelRays,
    warps: wp.array(dtype=int),
    # out
    image_out: wp.array(dtype=float),
    rays_out: wp.array(dtype=float),
    sums_out: wp.array(dtype=wp.float64),
    events_out: wp.array(dtype=wp.uint64),
    used_out: wp.array(dtype=wp.int64),
):
    _pixels_of(kernel, map, warps, image_out, rays_out, sums_out, events_out, used_out)


@wp.kernel
def _trace_blur(
    # in
    axis: Axis,
    stride: int,
    volume: wp.array(dtype=float),
    warps: wp.array(dtype=int),
    # out
    volume_out: wp.array(dtype=float),
    events_out: wp.array(dtype=wp.uint64),
    used_out: wp.array(dtype=wp.int64),
):
    _blur_of(axis, stride, volume, warps, volume_out, events_out, used_out)


@wp.kernel
def _trace_planes(
    # in
    kernel: int,
    map: PlaneMap,
    layers_of: wp.array(dtype=int),
    volume: wp.array(dtype=float),
    warps: wp.array(dtype=int),
    # out
    volume_out: wp.array(dtype=float),
    events_out: wp.array(dtype=wp.uint64),
    used_out: wp.array(dtype=wp.int64),
):
    _planes_of(kernel, map, layers_of, volume, warps, volume_out, events_out, used_out)


def _aligned(value: object) -> object:
    """Return an array, or a struct with its arrays, that begins a sector as on a GPU: a copy if it does not."""
    if isinstance(value, np.ndarray):
        value = to_device(value, device="cpu")
    if isinstance(value, wp.array):
        return value if value.ptr is None or value.ptr % SECTOR == 0 else wp.clone(value)
    for name in getattr(getattr(value, "_cls", None), "vars", ()):
        if isinstance(array := getattr(value, name), wp.array):
            setattr(value, name, _aligned(array))
    return value


def _launch_traced(kernel: wp.Kernel, arguments: list[object]) -> None:
    """Run a kernel that notes its accesses, on arrays in the host's memory; the notes are its last two arguments."""
    notes = [to_device(one, device="cpu") for one in arguments[-2:]]
    arrays = [*map(_aligned, arguments[:-2]), *notes]
    wp.launch(kernel, dim=1, inputs=arrays, device="cpu")


class Tracer:
    """Run kernels on a sample of their warps and count what these access."""

    def __init__(self, blocks: int = SAMPLED_BLOCKS):
        self._blocks = blocks
        self._events = np.empty(2 * EVENTS, np.uint64)
        self._used = np.zeros(2, np.int64)

    def trace(
        self, name: str, kernel: wp.Kernel, warps: int, call: Callable[[np.ndarray], list[object]], memory: float
    ) -> Traffic:
        """Trace a launch of `warps`; `call` returns the kernel's arguments for the warps of a sample.

        Raises
        ------
        RuntimeError
            If the sample has more accesses than there is room for.
        """
        blocks = -(-warps // WARPS_OF_BLOCK)
        chosen = np.unique(np.linspace(0, blocks - 1, min(self._blocks, blocks)).round().astype(np.int64))
        sample = (chosen[:, None] * WARPS_OF_BLOCK + np.arange(WARPS_OF_BLOCK)).ravel()
        sample = sample[sample < warps].astype(np.int32)
        _launch_traced(kernel, [*call(sample), self._events, self._used])
        accesses, exchanges = map(int, self._used)
        if accesses > EVENTS:
            raise RuntimeError(f"{name}: {accesses} accesses in the sample, room for {EVENTS}; sample fewer blocks.")
        events = self._events[: 2 * accesses].reshape(-1, 2)
        return count_sectors(name, events, exchanges, warps / len(sample), memory, warps, WARPS_OF_BLOCK)


def trace_gather(tiled: TiledProjector, voxel: int) -> tuple[np.ndarray, float]:
    """Gather one voxel; return its accesses, see ``Trace`` in ``lanes.h``, and its light."""
    events, used = np.zeros(2 * EVENTS // 64, np.uint64), np.zeros(2, np.int64)
    active = np.ones(len(tiled.matrix.scale), np.float32)
    out = wp.zeros(len(active), dtype=float, device="cpu")
    warps = np.array([voxel], np.int32)
    _launch_traced(_trace_projector, [0, tiled.matrix, ALL, active, warps, tiled.rays, out, events, used])
    return events[: 2 * used[0]].reshape(-1, 2), float(to_host(out)[voxel])


def model_projector(tracer: Tracer, projector: Projector, lenses: int = ALL) -> list[Traffic]:
    """Return the traffic of a camera's passes between voxels and pixels, without its planes."""
    tiled = TiledProjector(projector.blocks)
    matrix, voxels = tiled.matrix, len(projector.blocks.scale)
    light = np.ones(voxels, np.float32)
    map_ = _ray_map(projector, tiled)
    size = int(np.prod(projector.microimages.sensor_shape))
    part = 1.0 if lenses == ALL else 0.5
    heads = 4 + 1 + (0 if matrix.profiles else 5)
    count = len(projector.blocks.ray)
    values, lit = 4 * matrix.word.size, 4 * map_.rays.place.size
    passes = [
        tracer.trace(
            "scatter",
            _trace_projector,
            len(matrix.tile_ray),
            lambda warps: [1, matrix, lenses, light, warps, tiled.rays, light],
            part * (values + 12 * matrix.entry_voxel.size) + 8 * voxels + lit,
        ),
        tracer.trace(
            "gather",
            _trace_projector,
            voxels,
            lambda warps: [0, matrix, lenses, light, warps, tiled.rays, light.copy()],
            part * (values + heads * count + lit) + 16 * voxels,
        ),
    ]
    pixels = map_.rays if lenses == ALL else map_.of_lenses[lenses]
    image, sums = np.ones(size, np.float32), np.zeros(WARPS)
    per_ray, lit_pixels = 8 + 8, pixels.end - pixels.start
    bytes_ = {"compare": 16, "collect": 12, "spread": 12}
    for number, name in enumerate(bytes_):
        passes.append(
            tracer.trace(
                name,
                _trace_pixels,
                WARPS,
                lambda warps, number=number: [number, pixels, warps, image, tiled.rays, sums],
                per_ray * part * map_.rays.place.size + bytes_[name] * lit_pixels + 8 * map_.rays.dark.size,
            )
        )
    return passes


def _ray_map(projector: Projector, tiled: TiledProjector) -> RayMap:
    """Return the map between the pixels and a GPU's rays."""
    tiled.scatter(to_device(np.ones(len(projector.blocks.scale), np.float32), device="cpu"), ALL)
    rays = projector.microimages
    two = projector.lens_sets == 2
    return RayMap(rays, tiled.in_order(to_host(tiled.rays)), [0, rays.size], [0], two_sets=two, places=tiled.places)


def model_volume(tracer: Tracer, shape: tuple[int, int, int], sigma_voxel: float) -> Traffic:
    """Return the traffic of a blur: three launches."""
    blur = GaussianBlur(sigma_voxel, shape, truncate=TRUNCATE, border="nearest")
    size = int(np.prod(shape))
    volume, out, stride, axes = np.ones(size, np.float32), np.empty(size, np.float32), size, []
    for axis in blur._axes:
        stride //= len(axis.first)
        arguments = (axis, stride)
        axes.append(
            tracer.trace(
                f"blur {sigma_voxel}",
                _trace_blur,
                -(-size // LANES),
                lambda warps, arguments=arguments: [*arguments, volume, warps, out],
                8 * size,
            )
        )
    return total(f"blur {sigma_voxel}", axes)


def model_planes(tracer: Tracer, projector: Projector) -> list[Traffic]:
    """Return the traffic between voxels and the nodes of a camera's planes."""
    if projector.planes is None:
        return []
    shares = projector.planes
    planes = DepthPlanes(shares)
    layers = depth_planes_gpu.layers_of_planes(shares.plane, shares.nodes[1])
    voxels, nodes = (np.ones(int(np.prod(of)), np.float32) for of in (shares.voxels, shares.nodes))
    sides = (("spread to planes", nodes, voxels), ("collect from planes", voxels, nodes))
    return [
        tracer.trace(
            name,
            _trace_planes,
            -(-out.size // LANES),
            lambda warps, number=number, into=into, out=out: [number, planes._map, layers, into, warps, out],
            into.nbytes + out.nbytes,
        )
        for number, (name, out, into) in enumerate(sides)
    ]


@dataclass(frozen=True)
class Model:
    """Traffic of a rig's kernels."""

    voxels: int
    cameras: int
    weights_bytes: int
    """Memory of all cameras' weights on the GPU."""
    stored_bytes: int
    """The same on the CPU."""
    kernels: list[Traffic]
    """Of the first camera, and of blurs."""

    def seconds(self, name: str) -> float:
        """Return the predicted time of one launch of a kernel; 0 if the rig needs none [s]."""
        return sum(kernel.seconds for kernel in self.kernels if kernel.kernel == name)

    @property
    def epoch_s(self) -> float:
        """Predicted time of a pass over all rays in two subsets of each camera [s]."""
        names = ("scatter half", "gather half", "compare half", "spread to planes", "collect from planes")
        blurs = sum(kernel.seconds for kernel in self.kernels if kernel.kernel.startswith("blur"))
        sweep = BYTES_OF_SWEEP * self.voxels / MEMORY_BYTES_S + LAUNCH_S
        return 2 * self.cameras * (sum(map(self.seconds, names)) + blurs + SWEEPS_OF_STEP * sweep)

    @property
    def whole_s(self) -> float:
        """Predicted time of a pass over all rays at once [s]."""
        names = ("scatter", "gather", "compare", "spread to planes", "collect from planes")
        blurs = sum(kernel.seconds for kernel in self.kernels if kernel.kernel.startswith("blur"))
        sweep = BYTES_OF_SWEEP * self.voxels / MEMORY_BYTES_S + LAUNCH_S
        return self.cameras * sum(map(self.seconds, names)) + blurs + SWEEPS_OF_STEP * sweep

    @property
    def pair_s(self) -> float:
        """Predicted time of two volumes by the default passes [s]; correlation not included."""
        passes = SmartSettings().iterations
        return 2 * ((passes - WHOLE_PASSES) * self.epoch_s + WHOLE_PASSES * self.whole_s)


@cache
def model(scale: str, form: str = "profiles", refinement: float = 1.0) -> Model:
    """Model a rig of the benchmark, see ``cases.SCALES``, on voxels finer by `refinement`."""
    runtime.device()
    of, tracer = SCALES[scale], Tracer()
    voxels = grid(of)
    if refinement != 1.0:
        edge = voxels.voxel_mm / refinement
        voxels = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(0.1 * of["voxels"],) * 3, voxel_mm=edge)
    weights = lfpiv.build_weights(rig(of["sensor"]), voxels, form=form)
    name = next(iter(weights.cameras))
    projector = weights.projector(name)
    kernels = model_projector(tracer, projector)
    kernels += [
        dataclasses.replace(one, kernel=f"{one.kernel} half")
        for one in model_projector(tracer, projector, lenses=0)[:3]
    ]
    kernels += model_planes(tracer, projector)
    kernels += [model_volume(tracer, weights.stored.shape, sigma) for sigma in (0.6, SHARPENED_VOXEL)]
    return Model(
        voxels=weights.grid.size,
        cameras=len(weights.cameras),
        weights_bytes=sum(TiledProjector(weights.projector(name).blocks).nbytes for name in weights.cameras),
        stored_bytes=weights.memory_bytes,
        kernels=kernels,
    )


CORRELATION = ("_correlate", "_deform", "_vectors")
"""Functions that prepare the cases of the correlation."""


def predicted(case: str) -> float | None:
    """Return the predicted time of a benchmark's case [s]; None if it is not modelled."""
    maker, settings, scale = CASES[case]
    form = settings.get("form", "profiles")
    if maker.__name__ == "_projection":
        of = model(scale, form)
        names = ("scatter", "collect", "spread to planes")
        if not settings["forward"]:
            names = ("gather", "spread", "collect from planes")
        return of.cameras * sum(map(of.seconds, names))
    if maker.__name__ == "_smart":
        of = model(scale, form)
        forward = sum(map(of.seconds, ("spread to planes", "scatter", "compare")))
        back = sum(map(of.seconds, ("gather", "collect from planes")))
        return of.cameras * ((settings["iterations"] + 1) * forward + settings["iterations"] * back)
    if maker.__name__ in CORRELATION:
        found = gpu_correlation.trace(prepare(case).run)
        return found.seconds + found.host_s
    return None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scale", choices=SCALES, default="small")
    parser.add_argument("--form", choices=("profiles", "pixels"), default="profiles")
    parser.add_argument("--refinement", type=float, default=1.0, help="how much finer voxels are than the case's")
    parser.add_argument("--json", type=Path, help="file for the table")
    parser.add_argument(
        "--cases", nargs="+", choices=CASES, metavar="CASE", help="print their times [s] as JSON instead"
    )
    given = parser.parse_args()
    if given.cases:
        print(json.dumps({case: predicted(case) for case in given.cases}))
        return
    found = model(given.scale, given.form, given.refinement)
    print("kernel                 touched /needed  by block /filled atomics       ms  limit")
    for one in found.kernels:
        limit = max(one.limits_s, key=lambda name: one.limits_s[name])
        print(
            f"{one.kernel:20s} {one.touched / 1e6:8.2f}M {one.ratio:7.2f} {one.by_block / 1e6:8.2f}M {one.filled:7.2f} "
            f"{one.atomics:7.0f} {1e3 * one.seconds:8.4f}  {limit}"
        )
    print(f"weights: {found.weights_bytes / 2**20:.0f} MiB, on the CPU {found.stored_bytes / 2**20:.0f} MiB")
    work = gpu_correlation.model(given.scale)
    pair = found.pair_s + work.seconds
    print(f"epoch {1e3 * found.epoch_s:.2f} ms, whole pass {1e3 * found.whole_s:.2f} ms")
    print(f"pair {pair:.3f} s: volumes {found.pair_s:.3f} s, correlation {work.seconds:.3f} s;")
    print(f"{work.host_s:.3f} s of this processor between the correlation's launches besides")
    if given.json:
        rows = [dataclasses.asdict(one) | {"seconds": one.seconds, "ratio": one.ratio} for one in found.kernels]
        given.json.write_text(json.dumps({"kernels": rows, "epoch_s": found.epoch_s, "pair_s": pair}, indent=1))


if __name__ == "__main__":
    main()

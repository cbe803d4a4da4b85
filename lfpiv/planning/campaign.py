"""`plan`: time, memory and disk of a campaign before it begins, scaled from its first pair."""

from __future__ import annotations

import logging
import math
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

from lfpiv.errors import InputError
from lfpiv.experiment.experiment import Experiment
from lfpiv.experiment.opening import read_experiment
from lfpiv.files import size_text
from lfpiv.planning.result import Cost, Disk, Memory, Plan, Time
from lfpiv.progress import Progress
from lfpiv.reconstruction.refinement import LARGEST
from lfpiv.results.folder import Folder
from lfpiv.results.pair_files import FrameVolume, PairVolumes
from lfpiv.runs import belonging, device_memory, memory, rig, worker_plan
from lfpiv.runs.frame_light import FrameLight, frame_light, read_darks
from lfpiv.runs.pair import PairWork
from lfpiv.runs.refinement import Refinement
from lfpiv.runs.run import Run, open_run
from lfpiv.velocity import vector_grid
from lfpiv.warn import Warning, collected
from lfpiv.weights.checks import compare_with_count
from lfpiv.weights.memory_left import rays_bytes
from lfpiv_kernels import runtime
from lfpiv_kernels.runtime import cores

if TYPE_CHECKING:
    from lfpiv.calibration.camera import Calibration
    from lfpiv.weights.operator import Weights

log = logging.getLogger(__name__)

Result = TypeVar("Result")

FIRST_PAIR = "first pair"
"""Name of the step, for progress."""
PER_MICROLENS = 0.5
"""Simulated particles per microlens: a seeding that cameras of this kind resolve."""
BRIGHTEST, NOISE = 1000.0, 10.0
"""Light of the brightest simulated pixel, and standard deviation of the simulated noise [counts]."""
SHIFT_VOXEL = 1
"""Displacement of the simulated particles along each axis [reconstructed voxel]."""
SEED = 18


def plan(
    experiment: Experiment | str | Path,
    *,
    pairs: int | None = None,
    workers: int | None = None,
    out: str | Path | None = None,
    device: str | None = None,
    progress: Progress | None = None,
) -> Plan:
    """Say what a campaign will take, before it begins.

    The first pair is done as in a run, with simulated particles where its images are not there yet, and its times are
    scaled. So it takes as long as the weights and two pairs. What a run does once before the weights, such as the
    calibration, is not in the plan. Nothing is written.

    Parameters
    ----------
    experiment : Experiment or path
        The experiment, or its file.
    pairs : int, optional
        Number of pairs, or of instants of a series; default: those of the experiment.
    workers : int, optional
        Number of processes of this machine that share its cores; default: one per GPU on CUDA, one otherwise.
    out : path, optional
        Output folder of the run: its calibration, guard layers and voxels are taken if they fit. Default: thin lenses
        in the stated orientations, the least guard layers, and the smallest voxels that particles may demand.
    device : {"auto", "cpu", "cuda"}, optional
        Default: ``compute.device`` of the experiment.
    progress : callable, optional
        Called as ``progress(step, fraction)``.

    Raises
    ------
    InputError
        If the experiment, the numbers or the device are not as expected, a camera has neither a calibration nor an
        orientation, or the volume cannot fit into the memory of the machine or of the GPU.
    """
    if not isinstance(experiment, Experiment):
        experiment = read_experiment(experiment)
    pairs = experiment.pairs if pairs is None else pairs
    asked = 1 if workers is None else workers
    for name, value, most in (("--pairs", pairs, 10**9), ("--workers", asked, worker_plan.MAX_WORKERS)):
        if type(value) is not int or not 1 <= value <= most:
            raise InputError(f"{name}: expected a whole number from 1 to {most}, found {value!r}.")
    shared = experiment
    if workers is not None:  # they share the threads
        threads = max((experiment.compute.threads or cores()) // min(workers, pairs), 1)
        shared = replace(experiment, compute=experiment.compute.model_copy(update={"threads": threads}))
    if out is not None and not Path(out).is_dir():
        raise InputError(f"--out: expected the folder of a run, found no folder {out}. Leave it out before a run.")
    with tempfile.TemporaryDirectory(prefix="lfpiv-") as scratch:
        with open_run(shared, scratch if out is None else out, device, progress, writes_results=False) as current:
            gpus = worker_plan.visible_gpus() if current.device.kind == "cuda" else ()
            if workers is None:
                workers = len(gpus) if len(gpus) > 1 else 1
            with threadpool_limits(1):
                return _plan(current, pairs, min(workers, pairs), Path(scratch), out is not None)


def _plan(run: Run, pairs: int, workers: int, scratch: Path, stored: bool) -> Plan:
    """Measure the first pair and scale it. `run` has the threads of one worker."""
    step = run.step(FIRST_PAIR)
    step(0.0)
    experiment, assumptions = run.experiment, list[str]()
    calibration, calibrated = _calibration(run, stored, assumptions)
    run = _with_voxels(run, assumptions)
    finest = run.reconstructed_experiment
    maps = sum(map(rays_bytes, calibration.cameras.values()))
    estimated = memory.weights_bytes(finest, run.particle_voxel) + maps
    worker_plan.require_memory(finest, estimated, 1)
    memory_of(run, estimated, workers)
    step(0.1)
    first = _first_pair(run, calibration, scratch, calibrated, assumptions)
    step(0.9)
    need = memory_of(run, first.weights_bytes + maps, workers)
    disk = Disk(
        pair=first.file_bytes,
        results=first.file_bytes * pairs,
        volumes=2 * memory.BYTES_PER_VALUE * experiment.grid.size,
        weights=need.weights if workers > 1 else 0,
        free=shutil.disk_usage(run.folder.path if stored else Path.cwd()).free,
    )
    pair = sum(first.steps.values(), Cost())
    simulated = experiment.simulated_of(pairs)
    again = (pair - first.steps.get("tracking", Cost())) * (simulated + 1 if simulated else 0)
    total = sum(first.prepared.values(), Cost()) + first.once + pair * math.ceil(pairs / workers) + again
    step(1.0)
    return Plan(
        name=experiment.name,
        file=experiment.path,
        noun=experiment.noun,
        pairs=pairs,
        workers=workers,
        device=run.device,
        shape=experiment.grid.shape,
        voxel_mm=experiment.grid.voxel_mm,
        reconstructed=finest.grid.shape,
        reconstructed_mm=finest.grid.voxel_mm,
        vectors=vector_grid.planned(experiment.correlation, experiment.grid.shape).count,
        time=Time(
            preparation=first.prepared,
            first=first.once,
            pair=pair,
            steps=first.steps,
            simulated=again,
            total_s=total.wall_s,
        ),
        memory=need,
        disk=disk,
        limits=tuple(limits_of(finest, need, disk, first.steps, workers)),
        assumptions=tuple(assumptions),
    )


@dataclass(frozen=True, kw_only=True)
class _FirstPair:
    """What the first pair takes."""

    prepared: Mapping[str, Cost]
    """Weights with their check, and where the cameras show the particles of the pair, as far as it was compared."""
    once: Cost
    """What only the first pair needs: loaded kernels, sums of subsets, the estimator of the particles' size."""
    steps: Mapping[str, Cost]
    """Costs of a further pair: "images", "reconstruction", "correlation", "tracking" if particles are, "writing"."""
    weights_bytes: int
    file_bytes: int
    """Vectors and linked particles of a pair."""


def _timed(work: Callable[[], Result]) -> tuple[Result, Cost]:
    """Do some work in this process; return its result and its cost."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = work()
    return result, Cost(time.perf_counter() - wall, time.process_time() - cpu)


def _first_pair(
    run: Run, calibration: Calibration, scratch: Path, calibrated: bool, assumptions: list[str]
) -> _FirstPair:
    """Do the first pair of a run and measure what it takes; its file goes to a scratch folder."""
    experiment, number = run.experiment, run.experiment.numbers[0]
    weights, built = _timed(lambda: rig.weights_of(run, calibration))
    prepared = {"weights": built + _timed(lambda: compare_with_count(weights))[1]}
    light, reading = _light(experiment, weights)
    if reading is None:
        assumptions.append("particles are simulated: there are no images yet, whose reading is not in the plan")
    if reading is None or not calibrated:
        assumptions.append("the comparison of the cameras, once a run, is not in the plan")
    else:
        with collected(quiet=True):
            prepared["cameras"] = _timed(lambda: belonging.check(experiment, weights, experiment.numbers[:1]))[1]
    work = rig.pair_work(replace(run, folder=Folder(scratch, experiment.recording)), weights, keep_volumes=False)
    coming = iter(light)

    def solve() -> tuple[FrameVolume, FrameVolume]:
        if not experiment.recording.is_series:
            return work.reconstructor.pair(light, lambda _: None)
        found = work.reconstructor.frame(next(coming), lambda _: None)
        return found, found

    (_, first), (volumes, solved) = _timed(solve), _timed(solve)
    both = PairVolumes(frames=volumes, names=experiment.frames)
    (_, loaded), (vectors, correlated) = (_timed(lambda: work.vectors_between(number, both)) for _ in range(2))
    images = (reading or Cost()) * experiment.recording.lasers
    steps = {"images": images, "reconstruction": solved, "correlation": correlated}
    once, file = (first - solved) + (loaded - correlated), work.files(number)
    if file.particles is not None:
        (vectors, table, _), steps["tracking"] = _tracked(work, number, light, both, correlated)
        file.write_particles(table)
    _, steps["writing"] = _timed(lambda: work.result(file, vectors, both)[1]())
    paths = [path for path in (file.vectors, file.particles) if path is not None]
    return _FirstPair(
        prepared=prepared,
        once=once,
        steps=steps,
        weights_bytes=weights.memory_bytes,
        file_bytes=sum(path.stat().st_size for path in paths),
    )


def _tracked(
    work: PairWork, pair: int, light: tuple[FrameLight, FrameLight], volumes: PairVolumes, correlated: Cost
) -> tuple[tuple[xr.Dataset, xr.Dataset, list[Warning]], Cost]:
    """Track the particles of a pair; return the results and the cost beside the correlation.

    In a series the particles of its first frame are known.
    """
    first, _ = work.fits.of_pair(work.search, light, volumes)
    work.fits.last = (light[0].frame, first) if work.experiment.recording.is_series else None
    found, cost = _timed(lambda: work.tracked(pair, light, volumes))
    return found, cost - correlated


def _light(experiment: Experiment, weights: Weights) -> tuple[tuple[FrameLight, FrameLight], Cost | None]:
    """Return the light of both frames and the cost of reading one; simulated light, and None, without images."""
    first, second = experiment.pair_frames(experiment.numbers[0])
    darks = read_darks(experiment)
    try:
        one = frame_light(experiment, weights.cameras, darks, first)
        other, cost = _timed(lambda: frame_light(experiment, weights.cameras, darks, second))
        return (one, other), cost
    except InputError as error:
        log.debug("plan: particles are simulated: %s", error)
    lenses = [
        len(weights.projector(name).map.pixel) / camera.optics.microimage_pitch_px**2
        for name, camera in weights.cameras.items()
    ]
    rng, found = np.random.default_rng(SEED), []
    light = np.zeros(weights.grid.shape, np.float32)
    light.ravel()[rng.integers(0, light.size, max(round(PER_MICROLENS * min(lenses)), 1))] = 1.0
    for frame, shift in ((first, 0), (second, SHIFT_VOXEL)):
        images = weights(np.roll(light, (shift,) * 3, (0, 1, 2)))
        for image in images.values():
            image *= BRIGHTEST / max(float(image.max()), 1e-30)
            image += np.float32(NOISE) * rng.standard_normal(image.shape, np.float32)
        clear, noise = dict.fromkeys(images, 1.0), dict.fromkeys(images, NOISE)
        found.append(
            FrameLight(
                frame=frame, images=images, noise=noise, structure=clear, fingerprints={}, warnings=(), seconds=0.0
            )
        )
    return (found[0], found[1]), None


def _calibration(run: Run, stored: bool, assumptions: list[str]) -> tuple[Calibration, bool]:
    """Return the calibration in the folder if it fits, or else thin lenses in the stated orientations."""
    from lfpiv.calibration.cameras import thin_lens

    if stored:
        try:
            known = rig.load_calibration(run).calibration
            return rig.with_standing_light(run, known), True
        except InputError as error:
            log.debug("plan: %s", error)
    bare = [camera.name for camera in run.experiment.cameras if camera.orientation is None]
    if bare:
        raise InputError(
            f"{run.experiment.path}: camera {bare[0]!r}: expected its orientation or its calibration, found neither. "
            "Add nominal_direction, or run `lfpiv calibrate` and name its folder with --out."
        )
    assumptions.append("cameras are thin lenses in the stated orientations; the calibration is not in the plan")
    return thin_lens(run.experiment), False


def _with_voxels(run: Run, assumptions: list[str]) -> Run:
    """Return the run with the voxels that it reconstructs, as far as that is known before the images are."""
    experiment = run.experiment
    if experiment.smart.refinement == "auto" and run.refinement is None:
        run = replace(run, refinement=Refinement(pairs=(), size_voxel=None, factor=LARGEST, demanded=LARGEST))
        assumptions.append(f'particles are points: voxels are refined by {LARGEST:g}, the most that "auto" chooses')
    if experiment.guard_mm == "auto" and run.guard is None:
        assumptions.append("no light lies beyond the volume: one guard layer on each side")
    if run.guard is None:
        assumptions.append("the search of all images for background, guard layers and particle size is not in the plan")
    if experiment.tracking is not None and experiment.recording.is_series:
        assumptions.append("links over the whole series are not in the plan")
    if experiment.in_sequence:
        assumptions.append("each instant is reconstructed by itself: the time of smart.predict differs")
    if experiment.self_calibration.pairs:
        assumptions.append("the time of the self-calibration is not in the plan")
    return run


def memory_of(run: Run, weights: int, workers: int) -> Memory:
    """Estimate the memory for weights of a size [byte]; refuse a volume that cannot fit into the GPU."""
    finest = run.reconstructed_experiment
    free = runtime.free_bytes()
    whole = None
    if free is not None:
        need = device_memory.estimate_need(finest)
        sharing = -(-workers // max(len(worker_plan.visible_gpus()), 1))
        device_memory.require(finest, need, run.device, sharing=sharing)
        whole = sharing * need.whole
    return Memory(
        needed=memory.run_bytes(finest, weights, workers),
        weights=weights,
        worker=memory.worker_bytes(finest),
        allowed=memory.allowed_bytes(finest),
        device_needed=whole,
        device_free=free,
    )


def limits_of(finest: Experiment, need: Memory, disk: Disk, steps: Mapping[str, Cost], workers: int) -> Iterator[str]:
    """Say what limits the campaign: what does not fit, and the step that takes most of the time."""
    if need.needed > need.allowed:
        fits = memory.fitting_workers(finest, need.weights, workers)
        fewer = f"use --workers {fits}" if fits < workers else "raise volume.voxel_mm, or set smart.refinement = 1.0"
        yield f"memory: {size_text(need.needed)} needed, {size_text(need.allowed)} may be used; {fewer}"
    if disk.results + disk.weights > disk.free:
        yield f"disk: {size_text(disk.results + disk.weights)} needed, {size_text(disk.free)} free"
    name = max(steps, key=lambda one: steps[one].wall_s)
    share = steps[name].wall_s / sum(one.wall_s for one in steps.values())
    yield f"time: {100 * share:.0f} % of it is {name}"

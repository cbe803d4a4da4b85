"""`plan`: time, memory and disk of a campaign before it begins, from a short calibration of this machine."""

from __future__ import annotations

import logging
import math
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from threadpoolctl import threadpool_limits

from lfpiv.errors import InputError
from lfpiv.experiment.experiment import Experiment
from lfpiv.experiment.opening import read_experiment
from lfpiv.files import size_text
from lfpiv.planning import preparation
from lfpiv.planning.cost import NOTHING, Cost, grown, timed
from lfpiv.planning.part import LEAST_POINT, Form, Measured, Volume, measure
from lfpiv.planning.result import Disk, Memory, Plan, Time
from lfpiv.planning.vectors import plan_vectors
from lfpiv.progress import Progress, StepProgress
from lfpiv.reconstruction.motion import ITERATION_SHARE
from lfpiv.reconstruction.refinement import LARGEST
from lfpiv.runs import device_memory, memory, rig, worker_plan
from lfpiv.runs.run import Run, open_run
from lfpiv.velocity import vector_grid
from lfpiv.weights.depth_planes import FEWEST_VOXELS
from lfpiv.weights.device_share import DeviceNeed, beside_bytes, rays_bytes
from lfpiv_kernels import runtime
from lfpiv_kernels.runtime import Device, cores

if TYPE_CHECKING:
    from lfpiv.calibration.camera import Calibration

log = logging.getLogger(__name__)

SMALL_VOXELS, LARGE_VOXELS = 30_000, 220_000
"""Reconstructed voxels of the two parts whose costs are extrapolated."""
COUNTED_VOXELS = 4_000
"""The same of the larger part where weights are counted, which takes far longer."""
CALIBRATION = "calibration of this machine"
"""Name of the step, for progress."""


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

    The run's own steps are done on two parts of the volume, with the real rig and simulated particles, and their times
    are extrapolated to the whole. It takes some seconds, and needs no particle images. Nothing is written.

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

    Returns
    -------
    Plan

    Raises
    ------
    InputError
        If the experiment, the numbers or the device are not as expected, a camera has neither a calibration nor an
        orientation, or the volume cannot fit into the memory of the machine or of the GPU.
    """
    if not isinstance(experiment, Experiment):
        experiment = read_experiment(experiment)
    pairs = _whole("--pairs", experiment.pairs if pairs is None else pairs)
    workers = None if workers is None else _whole("--workers", workers, worker_plan.MAX_WORKERS)
    shared = experiment if workers is None else _sharing(experiment, min(workers, pairs))
    if out is not None and not Path(out).is_dir():
        raise InputError(f"--out: expected the folder of a run, found no folder {out}. Leave it out before a run.")
    with tempfile.TemporaryDirectory(prefix="lfpiv-") as scratch:
        with open_run(shared, scratch if out is None else out, device, progress, writes_results=False) as current:
            gpus = worker_plan.visible_gpus() if current.device.kind == "cuda" else ()
            if workers is None:
                workers = len(gpus) if len(gpus) > 1 else 1
            with threadpool_limits(1):
                return _plan(current, experiment, pairs, min(workers, pairs), Path(scratch), out is not None)


def _whole(name: str, value: object, most: int = 10**9) -> int:
    if type(value) is not int or not 1 <= value <= most:
        raise InputError(f"{name}: expected a whole number from 1 to {most}, found {value!r}.")
    return value


def _sharing(experiment: Experiment, workers: int) -> Experiment:
    """Return the experiment with the CPU threads of one of several workers."""
    threads = max((experiment.compute.threads or cores()) // workers, 1)
    return replace(experiment, compute=experiment.compute.model_copy(update={"threads": threads}))


def _plan(run: Run, experiment: Experiment, pairs: int, workers: int, scratch: Path, stored: bool) -> Plan:
    """Measure and extrapolate. `run` is on the experiment with the threads of one worker."""
    step, assumptions = run.step(CALIBRATION), list[str]()
    step(0.0)
    calibration, calibrated = _calibration(run, stored, assumptions)
    whole = _volume(run, calibration, assumptions)
    step(0.1)
    forms, chosen = timed(whole.forms)
    needed = memory_of(whole, forms, workers, run.device)
    if needed.device_streamed:
        assumptions.append("the time in which weights are copied to the GPU in each pass is not in the plan")
    step(0.2)
    small, large = _parts(whole, forms, step)
    step(0.7)
    light = preparation.read_light(experiment, calibration)
    if not light.recorded:
        assumptions.append("particle images are read as fast as the white images: there are none yet")
    step(0.8)
    vectors = plan_vectors(whole, whole.per_voxel(), large.volume, scratch)
    step(0.9)
    prepared = _prepared(run, whole, calibrated, light.frame, large, assumptions)
    size = sum(form.stored_bytes for form in forms.values())

    def full(part: str) -> Cost:
        near, far = ((one.stored_bytes, getattr(one, part)) for one in (small, large))
        return far[1] if large.voxels == whole.finest.grid.size else grown(near, far, size)

    frame = full("frame")
    check = large.check * (frame.cpu_s / large.frame.cpu_s) + 2 * light.frame  # both are SMART
    built = large.weights * (size / large.stored_bytes)
    prepared |= {"weights": chosen + built, "cameras": check}
    smart, series = experiment.smart, experiment.series is not None
    frames, again = 1 if series else 2, 1 + smart.motion_passes * ITERATION_SHARE
    steps = {
        "images": light.frame * frames,
        "reconstruction": frame * (frames * again),
        "correlation": vectors.correlate * (1 + smart.motion_passes),
        "writing": vectors.write,
    }
    pair = sum(steps.values(), NOTHING)
    simulated = experiment.bootstrap.count(pairs)
    again_simulated = pair * (simulated + 1 if simulated else 0)
    total = sum(prepared.values(), NOTHING) + full("once") + pair * math.ceil(pairs / workers) + again_simulated
    step(1.0)
    disk = Disk(
        pair=vectors.size,
        results=vectors.size * pairs,
        volumes=2 * memory.BYTES_PER_VALUE * experiment.grid.size,
        weights=size + _maps(calibration) if workers > 1 else 0,
        free=shutil.disk_usage(_nearest(run.folder.path if stored else Path.cwd())).free,
    )
    return Plan(
        name=experiment.name,
        file=experiment.path,
        noun=experiment.noun,
        pairs=pairs,
        workers=workers,
        device=run.device,
        shape=experiment.grid.shape,
        voxel_mm=experiment.grid.voxel_mm,
        reconstructed=whole.finest.grid.shape,
        reconstructed_mm=whole.finest.grid.voxel_mm,
        vectors=vector_grid.planned(experiment.correlation, experiment.grid.shape).count,
        time=Time(
            preparation=prepared,
            first=full("once"),
            pair=pair,
            steps=steps,
            simulated=again_simulated,
            total_s=total.wall_s,
        ),
        memory=needed,
        disk=disk,
        limits=tuple(limits_of(whole.finest, needed, disk, steps, workers)),
        assumptions=tuple(assumptions),
    )


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
    assumptions.append("cameras are thin lenses in the stated orientations: they are not calibrated yet")
    return thin_lens(run.experiment), False


def _volume(run: Run, calibration: Calibration, assumptions: list[str]) -> Volume:
    """Return the volume as it is reconstructed, as far as that is known before the images are."""
    experiment, found, factor = run.experiment, run.refinement, run.refinement_factor
    if experiment.smart.refinement == "auto" and found is None:
        factor = LARGEST
        assumptions.append(f'particles are points: voxels are refined by {LARGEST:g}, the most that "auto" chooses')
    if experiment.guard_mm == "auto" and run.guard is None:
        assumptions.append("no light lies beyond the volume: one guard layer on each side")
    if experiment.mask is not None:
        assumptions.append("the whole volume holds fluid: the mask saves some time")
    if experiment.tracking is not None:
        assumptions.append("the time of [tracking] is not in the plan")
    if experiment.in_sequence:
        assumptions.append("each instant is reconstructed by itself: the time of smart.predict differs")
    if experiment.self_calibration.pairs:
        assumptions.append("the time of the self-calibration is not in the plan")
    size = 0.0 if found is None or found.size_voxel is None else found.size_voxel * factor
    return Volume(
        experiment=experiment,
        guard=run.guard_layers,
        refinement=factor,
        calibration=calibration,
        particle_voxel=max(size, LEAST_POINT),
    )


def _parts(whole: Volume, forms: Mapping[str, Form], step: StepProgress) -> tuple[Measured, Measured]:
    """Measure two parts, after a third one that loads the kernels."""
    counting, dense = whole.experiment.compute.weights == "count", whole.per_voxel()
    large = COUNTED_VOXELS if counting else LARGE_VOXELS
    rests = (
        all(form.distance is None and not form.separable for form in forms.values())
        and whole.finest.grid.size >= FEWEST_VOXELS
    )
    if rests and not counting:  # dark voxels rest in such volumes, so they do in both parts
        sizes = [int(1.1 * FEWEST_VOXELS), 2 * FEWEST_VOXELS]
    else:
        sizes = [SMALL_VOXELS * large // LARGE_VOXELS, large]
    parts = [whole.cube, *map(whole.part, sizes)]
    found = []
    for number, one in enumerate(parts):
        found.append(measure(one, forms, dense, check_cameras=number != 1))
        step(0.2 + 0.5 * (number + 1) / len(parts))
    return found[1], found[2]


def _prepared(
    run: Run, whole: Volume, calibrated: bool, frame: Cost, large: Measured, assumptions: list[str]
) -> dict[str, Cost]:
    """Return the costs of the steps before the weights."""
    found = {}
    if not calibrated:
        dots = preparation.measure_dots(run.experiment, whole.calibration)
        if dots is None:
            assumptions.append("the time of the calibration is not in the plan: two planes of the board do not show it")
        else:
            found["calibration"] = dots
    if run.guard is None or run.refinement is None:
        looked = preparation.look_at_images(run.experiment, whole.calibration, large.images, frame)
        _, estimated = timed(lambda: memory.weights_bytes(whole.finest, whole.particle_voxel))
        found["images"] = looked + 2 * estimated  # by the sizes of particles and volume, and once they are known
    return found


def memory_of(whole: Volume, forms: Mapping[str, Form], workers: int, device: Device) -> Memory:
    """Estimate the memory; refuse a volume that cannot fit into that of the GPU."""
    finest = whole.finest
    weights = sum(form.stored_bytes for form in forms.values()) + sum(map(rays_bytes, whole.cameras.values()))
    gpus = len(worker_plan.visible_gpus()) if device.kind == "cuda" else 1
    sharing = -(-workers // max(gpus, 1))
    sizes = tuple(form.device_bytes for form in forms.values())
    need = DeviceNeed(sizes, beside_bytes(whole.cameras.values(), finest.grid))
    streamed = device_memory.require(finest, need, device, sharing=sharing)
    free = runtime.free_bytes()
    return Memory(
        needed=memory.run_bytes(finest, weights + workers * streamed, workers),
        weights=weights,
        worker=memory.worker_bytes(finest),
        allowed=memory.allowed_bytes(finest),
        device_needed=None if free is None else sharing * need.whole,
        device_least=None if free is None else sharing * (need.whole if sharing > 1 else need.least),
        device_streamed=streamed,
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


def _maps(calibration: Calibration) -> int:
    """Return the size of the arrays by which stored weights say which ray is which pixel [byte]."""
    layouts = (camera.microimages for camera in calibration.cameras.values())
    return sum(one.pixel.nbytes + one.share.nbytes + one.corner.nbytes for one in layouts)


def _nearest(path: Path) -> Path:
    """Return a folder that exists: the path or the first one above it."""
    return next(one for one in (path, *path.absolute().parents) if one.exists())

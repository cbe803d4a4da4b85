"""One invocation on one experiment and one output folder: its steps, what they depend on, its clock, its warnings."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

import lfpiv
from lfpiv import dataset, memory, summary
from lfpiv.errors import InputError
from lfpiv.experiment import Experiment, open_experiment
from lfpiv.folder import Folder, make_writable
from lfpiv.structure import structure
from lfpiv_kernels import runtime

if TYPE_CHECKING:
    from lfpiv.calibration import Calibration
    from lfpiv.weights import Weights

log = logging.getLogger(__name__)

Progress = Callable[[str, float], None]
"""Called as ``progress(step, fraction)``, fraction from 0 to 1."""

FRAME_SHARE = 0.45
"""Part of a pair's work that one of its volumes takes, for progress bars."""


@contextlib.contextmanager
def open_job(
    experiment: Experiment | str | Path,
    out: str | Path,
    device: str | None,
    progress: Progress | None,
    pairs: tuple[int, int | None] | None = None,
) -> Iterator[Job]:
    """Check everything, start the device, collect the warnings; leave no empty folder behind on failure."""
    start = time.perf_counter()
    if not isinstance(experiment, Experiment):
        experiment = open_experiment(experiment)
    folder = Folder(Path(out))
    numbers = _select(experiment, pairs)
    memory.require(memory.least_bytes(experiment), experiment, "volumes of")
    made = make_writable(folder.path)
    collector = _WarningCollector(level=logging.WARNING)
    loggers = [logging.getLogger(name) for name in ("lfpiv", "lfpiv_kernels")]
    for logger in loggers:
        logger.addHandler(collector)
    try:
        try:
            running = runtime.start(device or experiment.compute.device, threads=experiment.compute.threads)
        except (RuntimeError, ValueError) as error:
            raise InputError(str(error)) from None
        with threadpool_limits(running.threads):
            yield Job(experiment, folder, numbers, progress, running, collector.texts, start)
    finally:
        for logger in loggers:
            logger.removeHandler(collector)
        for path in made:
            with contextlib.suppress(OSError):  # not empty: the run got somewhere
                path.rmdir()


def _select(experiment: Experiment, pairs: tuple[int, int | None] | None) -> range:
    first, after = (0, None) if pairs is None else pairs
    after = experiment.pairs if after is None else after
    if not 0 <= first < after <= experiment.pairs:
        raise InputError(
            f"pairs: expected A:B with 0 <= A < B <= {experiment.pairs}, the pairs of the experiment, "
            f"found {first}:{after}."
        )
    return range(first, after)


class _WarningCollector(logging.Handler):
    """Keeps the text of each warning once; what vectors say of themselves the summary words pair by pair."""

    def __init__(self, level: int):
        super().__init__(level)
        self.texts: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        if text not in self.texts and record.name != "lfpiv.vectors":
            self.texts.append(text)


class Job:
    """The steps on one experiment and one folder, with the clock that times them."""

    def __init__(
        self,
        experiment: Experiment,
        folder: Folder,
        numbers: range,
        progress: Progress | None,
        device: runtime.Device,
        warnings: list[str],
        start: float,
    ):
        self.experiment = experiment
        self.folder = folder
        self.numbers = numbers
        self.progress: Progress = progress or (lambda step, fraction: None)
        self.device = device
        self.warnings = warnings
        self.reused: list[str] = []
        self.start = start
        self.seconds: dict[str, float] = {}
        self.weights_report: dict[str, Any] = {}
        self.done, self.total = 0, 1
        self.calibration: Calibration | None = None
        self.calibration_hash = _calibration_hash(experiment)
        self.previous = summary.read(folder.summary)

    @contextlib.contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the time of a block that ends well to a stage."""
        start = time.perf_counter()
        yield
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start

    def step(self, name: str) -> Callable[[float], None]:
        """Progress of a step as a function of its fraction."""
        return lambda fraction: self.progress(name, fraction)

    def begin_pair(self, done: int, total: int) -> None:
        """Say which pair is worked on; `pair_step` then reports parts of it."""
        self.done, self.total = done, total
        self.progress("image pairs", done / total)

    def pair_step(self, first: float, share: float) -> Callable[[float], None]:
        """Progress of a part of the present pair that starts at `first` and makes up `share` of it."""
        return lambda fraction: self.progress("image pairs", (self.done + first + share * fraction) / self.total)

    def note_reused(self, what: str) -> None:
        """Log and remember that something finished earlier is kept."""
        log.info("%s: finished before with the same settings, kept", what)
        self.reused.append(what)

    # --- hashes: what a finished file depends on

    def volume_hash(self, pair: int) -> str:
        """Hash of all that the volumes of a pair depend on."""
        experiment = self.experiment
        identity = [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in experiment.pair_paths(pair)]
        return dataset.settings_hash(
            calibration=self.calibration_hash,
            grid=dataclasses.asdict(experiment.grid),
            smart=experiment.smart.model_dump(),
            weights=(experiment.compute.weights, experiment.compute.weights_form),
            images=identity,
        )

    def vector_hash(self, pair: int) -> str:
        """Hash of all that the vectors of a pair depend on."""
        settings = self.experiment.correlation.model_dump()
        return dataset.settings_hash(volumes=self.volume_hash(pair), correlation=settings, dt_s=self.experiment.dt_s)

    def is_finished(self, pair: int, keep_volumes: bool) -> bool:
        """Whether the vectors of a pair, and its volumes where they are to be kept, are there and still fit."""
        stored = dataset.stored_hash(self.folder.vectors(pair))
        if stored is None:
            return False
        if stored != self.vector_hash(pair):
            log.info("pair %d: settings or images changed, its vectors are made anew", pair)
            return False
        return not keep_volumes or self._volumes_fit(pair)

    def finished_pairs(self) -> list[int]:
        """Pairs whose vectors in the folder fit the experiment."""
        return [pair for pair in range(self.experiment.pairs) if self._vectors_fit(pair)]

    def _vectors_fit(self, pair: int) -> bool:
        return dataset.stored_hash(self.folder.vectors(pair)) == self.vector_hash(pair)

    def _volumes_fit(self, pair: int) -> bool:
        wanted = self.volume_hash(pair)
        return all(dataset.stored_hash(self.folder.volume(pair, frame)) == wanted for frame in (0, 1))

    # --- steps

    def load_calibration(self) -> Calibration:
        """Load the calibration in the folder; InputError where there is none that fits the experiment."""
        from lfpiv.calibration import load_calibration

        path = self.folder.calibration
        if dataset.stored_hash(path) != self.calibration_hash:
            raise InputError(
                f"{path}: expected the calibration of this experiment, found none that fits. "
                "Run `lfpiv calibrate` or `lfpiv run` first."
            )
        self.note_reused("calibration")
        self.calibration = load_calibration(path)
        return self.calibration

    def calibrate(self) -> Calibration:
        """Keep the calibration in the folder where it fits the experiment, make it otherwise."""
        path = self.folder.calibration
        stored = dataset.stored_hash(path)
        if stored == self.calibration_hash:
            return self.load_calibration()
        if stored is not None:
            log.info("calibration: settings or images changed, made anew")
        from lfpiv.calibration import calibrate as calibrate_cameras

        with self.timed("calibration"):
            self.calibration = calibrate_cameras(self.experiment, progress=self.step("calibration"))
        with dataset.replacing(path) as scratch:
            self.calibration.save(scratch)
            _stamp(scratch, settings_hash=self.calibration_hash, seconds=self.seconds["calibration"])
        return self.calibration

    def plan_memory(self) -> None:
        """Refuse a volume whose weights do not fit into memory, before any work: from the nominal rig."""
        from lfpiv.weights import estimate_memory

        cameras, grid, form = (
            _nominal_cameras(self.experiment),
            self.experiment.grid,
            self.experiment.compute.weights_form,
        )
        weights = estimate_memory(cameras, grid, form)
        needed = memory.least_bytes(self.experiment) + weights
        log.info("memory: about %.1f GiB needed, %.1f GiB of it for weights", needed / memory.GIB, weights / memory.GIB)
        if form == "auto" and (most := estimate_memory(cameras, grid, "pixels")) > weights:
            log.info("memory: up to %.1f GiB for weights where rays bend", most / memory.GIB)
        memory.require(needed, self.experiment, "volumes and weights of")

    def build_weights(self, calibration: Calibration) -> Weights:
        """Build the weights of the grid."""
        from lfpiv.calibration import warn_outside
        from lfpiv.view import require_seen
        from lfpiv.weights import build_weights, compare_with_count

        method = self.experiment.compute.weights
        require_seen(self.experiment.path, calibration, self.experiment.grid)
        warn_outside(calibration, self.experiment.grid)
        if len(calibration.cameras) == 1:
            log.warning(
                "one camera hardly sees depth: w and displacement_z are not to be trusted, nor is their validation"
            )
        with self.timed("weights"):
            weights = build_weights(
                calibration,
                self.experiment.grid,
                method,
                form=self.experiment.compute.weights_form,
                limit_bytes=memory.left_for_weights(self.experiment),
                progress=self.step("weights"),
            )
        self.weights_report = {"method": method, "memory_mib": weights.memory_bytes / memory.MIB}
        if method == "footprint":
            self.weights_report["form"] = dict(weights.forms)
            self.weights_report["profiles_check_l2"] = {
                name: [round(error, 4) for error in errors] for name, errors in weights.profile_errors.items()
            }
            errors = [error for camera in compare_with_count(weights).values() for error in camera]
            self.weights_report["count_check_l2"] = [round(error, 4) for error in errors]
            if errors:  # of the few voxels drawn some camera may see none
                share = 100 * np.mean(errors)
                log.info("weights differ from counted rays by %.1f %% (mean of %d voxels)", share, len(errors))
        return weights

    def reconstruct(self, calibration: Calibration, weights: Weights, pair: int, *, keep: bool) -> list[xr.DataArray]:
        """Reconstruct both volumes of a pair; write them where they are to be kept."""
        from lfpiv.volume import reconstruct as reconstruct_volume

        experiment, volumes = self.experiment, []
        for number, frame in enumerate(experiment.frames):
            with self.timed(f"volume {pair} {number}"):
                light, noise = self.read_light(calibration, pair, frame)
                shown = {name: structure(image, calibration.cameras[name].decoder) for name, image in light.items()}
                settings = experiment.smart.model_dump()
                progress = self.pair_step(number * FRAME_SHARE, FRAME_SHARE)
                try:
                    volume = reconstruct_volume(weights, light, floor=noise, progress=progress, **settings)
                except ValueError as error:
                    raise InputError(f"pair {pair}, frame {frame!r}: {error}") from error
            volume.attrs |= {"cameras": list(shown), "structure": list(shown.values())}
            volumes.append(volume)
            if keep:
                path = self.folder.volume(pair, number)
                seconds = self.seconds[f"volume {pair} {number}"]
                stamp = {"settings_hash": self.volume_hash(pair), "seconds": seconds, "pair": pair, "frame": frame}
                dataset.write_volume(volume, path, attributes=stamp)
        return volumes

    def read_light(
        self, calibration: Calibration, pair: int, frame: str
    ) -> tuple[dict[str, np.ndarray], dict[str, float]]:
        """Images of one frame without dark and background [counts], and the noise of that background [counts]."""
        light, noise = {}, {}
        for camera in self.experiment.cameras:
            image, dark = self.experiment.particle_image(camera.name, pair, frame), self.experiment.dark(camera.name)
            image = image if dark is None else image - dark
            level, noise[camera.name] = calibration.cameras[camera.name].decoder.background(image)
            light[camera.name] = image - np.float32(level)
        return light, noise

    def stored_volumes(self, pair: int) -> list[xr.DataArray] | None:
        """Both volumes of a pair from the folder; None where they are missing or do not fit."""
        if not self._volumes_fit(pair):
            return None
        return [dataset.read_volume(self.folder.volume(pair, frame)) for frame in (0, 1)]

    def volume_seconds(self, pair: int, frame: int) -> float:
        """Time that a volume took, in this invocation or an earlier one [s]."""
        if f"volume {pair} {frame}" in self.seconds:
            return self.seconds[f"volume {pair} {frame}"]
        return float(dataset.read_attributes(self.folder.volume(pair, frame))["seconds"])

    def correlate(self, pair: int, volumes: list[xr.DataArray]) -> None:
        """Correlate the volumes of a pair and write its vectors."""
        experiment = self.experiment
        with self.timed(f"correlation {pair}"):
            vectors = lfpiv.correlate(*volumes, dt_s=experiment.dt_s, **experiment.correlation.model_dump())
        reconstructed = sum(self.volume_seconds(pair, frame) for frame in (0, 1))
        path = self.folder.vectors(pair)
        attributes = {
            "settings_hash": self.vector_hash(pair),
            "experiment": experiment.name,
            "pair": pair,
            "reconstruction_s": reconstructed,
            "correlation_s": self.seconds[f"correlation {pair}"],
            "smart": experiment.smart.model_dump(),
            "correlation": experiment.correlation.model_dump(),
        }
        condensed = dataset.build_reconstruction(dict(zip(experiment.frames, volumes, strict=True)))
        dataset.write_vectors(vectors, path, attributes=attributes, reconstruction=condensed)
        log.info("pair %d: %.0f %% of the vectors valid", pair, 100 * float(vectors["valid"].mean()))

    def finish(self, pairs: range | list[int], *, report: bool) -> dict[str, Any]:
        """Write summary.json, and report.html where asked; return the summary."""
        vectors = {pair: self.folder.vectors(pair) for pair in pairs}
        result = summary.build(
            experiment=self.experiment,
            calibration=self.calibration,
            calibration_path=self.folder.calibration,
            vectors=vectors,
            previous=self.previous,
            weights_s=self.seconds.get("weights"),
            weights=self.weights_report,
            device=self.device,
            warnings=self.warnings,
            reused=self.reused,
        )
        self.stop_clock(result)
        if report:
            from lfpiv.report import write_report

            with self.timed("report"):
                write_report(self.experiment, self.calibration, result, vectors, self.folder.report)
            result["timings_s"]["report"] = self.seconds["report"]
            self.stop_clock(result)
        dataset.write_json(result, self.folder.summary)
        return result

    def stop_clock(self, result: dict[str, Any]) -> None:
        """Put the time and the peak memory so far into a summary."""
        result["timings_s"]["total"] = time.perf_counter() - self.start
        earlier = self.previous.get("peak_memory_mib") if self.reused else None
        result["peak_memory_mib"] = max(memory.peak_mib(), earlier or 0.0)


def _nominal_cameras(experiment: Experiment) -> Calibration:
    """Return the rig as the data sheets have it: no image is read, nothing found."""
    from lfpiv.calibration import CalibratedCamera, Calibration
    from lfpiv.rig import LensLattice
    from lfpiv.thinlens import thin_lens_model

    cameras = {}
    for setup in experiment.cameras:
        pitch, half = setup.optics.microlens_pitch_mm, setup.optics.microlens_pitch_mm / 2
        second = (half, half * 3**0.5) if setup.optics.layout == "hexagonal" else (0.0, pitch)
        cameras[setup.name] = CalibratedCamera(
            name=setup.name,
            optics=setup.optics,
            lattice=LensLattice(origin_mm=(0.0, 0.0), basis_mm=((pitch, 0.0), second), layout=setup.optics.layout),
            decoder=None,
            baseline=thin_lens_model(setup.optics, setup.nominal_angle_deg),
        )
    return Calibration(cameras)


def _calibration_hash(experiment: Experiment) -> str:
    cameras = [
        [camera.name, dataclasses.asdict(camera.optics), camera.nominal_angle_deg, camera.image_flip]
        for camera in experiment.cameras
    ]
    return dataset.settings_hash(
        version=lfpiv.__version__,
        cameras=cameras,
        board=experiment.board.model_dump(),
        network=experiment.network.model_dump(),
        images=dataset.content_hash(experiment.calibration_paths()),
    )


def _stamp(path: Path, **attributes: Any) -> None:
    import h5py

    with h5py.File(path, "a") as file:
        file.attrs.update(attributes)

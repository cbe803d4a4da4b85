"""The work on pairs: images to volumes to vectors, and files of both.

`PairWork.do` takes a stretch of pairs and yields the `Outcome` of each. Volumes that are in the output folder and still
fit are read instead of reconstructed. Each frame is reconstructed once, for all its pairs (`lfpiv.runs.frames`).
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

from lfpiv import warn
from lfpiv.errors import InputError, StorageError
from lfpiv.experiment.experiment import Experiment
from lfpiv.experiment.recording import Frame
from lfpiv.geometry.grid import Layers
from lfpiv.joint.field import joint_field
from lfpiv.joint.vectors import is_joint
from lfpiv.progress import StepProgress, part_of
from lfpiv.results.folder import Folder
from lfpiv.results.pair_files import FrameVolume, PairFiles, PairVolumes, VolumeFile
from lfpiv.runs import belonging, pair_figures
from lfpiv.runs.frame_light import FrameLight, frame_light, read_darks
from lfpiv.runs.frames import Frames, JointFrames, failure
from lfpiv.runs.pair_figures import PairFigures
from lfpiv.runs.pair_outcome import CORRELATED, RECONSTRUCTED, Computed, Outcome, PairProgress
from lfpiv.runs.pair_vectors import REFUSED, measure_vectors, without_unmeasured
from lfpiv.runs.pair_volumes import Followed, Reconstructor, reconstruction_s
from lfpiv.runs.particles import FrameFits, refused, track
from lfpiv.runs.sequences import FollowedFrames
from lfpiv.runs.side_threads import ReadAhead, Writer
from lfpiv.sequence.solver import Before
from lfpiv.tracking.finding import ParticleSearch
from lfpiv.tracking.link_vectors import vectors_from_links
from lfpiv.velocity.cross_correlation import Verdict
from lfpiv.warn import Code, FirstOfEachCode, Warning

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera
    from lfpiv.weights.operator import Weights

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class PairWork:
    """The work on each pair of an experiment, with all its inputs."""

    experiment: Experiment
    folder: Folder
    calibration_hash: str
    guard: Layers
    """Layers of voxels that the grid of the weights has beyond the grid of the experiment; cut away afterwards."""
    refinement: float
    """Edge of a voxel of the experiment over that of the weights, which volumes are sampled from."""
    weights: Weights | None
    """None if all volumes are in the folder."""
    cameras: Mapping[str, CalibratedCamera]
    """Cameras that know what stands still in their images; empty if no image is read."""
    keep_volumes: bool
    """Write the volumes."""
    background: str | None = None
    """Hash of the light that is subtracted from the images; None if there is none."""
    vectors: bool = True
    """Correlate the volumes and write the vectors."""
    refusals: tuple[Warning, ...] = ()
    """Why the vectors of all pairs, or of some, are not valid; see `belonging.check`."""
    scratch: Path | None = None
    """Folder in which processes store volumes for each other; None for a process by itself."""
    log_first: FirstOfEachCode = field(default_factory=lambda: FirstOfEachCode(log))

    def do(self, pairs: Iterable[int], progress: PairProgress, *, stored: Collection[int] = ()) -> Iterator[Outcome]:
        """Work on pairs, one after the other; yield the outcome of each.

        An error ends one pair only and is returned as its outcome. `stored` are the frames whose volumes other
        processes need.

        Raises
        ------
        StorageError
            If a result cannot be written; then no other pair could be written either.
        """
        frames = self.frames(stored)
        computed: Computed | None = None
        try:
            for number, (pair, coming) in enumerate(_with_next(pairs)):
                self._read_ahead(pair, coming)
                found = self._compute(pair, frames, partial(progress, number))
                if computed is not None:
                    yield computed.outcome()
                computed = found
            if computed is not None:
                yield computed.outcome()
        finally:
            self.writer.wait()
            self.images.start(())
        frames.clear()
        self.fits.last = None

    def frames(self, stored: Collection[int] = ()) -> Frames:
        """Return the frames of pairs to come, of which none is known yet."""
        if self.experiment.in_sequence:
            return FollowedFrames(self, stored)
        return JointFrames(self) if self.experiment.smart.estimate == "joint" else Frames(self, stored)

    def _compute(self, pair: int, frames: Frames, progress: StepProgress) -> Computed:
        """Compute the results of one pair and start to write them."""
        self.written.clear()
        try:
            # sums of BLAS depend on its number of threads; the numbers must not depend on the number of workers
            with threadpool_limits(1):
                self._do(pair, frames, progress)
        except StorageError:
            raise
        except Exception as error:  # an error in one pair must not end the others
            return Computed(pair=pair, reason=str(failure(error)), written=tuple(self.written), progress=progress)
        return Computed(pair=pair, reason="", written=tuple(self.written), progress=progress)

    def _read_ahead(self, pair: int, coming: int | None) -> None:
        """Start to read the images of the coming pair whose volumes are not in the folder."""
        frames: list[Frame] = []
        if coming is not None and self.weights is not None:
            both = list(enumerate(self.experiment.pair_frames(coming)))
            if self.experiment.in_sequence:  # the first instant is reconstructed already
                del both[0]
            frames = [frame for number, frame in both if not self.folder.volume(coming, number).exists()]
        self.images.start(frames, self.experiment.pair_frames(pair))

    def write(self, write: Callable[[], None], *, large: bool = False) -> None:
        """Start to write a result of the present pair. `large` ones are written before the next reconstruction."""
        self.written.append(self.writer.start(write, large=large))

    @cached_property
    def darks(self) -> Mapping[str, np.ndarray | None]:
        """Dark image of every camera [counts]."""
        return read_darks(self.experiment)

    @cached_property
    def images(self) -> ReadAhead:
        """Images that are read while others are reconstructed."""
        return ReadAhead(self.experiment)

    @cached_property
    def recent(self) -> dict[Frame, FrameLight]:
        """Light of the frames that were read last, so that particles are found without reading the images again."""
        return {}

    @cached_property
    def writer(self) -> Writer:
        """Thread that writes results."""
        return Writer()

    @cached_property
    def written(self) -> list[Future[None]]:
        """Results of the present pair that are being written."""
        return []

    @cached_property
    def reconstructor(self) -> Reconstructor:
        """SMART with the weights, made once for all pairs."""
        assert self.weights is not None
        return Reconstructor(
            experiment=self.experiment,
            weights=self.weights,
            guard=self.guard,
            refinement=self.refinement,
        )

    def files(self, pair: int) -> PairFiles:
        """Return the files of a pair with the stamps that they must have."""
        return PairFiles.of(
            self.experiment,
            self.calibration_hash,
            self.folder,
            pair,
            background=self.background,
            guard=self.guard,
            refinement=self.refinement,
        )

    def _do(self, pair: int, frames: Frames, progress: StepProgress) -> None:
        files = self.files(pair)
        wanted = {"vectors": self.vectors, "volumes": self.keep_volumes, "particles": self.weights is not None}
        if files.outdated(**wanted) is None:
            log.info("%s: was finished by a worker that died afterwards", self.experiment.name_of(pair))
            return
        volumes = self.volumes(files, frames, part_of(progress, 0.0, RECONSTRUCTED if self.vectors else 1.0))
        if self.vectors:
            progress(RECONSTRUCTED)
            self._correlate(files, volumes, progress)

    def volumes(self, files: PairFiles, frames: Frames, progress: StepProgress) -> PairVolumes:
        """Return the volumes of a pair, with the refusals of the pair; raise as `Frames.volumes`."""
        both = frames.volumes(files, progress)
        return replace(both, between=(*both.between, *belonging.of_pair(self.experiment, self.refusals, files.pair)))

    def require_weights(self, file: VolumeFile) -> None:
        """Raise InputError if there are no weights because all volumes should be in the folder."""
        if self.weights is None:
            raise InputError(
                f"{file.path}: expected the volume of {file.frame.label} made with the present settings, found none. "
                "Run `lfpiv reconstruct` first."
            )

    def light_again(self, frame: Frame) -> FrameLight:
        """Read the images of a frame, also if its volume is known; raise InputError if that is not possible."""
        if not self.cameras:
            raise InputError(f"{frame.label}: no image is read in this step.")
        if (known := self.recent.get(frame)) is not None:
            return known
        light = frame_light(self.experiment, self.cameras, self.darks, frame, self.images.image)
        if self.experiment.tracking is not None:  # particles are found in the two latest frames
            self.recent[frame] = light
            for old in list(self.recent)[:-2]:
                del self.recent[old]
        return light

    def reconstruct(self, light: FrameLight, progress: StepProgress) -> FrameVolume:
        """Reconstruct one frame by itself; raise InputError if its images cannot be reconstructed."""
        self.writer.wait_large()
        return self.reconstructor.frame(light, progress)

    def reconstruct_pair(self, light: Sequence[FrameLight], progress: StepProgress) -> tuple[FrameVolume, FrameVolume]:
        """Reconstruct both frames of an image pair together; raise InputError if that is not possible."""
        self.writer.wait_large()
        return self.reconstructor.pair(light, progress)

    def follow(self, light: FrameLight, before: Before | None, progress: StepProgress) -> tuple[Followed, Before]:
        """Reconstruct a frame of a series from its predecessor; return it and what its successor needs.

        Raises
        ------
        InputError
            If its images cannot be reconstructed.
        """
        frame = light.frame.number
        self.log_warnings(frame, light.warnings)
        self.writer.wait_large()
        found, coming = self.reconstructor.follow(light, before, progress)
        self.log_warnings(frame, found.light.warnings[len(light.warnings) :])
        return found, coming

    def correct(self, trail: Sequence[Followed], at: int, progress: StepProgress) -> FrameVolume:
        """Reconstruct one of successive frames again from those before and after it.

        Raises
        ------
        InputError
            If its images cannot be reconstructed.
        """
        return self.reconstructor.correct(trail, at, progress)

    def log_warnings(self, pair: int, warnings: Iterable[Warning]) -> None:
        """Log the first warning of each code about a pair or its frames."""
        self.log_first([self.experiment.recording.by_result(warning.of_pair(pair)) for warning in warnings])

    def measure(
        self,
        images: Sequence[Mapping[str, np.ndarray]],
        noise: Sequence[Mapping[str, float]],
        *,
        frames: Sequence[Frame],
        reconstructor: Reconstructor,
    ) -> xr.Dataset:
        """Return the vectors of two sets of images, measured as those of the experiment; nothing is written.

        The masks are those of `frames`.

        Raises
        ------
        ValueError
            If the images cannot be reconstructed.
        """
        first, second = reconstructor.volumes(images, noise, frames)
        return measure_vectors(first, second, self.experiment)

    def vectors_between(self, pair: int, volumes: PairVolumes) -> xr.Dataset:
        """Return the vectors of a pair, with the warnings about its images and with times [s] as attributes."""
        start = time.perf_counter()
        vectors = without_unmeasured(measure_vectors(*volumes.volumes, self.experiment), volumes)
        vectors.attrs["warnings"] = warn.to_text(volumes.warnings)
        vectors.attrs["reconstruction_s"] = reconstruction_s(self.experiment, pair, volumes)
        vectors.attrs["correlation_s"] = time.perf_counter() - start
        return vectors

    def tracked(self, files: PairFiles, volumes: PairVolumes) -> tuple[xr.Dataset, xr.Dataset, list[Warning]]:
        """Return the vectors of a pair, its linked particles, and the warnings about these.

        Where links resolve the flow better, vectors are means of the flow through them.

        Raises
        ------
        InputError
            If an image cannot be read again.
        """
        vectors = self.vectors_between(files.pair, volumes)
        start = time.perf_counter()
        light = [self.light_again(file.frame) for file in files.frames]
        table, found = track(self.search, self.fits, light, volumes, vectors)
        if vectors.attrs["verdict"] in REFUSED:
            table = refused(table)
        elif self.experiment.by_links:
            vectors = vectors_from_links(vectors, table)
            vectors.attrs["correlation_s"] += time.perf_counter() - start
            if "links" not in vectors.attrs and len(self.experiment.cameras) == 1:
                found.append(Warning(code=Code.ONE_CAMERA))
        vectors.attrs["warnings"] = warn.to_text((*volumes.warnings, *found))
        return vectors, table, found

    def result(
        self, files: PairFiles, vectors: xr.Dataset, volumes: PairVolumes, found: Iterable[Warning] = ()
    ) -> tuple[PairFigures, Callable[[], None]]:
        """Return the figures of a pair's vectors, and what writes them to its file."""
        condensed = volumes.condensed()
        figures = pair_figures.measure(vectors, condensed, (*volumes.warnings, *found))
        attributes = {
            "experiment": self.experiment.name,
            "smart": self.experiment.smart.model_dump(),
            "correlation": self.experiment.correlation.model_dump(),
            "figures": figures.to_json(),
        }
        field = joint_field(volumes.volumes, vectors) if is_joint(*volumes.volumes) else None
        return figures, partial(files.write_vectors, vectors, condensed, attributes, field)

    def _correlate(self, files: PairFiles, volumes: PairVolumes, progress: StepProgress) -> None:
        experiment = self.experiment
        if files.particles is None or self.weights is None:
            vectors, found = self.vectors_between(files.pair, volumes), list[Warning]()
        else:
            vectors, table, found = self.tracked(files, volumes)
            self._keep_particles(files, table, found)
        figures, write_vectors = self.result(files, vectors, volumes, found)
        self.log_warnings(files.pair, volumes.between)
        if figures.verdict not in (*REFUSED, Verdict.GOOD.value):
            self.log_warnings(files.pair, [figures.few_valid_warning(files.pair)])
        if figures.lost_unseeded > 0:
            self.log_warnings(files.pair, [figures.unseeded_warning(files.pair)])
        progress(CORRELATED)

        def write() -> None:
            write_vectors()
            name = experiment.name_of(files.pair)
            valid, moved = 100 * figures.valid_fraction, figures.moved(experiment.grid.voxel_mm, experiment.dt_s)
            log.info("%s: %.0f %% of the vectors valid; median movement %s", name, valid, moved)

        self.write(write)

    def _keep_particles(self, files: PairFiles, table: xr.Dataset, found: Iterable[Warning]) -> None:
        """Write the linked particles of a pair, and log their figures and the warnings about them."""
        assert files.particles is not None
        self.write(partial(files.write_particles, table))
        name, linked = self.experiment.name_of(files.pair), table.sizes["particle"]
        log.info(
            "%s: %d and %d particles found, %d linked, %d of them valid; %.3g per microlens, %.0f %% of the light "
            "explained",
            name,
            *table.attrs["found"],
            linked,
            table.attrs["valid_links"],
            np.mean(table.attrs["per_microlens"]),
            100 * np.mean(table.attrs["explained"]),
        )
        self.log_warnings(files.pair, found)

    @cached_property
    def fits(self) -> FrameFits:
        """Particles of the latest frame."""
        return FrameFits()

    @cached_property
    def search(self) -> ParticleSearch:
        """Search for particles of this rig, made once for all pairs."""
        assert self.weights is not None and self.experiment.tracking is not None
        return ParticleSearch(self.weights, self.experiment.grid, **self.experiment.tracking.search)


def _with_next(pairs: Iterable[int]) -> Iterator[tuple[int, int | None]]:
    """Yield each pair with its successor, None for the last pair."""
    source = iter(pairs)
    present = next(source, None)
    while present is not None:
        coming = next(source, None)
        yield present, coming
        present = coming

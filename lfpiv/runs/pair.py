"""The work on pairs: images to volumes to vectors, and files of both.

`PairWork.do` takes pairs and yields the `Outcome` of each. Volumes that are in the output folder and still
fit are read instead of reconstructed. Each frame is reconstructed once, for all its pairs (`lfpiv.runs.frames`).
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

from lfpiv import warn
from lfpiv.errors import StorageError
from lfpiv.experiment.recording import Frame
from lfpiv.joint.field import joint_field
from lfpiv.joint.vectors import is_joint
from lfpiv.progress import StepProgress, part_of, record
from lfpiv.results.folder import Folder
from lfpiv.results.pair_files import PairFiles, PairVolumes
from lfpiv.runs import belonging, pair_figures
from lfpiv.runs.frame_light import FrameLight
from lfpiv.runs.frame_work import FrameWork
from lfpiv.runs.frames import Frames, JointFrames, failure
from lfpiv.runs.pair_figures import PairFigures
from lfpiv.runs.pair_outcome import CORRELATED, PREPARED, RECONSTRUCTED, Computed, Outcome, PairProgress
from lfpiv.runs.pair_vectors import REFUSED, measure_vectors, without_unmeasured
from lfpiv.runs.pair_volumes import Reconstructor, reconstruction_s
from lfpiv.runs.particles import FrameFits, refused, track
from lfpiv.runs.sequences import FollowedFrames
from lfpiv.tracking.finding import ParticleSearch
from lfpiv.tracking.link_vectors import vectors_from_links
from lfpiv.velocity.cross_correlation import Verdict
from lfpiv.warn import Code, Warning

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class PairWork(FrameWork):
    """The work on each pair of an experiment, with all its inputs."""

    folder: Folder
    vectors: bool = True
    """Correlate the volumes and write the vectors."""
    refusals: tuple[Warning, ...] = ()
    """Why the vectors of all pairs, or of some, are not valid; see `belonging.check`."""

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
                found = self._compute(pair, frames, self._recorded(pair, partial(progress, number)))
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

    def _recorded(self, pair: int, progress: StepProgress) -> StepProgress:
        """Return the progress of a pair that is also recorded for the studio."""

        def both(fraction: float) -> None:
            record(self.experiment.name_of(pair), fraction, pair)
            progress(fraction)

        both(0.0)
        return both

    def frames(self, stored: Collection[int] = ()) -> Frames:
        """Return the frames of pairs to come, of which none is known yet."""
        if self.experiment.in_sequence:
            return FollowedFrames(self, stored)
        return JointFrames(self) if self.experiment.is_joint else Frames(self, stored)

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

    def files(self, pair: int) -> PairFiles:
        """Return the files of a pair with the stamps that they must have."""
        return PairFiles.for_pair(self.experiment, self.inputs, self.folder, pair)

    def _do(self, pair: int, frames: Frames, progress: StepProgress) -> None:
        files = self.files(pair)
        wanted = {"vectors": self.vectors, "volumes": self.keep_volumes, "particles": self.weights is not None}
        if files.outdated(**wanted) is None:
            log.info("%s: was finished by a worker that died afterwards", self.experiment.name_of(pair))
            return
        volumes = self.volumes(files, frames, part_of(progress, PREPARED, RECONSTRUCTED if self.vectors else 1.0))
        if self.vectors:
            progress(RECONSTRUCTED)
            self._correlate(files, volumes, progress)

    def volumes(self, files: PairFiles, frames: Frames, progress: StepProgress) -> PairVolumes:
        """Return the volumes of a pair, with the refusals of the pair; raise as `Frames.volumes`."""
        both = frames.volumes(files, progress)
        refusals = belonging.refusals_of_pair(self.experiment, self.refusals, files.pair)
        return replace(both, between=(*both.between, *refusals))

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

    def tracked(
        self, pair: int, light: Sequence[FrameLight], volumes: PairVolumes
    ) -> tuple[xr.Dataset, xr.Dataset, list[Warning]]:
        """Return the vectors of a pair, its linked particles, and the warnings about these.

        Where links resolve the flow better, vectors are means of the flow through them.
        """
        vectors = self.vectors_between(pair, volumes)
        start = time.perf_counter()
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
            light = [self.light_again(file.frame) for file in files.frames]
            vectors, table, found = self.tracked(files.pair, light, volumes)
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
            log.info("%s: %.1f %% of the vectors valid; median movement %s", name, valid, moved)

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

"""Files of one pair in an output folder: two volumes and the vectors, each with a stamp of its origin.

`PairFiles` checks whether they still fit the experiment, reads and writes them. `VolumeFile` does so for the volume of
one frame; two pairs of a series share the volume of an instant. `PairVolumes` holds two volumes with figures and
warnings of their images.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from lfpiv import warn
from lfpiv.errors import DamagedFile, InputError
from lfpiv.experiment.experiment import Experiment
from lfpiv.experiment.recording import Frame
from lfpiv.files import writing
from lfpiv.geometry.grid import Grid
from lfpiv.records import read_json, validate
from lfpiv.results import datasets, netcdf, provenance, stamps
from lfpiv.results.folder import RETIRED, Folder, retire
from lfpiv.results.particles import write_particles
from lfpiv.results.provenance import Marks, Stamp
from lfpiv.results.stamps import Inputs
from lfpiv.warn import Warning


@dataclass(frozen=True, kw_only=True)
class FrameRecord:
    """Figures and warnings of the images of one frame, stored with its volume."""

    structure: Mapping[str, float]
    """Camera -> correlation of near pixels of its image; empty where it was not stored."""
    warnings: tuple[Warning, ...]
    """Warnings about the images. In an image pair a warning about both frames is in the record of the first one."""
    seconds: float
    """Time that reading the images and reconstructing the volume took [s]."""


@dataclass(frozen=True, kw_only=True)
class FrameVolume:
    """The volume of one frame and its record."""

    volume: xr.DataArray
    """Volume (z, y, x) [counts]."""
    record: FrameRecord


@dataclass(frozen=True, kw_only=True)
class PairVolumes:
    """The volumes of both frames of a pair."""

    frames: tuple[FrameVolume, FrameVolume]
    names: tuple[str, str] = ("a", "b")
    """Names of the frames in the experiment; those of a series are "a" and "b"."""
    between: tuple[Warning, ...] = ()
    """Warnings about both instants of a pair of a series, and refusals of the pair."""

    @property
    def volumes(self) -> tuple[xr.DataArray, xr.DataArray]:
        """Both volumes (z, y, x) [counts]."""
        return self.frames[0].volume, self.frames[1].volume

    @property
    def records(self) -> tuple[FrameRecord, FrameRecord]:
        """Records of both volumes."""
        return self.frames[0].record, self.frames[1].record

    @property
    def warnings(self) -> tuple[Warning, ...]:
        """Warnings about the images of both frames."""
        return self.records[0].warnings + self.records[1].warnings + self.between

    def condensed(self) -> xr.Dataset:
        """Return projections, profiles and figures of the volumes, as `netcdf.build_reconstruction` does."""
        volumes = dict(zip(self.names, self.volumes, strict=True))
        structure = {name: record.structure for name, record in zip(self.names, self.records, strict=True)}
        return netcdf.build_reconstruction(volumes, structure)


@dataclass(frozen=True, kw_only=True)
class VolumeFile:
    """Path and stamp of the volume of one frame."""

    frame: Frame
    path: Path
    stamp: Stamp
    origin: Mapping[str, Any]
    """Attributes that say of what the volume is: pair and frame, or instant and time."""
    grid: Grid | None = None
    """Voxels of the volume; None if the file is not compared with them."""

    def fitting(self) -> Marks | None:
        """Return the marks of the file; None if it is missing or does not fit."""
        marks = provenance.read_marks(self.path)
        return marks if self.stamp.fits(marks) else None

    def read(self) -> FrameVolume | None:
        """Read the volume and its record; None if the file is missing, damaged, or does not fit."""
        if self.fitting() is None:
            return None
        try:
            volume = netcdf.read_volume(self.path, grid=self.grid)
            return FrameVolume(volume=volume, record=_read_record(volume, self.path))
        except InputError as error:
            provenance.reject(self.path, error.reason if isinstance(error, DamagedFile) else str(error))
            return None

    def write(self, found: FrameVolume) -> None:
        """Write the volume with its record, atomically."""
        record = found.record
        attributes = {
            **self.stamp.attributes,
            "seconds": record.seconds,
            "warnings": warn.to_text(record.warnings),
            **self.origin,
        }
        of_images = {"cameras": list(record.structure), "structure": list(record.structure.values())}
        with writing(self.path):
            netcdf.write_volume(found.volume.assign_attrs(of_images), self.path, attributes=attributes)
            self.path.with_suffix(RETIRED).unlink(missing_ok=True)

    def within(self, folder: Path) -> VolumeFile:
        """Return the file of the same volume in another folder."""
        return replace(self, path=folder / self.path.name)


@dataclass(frozen=True, kw_only=True)
class PairFiles:
    """Paths and stamps of the results of one pair."""

    pair: int
    vectors: Path
    stamp: Stamp
    """Stamp of the vectors."""
    frames: tuple[VolumeFile, VolumeFile]
    """Volumes of the first and of the second frame."""
    origin: Mapping[str, Any]
    """Attributes that say of what the vectors are: the pair, or instant, step and time."""
    particles: Path | None = None
    """Linked particles; None without tracking."""
    particles_stamp: Stamp | None = None

    @classmethod
    def for_pair(cls, experiment: Experiment, inputs: Inputs, folder: Folder, pair: int) -> PairFiles:
        """Return the files of a pair."""
        own = stamps.of_pair(experiment, inputs, pair)
        frames = experiment.pair_frames(pair)
        first, second = (
            VolumeFile(
                frame=frames[number],
                path=folder.volume(pair, number),
                stamp=own.volumes[number],
                origin=experiment.recording.frame_origin(frames[number], experiment.dt_s),
                grid=experiment.grid,
            )
            for number in (0, 1)
        )
        return cls(
            pair=pair,
            vectors=folder.vectors(pair),
            stamp=own.vectors,
            frames=(first, second),
            origin=experiment.recording.origin(pair, experiment.dt_s),
            particles=None if own.particles is None else folder.particles(pair),
            particles_stamp=own.particles,
        )

    @cached_property
    def vector_marks(self) -> Marks | None:
        """Marks of the vectors, read once; None if they are missing or cannot be used."""
        return provenance.read_marks(self.vectors)

    def _stamped(self, vectors: bool, volumes: bool, particles: bool) -> Iterator[tuple[Stamp, Marks | None]]:
        """Yield the stamp of each file and the marks of the stored one; None if it is missing or cannot be used."""
        if vectors:
            yield self.stamp, self.vector_marks
        if vectors and particles and self.particles is not None and self.particles_stamp is not None:
            yield self.particles_stamp, provenance.read_marks(self.particles)
        if volumes:
            yield from ((frame.stamp, provenance.read_marks(frame.path)) for frame in self.frames)

    def outdated(self, *, vectors: bool, volumes: bool, particles: bool = True) -> list[str] | None:
        """Return the names of the changed parts of a file's stamp; empty if a file is missing, None if all fit."""
        for stamp, marks in self._stamped(vectors, volumes, particles):
            changes = [] if marks is None else stamp.changes(marks)
            if changes or marks is None:
                return changes
        return None

    def fitting_vectors(self) -> Marks | None:
        """Return the marks of the vectors; None if they are missing or do not fit."""
        marks = self.vector_marks
        return marks if self.stamp.fits(marks) else None

    def has_particles(self) -> bool:
        """Return whether the linked particles are there and fit."""
        if self.particles is None or self.particles_stamp is None:
            return False
        marks = provenance.read_marks(self.particles)
        return marks is not None and self.particles_stamp.fits(marks)

    def fitting_volumes(self) -> tuple[Marks, ...] | None:
        """Return the marks of both volumes; None if one is missing or does not fit."""
        marks = tuple(found for frame in self.frames if (found := frame.fitting()) is not None)
        return marks if len(marks) == 2 else None

    def retire_outdated(self) -> Iterator[tuple[Path, Path]]:
        """Rename the results whose images changed; yield old and new paths."""
        results = [(self.vectors, self.stamp), *((frame.path, frame.stamp) for frame in self.frames)]
        if self.particles is not None and self.particles_stamp is not None:
            results.append((self.particles, self.particles_stamp))
        for path, stamp in results:
            marks = provenance.read_marks(path)
            if marks is not None and "images" in stamp.changes(marks):
                with writing(path):
                    aside = retire(path)
                yield path, aside

    def write_vectors(
        self,
        vectors: xr.Dataset,
        condensed: xr.Dataset,
        attributes: Mapping[str, Any],
        field: xr.Dataset | None = None,
    ) -> None:
        """Write the vectors, the condensed volumes and the field of a joint fit into one file, atomically."""
        marks = {**self.stamp.attributes, **self.origin, **attributes}
        with writing(self.vectors):
            netcdf.write_vectors(vectors, self.vectors, attributes=marks, reconstruction=condensed, field=field)
            self.vectors.with_suffix(RETIRED).unlink(missing_ok=True)

    def write_particles(self, table: xr.Dataset) -> None:
        """Write the linked particles, atomically."""
        assert self.particles is not None and self.particles_stamp is not None
        with writing(self.particles):
            attributes = {**self.particles_stamp.attributes, **self.origin}
            write_particles(table, self.particles, attributes=attributes)
            self.particles.with_suffix(RETIRED).unlink(missing_ok=True)


def _read_record(volume: xr.DataArray, path: Path) -> FrameRecord:
    stored = datasets.read_attributes(path)
    try:
        cameras = volume.attrs.get("cameras", [])
        names = read_json(cameras) if isinstance(cameras, str) else cameras
        values = np.atleast_1d(volume.attrs.get("structure", [])).tolist()
        return FrameRecord(
            structure=validate(dict[str, float], dict(zip(names, values, strict=True)) if values else {}),
            warnings=provenance.stored_warnings(stored),
            seconds=validate(float, stored.get("seconds")),
        )
    except (ValueError, TypeError) as error:
        raise DamagedFile(path, f"its attributes have another form: {error}") from None

"""Files of one pair in an output folder: two volumes and the vectors, each with a stamp of its origin.

`PairFiles` checks whether they still fit the experiment, reads and writes them. `PairVolumes` holds two volumes with
figures and warnings of their images.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from lfpiv import warn
from lfpiv.experiment.experiment import Experiment
from lfpiv.files import writing
from lfpiv.geometry.grid import NO_LAYERS, Layers
from lfpiv.results import netcdf, provenance
from lfpiv.results.folder import RETIRED, Folder, retire
from lfpiv.results.provenance import Marks, PairStamps, Stamp
from lfpiv.warn import Warning


@dataclass(frozen=True, kw_only=True)
class FrameRecord:
    """Figures and warnings of the images of one frame, stored with its volume."""

    frame: str
    """Name of the frame in the experiment."""
    structure: Mapping[str, float]
    """Camera -> correlation of near pixels of its image; empty where it was not stored."""
    warnings: tuple[Warning, ...]
    """Warnings about the images. A warning about both frames is in the record of the first one."""
    seconds: float
    """Time that reading the images and reconstructing the volume took [s]."""


@dataclass(frozen=True, kw_only=True)
class PairVolumes:
    """The volumes of both frames of a pair, and their records."""

    volumes: tuple[xr.DataArray, xr.DataArray]
    """Volumes (z, y, x) [counts]."""
    records: tuple[FrameRecord, FrameRecord]

    @property
    def warnings(self) -> tuple[Warning, ...]:
        """Warnings about the images of both frames."""
        return self.records[0].warnings + self.records[1].warnings

    def condensed(self) -> xr.Dataset:
        """Return projections, profiles and figures of the volumes, as `netcdf.build_reconstruction` does."""
        volumes = {record.frame: volume for record, volume in zip(self.records, self.volumes, strict=True)}
        return netcdf.build_reconstruction(volumes, {record.frame: record.structure for record in self.records})


@dataclass(frozen=True, kw_only=True)
class PairFiles:
    """Paths and stamps of the results of one pair."""

    pair: int
    vectors: Path
    volumes: tuple[Path, Path]
    """Volumes of the first and of the second frame."""
    stamps: PairStamps

    @classmethod
    def of(
        cls,
        experiment: Experiment,
        calibration: str,
        folder: Folder,
        pair: int,
        *,
        background: str | None = None,
        guard: Layers = NO_LAYERS,
    ) -> PairFiles:
        """Return the files of a pair.

        `calibration` and `background` are the hashes of the calibration's stamp and of the subtracted light. `guard`
        has the guard layers of the volumes.
        """
        stamps = provenance.of_pair(experiment, calibration, pair, background=background, guard=guard)
        volumes = (folder.volume(pair, 0), folder.volume(pair, 1))
        return cls(pair=pair, vectors=folder.vectors(pair), volumes=volumes, stamps=stamps)

    @cached_property
    def vector_marks(self) -> Marks | None:
        """Marks of the vectors, read once; None if they are missing."""
        return provenance.read_marks(self.vectors)

    def _wanted(self, vectors: bool, volumes: bool) -> Iterator[tuple[Path, Stamp]]:
        if vectors:
            yield self.vectors, self.stamps.vectors
        if volumes:
            yield from ((path, self.stamps.volumes) for path in self.volumes)

    def outdated(self, *, vectors: bool, volumes: bool) -> list[str] | None:
        """Return the names of the changed parts of a file's stamp; empty if a file is missing, None if all fit."""
        for path, stamp in self._wanted(vectors, volumes):
            marks = self.vector_marks if path == self.vectors else provenance.read_marks(path)
            changes = [] if marks is None else stamp.changes(marks)
            if changes or marks is None:
                return changes
        return None

    def fitting_vectors(self) -> Marks | None:
        """Return the marks of the vectors; None if they are missing or do not fit."""
        return self.vector_marks if self.stamps.vectors.fits(self.vector_marks) else None

    def fitting_volumes(self) -> tuple[Marks, ...] | None:
        """Return the marks of both volumes; None if one is missing or does not fit."""
        marks = tuple(found for path in self.volumes if (found := provenance.read_marks(path)) is not None)
        return marks if len(marks) == 2 and all(map(self.stamps.volumes.fits, marks)) else None

    def retire_outdated(self) -> Iterator[tuple[Path, Path]]:
        """Rename the results whose images changed; yield old and new paths."""
        for path, stamp in self._wanted(vectors=True, volumes=True):
            marks = provenance.read_marks(path)
            if marks is not None and "images" in stamp.changes(marks):
                with writing(path):
                    aside = retire(path)
                yield path, aside

    def read_volumes(self) -> PairVolumes | None:
        """Read both volumes and their records; None if one is missing or does not fit."""
        if self.fitting_volumes() is None:
            return None
        first, second = (netcdf.read_volume(path) for path in self.volumes)
        a, b = (_read_record(volume, path) for volume, path in zip((first, second), self.volumes, strict=True))
        return PairVolumes(volumes=(first, second), records=(a, b))

    def write_volumes(self, pair: PairVolumes) -> None:
        """Write both volumes with their records, each file atomically."""
        for volume, record, path in zip(pair.volumes, pair.records, self.volumes, strict=True):
            attributes = {
                **self.stamps.volumes.attributes,
                "seconds": record.seconds,
                "warnings": warn.to_text(record.warnings),
                "pair": self.pair,
                "frame": record.frame,
            }
            of_images = {"cameras": list(record.structure), "structure": list(record.structure.values())}
            with writing(path):
                netcdf.write_volume(volume.assign_attrs(of_images), path, attributes=attributes)
                path.with_suffix(RETIRED).unlink(missing_ok=True)

    def write_vectors(self, vectors: xr.Dataset, condensed: xr.Dataset, attributes: Mapping[str, Any]) -> None:
        """Write the vectors and the condensed volumes into one file, atomically."""
        marks = {**self.stamps.vectors.attributes, "pair": self.pair, **attributes}
        with writing(self.vectors):
            netcdf.write_vectors(vectors, self.vectors, attributes=marks, reconstruction=condensed)
            self.vectors.with_suffix(RETIRED).unlink(missing_ok=True)


def _read_record(volume: xr.DataArray, path: Path) -> FrameRecord:
    stored = netcdf.read_attributes(path)
    structure = {}
    if "structure" in volume.attrs:
        cameras = volume.attrs["cameras"]
        names = json.loads(cameras) if isinstance(cameras, str) else cameras
        structure = dict(zip(names, np.atleast_1d(volume.attrs["structure"]).tolist(), strict=True))
    return FrameRecord(
        frame=str(stored["frame"]),
        structure=structure,
        warnings=provenance.stored_warnings(stored),
        seconds=float(stored["seconds"]),
    )

"""The work on one image pair: images to volumes to vectors, each written whole, and what came of it."""

from __future__ import annotations

import json
import logging
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

from lfpiv.errors import InputError, StorageError
from lfpiv.experiment.experiment import Experiment
from lfpiv.experiment.settings import Correlation
from lfpiv.files import writing
from lfpiv.lightfield import image_checks
from lfpiv.lightfield.particle_signal import seen_structure
from lfpiv.results import netcdf, provenance
from lfpiv.results.folder import RETIRED, Folder
from lfpiv.runs import summary, summary_warnings
from lfpiv.velocity.cross_correlation import correlate
from lfpiv.warn import Code, Warning, gather

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera
    from lfpiv.weights.operator import Weights

log = logging.getLogger(__name__)

FRAME_SHARE = 0.45
"""Part of a pair's work that one of its volumes takes, for progress bars."""

WRITES = 0.99
"""Finished part of a pair when all that is left is to write its vectors."""

Fraction = Callable[[float], None]
"""Called with the finished fraction of a pair, from 0 to 1."""


NO_PARTICLES = "no particles in the images: none of the vectors counts"
"""Verdict on the vectors of a pair of which the images of a frame show nothing but noise."""


@dataclass(frozen=True, kw_only=True)
class FrameLight:
    """The images of one frame, by camera, and what they tell by themselves."""

    light: dict[str, np.ndarray]
    """Images without dark and background [counts]."""
    noise: dict[str, float]
    """Noise of that background [counts]."""
    fingerprints: dict[str, bytes]
    """What tells images from copies of each other."""
    warnings: list[Warning]
    """Doubts about them."""
    seconds: float
    """Time that reading and looking at them took."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What came of a pair."""

    pair: int
    reason: str = ""
    """Why there is no result; empty where there is one."""


@dataclass(frozen=True, kw_only=True)
class PairWork:
    """What is to be done with each pair of an experiment, and everything that needs."""

    experiment: Experiment
    folder: Folder
    calibration_hash: str
    weights: Weights | None
    """None where all volumes are in the folder."""
    keep_volumes: bool
    """Write the volumes."""
    vectors: bool = True
    """Go on to the vectors."""

    def do(self, pair: int, progress: Fraction) -> Outcome:
        """Do all of it with one pair; what goes wrong with it is its outcome, and no other pair's.

        Raises
        ------
        StorageError
            If a result cannot be written: no other pair could be, either.
        """
        try:
            # sums of BLAS depend on its threads, and the numbers must not depend on how many workers there are
            with threadpool_limits(1):
                self._do(pair, progress)
        except StorageError:
            raise
        except MemoryError:
            return Outcome(pair=pair, reason="out of memory: use fewer workers, larger voxels or a smaller volume")
        except ValueError as error:
            return Outcome(pair=pair, reason=" ".join(str(error).split()))
        except Exception as error:  # whatever it is, the other pairs are not to blame
            log.debug("pair %d: %s", pair, traceback.format_exc())
            return Outcome(pair=pair, reason=f"unexpected {type(error).__name__}: {' '.join(str(error).split())}")
        progress(1.0)
        return Outcome(pair=pair)

    def _do(self, pair: int, progress: Fraction) -> None:
        volumes = self.stored_volumes(pair)
        if volumes is None:
            volumes = self.reconstruct(pair, lambda fraction: progress(2 * FRAME_SHARE * fraction))
            if self.keep_volumes:
                self._write_volumes(pair, volumes)
        if self.vectors:
            progress(2 * FRAME_SHARE)
            self.correlate(pair, volumes, progress)

    def stored_volumes(self, pair: int) -> list[xr.DataArray] | None:
        """Both volumes of a pair from the folder; None where they are missing or do not fit."""
        wanted = provenance.of_volumes(self.experiment, self.calibration_hash, pair)
        paths = [self.folder.volume(pair, frame) for frame in (0, 1)]
        if not all(found is not None and not wanted.changes(found) for found in map(provenance.marks, paths)):
            return None
        volumes = [netcdf.read_volume(path) for path in paths]
        for volume, path in zip(volumes, paths, strict=True):
            volume.attrs["seconds"] = float(netcdf.read_attributes(path)["seconds"])
        return volumes

    def reconstruct(self, pair: int, progress: Fraction) -> list[xr.DataArray]:
        """Reconstruct both volumes of a pair; the attribute `seconds` says what each took."""
        if self.weights is None:
            raise InputError(
                f"{self.folder.volume(pair, 0)}: expected the two volumes of pair {pair} made with the present "
                "settings, found none. Run `lfpiv reconstruct` first."
            )
        frames = self.experiment.frames
        read = [self.read_light(pair, frame) for frame in frames]
        image_checks.require_different(
            (f"{name}, pair {pair}, frame {frame}", mark)
            for frame, one in zip(frames, read, strict=True)
            for name, mark in one.fingerprints.items()
        )
        warnings = [list(one.warnings) for one in read]
        for name in read[0].light:  # what concerns both frames is kept with the first one
            warnings[0] += image_checks.uneven_warnings(read[0].light[name], read[1].light[name], name)
        shown = [self._structure(one.light) for one in read]
        for frame, found, structure in zip(frames, warnings, shown, strict=True):
            found += image_checks.signal_warnings(structure, frame)
        self._log_new(pair, [warning for found in warnings for warning in found])
        volumes = _volumes(self.weights, read, self.experiment, pair, progress)
        for volume, one, found, structure in zip(volumes, read, warnings, shown, strict=True):
            volume.attrs |= {"cameras": list(structure), "structure": list(structure.values())}
            volume.attrs["warnings"] = json.dumps([warning.to_json() for warning in found])
            volume.attrs["seconds"] += one.seconds
        return volumes

    def _structure(self, light: Mapping[str, np.ndarray]) -> dict[str, float]:
        assert self.weights is not None
        return {name: seen_structure(image, self.weights.cameras[name].decoder) for name, image in light.items()}

    @cached_property
    def logged(self) -> set[Code]:
        """Codes that this process has warned of. The summary names all pairs."""
        return set()

    def _log_new(self, pair: int, warnings: Sequence[Warning]) -> None:
        new = [warning for warning in warnings if warning.code not in self.logged]
        for warning in gather(new):
            log.warning("%s", warning.of_pair(pair).sentence)
        self.logged.update(warning.code for warning in new)

    @cached_property
    def darks(self) -> dict[str, np.ndarray | None]:
        """Dark image of every camera [counts], None where there is none; read once."""
        return {camera.name: self.experiment.dark(camera.name) for camera in self.experiment.cameras}

    def read_light(self, pair: int, frame: str) -> FrameLight:
        """Read the images of one frame and look at each by itself."""
        assert self.weights is not None
        return read_light(self.experiment, self.weights.cameras, self.darks, pair, frame)

    def _write_volumes(self, pair: int, volumes: Sequence[xr.DataArray]) -> None:
        mark = provenance.of_volumes(self.experiment, self.calibration_hash, pair).attributes
        for number, (volume, frame) in enumerate(zip(volumes, self.experiment.frames, strict=True)):
            path = self.folder.volume(pair, number)
            own = {key: volume.attrs[key] for key in ("seconds", "warnings")}
            attributes = {**mark, **own, "pair": pair, "frame": frame}
            with writing(path):
                netcdf.write_volume(volume, path, attributes=attributes)
                path.with_suffix(RETIRED).unlink(missing_ok=True)

    def correlate(self, pair: int, volumes: Sequence[xr.DataArray], progress: Fraction) -> None:
        """Correlate the volumes of a pair and write its vectors, the figures of the summary with them."""
        experiment, start = self.experiment, time.perf_counter()
        vectors = correlate(*volumes, dt_s=experiment.dt_s, **experiment.correlation.model_dump())
        vectors = _with_warnings(_with_motion(vectors, volumes), volumes)
        vectors.attrs["reconstruction_s"] = sum(float(volume.attrs["seconds"]) for volume in volumes)
        vectors.attrs["correlation_s"] = time.perf_counter() - start
        condensed = netcdf.build_reconstruction(dict(zip(experiment.frames, volumes, strict=True)))
        attributes = {
            **provenance.of_vectors(experiment, self.calibration_hash, pair).attributes,
            "experiment": experiment.name,
            "pair": pair,
            "smart": experiment.smart.model_dump(),
            "correlation": experiment.correlation.model_dump(),
            "figures": summary.pair_figures(vectors, condensed),
        }
        path = self.folder.vectors(pair)
        progress(WRITES)
        with writing(path):
            netcdf.write_vectors(vectors, path, attributes=attributes, reconstruction=condensed)
            path.with_suffix(RETIRED).unlink(missing_ok=True)
        log.info("pair %d: %.0f %% of the vectors valid", pair, 100 * float(vectors["valid"].mean()))


def read_light(
    experiment: Experiment,
    cameras: Mapping[str, CalibratedCamera],
    darks: Mapping[str, np.ndarray | None],
    pair: int,
    frame: str,
) -> FrameLight:
    """Read the images of one frame, given the dark image of every camera, and look at each by itself."""
    start = time.perf_counter()
    light, noise, fingerprints, warnings = {}, {}, {}, list[Warning]()
    for name, camera in cameras.items():
        raw, dark = experiment.particle_image(name, pair, frame), darks[name]
        image = raw if dark is None else raw - dark
        level, noise[name] = camera.decoder.background(image)
        light[name] = image - np.float32(level)
        fingerprints[name] = image_checks.fingerprint(raw)
        warnings += image_checks.image_warnings(raw, light[name], camera.decoder, name, frame)
    seconds = time.perf_counter() - start
    return FrameLight(light=light, noise=noise, fingerprints=fingerprints, warnings=warnings, seconds=seconds)


def _volumes(
    weights: Weights,
    read: Sequence[FrameLight],
    experiment: Experiment,
    pair: int,
    progress: Fraction,
) -> list[xr.DataArray]:
    """Volumes of both frames from their light and noise, with the seconds each took."""
    from lfpiv.reconstruction.motion import reconstruct_pair

    # by windows of its own: other windows in `[correlation]` do not ask for other volumes
    farthest, start = experiment.correlation.max_displacement_voxel, time.perf_counter()
    try:
        volumes = reconstruct_pair(
            weights,
            [one.light for one in read],
            floor=[one.noise for one in read],
            correlation=Correlation(max_displacement_voxel=farthest).model_dump(),
            progress=progress,
            **experiment.smart.model_dump(),
        )
    except ValueError as error:
        raise InputError(f"pair {pair}: {error}") from error
    for volume in volumes:
        volume.attrs["seconds"] = (time.perf_counter() - start) / len(volumes)
    if experiment.smart.motion_passes:
        log.info("pair %d: %s", pair, volumes[0].attrs["motion"])
    return volumes


def _with_motion(vectors: xr.Dataset, volumes: Sequence[xr.DataArray]) -> xr.Dataset:
    """Vectors that know whether their volumes share light along the motion, and whose quality does not count that."""
    from lfpiv.reconstruction.motion import Motion, unshared_quality

    told = volumes[0].attrs
    if told.get("motion", Motion.OFF.value) == Motion.OFF.value:
        return vectors
    vectors = unshared_quality(vectors, volumes)
    vectors.attrs |= {"motion": told["motion"], "motion_valid": np.atleast_1d(told["motion_valid"]).tolist()}
    return vectors


def _with_warnings(vectors: xr.Dataset, volumes: Sequence[xr.DataArray]) -> xr.Dataset:
    """Vectors that know what is suspicious about their images, and count for nothing where those are empty."""
    warnings = [summary_warnings.stored_warnings(volume.attrs) for volume in volumes]
    vectors.attrs["warnings"] = json.dumps([warning.to_json() for found in warnings for warning in found])
    cameras = volumes[0].attrs.get("cameras", [])
    if image_checks.unmeasured(warnings, len(json.loads(cameras) if isinstance(cameras, str) else cameras)):
        vectors["valid"] = xr.zeros_like(vectors["valid"])  # keeps its attributes
        for name in [name for name in vectors.data_vars if str(name).startswith("uncertainty")]:
            vectors[name] = vectors[name].where(vectors["valid"])
        vectors.attrs |= {"verdict": NO_PARTICLES, "valid_fraction": 0.0}
    return vectors

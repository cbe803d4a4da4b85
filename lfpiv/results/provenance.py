"""Stamps: settings and images that a finished file depends on, stored inside it.

A later run compares the stamp of a file with the stamp of the present experiment. It repeats the work if they differ,
and names the differences.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv import files, hdf5, warn
from lfpiv.errors import DamagedFile
from lfpiv.experiment import images
from lfpiv.experiment.experiment import CameraSetup, Experiment, Frame
from lfpiv.experiment.readers.source import ImagePath, split
from lfpiv.experiment.segments import followed
from lfpiv.geometry.grid import NO_LAYERS, Layers
from lfpiv.records import RecordError, read_json, read_object, validate
from lfpiv.version import __version__
from lfpiv.warn import Warning

log = logging.getLogger(__name__)

IMAGES, IMAGES_BEFORE = "images", "images_before"
"""Parts of a stamp: the images of a result, and those of the instants before it from which it follows."""
OF_PAIR = (IMAGES, IMAGES_BEFORE)
"""Parts of a stamp that differ from pair to pair of a run."""


@dataclass(frozen=True, kw_only=True)
class Marks:
    """Stamp, figures and warnings that a finished file stores."""

    settings_hash: str = ""
    """Hash of its stamp."""
    depends_on: str = ""
    """Parts of its stamp, as JSON."""
    figures: Mapping[str, Any] | None = None
    """Figures for the summary; None in files without."""
    warnings: tuple[Warning, ...] = ()
    """Warnings about the images it was made from."""
    frame: str = ""
    """Frame of a volume, as the experiment names it; empty in other files."""
    sealed: bool = False
    """Whether a digest shows that the file is as it was written; files of earlier versions have none."""


@dataclass(frozen=True)
class Stamp:
    """The parts that a result depends on."""

    parts: Mapping[str, Any]
    """Name -> settings, a hash, or the identity of images; None for missing images."""

    @cached_property
    def hash(self) -> str:
        """Short hash of all parts."""
        return files.settings_hash(**self.parts)

    @property
    def attributes(self) -> dict[str, str]:
        """Attributes that a file stores."""
        return {"settings_hash": self.hash, "depends_on": json.dumps(files.plain(self.parts))}

    def changes(self, marks: Marks) -> list[str]:
        """Return the names of the parts that changed since a file was made; empty if the file still fits.

        Missing images count as unchanged, because raw data may be deleted.
        """
        if marks.settings_hash == self.hash:
            return []
        try:
            before = read_object(marks.depends_on)
        except RecordError:
            return ["settings or images"]
        now = files.plain(self.parts)
        found = []
        for name in {**before, **now}:
            old, new = before.get(name), now.get(name)
            if old == new or (name in (IMAGES, IMAGES_BEFORE) and new is None):
                continue
            if isinstance(old, dict) and isinstance(new, dict):
                gone = {IMAGES} if new.get("images", ()) is None else set()
                found += [f"{name}.{key}" for key in {**old, **new} if old.get(key) != new.get(key) and key not in gone]
            else:
                found.append(name)
        return found

    def fits(self, marks: Marks | None) -> bool:
        """Return whether there is a file and nothing it depends on changed."""
        return marks is not None and not self.changes(marks)


@dataclass(frozen=True, kw_only=True)
class PairStamps:
    """Stamps of the results of one pair."""

    volumes: tuple[Stamp, Stamp]
    """Of both frames; the same for both frames of an image pair, which motion passes reconstruct together."""
    vectors: Stamp
    particles: Stamp | None = None
    """Of the linked particles; None without tracking."""


def read_marks(path: Path) -> Marks | None:
    """Read the marks of a finished NetCDF or HDF5 file, verified; None if it is missing or damaged.

    The log names a damaged file and the reason.
    """
    try:
        return require_marks(path)
    except FileNotFoundError:
        return None
    except DamagedFile as error:
        reject(path, error.reason)
        return None


def require_marks(path: Path) -> Marks:
    """Read the marks of a finished file, verified.

    Raises
    ------
    FileNotFoundError
        If it is missing.
    DamagedFile
        If its bytes are not those that were written, it is a copy of another file, or its marks have another form.
    """
    names = ("settings_hash", "depends_on", "figures", "warnings", "findings", "frame")
    with hdf5.opened(path, values=False) as file:
        sealed = hdf5.SEALED in file.attrs
        found = {name: _text(file.attrs[name], name) for name in names if name in file.attrs}
        require_name(path, file.attrs)
    if not sealed:
        _note_unsealed(path.parent)
    try:
        if found.get("depends_on"):
            read_object(found["depends_on"])
        return Marks(
            settings_hash=found.get("settings_hash", ""),
            depends_on=found.get("depends_on", ""),
            figures=read_object(found["figures"]) if "figures" in found else None,
            warnings=stored_warnings(found),
            frame=found.get("frame", ""),
            sealed=sealed,
        )
    except RecordError as error:
        raise DamagedFile(path, f"its attributes have another form: {error}") from None


def reject(path: Path, reason: str) -> None:
    """Log that a file is not used, with the reason."""
    log.warning("%s: damaged or foreign, not used: %s", path, reason)


def _text(value: Any, name: str) -> str:
    if not isinstance(value, str):
        raise RecordError(f"expected text in {name!r}, found {type(value).__name__}")
    return value


_PAIR_OF_NAME = re.compile(r"pair_(\d+)(?:_[ab])?\.nc")


def require_name(path: Path, attributes: Mapping[str, Any]) -> None:
    """Refuse a file that was written under another name, such as another pair's.

    Raises
    ------
    DamagedFile
        If the attributes of the file name another one.
    """
    if foreign := _other_name(path, attributes):
        raise DamagedFile(path, f"it is {foreign} under another name")


def _other_name(path: Path, attributes: Mapping[str, Any]) -> str:
    """Return what a file was written as, if that is not its name; files of earlier versions state a pair only."""
    named, match = attributes.get("file"), _PAIR_OF_NAME.fullmatch(path.name)
    if named is not None:
        return "" if named == path.name else str(named)[:80]
    pair = attributes.get("pair")
    if match is None or pair is None:
        return ""
    return "" if np.array_equal(np.ravel(pair), [int(match[1])]) else f"pair {str(pair)[:40]}"


_noted: set[Path] = set()


def _note_unsealed(folder: Path) -> None:
    """Log once for a folder that its files have no digest."""
    if folder not in _noted:
        _noted.add(folder)
        log.warning("%s: files of an earlier version have no digest; damage to them can be seen only in part", folder)


def background_content(path: Path) -> str | None:
    """Return the hash of the light in a stored background, whether it fits or not; None if it subtracts nothing."""
    marks = read_marks(path)
    content = None if marks is None or marks.figures is None else marks.figures.get("content")
    return content if isinstance(content, str) else None


def background_figures(path: Path) -> tuple[Mapping[str, Mapping[str, float | None]], tuple[Warning, ...]]:
    """Return the figures of each camera and the warnings of a stored background; empty ones if there is none."""
    marks = read_marks(path)
    if marks is None or marks.figures is None:
        return {}, ()
    try:
        return validate(dict[str, dict[str, float | None]], marks.figures.get("cameras")), marks.warnings
    except RecordError as error:
        reject(path, f"its figures have another form: {error}")
        return {}, marks.warnings


def stored_warnings(attributes: Mapping[str, Any]) -> tuple[Warning, ...]:
    """Read the warnings in the attributes of a file; version 0.1.0 calls them findings.

    Raises
    ------
    RecordError
        If they are no list of warnings.
    """
    return warn.from_list(read_json(attributes.get("warnings", attributes.get("findings", "[]"))))


def _orientation(camera: CameraSetup) -> float | list[float] | None:
    """Return the nominal angle about y [degree], yaw, pitch and roll if there is more to state, None if nothing is."""
    stated = camera.orientation
    if stated is None or not (stated.pitch_deg or stated.roll_deg):
        return None if stated is None else stated.yaw_deg
    return [stated.yaw_deg, stated.pitch_deg, stated.roll_deg]


def of_calibration(experiment: Experiment) -> Stamp:
    """Return the stamp of the calibration."""
    cameras = {
        camera.name: [dataclasses.asdict(camera.optics), _orientation(camera), camera.image_flip]
        + ([camera.raw.model_dump()] if camera.raw else [])
        for camera in experiment.cameras
    }
    return Stamp(
        {
            "version": __version__,
            "camera": cameras,
            "board": experiment.board.model_dump(exclude=None if experiment.board.mark else {"mark"}),
            "network": experiment.network.model_dump(),
            "images": content_hash(experiment.calibration_images()),
        }
    )


def of_background(experiment: Experiment, calibration: str, pairs: Sequence[int]) -> Stamp:
    """Return the stamp of the standing light.

    Parameters
    ----------
    experiment : Experiment
    calibration : str
        Hash of the calibration's stamp.
    pairs : sequence of int
        Pairs from which the light is estimated.
    """
    recorded = {camera.name: camera.background for camera in experiment.cameras}
    paths = [
        path
        for pair in pairs
        for frame in background_frames(experiment, pair)
        for path in experiment.frame_paths(frame)
    ]
    images = [
        path
        for name in recorded
        for frame in lit_frames(experiment)
        if (path := experiment.background_path(name, frame)) is not None
    ]
    return Stamp(
        {
            "calibration": calibration,
            "background": experiment.background,
            "background_image": recorded if images else None,
            "recorded": _identity(images, experiment.path.parent),
            "images": _identity(_existing(paths), experiment.path.parent) if None in recorded.values() else None,
        }
    )


def lit_frames(experiment: Experiment) -> tuple[str, ...]:
    """Return the names of the frames that each have a laser. One laser lights all instants of a series."""
    return experiment.frames if experiment.series is None else experiment.frames[:1]


def background_frames(experiment: Experiment, pair: int) -> tuple[Frame, ...]:
    """Return the frames of a pair from which standing light is estimated: both, or the first instant of a series."""
    return experiment.pair_frames(pair)[: len(lit_frames(experiment))]


def _existing(paths: Iterable[Path]) -> list[Path]:
    return [path for path in paths if split(path).file.is_file()]


def of_self_calibration(experiment: Experiment, calibration: str, background: str | None = None) -> Stamp | None:
    """Return the stamp of the self-calibration; None if the experiment has none.

    `calibration` is a stamp's hash, `background` that of the subtracted light.
    """
    if not experiment.self_calibration.pairs:
        return None
    volume = dataclasses.asdict(experiment.grid)
    parts = {"calibration": calibration, "volume": volume, "self_calibration": _self_calibration(experiment)}
    return Stamp(parts | {"background": background})


def of_guard(experiment: Experiment, calibration: str, pairs: Sequence[int], background: str | None = None) -> Stamp:
    """Return the stamp of what is measured in some pairs before volumes are reconstructed: guard layers, refinement.

    `calibration` and `background` are the hashes of the calibration's stamp and of the subtracted light.
    """
    paths = [path for pair in pairs for path in experiment.pair_paths(pair)]
    return Stamp(
        {
            "calibration": calibration,
            "self_calibration": _self_calibration(experiment),
            "volume": dataclasses.asdict(experiment.grid),
            "background": background,
            "images": _identity(paths, experiment.path.parent),
        }
    )


def of_pair(
    experiment: Experiment,
    calibration: str,
    pair: int,
    *,
    background: str | None = None,
    guard: Layers = NO_LAYERS,
    refinement: float = 1.0,
) -> PairStamps:
    """Return the stamps of the volumes and of the vectors of a pair.

    `calibration` is the hash of its stamp, `background` that of the light that is subtracted from the images, `guard`
    the guard layers of the volumes, `refinement` the edge of their voxels over that of the reconstructed ones.
    """
    light, start = _of_light(experiment, calibration, background), experiment.path.parent
    parts = light | {
        "guard": guard if guard != NO_LAYERS else None,
        "refinement": refinement if refinement != 1 else None,
    }
    of_pair = parts | {"images": _identity(experiment.pair_paths(pair), start)}
    of_vectors = {"correlation": experiment.correlation.model_dump(), "dt_s": experiment.dt_s}
    if experiment.series is None:
        volumes = Stamp(of_pair)
        return PairStamps(
            volumes=(volumes, volumes),
            vectors=Stamp(of_pair | of_vectors),
            particles=_of_particles(experiment, of_pair | of_vectors),
        )
    first, second = (
        Stamp(parts | {"images": _identity(experiment.frame_paths(instant), start)})
        for instant in experiment.pair_frames(pair)
    )
    of_vectors["step"] = experiment.series.step
    if experiment.in_sequence:
        before = [_images_before(experiment, instant.number) for instant in experiment.pair_frames(pair)]
        first, second = (
            Stamp({**stamp.parts, IMAGES_BEFORE: hashed}) for stamp, hashed in zip((first, second), before, strict=True)
        )
        of_vectors[IMAGES_BEFORE] = None if None in before else before
    return PairStamps(
        volumes=(first, second),
        vectors=Stamp(of_pair | of_vectors),
        particles=_of_particles(experiment, of_pair | of_vectors),
    )


def of_bootstrap(experiment: Experiment, vectors: Stamp, pairs: Sequence[int]) -> Stamp:
    """Return the stamp of the damping that was measured with the flow of some pairs.

    It has the parts of `vectors`, the stamp of a pair's vectors, so that readers can compare the two; but the images
    are those of the pairs.
    """
    paths = [path for pair in pairs for path in experiment.pair_paths(pair)]
    parts = {name: part for name, part in vectors.parts.items() if name not in OF_PAIR}
    images = _identity(paths, experiment.path.parent)
    return Stamp(parts | {"images": images, "bootstrap": experiment.simulated_pairs})


def _of_particles(experiment: Experiment, of_vectors: dict[str, Any]) -> Stamp | None:
    """Return the stamp of the linked particles, for which the vectors are the predictor."""
    tracking = experiment.tracking
    return None if tracking is None else Stamp(of_vectors | {"tracking": tracking.model_dump()})


def _images_before(experiment: Experiment, instant: int) -> str | None:
    """Hash the identity of the images from which an instant of a sequence follows; None if one is missing."""
    assert experiment.series is not None
    name = experiment.frames[0]
    frames = (Frame(number, name) for number in followed(experiment.series, instant)[:-1])
    found = _identity([path for frame in frames for path in experiment.frame_paths(frame)], experiment.path.parent)
    return None if found is None else files.settings_hash(images=found)


def _of_light(experiment: Experiment, calibration: str, background: str | None) -> dict[str, Any]:
    """Return the parts of the stamp of volumes; the identity of the images is None and to be filled in."""
    compute = experiment.compute
    reach = {"max_displacement_voxel": experiment.correlation.max_displacement_voxel}
    particles: dict[str, Any] = {"images": experiment.particle_images}
    if experiment.series is None:
        particles["frames"] = list(experiment.frames)
    return {
        "calibration": calibration,
        "self_calibration": _self_calibration(experiment),
        "volume": dataclasses.asdict(experiment.grid),
        "mask": _mask_hash(experiment.solid),
        "smart": experiment.smart.model_dump(),
        "motion": reach if experiment.smart.motion_passes or experiment.in_sequence else None,
        "compute": {"weights": compute.weights, "weights_form": compute.weights_form},
        "particles": particles,
        "images": None,
        "background": background,
    }


def _self_calibration(experiment: Experiment) -> dict[str, Any] | None:
    """Return settings and images of the self-calibration; None if the experiment has none."""
    if not experiment.self_calibration.pairs:
        return None
    images = [
        experiment.particle_path(camera.name, pair, experiment.frames[0])
        for pair in experiment.self_calibration_pairs
        for camera in experiment.cameras
    ]
    return {**experiment.self_calibration.model_dump(), "images": _identity(images, experiment.path.parent)}


def _identity(paths: Sequence[Path], start: Path) -> list[list[Any]] | None:
    """Return path from `start`, size and time of the last change of images; None if one is missing."""
    try:
        found = [(path, split(path).file.stat()) for path in paths]
    except OSError:
        return None
    return [[os.path.relpath(path, start), status.st_size, status.st_mtime_ns] for path, status in found]


def content_hash(sources: Iterable[ImagePath]) -> str:
    """Hash several images, in order: the bytes of whole files, the grey values of parts of files."""
    digest = hashlib.blake2b(digest_size=16)
    for source in sources:
        if source.part:
            grey = images.read_image(source.path, "part of a file", raw=source.raw)
            digest.update(repr(grey.shape).encode() + grey.tobytes())
        else:
            with source.file.open("rb") as file:
                while block := file.read(1 << 20):
                    digest.update(block)
        digest.update(b"end of file" + source.part.encode())
    return digest.hexdigest()


def _mask_hash(solid: np.ndarray | None) -> str | None:
    """Hash the flags of the voxels without fluid; None without a mask."""
    return None if solid is None else hashlib.blake2b(np.packbits(solid).tobytes(), digest_size=16).hexdigest()

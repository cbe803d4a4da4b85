"""What a finished file depends on, kept inside it: a rerun compares, does anew what changed, and says what that was."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from lfpiv import files
from lfpiv.experiment.davis import split_frame
from lfpiv.experiment.experiment import Experiment
from lfpiv.version import __version__


@dataclass(frozen=True)
class Stamp:
    """The parts that a result depends on, and the hash of all of them."""

    parts: Mapping[str, Any]
    """Name -> settings, a hash, or what tells the images apart; None where the images are gone."""

    @cached_property
    def hash(self) -> str:
        """Short hash of all parts."""
        return files.settings_hash(**self.parts)

    @property
    def attributes(self) -> dict[str, Any]:
        """What is written into the result."""
        return {"settings_hash": self.hash, "depends_on": json.dumps(files.plain(self.parts))}

    def changes(self, marks: Mapping[str, Any]) -> list[str]:
        """Names of what changed since a file was made, from its `marks`; empty where the file still fits.

        Images that are gone did not change: a result outlives its raw data.
        """
        if marks.get("settings_hash") == self.hash:
            return []
        try:
            before = dict(json.loads(marks["depends_on"]))
        except (KeyError, ValueError, TypeError):
            return ["settings or images"]
        now = files.plain(self.parts)
        found = []
        for name in {**before, **now}:
            old, new = before.get(name), now.get(name)
            if old == new or (name == "images" and new is None):
                continue
            if isinstance(old, dict) and isinstance(new, dict):
                gone = {"images"} if new.get("images", ()) is None else set()
                found += [f"{name}.{key}" for key in {**old, **new} if old.get(key) != new.get(key) and key not in gone]
            else:
                found.append(name)
        return found


def marks(path: Path) -> dict[str, Any] | None:
    """Stamp, figures and warnings in a finished NetCDF or HDF5 file; None where there is none or it cannot be read."""
    import h5py

    found = {}
    try:
        with h5py.File(path, "r") as file:
            for name in ("settings_hash", "depends_on", "figures", "warnings", "findings"):
                with contextlib.suppress(KeyError):
                    found[name] = file.attrs[name]
    except OSError:
        return None
    return found


def of_calibration(experiment: Experiment) -> Stamp:
    """Stamp of the calibration."""
    cameras = {
        camera.name: [dataclasses.asdict(camera.optics), camera.nominal_angle_deg, camera.image_flip]
        for camera in experiment.cameras
    }
    return Stamp(
        {
            "version": __version__,
            "camera": cameras,
            "board": experiment.board.model_dump(),
            "network": experiment.network.model_dump(),
            "images": content_hash(experiment.calibration_paths()),
        }
    )


def of_self_calibration(experiment: Experiment, calibration: str) -> Stamp | None:
    """Stamp of the self-calibration; None where none is asked for. `calibration` is the calibration's hash."""
    if not experiment.self_calibration.pairs:
        return None
    volume = dataclasses.asdict(experiment.grid)
    return Stamp({"calibration": calibration, "volume": volume, "self_calibration": _self_calibration(experiment)})


def _self_calibration(experiment: Experiment) -> dict[str, Any] | None:
    """Return settings and images of the self-calibration; None where none is asked for."""
    if not experiment.self_calibration.pairs:
        return None
    images = [
        experiment.particle_path(camera.name, pair, experiment.frames[0])
        for pair in experiment.self_calibration_pairs
        for camera in experiment.cameras
    ]
    return {**experiment.self_calibration.model_dump(), "images": _identity(images, experiment.path.parent)}


def of_volumes(experiment: Experiment, calibration: str, pair: int) -> Stamp:
    """Stamp of both volumes of a pair; `calibration` is the calibration's hash."""
    compute = experiment.compute
    reach = {"max_displacement_voxel": experiment.correlation.max_displacement_voxel}
    return Stamp(
        {
            "calibration": calibration,
            "self_calibration": _self_calibration(experiment),
            "volume": dataclasses.asdict(experiment.grid),
            "smart": experiment.smart.model_dump(),
            "motion": reach if experiment.smart.motion_passes else None,
            "compute": {"weights": compute.weights, "weights_form": compute.weights_form},
            "particles": {"images": experiment.particle_images, "frames": list(experiment.frames)},
            "images": _identity(experiment.pair_paths(pair), experiment.path.parent),
        }
    )


def of_vectors(experiment: Experiment, calibration: str, pair: int) -> Stamp:
    """Stamp of the vectors of a pair."""
    volumes = of_volumes(experiment, calibration, pair).parts
    return Stamp({**volumes, "correlation": experiment.correlation.model_dump(), "dt_s": experiment.dt_s})


def _identity(paths: list[Path], start: Path) -> list[list[Any]] | None:
    """Tell images from others at the price of a glance: by path from `start`, size and time of the last change."""
    try:
        found = [(path, split_frame(path)[0].stat()) for path in paths]
    except OSError:
        return None
    return [[os.path.relpath(path, start), status.st_size, status.st_mtime_ns] for path, status in found]


def content_hash(paths: Iterable[Path]) -> str:
    """Hash of the bytes of several images, in order; a frame of a file that holds several counts, too."""
    digest = hashlib.blake2b(digest_size=16)
    for path in paths:
        image, frame = split_frame(path)
        with image.open("rb") as file:
            while block := file.read(1 << 20):
                digest.update(block)
        digest.update(b"end of file" + frame.encode())
    return digest.hexdigest()

"""Stamps of an experiment: what the calibration, the other steps of a run and each pair depend on.

A step of a run depends on the hash of the steps before it. A pair depends on all of them and on its own images.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lfpiv import files
from lfpiv.experiment.experiment import CameraSetup, Experiment
from lfpiv.experiment.readers.source import ImagePath, split
from lfpiv.experiment.recording import Frame
from lfpiv.experiment.segments import depended_on
from lfpiv.geometry.grid import NO_LAYERS, Layers
from lfpiv.results.image_identity import CondensedImages, Images, content_hash, look_at
from lfpiv.results.provenance import IMAGES_BESIDE, MASK_FILES, OF_PAIR, Stamp
from lfpiv.version import __version__


@dataclass(frozen=True)
class Inputs:
    """What volumes depend on beside settings and images."""

    calibration: str
    """Hash of the stamp of the calibration."""
    background: str | None = None
    """Hash of the light that is subtracted from the images; None if there is none."""
    guard: Layers = NO_LAYERS
    """Layers of voxels beyond the grid of the experiment that are reconstructed, and cut away afterwards."""
    refinement: float = 1.0
    """Edge of a voxel of the experiment over the edge of a reconstructed one, from which volumes are sampled."""


@dataclass(frozen=True, kw_only=True)
class PairStamps:
    """Stamps of the results of one pair."""

    volumes: tuple[Stamp, Stamp]
    """Of both frames; the same for both frames of an image pair, which a joint fit reconstructs together."""
    vectors: Stamp
    particles: Stamp | None = None
    """Of the linked particles; None without tracking."""


def _orientation(camera: CameraSetup) -> float | list[float] | None:
    """Return the nominal angle about y [degree], yaw, pitch and roll if there is more to state, None if nothing is."""
    stated = camera.orientation
    if stated is None or not (stated.pitch_deg or stated.roll_deg):
        return None if stated is None else stated.yaw_deg
    return [stated.yaw_deg, stated.pitch_deg, stated.roll_deg]


def of_calibration(experiment: Experiment) -> Stamp:
    """Return the stamp of the calibration."""
    return _of_cameras(experiment, experiment.cameras)


def of_camera(experiment: Experiment, name: str) -> Stamp:
    """Return the stamp of what the calibration measures of one camera alone."""
    return _of_cameras(experiment, (experiment.camera(name),))


def _of_cameras(experiment: Experiment, cameras: Sequence[CameraSetup]) -> Stamp:
    stated = {
        camera.name: [dataclasses.asdict(camera.optics), _orientation(camera), camera.image_flip]
        + ([camera.raw.model_dump()] if camera.raw else [])
        for camera in cameras
    }
    return Stamp(
        {
            "version": __version__,
            "camera": stated,
            "board": experiment.board.model_dump(exclude={"axes"} if experiment.board.mark else {"axes", "mark"}),
            "network": experiment.network.model_dump(),
            "images": content_hash(experiment.calibration_images(cameras)),
        }
    )


def of_background(experiment: Experiment, calibration: str, pairs: Sequence[int]) -> Stamp:
    """Return the stamp of the standing light.

    Parameters
    ----------
    calibration : str
        Hash of the calibration's stamp.
    pairs : sequence of int
        Pairs from which the light is estimated.
    """
    recorded = {camera.name: camera.background for camera in experiment.cameras}
    start = experiment.path.parent
    frames = [frame for pair in pairs for frame in experiment.recording.new_frames(pair)]
    seen = [image for image in _images(experiment, frames) if image.file.is_file()]
    images = [
        split(path, camera.raw)
        for camera in experiment.cameras
        for frame in experiment.laser_names
        if (path := experiment.background_path(camera.name, frame)) is not None
    ]
    return Stamp(
        {
            "calibration": calibration,
            "background": experiment.background,
            "background_image": recorded if images else None,
            "recorded": look_at(images, start),
            "white_level": _white_levels(experiment),
            "images": look_at(seen, start) if None in recorded.values() else None,
        }
    )


def of_self_calibration(experiment: Experiment, calibration: str, background: str | None) -> Stamp | None:
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
    images = [image for pair in pairs for image in experiment.pair_images(pair)]
    return Stamp(
        {
            "calibration": calibration,
            "self_calibration": _self_calibration(experiment),
            "volume": dataclasses.asdict(experiment.grid),
            "background": background,
            "images": look_at(images, experiment.path.parent),
        }
    )


def of_pair(experiment: Experiment, inputs: Inputs, pair: int) -> PairStamps:
    """Return the stamps of the volumes and of the vectors of a pair."""
    recording, start = experiment.recording, experiment.path.parent
    parts = _of_light(experiment, inputs.calibration, inputs.background) | {
        "guard": inputs.guard if inputs.guard != NO_LAYERS else None,
        "refinement": inputs.refinement if inputs.refinement != 1 else None,
    }
    frames = experiment.pair_frames(pair)

    def seen(some: Sequence[Frame]) -> dict[str, Any]:
        return {**parts, "images": look_at(_images(experiment, some), start), **_mask_files(experiment, some)}

    of_pair = seen(frames)
    of_vectors: dict[str, Any] = {"correlation": experiment.correlation.model_dump(), "dt_s": experiment.dt_s}
    if experiment.by_links and experiment.tracking is not None:
        of_vectors["links"] = experiment.tracking.search
    volumes = [seen([frame]) for frame in frames] if recording.is_series else [of_pair, of_pair]
    if recording.is_series:
        of_vectors["step"] = recording.step
    if experiment.in_sequence:
        others = [list(map(recording.frame, depended_on(recording.frames, frame.number))) for frame in frames]
        beside = [look_at(_images(experiment, some), start, condensed=True) for some in others]
        for volume, own, some, images in zip(volumes, frames, others, beside, strict=True):
            volume |= {IMAGES_BESIDE: images, **_mask_files(experiment, [own, *some])}
        both = [state for images in beside if images is not None for state in images.states]
        of_vectors[IMAGES_BESIDE] = None if None in beside else CondensedImages(tuple(both))
        of_vectors |= _mask_files(experiment, [*frames, *others[0], *others[1]])
    return PairStamps(
        volumes=(Stamp(volumes[0]), Stamp(volumes[1])),
        vectors=Stamp(of_pair | of_vectors),
        particles=_of_particles(experiment, of_pair | of_vectors),
    )


def of_bootstrap(experiment: Experiment, vectors: Stamp, pairs: Sequence[int]) -> Stamp:
    """Return the stamp of the damping that was measured with the flow of some pairs.

    It has the parts of `vectors`, the stamp of a pair's vectors, so that readers can compare the two; but the images
    are those of the pairs.
    """
    frames = [frame for pair in pairs for frame in experiment.pair_frames(pair)]
    parts = {name: part for name, part in vectors.parts.items() if name not in OF_PAIR}
    images = look_at(_images(experiment, frames), experiment.path.parent)
    parts |= {"images": images, "bootstrap": experiment.simulated_pairs}
    return Stamp(parts | _mask_files(experiment, frames))


def of_tracks(experiment: Experiment, particles: Stamp, pairs: Sequence[int]) -> Stamp:
    """Return the stamp of the tracks that the linked particles of some pairs begin.

    It has the parts of `particles`, the stamp of a pair's particles; but the images are those of all the pairs.
    """
    frames = list(dict.fromkeys(frame for pair in pairs for frame in experiment.pair_frames(pair)))
    parts = {name: part for name, part in particles.parts.items() if name not in OF_PAIR}
    images = look_at(_images(experiment, frames), experiment.path.parent, condensed=True)
    return Stamp(parts | {"images": images, "tracks": list(pairs)} | _mask_files(experiment, frames))


def _of_particles(experiment: Experiment, of_vectors: dict[str, Any]) -> Stamp | None:
    """Return the stamp of the linked particles, for which the vectors are the predictor."""
    tracking = experiment.tracking
    return None if tracking is None else Stamp(of_vectors | {"tracking": tracking.model_dump()})


def _images(experiment: Experiment, frames: Iterable[Frame]) -> list[ImagePath]:
    """Return the images of some frames."""
    return [image for frame in frames for image in experiment.frame_images(frame)]


def _mask_files(experiment: Experiment, frames: Iterable[Frame]) -> dict[str, Images | None]:
    """Return the part of a stamp that states the masks of some frames; empty if they are the same in all frames."""
    if experiment.mask is None or not experiment.mask.moves:
        return {}
    found = map(split, experiment.mask_files(frames))
    return {MASK_FILES: look_at(found, experiment.path.parent, condensed=experiment.in_sequence)}


def _of_light(experiment: Experiment, calibration: str, background: str | None) -> dict[str, Any]:
    """Return the parts of the stamp of volumes; the identity of the images is None and to be filled in."""
    compute = experiment.compute
    reach = {"max_displacement_voxel": experiment.correlation.max_displacement_voxel}
    particles: dict[str, Any] = {"images": experiment.particle_images}
    if not experiment.recording.is_series:
        particles["frames"] = list(experiment.frames)
    return {
        "calibration": calibration,
        "self_calibration": _self_calibration(experiment),
        "volume": dataclasses.asdict(experiment.grid),
        "mask": _mask(experiment),
        "smart": experiment.smart.model_dump() | {"estimate": experiment.estimate},
        "motion": reach if experiment.is_joint or experiment.in_sequence else None,
        "compute": {"weights": compute.weights, "weights_form": compute.weights_form},
        "particles": particles,
        "images": None,
        "background": background,
        "white_level": _white_levels(experiment),
    }


def _white_levels(experiment: Experiment) -> dict[str, float] | None:
    """Return the stated white levels by camera; None if none is stated."""
    return {camera.name: camera.white_level for camera in experiment.cameras if camera.white_level} or None


def _self_calibration(experiment: Experiment) -> dict[str, Any] | None:
    """Return settings and images of the self-calibration; None if the experiment has none."""
    if not experiment.self_calibration.pairs:
        return None
    frames = [experiment.recording.frame_of(pair, 0) for pair in experiment.self_calibration_pairs]
    seen = look_at(_images(experiment, frames), experiment.path.parent)
    content = None if seen is None else files.settings_hash(images=[[s.place, s.digest] for s in seen.states])
    return {**experiment.self_calibration.model_dump(), "images": content}


def _mask(experiment: Experiment) -> Any:
    """Hash the flags of the voxels without fluid; None without a mask.

    Where frames have masks of their own, return the solids that stand still and the pattern of the files.
    """
    mask = experiment.mask
    if mask is None:
        return None
    if mask.moves:
        return {"file": mask.file, "solid": [one.model_dump() for one in mask.solid]}
    solid = mask.flags({})
    return hashlib.blake2b(np.packbits(solid).tobytes(), digest_size=16).hexdigest()

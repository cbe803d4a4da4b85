"""Open an experiment file: a TOML file in, a frozen `Experiment` out, with all its keys and images checked."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from lfpiv.errors import InputError
from lfpiv.experiment import axes, images, nominal_checks, recorded, scale_checks
from lfpiv.experiment.experiment import CameraSetup, Experiment, board_label, check_shape
from lfpiv.experiment.mask import Mask
from lfpiv.experiment.patterns import check_length, check_pattern
from lfpiv.experiment.recording import Recording
from lfpiv.experiment.toml import parse, read_text, read_toml
from lfpiv.geometry.grid import AXES, Grid
from lfpiv.settings import bounds
from lfpiv.settings.experiment import ExperimentTable
from lfpiv.settings.particles import Particles
from lfpiv.settings.processing import SMALLEST_WINDOW, Correlation
from lfpiv.settings.rig import CameraTable, RawImages
from lfpiv.settings.volume import ExperimentVolume

DECODED_PIXELS = 100_000_000
"""Largest number of pixels of particle images that are decoded before the work starts [pixel]."""

CHECKED_PAIRS = 100
"""Largest number of pairs whose images `open_experiment` checks, evenly spread over all."""

LEAST_BYTES_PER_VOXEL, LEAST_BYTES_PER_CAMERA = 120, 24
"""Memory that a run needs at least for each voxel, and for each voxel and camera [byte], see `lfpiv.runs.memory`."""


def open_experiment(path: str | Path) -> Experiment:
    """Read an experiment file and check all its keys and images.

    All pairs must have their images, as folders and headers show. White, dark and board images are decoded, and the
    particle images of up to `CHECKED_PAIRS` pairs, evenly spread, are checked as by `check_pairs`. `lfpiv.run` checks
    the particle images of all pairs that it does and continues without damaged ones.

    Parameters
    ----------
    path : str or Path
        TOML file in the form described in the README.

    Raises
    ------
    InputError
        If a key is unknown, missing or out of range, if an image is missing, damaged, or does not fit the others, or
        if a nominal camera certainly sees nothing of the volume.
    """
    experiment = read_experiment(path)
    if (absent := recorded.missing(experiment)) is not None:
        raise InputError(absent.message())
    for _, reason in check_pairs(experiment, experiment.spread_pairs(CHECKED_PAIRS)):
        raise InputError(reason)
    return experiment


def read_experiment(path: str | Path) -> Experiment:
    """Read and check an experiment as `open_experiment` does, without its particle images."""
    return experiment_of(Path(path), _read_table(Path(path)))


def experiment_of(path: Path, table: ExperimentTable) -> Experiment:
    """Check the tables of an experiment file, as `read_experiment` does, and return what they state."""
    check_tables(path, table)
    board, particles = table.board, table.particles
    cameras = tuple(_camera(path, camera, table.board.axes) for camera in table.camera)
    scale_checks.require_scale(path, table.volume, board, cameras)
    grid = grid_of(path, table)
    experiment = Experiment(
        path=path,
        name=table.name,
        dt_s=table.dt_s,
        cameras=cameras,
        board=board,
        grid=grid,
        guard_mm=table.volume.guard_mm,
        recording=Recording.from_table(particles),
        smart=table.smart,
        self_calibration=table.self_calibration,
        bootstrap=table.bootstrap,
        correlation=table.correlation,
        tracking=table.used_tracking,
        network=table.network,
        compute=table.compute,
        particle_images=particles.images,
        background=particles.background,
        mask=_mask(path, table.volume, grid),
    )
    for camera in experiment.cameras:
        if camera.orientation is not None:
            nominal_checks.require_board(path, experiment.board, camera.name, camera.optics, camera.orientation)
            nominal_checks.require_volume(path, grid, camera.name, camera.optics, camera.orientation)
    _check_calibration_images(experiment)
    if experiment.mask is not None:
        experiment.mask.look_at(frame.fields for frame in experiment.all_frames())
    return experiment


def check_tables(path: Path, table: ExperimentTable) -> None:
    """Check the tables of an experiment file against each other, without any image.

    Raises
    ------
    InputError
        If they do not fit each other.
    """
    names = [camera.name for camera in table.camera]
    if len(set(names)) != len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"{path}: camera.name: expected a different name for each camera, found {twice!r} twice.")
    for one in table.camera:
        if not table.board.mark:
            _require_orientation(path, one)
    board, particles = table.board, table.particles
    recording = Recording.from_table(particles)
    check_pattern(path, "board.images", board.images, {"camera": names, "plane": range(len(board.planes_mm))})
    check_pattern(path, "particles.images", particles.images, {"camera": names, **_fields(recording, particles.images)})
    if table.volume.mask is not None:
        check_pattern(path, "volume.mask", table.volume.mask, _fields(recording, table.volume.mask), optional=True)
    for one in table.camera:
        if one.background_image is not None:
            _check_background(path, one, particles)
    if table.smart.estimate == "joint" and (recording.is_series or len(table.camera) < 2):
        where = "a time series, where each instant is reconstructed once" if recording.is_series else "a single camera"
        raise InputError(
            f"{path}: smart.estimate: expected 'correlation' for {where}, found 'joint'. Set it to 'correlation'."
        )


def grid_of(path: Path, table: ExperimentTable) -> Grid:
    """Return the grid of the volume; refuse one that does not fit the memory or the windows."""
    grid = _grid(path, table.volume, len(table.camera))
    _check_windows(path, table.correlation, grid)
    return grid


def _mask(path: Path, volume: ExperimentVolume, grid: Grid) -> Mask | None:
    if volume.mask is None and not volume.solid:
        return None
    return Mask(path=path, grid=grid, file=volume.mask, solid=volume.solid)


def _read_table(path: Path) -> ExperimentTable:
    """Read the tables of an experiment file; a scene of the simulator is refused as such."""
    try:
        return read_toml(path, ExperimentTable)
    except InputError:
        if "flow" in parse(read_text(path), path):
            raise InputError(
                f"{path}: expected an experiment file, found a scene of the simulator, with a table [flow]. Use "
                f"`lfpiv simulate {path} --out DIR` first, and then DIR/experiment.toml."
            ) from None
        raise


def check_pairs(experiment: Experiment, pairs: Sequence[int]) -> Iterator[tuple[int, str]]:
    """Check the particle images of some pairs; yield each damaged pair with the reason.

    Parameters
    ----------
    experiment : Experiment
        From `read_experiment`.
    pairs : sequence of int
        Pairs to check. The first is decoded, and the following up to `DECODED_PIXELS`; of the others the header and the
        length are checked (a DaVis image must exist).

    Yields
    ------
    pair : int
    reason : str
        Message with the file, what was expected and what was found.
    """
    decoded = 0
    for number, pair in enumerate(pairs):
        try:
            for camera in experiment.cameras:
                for frame in experiment.pair_frames(pair):
                    check_shape(
                        experiment.frame_path(camera.name, frame), experiment.frame_label(camera.name, frame), camera
                    )
            decoded += 2 * sum(math.prod(camera.optics.sensor_shape) for camera in experiment.cameras)
            if number == 0 or decoded <= DECODED_PIXELS:
                for camera in experiment.cameras:
                    for frame in experiment.pair_frames(pair):
                        experiment.frame_image(camera.name, frame)
        except InputError as error:
            yield pair, str(error)


def _fields(recording: Recording, pattern: str) -> dict[str, Sequence[Any]]:
    """Return the fields that tell the frames apart in a path pattern, with their values."""
    if recording.is_series:
        return {"instant": recording.frames}
    return {"image": recording.frames} if "{image" in pattern else {"pair": recording.numbers, "frame": recording.names}


def _require_orientation(path: Path, camera: CameraTable) -> None:
    if camera.orientation is None:
        raise InputError(
            f"{path}: camera {camera.name!r}: expected nominal_angle_deg, its angle about y, or nominal_direction, a "
            "vector from the origin towards it, found neither. Add one, or use a board with a mark (board.mark)."
        )


def _check_background(path: Path, camera: CameraTable, particles: Particles) -> None:
    """Refuse a pattern with unknown fields, and an image that `particles.background` would not use."""
    key = f"camera {camera.name!r}, background_image"
    assert camera.background_image is not None
    if particles.instants is not None and "{frame" in camera.background_image:
        raise InputError(
            f"{path}: {key}: expected no {{frame}}, because one laser lights all instants of a time series, found "
            f"{camera.background_image!r}."
        )
    check_pattern(path, key, camera.background_image, {"frame": particles.frames[:1]})
    if particles.background in ("minimum", "median"):
        raise InputError(
            f'{path}: {key}: expected particles.background = "auto", which takes this image, found '
            f'"{particles.background}". Remove one of the two keys.'
        )


def _grid(path: Path, volume: ExperimentVolume, cameras: int) -> Grid:
    for axis, size in zip("xyz", volume.size_mm, strict=True):
        if not SMALLEST_WINDOW <= size / volume.voxel_mm + 0.5 < 2**31:
            raise InputError(
                f"{path}: volume.size_mm: expected {SMALLEST_WINDOW} voxels or more along {axis}, at most 2^31, "
                f"found {size:g} mm with voxel_mm = {volume.voxel_mm:g}."
            )
    grid = Grid.from_extent(centre_mm=volume.centre_mm, size_mm=volume.size_mm, voxel_mm=volume.voxel_mm)
    guarded = grid if volume.guard_mm == "auto" else grid.padded(grid.layers(volume.guard_mm))
    if guarded.size > bounds.MOST_VOXELS:
        raise InputError(
            f"{path}: volume: expected at most {bounds.MOST_VOXELS:.0e} voxels, guard layers included, found "
            f"{guarded.size:.1e}. Raise volume.voxel_mm, or shrink volume.size_mm or volume.guard_mm."
        )
    needed = (LEAST_BYTES_PER_VOXEL + LEAST_BYTES_PER_CAMERA * cameras) * guarded.size
    machine = memory_of_machine()
    if (volume.mask is not None or volume.solid) and needed > machine:
        raise InputError(
            f"{path}: volume: expected voxels that fit into memory, found {guarded.size:.1e}, guard layers included, "
            f"which need at least {needed / 2**30:,.0f} GiB of {machine / 2**30:,.0f} GiB. Raise volume.voxel_mm, or "
            "shrink volume.size_mm or volume.guard_mm."
        )
    return grid


def memory_of_machine() -> int:
    """Return the memory of this machine [byte]."""
    if not hasattr(os, "sysconf"):
        return sys.maxsize
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def _check_windows(path: Path, correlation: Correlation, grid: Grid) -> None:
    farthest = correlation.max_displacement_voxel
    if farthest is not None and farthest >= max(grid.shape):
        raise InputError(
            f"{path}: correlation.max_displacement_voxel: expected less than the volume's {max(grid.shape)} voxels, "
            f"found {farthest:g}."
        )
    for window in correlation.windows or ():
        edges = window if isinstance(window, tuple) else (window, window, window)
        for axis, edge, n in zip(AXES, edges, grid.shape, strict=True):
            if edge > n:
                cut = [min(one, most) for one, most in zip(edges, grid.shape, strict=True)]
                raise InputError(
                    f"{path}: correlation.windows: expected windows inside the volume, found {edge} voxels "
                    f"along {axis} where the volume has {n}. State {cut}, ordered (z, y, x), or a smaller window."
                )


def _camera(path: Path, table: CameraTable, handedness: str) -> CameraSetup:
    key = f"camera {table.name!r}"
    for name in ("white_image", "dark_image"):
        if (image := getattr(table, name)) is not None:
            check_length(path, f"{key}, {name}", image)
    white_path = path.parent / table.white_image
    shape = _white_shape(white_path, f"white_image of camera {table.name!r}", table.raw)
    optics = table.optics_of(shape)
    nominal_checks.require_microimages(path, table.name, optics)
    return CameraSetup(
        name=table.name,
        optics=optics,
        orientation=table.orientation,
        image_flip=axes.flip_on_reading(table.image_flip, handedness),
        stated_flip=table.image_flip,
        white_path=white_path,
        dark_path=None if table.dark_image is None else path.parent / table.dark_image,
        background=table.background_image,
        raw=table.raw,
        white_level=table.white_level,
    )


def _white_shape(path: Path, label: str, raw: RawImages | None) -> tuple[int, int]:
    header = images.read_header(path, label, raw)
    if header is not None:
        return header.shape
    rows, columns = images.read_image(path, label, raw=raw).shape
    return rows, columns


def _check_calibration_images(experiment: Experiment) -> None:
    """Check that every image of the calibration exists, has its camera's shape and can be decoded."""
    for camera in experiment.cameras:
        if camera.dark_path is not None:
            check_shape(camera.dark_path, f"dark_image of camera {camera.name!r}", camera)
        for frame in experiment.frames:
            if (path := experiment.background_path(camera.name, frame)) is not None:
                check_shape(path, f"background_image of camera {camera.name!r}", camera)
                experiment.background_image(camera.name, frame)
        for plane in range(len(experiment.board.planes_mm)):
            check_shape(experiment.board_path(camera.name, plane), board_label(camera.name, plane), camera)
    for camera in experiment.cameras:
        white, dark = experiment.white(camera.name), experiment.dark(camera.name)
        label = f"white_image of camera {camera.name!r}"
        images.require_contrast(white, camera.white_path, label)
        if dark is not None and float((white - dark).max()) <= 0:
            raise InputError(
                f"{camera.white_path} ({label}): expected a white image brighter than the dark image, found none of "
                f"its pixels above {camera.dark_path}. Are the two files exchanged?"
            )
        for plane in range(len(experiment.board.planes_mm)):
            board = experiment.board_image(camera.name, plane)
            path, label = experiment.board_path(camera.name, plane), board_label(camera.name, plane)
            images.require_contrast(board, path, label)

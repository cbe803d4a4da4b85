"""The experiment as a frozen value: its settings, the numbers of its pairs or instants, its images and their paths."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import ConfigDict

from lfpiv.errors import InputError
from lfpiv.experiment import images
from lfpiv.experiment.mask import Mask
from lfpiv.experiment.readers.source import ImagePath, split
from lfpiv.experiment.recording import Frame, Recording
from lfpiv.geometry.grid import Grid
from lfpiv.geometry.optics import Optics
from lfpiv.geometry.orientation import Orientation
from lfpiv.prompt import Card, Shown, count, seconds, times
from lfpiv.settings.processing import Bootstrap, Compute, Correlation, Network, SelfCalibration, Smart, Tracking
from lfpiv.settings.rig import Board, RawImages


@dataclass(frozen=True, kw_only=True)
class CameraSetup:
    """One camera of an experiment: its nominal optics, white image and dark image."""

    name: str
    optics: Optics
    """Nominal optics; ``sensor_shape`` is that of the white image."""
    orientation: Orientation | None
    """Nominal orientation; it numbers the board's dots and enters the thin-lens mapping, never the network. None where
    the board's mark does."""
    image_flip: str
    """Mirroring that is reversed on reading, so that +x is on the left and +y is up in what is read."""
    white_path: Path
    dark_path: Path | None
    background: str | None = None
    """Path pattern of the background image, relative to the experiment file, or None."""
    raw: RawImages | None = None
    """Layout of the camera's files without a header, or None."""
    white_level: float | None = None
    """Value from which on pixels are saturated [counts]; None where the images show it."""
    stated_flip: str | None = None
    """The key ``image_flip``, or None where it is absent."""

    def cells(self) -> tuple[str, ...]:
        """Return the camera's row in the card of its experiment."""
        optics, angle = self.optics, self.nominal_angle_deg
        return (
            self.name,
            times(optics.sensor_shape),
            f"{optics.focal_length_mm:g}",
            f"{optics.magnification:g}",
            f"{optics.f_number:g}",
            f"{optics.layout}, {1000 * optics.microlens_pitch_mm:.4g} um",
            "-" if angle is None else f"{angle:.4g} deg",
        )

    @property
    def nominal_angle_deg(self) -> float | None:
        """Nominal angle about y [degree], None where no orientation is stated."""
        return None if self.orientation is None else self.orientation.yaw_deg


@dataclass(frozen=True, kw_only=True, repr=False)
class Experiment(Shown):
    """An experiment with checked settings and images. Made by `open_experiment`."""

    __pydantic_config__ = ConfigDict(arbitrary_types_allowed=True, extra="forbid")  # workers get it as JSON

    path: Path
    name: str
    dt_s: float
    """Time between the two frames of a pair, or between instants k and k + step of a series [s]."""
    cameras: tuple[CameraSetup, ...]
    board: Board
    grid: Grid
    guard_mm: float | tuple[float, float, float] | Literal["auto"]
    """Thickness of the guard layers beyond the grid's faces, one number or (x, y, z) [mm], or "auto"."""
    recording: Recording
    """Numbers and names of the frames and pairs."""
    smart: Smart
    correlation: Correlation
    network: Network
    self_calibration: SelfCalibration
    compute: Compute
    particle_images: str
    """Path pattern of the particle images, relative to the experiment file."""
    mask: Mask | None = None
    """Where the volume holds no fluid; None if it does everywhere."""
    bootstrap: Bootstrap = field(default_factory=Bootstrap)
    """How many pairs are simulated to measure the damping by ghosts."""
    background: str = "none"
    """Estimate of the light that stands still: "auto", "none", "minimum" or "median"."""
    tracking: Tracking | None = None
    """Settings of the tracking of particles; None without it."""

    def card(self) -> Card:
        """Return what matters of the experiment, for people."""
        grid, board = self.grid, self.board
        what = self.recording.text
        size = [n * grid.voxel_mm for n in grid.shape[::-1]]
        guard_mm = self.guard_mm if isinstance(self.guard_mm, str | tuple) else (self.guard_mm,)
        planes = count(len(board.planes_mm), "plane")
        facts = [
            ("file", str(self.path)),
            ("images", f"{what}, {seconds(self.dt_s)} between frames: {self.particle_images}"),
            ("volume", f"{times(size)} mm (x, y, z) in {times(grid.shape)} voxels (z, y, x) of {grid.voxel_mm:g} mm"),
            ("guard layers", guard_mm if isinstance(guard_mm, str) else f"{times(guard_mm)} mm (x, y, z)"),
            ("board", f"{times(board.dots)} dots, {board.spacing_mm:g} mm apart, {planes}"),
        ]
        if self.mask is not None:
            if self.mask.moves:
                facts.append(("mask", f"a file of each frame: {self.mask.file}"))
            else:
                facts.append(("mask", f"{100 * float(self.mask.flags({}).mean()):.1f} % of the volume holds no fluid"))
        for name in ("smart", "correlation", "tracking", "network", "self_calibration", "bootstrap", "compute"):
            table = getattr(self, name)
            stated = {} if table is None else {key: getattr(table, key) for key in sorted(table.model_fields_set)}
            if stated:
                facts.append((f"[{name}]", ", ".join(f"{key} = {value!r}" for key, value in stated.items())))
        head = ("camera", "pixels (rows, columns)", "f [mm]", "M", "f/", "microlenses", "angle")
        title = f"Experiment {self.name!r}: {count(len(self.cameras), 'camera')}, {what}"
        return Card(title, tuple(facts), (head, *(camera.cells() for camera in self.cameras)))

    @property
    def numbers(self) -> range:
        """Numbers of all pairs, in a series those of their first instants."""
        return self.recording.numbers

    @property
    def pairs(self) -> int:
        """Number of pairs; the last `step` instants of a series are the first of no pair."""
        return self.recording.pairs

    @property
    def frames(self) -> tuple[str, str]:
        """Names of the two frames of a pair."""
        return self.recording.names

    @property
    def laser_names(self) -> tuple[str, ...]:
        """Names of the frames that each have a laser. One laser lights all instants of a series."""
        return self.frames[: self.recording.lasers]

    def pair_frames(self, pair: int) -> tuple[Frame, Frame]:
        """Return both frames of a pair. An instant of a series is the same frame in both its pairs."""
        return self.recording.of_pair(pair)

    def all_frames(self) -> Iterator[Frame]:
        """Yield all frames that belong to a pair."""
        return (frame for pair in self.numbers for frame in self.pair_frames(pair))

    def solid(self, frame: Frame, grid: Grid | None = None) -> np.ndarray | None:
        """Return the flags of the voxels without fluid in a frame, shape (z, y, x); None without a mask.

        Parameters
        ----------
        frame : Frame
            Frame of the recording.
        grid : Grid, optional
            Grid of the flags, each of which is that of the nearest voxel; default: the voxels of the experiment.

        Raises
        ------
        InputError
            If the frame's file is no mask of this volume.
        """
        if self.mask is None:
            return None
        flags = self.mask.flags(frame.fields)
        grid = self.grid if grid is None else grid
        return flags if grid == self.mask.grid else np.ascontiguousarray(flags[grid.nearest_in(self.mask.grid)])

    def mask_files(self, frames: Iterable[Frame]) -> list[Path]:
        """Return the files of the masks of some frames, each once; none if no file is read."""
        if self.mask is None or self.mask.file is None:
            return []
        return list(dict.fromkeys(self.mask.file_of(frame.fields) for frame in frames))

    @property
    def estimate(self) -> Literal["correlation", "joint"]:
        """How displacements are estimated: as stated, or with "auto" by a joint fit where it can be used."""
        if self.smart.estimate != "auto":
            return self.smart.estimate
        usable = len(self.cameras) > 1 and not self.recording.is_series and not self.by_links
        return "joint" if usable else "correlation"

    @property
    def is_joint(self) -> bool:
        """Whether both frames of a pair are fitted together with their displacement."""
        return self.estimate == "joint"

    @property
    def in_sequence(self) -> bool:
        """Whether each instant of a series is reconstructed from the one before."""
        return self.recording.is_series and self.smart.predict

    def name_of(self, pair: int) -> str:
        """Return "pair" or, in a series, "instant" with the number, for messages."""
        return self.recording.name_of(pair)

    @property
    def noun(self) -> str:
        """What results are numbered by: "pair" or "instant"."""
        return self.recording.noun

    def disjoint(self, pairs: Iterable[int]) -> Iterator[int]:
        """Yield the pairs that share no image with one yielded before."""
        seen = set[Frame]()
        for pair in pairs:
            frames = self.pair_frames(pair)
            if seen.isdisjoint(frames):
                seen.update(frames)
                yield pair

    def camera(self, name: str) -> CameraSetup:
        """Return the camera of that name; raise ValueError for an unknown name."""
        by_name = {camera.name: camera for camera in self.cameras}
        if name not in by_name:
            raise ValueError(f"camera: expected one of {', '.join(by_name)}, got {name!r}.")
        return by_name[name]

    def white(self, name: str) -> np.ndarray:
        """Return the white image of a camera [counts], dark image not subtracted, float32 (rows, columns)."""
        camera = self.camera(name)
        return read_image_of(camera.white_path, f"white_image of camera {name!r}", camera)

    def dark(self, name: str) -> np.ndarray | None:
        """Return the dark image of a camera [counts], float32 (rows, columns), or None where the file names none."""
        camera = self.camera(name)
        if camera.dark_path is None:
            return None
        return read_image_of(camera.dark_path, f"dark_image of camera {name!r}", camera)

    def board_image(self, name: str, plane: int) -> np.ndarray:
        """Return the board image of a camera at a plane [counts], float32 (rows, columns)."""
        return read_image_of(self.board_path(name, plane), board_label(name, plane), self.camera(name))

    def particle_image(self, name: str, pair: int, frame: str) -> np.ndarray:
        """Return a particle image [counts], float32 (rows, columns); raise InputError if it has no contrast."""
        return self.frame_image(name, self.pair_frames(pair)[self.frames.index(frame)])

    def frame_image(self, name: str, frame: Frame) -> np.ndarray:
        """Return a camera's image of a frame as `particle_image` does."""
        label, path = self.frame_label(name, frame), self.frame_path(name, frame)
        image = read_image_of(path, label, self.camera(name))
        images.require_contrast(image, path, label)
        return image

    def frame_white_level(self, name: str, frame: Frame) -> float | None:
        """Return the value from which on pixels of a camera's image of a frame are saturated, see `white_level`."""
        return white_level(self.frame_path(name, frame), self.camera(name))

    def background_image(self, name: str, frame: str) -> np.ndarray | None:
        """Return the background image of a camera [counts], float32 (rows, columns); None where the file names none."""
        path = self.background_path(name, frame)
        return None if path is None else read_image_of(path, f"background_image of camera {name!r}", self.camera(name))

    def background_path(self, name: str, frame: str) -> Path | None:
        """Return the path of a camera's background image for a frame; None where the file names none."""
        pattern = self.camera(name).background
        return None if pattern is None else self.path.parent / pattern.format(frame=frame)

    def board_path(self, name: str, plane: int) -> Path:
        """Return the path of a board image."""
        return self.path.parent / self.board.images.format(camera=name, plane=plane)

    def particle_path(self, name: str, pair: int, frame: str) -> Path:
        """Return the path of a particle image."""
        return self.frame_path(name, self.pair_frames(pair)[self.frames.index(frame)])

    def frame_path(self, name: str, frame: Frame) -> Path:
        """Return the path of a camera's image of a frame."""
        return self.path.parent / self.particle_images.format(camera=name, **frame.fields)

    def frame_label(self, name: str, frame: Frame) -> str:
        """Return key, camera and number of a particle image, for messages."""
        return f"particles.images, camera {name!r}, {frame.label}"

    def calibration_images(self, cameras: Sequence[CameraSetup] | None = None) -> list[ImagePath]:
        """Return all images that the calibration reads, in a fixed order; `cameras` are all unless some are given."""
        cameras = self.cameras if cameras is None else cameras
        found = [split(path, c.raw) for c in cameras for path in (c.white_path, c.dark_path) if path is not None]
        planes = range(len(self.board.planes_mm))
        return found + [split(self.board_path(c.name, plane), c.raw) for c in cameras for plane in planes]

    @property
    def self_calibration_pairs(self) -> list[int]:
        """Pairs used by the self-calibration, evenly spread over all."""
        return self.spread_pairs(self.self_calibration.pairs)

    def spread_pairs(self, count: int) -> list[int]:
        """Return `count` pairs, evenly spread over all, or all if there are no more; none shares an image with another.

        Pairs of a short series overlap. Then these are fewer.
        """
        count = min(count, self.pairs)
        spread = (self.numbers[(2 * number + 1) * self.pairs // (2 * count)] for number in range(count))
        return list(self.disjoint(spread))

    @property
    def simulated_pairs(self) -> int:
        """Number of pairs that are simulated to measure the damping by ghosts; 0 for none."""
        return self.simulated_of(self.pairs)

    def simulated_of(self, pairs: int) -> int:
        """Return the number of simulated pairs for a number of recorded ones. A joint fit hardly damps."""
        unasked = self.is_joint and self.bootstrap.pairs == "auto"
        return 0 if self.by_links or unasked else self.bootstrap.count(pairs)

    @property
    def by_links(self) -> bool:
        """Whether linked particles give the vectors. Ghosts do not damp these."""
        return self.tracking is not None and self.tracking.gives_vectors(len(self.cameras))

    def frame_images(self, frame: Frame) -> list[ImagePath]:
        """Return the images of one frame, in the order of the cameras."""
        return [split(self.frame_path(camera.name, frame), camera.raw) for camera in self.cameras]

    def pair_images(self, pair: int) -> list[ImagePath]:
        """Return all images of one pair, in a fixed order."""
        return [image for frame in self.pair_frames(pair) for image in self.frame_images(frame)]


def read_image_of(path: Path, label: str, camera: CameraSetup) -> np.ndarray:
    """Read an image of a camera and reverse its mirroring; refuse another shape than the white image's."""
    image = images.read_image(path, label, flip=camera.image_flip, raw=camera.raw)
    _require_shape(image.shape, path, label, camera)
    return image


def white_level(path: Path, camera: CameraSetup) -> float | None:
    """Return the value from which on pixels of an image are saturated: as stated, or else as its header says [counts].

    None where neither says it, or where the file cannot be read, which is told elsewhere.
    """
    if camera.white_level is not None:
        return camera.white_level
    try:
        header = images.read_header(path, "", camera.raw)
    except InputError:
        return None
    return None if header is None else header.white_level


def check_shape(path: Path, label: str, camera: CameraSetup) -> None:
    """Refuse an image that is missing, damaged, or of another shape than its camera's white image.

    A DaVis image must exist; its content is checked when it is decoded.
    """
    header = images.read_header(path, label, camera.raw)
    if header is not None:
        _require_shape(header.shape, path, label, camera)


def _require_shape(shape: tuple[int, ...], path: Path, label: str, camera: CameraSetup) -> None:
    if shape != camera.optics.sensor_shape:
        raise InputError(
            f"{path} ({label}): expected {camera.optics.sensor_shape} pixels (rows, columns) as in the white image "
            f"{camera.white_path}, found {shape}. All images of a camera have one size."
        )


def board_label(camera: str, plane: int) -> str:
    """Return key, camera and plane of a board image, for messages."""
    return f"board.images, camera {camera!r}, plane {plane}"

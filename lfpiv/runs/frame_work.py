"""The work on frames: read their images, reconstruct them, and write what is found beside the computation."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lfpiv.errors import InputError
from lfpiv.experiment.experiment import Experiment
from lfpiv.experiment.recording import Frame
from lfpiv.progress import StepProgress
from lfpiv.results.pair_files import VolumeFile
from lfpiv.results.stamps import Inputs
from lfpiv.runs.frame_light import FrameLight, frame_light, read_darks
from lfpiv.runs.pair_volumes import Reconstructor, SequenceFrame
from lfpiv.runs.side_threads import ReadAhead, Writer
from lfpiv.sequence.solver import PreviousFrame
from lfpiv.warn import FirstOfEachCode, Warning

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera
    from lfpiv.weights.operator import Weights

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class FrameWork:
    """The work on each frame of an experiment, with all its inputs."""

    experiment: Experiment
    inputs: Inputs
    """What all its volumes depend on."""
    weights: Weights | None
    """None if all volumes are in the folder."""
    cameras: Mapping[str, CalibratedCamera]
    """Cameras that know what stands still in their images; empty if no image is read."""
    keep_volumes: bool
    """Write the volumes."""
    scratch: Path | None = None
    """Folder in which processes store volumes for each other; None for a process by itself."""
    log_first: FirstOfEachCode = field(default_factory=lambda: FirstOfEachCode(log))

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
            guard=self.inputs.guard,
            refinement=self.inputs.refinement,
        )

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

    def follow(
        self, light: FrameLight, previous: PreviousFrame | None, progress: StepProgress
    ) -> tuple[SequenceFrame, PreviousFrame]:
        """Reconstruct a frame of a series from its predecessor; return it and what its successor needs.

        Raises
        ------
        InputError
            If its images cannot be reconstructed.
        """
        frame = light.frame.number
        self.log_warnings(frame, light.warnings)
        self.writer.wait_large()
        found, coming = self.reconstructor.follow(light, previous, progress)
        self.log_warnings(frame, found.light.warnings[len(light.warnings) :])
        return found, coming

    def log_warnings(self, pair: int, warnings: Iterable[Warning]) -> None:
        """Log the first warning of each code about a pair or its frames."""
        self.log_first([self.experiment.recording.by_result(warning.of_pair(pair)) for warning in warnings])

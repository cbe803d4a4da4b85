"""Volumes of a time series whose instants are reconstructed one after the other, each from the one before.

`SequentialInstants` goes along the pairs k, k + 1, k + 2, ... of a stretch and holds the instants from the first to the
second one of the present pair. The instants of a segment are always reconstructed from the same beginning
(`lfpiv.experiment.segments`), so the numbers do not depend on the pairs that are asked for, on the processes, or on
interruptions. A process that begins within a segment reconstructs the segment's instants up to there again.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from lfpiv.errors import StorageError
from lfpiv.experiment.experiment import Frame
from lfpiv.experiment.segments import followed, segment_of
from lfpiv.progress import StepProgress, part_of
from lfpiv.reconstruction.sequence import Before
from lfpiv.results.pair_files import FrameVolume, PairFiles, VolumeFile
from lfpiv.runs.frame_light import FrameLight
from lfpiv.runs.instants import Failure, Instant, Instants, InstantWork, failure
from lfpiv.warn import Code, Warning

log = logging.getLogger(__name__)


@dataclass(eq=False)
class SequentialInstants(Instants):
    """The instants of the present pair of a stretch, and those between them."""

    sequences: dict[int, _Sequence] = field(default_factory=dict)
    """Segment -> its instants so far."""

    def _obtain(self, files: PairFiles, progress: StepProgress, wanted: Sequence[VolumeFile] | None = None) -> None:
        for segment in [known for known in self.sequences if known < segment_of(files.pair)]:
            del self.sequences[segment]
        for sequence in self.sequences.values():
            sequence.forget(files.pair)
        super()._obtain(files, progress, wanted)

    def _needed(self, frame: Frame, files: PairFiles, wanted: Sequence[VolumeFile]) -> bool:
        return frame.number >= files.pair

    def _reconstruct(self, file: VolumeFile, progress: StepProgress) -> Instant:
        self.work.require_weights(file)
        segment = segment_of(file.frame.number)
        if segment not in self.sequences:
            self.sequences[segment] = _Sequence(self.work)
        return self._handed_on(file, self.sequences[segment].reach(file.frame, progress))

    def clear(self) -> None:
        """Forget all instants; see `Instants.clear`."""
        self.sequences.clear()
        super().clear()


@dataclass(eq=False)
class _Sequence:
    """The instants of one segment, as far as they are reconstructed."""

    work: InstantWork
    last: int | None = None
    """The last instant that was reconstructed or failed."""
    before: Before | None = None
    """What the next instant starts from; None if it starts from its images alone."""
    fingerprints: dict[str, bytes] = field(default_factory=dict)
    """Hash of the last instant's images by camera; empty if it failed."""
    ahead: dict[int, Instant | Failure] = field(default_factory=dict)
    """Instants that were reconstructed before a pair asked for them."""

    def forget(self, first: int) -> None:
        """Forget the instants before one that no pair asks for any more."""
        self.ahead = {number: found for number, found in self.ahead.items() if number >= first}

    def reach(self, frame: Frame, progress: StepProgress) -> Instant:
        """Reconstruct instants up to one and return that one; raise Failure if it failed."""
        if frame.number not in self.ahead:
            assert self.work.experiment.series is not None
            whole = followed(self.work.experiment.series, frame.number)
            if self.last is None or self.last >= frame.number:
                self.last, self.before, self.fingerprints = whole[0] - 1, None, {}
            coming = whole[whole.index(self.last) + 1 :] if self.last in whole else whole
            for place, number in enumerate(coming):
                step = part_of(progress, place / len(coming), (place + 1) / len(coming))
                self.ahead[number] = self._advance(Frame(number, frame.name), step)
        found = self.ahead.pop(frame.number)
        if isinstance(found, Failure):
            raise found.with_traceback(None)
        return found

    def _advance(self, frame: Frame, progress: StepProgress) -> Instant | Failure:
        """Reconstruct the next instant. After one that fails, the sequence begins anew."""
        self.last = frame.number
        try:
            light = self._checked(self.work.light_again(frame))
            volume, self.before = self.work.follow(light, self.before, progress)
        except StorageError:
            raise
        except Exception as error:  # an error in one instant must not end the series
            self.before, self.fingerprints = None, {}
            return failure(error)
        self.fingerprints = dict(light.fingerprints)
        return Instant(frame, volume, light)

    def _checked(self, light: FrameLight) -> FrameLight:
        """Return the light of the next instant, with a warning if an image is that of the instant before."""
        same = [name for name, mark in light.fingerprints.items() if self.fingerprints.get(name) == mark]
        if not same:
            return light
        self.before = None  # particles that seem to rest say nothing of the flow
        number = light.frame.number
        figures = {"camera": " and ".join(same), "before": number - 1}
        repeated = Warning(code=Code.REPEATED, figures=figures, instants=(number,))
        return replace(light, warnings=(*light.warnings, repeated))


def restarted(volume: FrameVolume, ratio: float, instant: int) -> FrameVolume:
    """Return the volume of an instant that was not where it was predicted, with a warning in its record."""
    missed = Warning(code=Code.NOT_FOLLOWED, figures={"ratio": ratio}, instants=(instant,))
    return replace(volume, record=replace(volume.record, warnings=(*volume.record.warnings, missed)))

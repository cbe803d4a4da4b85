"""Volumes of a time series whose instants are reconstructed one after the other, each from the one before.

`FollowedFrames` goes along the pairs k, k + 1, k + 2, ... of a work unit and holds the instants from the first to the
second one of the present pair. Each is corrected by the few instants before and after it, so images are read ahead. The
instants of a segment are always reconstructed from the same beginning
(`lfpiv.experiment.segments`), so the numbers do not depend on the pairs that are asked for, on the processes, or on
interruptions. A process that begins within a segment reconstructs the segment's instants up to there again.

Where the flow is too rough to be followed, the rest of a segment is reconstructed by itself. No further instant outside
the segment is reconstructed for it. The next segment tries again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

from lfpiv.experiment import segments
from lfpiv.experiment.recording import Frame
from lfpiv.experiment.segments import corrected_by, followed, segment_of
from lfpiv.progress import StepProgress, part_of
from lfpiv.results.pair_files import PairFiles, VolumeFile
from lfpiv.runs.frame_light import FrameLight
from lfpiv.runs.frame_work import FrameWork
from lfpiv.runs.frames import Failure, Frames, HeldFrame, attempted
from lfpiv.runs.pair_volumes import SequenceFrame
from lfpiv.sequence.solver import PreviousFrame, StartedFrom
from lfpiv.warn import Code, Warning


@dataclass(eq=False)
class FollowedFrames(Frames):
    """The frames of the present pair of a work unit, and those between them."""

    sequences: dict[int, Segment] = field(default_factory=dict)
    """Number of a segment -> its frames so far."""

    def _needed(self, frame: Frame, files: PairFiles) -> bool:
        return frame.number >= files.pair

    def _obtain(self, file: VolumeFile) -> HeldFrame:
        if (known := self._known(file)) is not None:
            return known
        self.work.require_weights(file)
        return HeldFrame(file.frame)

    def _complete(self, files: PairFiles, progress: StepProgress) -> Sequence[Warning]:
        """Follow the segments up to both frames, then compare their images."""
        self.sequences = {known: found for known, found in self.sequences.items() if known >= segment_of(files.pair)}
        for sequence in self.sequences.values():
            sequence.forget(files.pair)
        for number, file in enumerate(files.frames):
            one = self.held[file.frame]
            if isinstance(one, HeldFrame) and one.volume is None:
                step = part_of(progress, number / 2, (number + 1) / 2)
                self.held[file.frame] = found = attempted(partial(self._reached, file.frame, step))
                self._hand_on(files, [found] if isinstance(found, HeldFrame) else [])
        return super()._complete(files, progress)

    def _reached(self, frame: Frame, progress: StepProgress) -> HeldFrame:
        number = segment_of(frame.number)
        if number not in self.sequences:
            self.sequences[number] = Segment(self.work, number)
        return self.sequences[number].reach(frame, progress)

    def clear(self) -> None:
        """Forget all frames; see `Frames.clear`."""
        self.sequences.clear()
        super().clear()


@dataclass(eq=False)
class Segment:
    """The frames of one segment, as far as they are reconstructed."""

    work: FrameWork
    number: int
    done: int | None = None
    """The last instant that is finished."""
    last: int = -1
    """The last instant that was followed or failed; some are ahead of the finished ones, to correct these."""
    previous: PreviousFrame | None = None
    """What the next instant starts from; None if it starts from its images alone."""
    fingerprints: dict[str, bytes] = field(default_factory=dict)
    """Hash of the last instant's images by camera; empty if it failed."""
    trail: dict[int, SequenceFrame | Failure] = field(default_factory=dict)
    """Instants that were followed or failed and that correct others, or will be corrected."""
    beginnings: set[int] = field(default_factory=set)
    """Instants whose particles are not those of the instant before, as far as one knows."""
    ahead: dict[int, HeldFrame | Failure] = field(default_factory=dict)
    """Instants that were finished before a pair asked for them."""

    def forget(self, first: int) -> None:
        """Forget the instants before one that no pair asks for any more."""
        self.ahead = {number: found for number, found in self.ahead.items() if number >= first}

    def reach(self, frame: Frame, progress: StepProgress) -> HeldFrame:
        """Reconstruct instants up to `instant` and return it; raise Failure if it failed."""
        if frame.number not in self.ahead:
            frames = self.work.experiment.recording.frames
            whole = followed(frames, frame.number)
            if self.done is None or self.done >= frame.number:
                self.done = self.last = whole[0] - 1
                self.previous, self.fingerprints, self.trail, self.beginnings = None, {}, {}, set()
            coming = range(self.done + 1, frame.number + 1)
            for place, number in enumerate(coming):
                step = part_of(progress, place / len(coming), (place + 1) / len(coming))
                self._finish(number, corrected_by(frames, number), step)
        found = self.ahead.pop(frame.number)
        if isinstance(found, Failure):
            raise found.with_traceback(None)
        return found

    def _finish(self, number: int, later: range, progress: StepProgress) -> None:
        """Finish the next instant, after it and those later ones that correct it were followed."""
        coming = range(self.last + 1, later.stop)
        for place, one in enumerate(coming):
            if segment_of(one) != self.number and self.previous is not None and self.previous.given_up:
                self.last = one  # no instant of the segment is corrected by it
                continue
            step = part_of(progress, place / (len(coming) + 1), (place + 1) / (len(coming) + 1))
            self.trail[one] = self._follow(one, step)
        self.done = number
        if segment_of(number) == self.number:  # the others lead into it
            step = part_of(progress, len(coming) / (len(coming) + 1), 1.0)
            self.ahead[number] = self._corrected(number, step)
        own = self.trail.get(number)
        if isinstance(own, SequenceFrame):
            self.trail[number] = own.finished()
        self.trail = {one: found for one, found in self.trail.items() if one > number - segments.REACH}

    def _follow(self, number: int, progress: StepProgress) -> SequenceFrame | Failure:
        """Reconstruct the next instant from the one before. After one that fails, the sequence begins anew."""
        self.last = number

        def follow() -> SequenceFrame:
            light = self._checked(self.work.light_again(self.work.experiment.recording.frame(number)))
            if self.previous is None:
                self.beginnings.add(number)
            found, self.previous = self.work.follow(light, self.previous, progress)
            return found

        found = attempted(follow)
        if isinstance(found, Failure):
            self.previous, self.fingerprints = None, {}
            return found
        if found.result.started_from in (StartedFrom.MISSED, StartedFrom.UNRESOLVED):
            self.beginnings.add(number)
        self.fingerprints = dict(found.light.fingerprints)
        return found

    def _corrected(self, number: int, progress: StepProgress) -> HeldFrame | Failure:
        """Correct an instant by those beside it that show the same particles."""
        own = self.trail[number]
        if isinstance(own, Failure):
            return own
        found = attempted(partial(self.work.reconstructor.correct, *self._beside(number), progress))
        return found if isinstance(found, Failure) else HeldFrame(own.light.frame, own.light, found)

    def _beside(self, number: int) -> tuple[list[SequenceFrame], int]:
        """Return an instant with those that correct it, and its index among them."""

        def known(one: int) -> bool:
            return isinstance(self.trail.get(one), SequenceFrame)

        first = last = number
        while first > number - segments.REACH and first not in self.beginnings and known(first - 1):
            first -= 1
        while last < number + segments.REACH and last + 1 not in self.beginnings and known(last + 1):
            last += 1
        found = (self.trail[one] for one in range(first, last + 1))
        return [one for one in found if isinstance(one, SequenceFrame)], number - first

    def _checked(self, light: FrameLight) -> FrameLight:
        """Return the light of the next instant, with a warning if an image is that of the instant before."""
        same = [name for name, mark in light.fingerprints.items() if self.fingerprints.get(name) == mark]
        if not same:
            return light
        self.previous = None  # particles that seem to rest say nothing of the flow
        number = light.frame.number
        figures = {"camera": " and ".join(same), "before": number - 1}
        repeated = Warning(code=Code.REPEATED, figures=figures, instants=(number,))
        return replace(light, warnings=(*light.warnings, repeated))

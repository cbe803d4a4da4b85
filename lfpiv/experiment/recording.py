"""What was recorded: frames, which have volumes, and the pairs of them, which have vectors.

Image pair k is frames 2k and 2k + 1. In a time series pair k is frames k and k + `step`, so that a frame belongs to two
pairs, and frames are called instants. `Recording` numbers, names and orders both kinds; nothing else tells them apart.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from lfpiv.prompt import count
from lfpiv.settings.particles import Particles
from lfpiv.warn import Warning

FRAME_NAMES = "ab"
"""Names of the two frames of an image pair in output files, independent of the names of the images."""


@dataclass(frozen=True, order=True)
class Frame:
    """One exposure of all cameras."""

    number: int
    """Number in the recording; frame 2k is the first one of image pair k."""
    label: str = field(compare=False)
    """Name for messages: "pair 3, frame a" or "instant 3"."""
    stem: str = field(compare=False, repr=False)
    """Name of the file of its volume, without suffix."""
    fields: Mapping[str, Any] = field(compare=False, repr=False)
    """Fields of path patterns."""
    name: str | None = field(compare=False, repr=False)
    """Name in its image pair; None in a series."""
    laser: int = field(compare=False, repr=False)
    """0 or 1: the laser that lights it."""

    @property
    def within(self) -> str:
        """Name beside the other frame of its pair: "frame a" or "instant 3"."""
        return self.label if self.name is None else f"frame {self.name}"


@dataclass(frozen=True)
class Recording:
    """Numbers and names of frames and pairs."""

    pairs: int = 1
    """Number of pairs."""
    names: tuple[str, str] = FRAME_NAMES[0], FRAME_NAMES[1]
    """Text for ``{frame}`` in the paths of both images of a pair."""
    first: int = 0
    """Number of the first pair, in a series of the first instant."""
    step: int = 1
    """Number of frames from the first to the second frame of a pair."""
    lasers: int = 2
    """Number of frames that no other pair begins with: 2 of image pairs, one by each laser; 1 of a series."""

    @classmethod
    def of_series(cls, instants: int, first: int = 0, step: int = 1) -> Recording:
        """Return a time series; its last `step` instants are the first of no pair."""
        return cls(pairs=instants - step, first=first, step=step, lasers=1)

    @classmethod
    def from_table(cls, particles: Particles) -> Recording:
        """Return what a table ``[particles]`` states."""
        if particles.instants is None:
            return cls(pairs=particles.pairs or 0, names=particles.frames)
        return cls.of_series(particles.instants, particles.first, particles.step)

    @property
    def is_series(self) -> bool:
        """Whether a frame belongs to two pairs: it ends pair k and begins pair k + `step`."""
        return self.lasers == 1

    @property
    def shared_step(self) -> int | None:
        """Distance of pairs that share a frame; None where no pairs do."""
        return self.step if self.is_series else None

    @property
    def noun(self) -> str:
        """What results are numbered by: "pair" or "instant"."""
        return "instant" if self.is_series else "pair"

    @property
    def exposure(self) -> str:
        """What a frame is called: "frame" or "instant"."""
        return "instant" if self.is_series else "frame"

    @property
    def both(self) -> tuple[str, str]:
        """Names of the two frames of any pair, for people."""
        return ("k", f"k + {self.step}") if self.is_series else self.names

    @property
    def work(self) -> str:
        """Name of the step of a run that works on pairs, for progress."""
        return "instants" if self.is_series else "image pairs"

    @property
    def text(self) -> str:
        """What was recorded, for people."""
        return count(len(self.frames), "instant") if self.is_series else count(self.pairs, "image pair")

    @property
    def later(self) -> str:
        """Which frames are correlated, after "between frames"."""
        return "" if self.step == 1 else f", from each to the one {self.step} later"

    @property
    def stated(self) -> dict[str, Any]:
        """What the summary states beside the number of pairs."""
        if not self.is_series:
            return {}
        return {"series": {"instants": len(self.frames), "first": self.first, "step": self.step}}

    @property
    def numbers(self) -> range:
        """Numbers of all pairs, in a series of their first instants."""
        return range(self.first, self.first + self.pairs)

    @property
    def frames(self) -> range:
        """Numbers of all frames."""
        return range(self.lasers * self.first, self.lasers * self.numbers[-1] + self.step + 1)

    def frame(self, number: int) -> Frame:
        """Return a frame by its number."""
        if self.is_series:
            return Frame(number, f"instant {number}", f"instant_{number:06d}", {"instant": number}, None, 0)
        pair, at = divmod(number, 2)
        name, fields = self.names[at], {"pair": pair, "frame": self.names[at], "image": number}
        return Frame(number, f"pair {pair}, frame {name}", f"pair_{pair:04d}_{FRAME_NAMES[at]}", fields, name, at)

    def frame_of(self, pair: int, at: int) -> Frame:
        """Return frame 0 or 1 of a pair."""
        return self.frame(self.lasers * pair + at * self.step)

    def of_pair(self, pair: int) -> tuple[Frame, Frame]:
        """Return both frames of a pair."""
        return self.frame_of(pair, 0), self.frame_of(pair, 1)

    def named(self, pair: int, name: str) -> Frame:
        """Return the frame of a pair by its name."""
        return self.frame_of(pair, self.names.index(name))

    def name_of(self, pair: int) -> str:
        """Return "pair" or, in a series, "instant" with the number, for messages."""
        return f"{self.noun} {pair}"

    def new_frames(self, pair: int) -> tuple[Frame, ...]:
        """Return the frames of a pair that no other pair begins with: both, or the first instant of a series."""
        return self.of_pair(pair)[: self.lasers]

    def stem(self, pair: int) -> str:
        """Return the name of the file of a pair's vectors, without suffix."""
        return f"instant_{pair:06d}" if self.is_series else f"pair_{pair:04d}"

    def time_s(self, instant: int, dt_s: float) -> float:
        """Return the time of an instant after the first one [s]; `dt_s` passes between the frames of a pair."""
        return (instant - self.first) * dt_s / self.step

    def origin(self, pair: int, dt_s: float) -> dict[str, Any]:
        """Return the attributes that say of what vectors are: the pair, or instant, step and time."""
        if not self.is_series:
            return {"pair": pair}
        return {"instant": pair, "step": self.step, "time_s": self.time_s(pair, dt_s)}

    def frame_origin(self, frame: Frame, dt_s: float) -> dict[str, Any]:
        """Return the attributes that say of what a volume is: pair and frame, or instant and time."""
        if not self.is_series:
            return {name: frame.fields[name] for name in ("pair", "frame")}
        return {"instant": frame.number, "time_s": self.time_s(frame.number, dt_s)}

    def by_result(self, warning: Warning) -> Warning:
        """Return a warning about pairs with these named as results are, in a series by their first instants."""
        return warning.by_instant() if self.is_series else warning

    def by_frame(self, warning: Warning, frame: Frame) -> Warning:
        """Return a warning about a frame with its number, if it has no name within its pair."""
        return replace(warning, instants=(frame.number,)) if frame.name is None else warning

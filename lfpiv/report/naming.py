"""Name results on the page: by pair and frame, or by instant in a time series."""

from __future__ import annotations

from dataclasses import dataclass

from lfpiv.experiment.experiment import Experiment


@dataclass(frozen=True, kw_only=True)
class Naming:
    """What results are numbered by."""

    noun: str = "pair"
    """ "pair", or "instant" in a time series."""
    step: int | None = None
    """Instants from the first to the second of a vector field; None for image pairs."""

    @classmethod
    def of(cls, experiment: Experiment) -> Naming:
        """Return the names of an experiment's results."""
        return cls(noun=experiment.noun, step=experiment.recording.chain)

    def result(self, number: int) -> str:
        """Name a vector field."""
        return f"{self.noun} {number}"

    def frame(self, number: int, frame: str) -> str:
        """Name a frame of a known vector field: "frame a", or its instant."""
        if self.step is None:
            return f"frame {frame}"
        return f"instant {number + (self.step if frame == 'b' else 0)}"

    def volume(self, number: int, frame: str) -> str:
        """Name a volume; the volume of an instant has the same name in both its vector fields."""
        name = self.frame(number, frame)
        return name if self.step is not None else f"{self.result(number)}, {name}"


PAIRS = Naming()
"""Names of image pairs."""

"""Tables of the particle images: pairs, or a time series."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from lfpiv.settings import bounds
from lfpiv.settings.bounds import Count, Name, PathText
from lfpiv.settings.table import Table


class Particles(Table):
    """Table ``[particles]``: the image pairs, or the time series."""

    images: PathText
    """Path of the particle images: with ``{camera}``, ``{pair}`` and ``{frame}`` for pairs, which count from 0, or
    ``{image}``, which is 2 pair for the first and 2 pair + 1 for the second frame; with ``{camera}`` and ``{instant}``
    for a time series."""
    pairs: Count | None = None
    """Number of image pairs; absent for a time series."""
    instants: Annotated[int, Field(strict=True, ge=2, le=bounds.MOST)] | None = None
    """Number of instants of a time series, each of which is the second image of one pair and the first of another."""
    first: Annotated[int, Field(strict=True, ge=0, le=bounds.MOST)] = 0
    """Number of the first instant of a time series."""
    step: Count = 1
    """Distance of the two instants that are correlated in a time series, ``dt_s`` apart: k and k + step."""
    frames: tuple[Name, Name] = ("a", "b")
    """Text for ``{frame}`` in the first and second image of a pair."""
    background: Literal["auto", "none", "minimum", "median"] = "auto"
    """Light that stands still, subtracted from the images: the light of `background_image`, or what the series of pairs
    shows beyond chance ("auto"), the minimum or median of each pixel over the series, or nothing ("none")."""

    @field_validator("frames")
    @classmethod
    def _differ(cls, frames: tuple[str, str]) -> tuple[str, str]:
        if frames[0] == frames[1]:
            raise ValueError("two different frame names")
        return frames

    @model_validator(mode="after")
    def _pairs_or_series(self) -> Particles:
        if (self.pairs is None) == (self.instants is None):
            raise ValueError("either pairs or instants")
        if self.instants is None and {"first", "step"} & self.model_fields_set:
            raise ValueError("first and step only with instants")
        if self.instants is not None and "frames" in self.model_fields_set:
            raise ValueError("frames only with pairs; an instant has one image of each camera")
        if self.instants is not None and self.instants <= self.step:
            raise ValueError("more instants than step")
        return self

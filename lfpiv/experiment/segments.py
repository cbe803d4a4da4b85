"""Segments of a time series: instants that are reconstructed in turn, each from its predecessor.

Segments begin at fixed numbers of instants, whatever pairs a run is asked for. A few instants are reconstructed before
a segment, only to lead into it, and a few after it, to correct its last instants. So the volume
of an instant depends on its own images and on those of a known range of instants beside it, and on nothing else.
"""

from __future__ import annotations

SEGMENT = 64
"""Number of instants of a segment. The number of its first one is a multiple of it."""
LEAD_IN = 6
"""Largest number of instants before a segment that lead into it."""
REACH = 3
"""Largest number of instants before and after an instant by which it is corrected."""


def segment_of(instant: int) -> int:
    """Return the number of the segment of an instant."""
    return instant // SEGMENT


def followed(frames: range, instant: int) -> range:
    """Return the instants that are reconstructed in turn up to and with an instant.

    They begin with those that lead into its segment, as far as `frames`, the numbers of all instants, have them.
    """
    start = max(segment_of(instant) * SEGMENT - LEAD_IN, frames.start)
    return range(start, instant + 1)


def depended_on(frames: range, instant: int) -> list[int]:
    """Return the other instants on whose images an instant depends: those it follows, and those that correct it."""
    return [*followed(frames, instant)[:-1], *corrected_by(frames, instant)]


def corrected_by(frames: range, instant: int) -> range:
    """Return the instants after one by which it is corrected, as far as the series has them."""
    return range(instant + 1, min(instant + REACH, frames[-1]) + 1)

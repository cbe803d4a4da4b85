"""Find runs whose pairs are made of other frames than those that show the same particles, in all cameras.

An image too many or too few at the start of a recording shifts all others. The cameras of a frame still agree. The
frames of a pair show the mistake: they are as unlike as frames of different pairs, and frames of neighbouring pairs are
alike.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from lfpiv.selfcalibration.paired_frames import ALIKE, UNLIKE, likeness
from lfpiv.warn import Code, Warning

if TYPE_CHECKING:
    from lfpiv.runs.moved_cameras import ShownParticles

_FEWEST = 2  # neighbouring pairs whose frames are all alike
_SHIFTED = ((1, 0), (0, 1))  # frame of a pair, and frame of the next pair, that may show the same particles


def refusals_of_all(shown: ShownParticles, pairs: Sequence[int]) -> list[Warning]:
    """Return the refusal of all pairs if frames of neighbouring pairs belong together."""
    recording = shown.experiment.recording
    if recording.is_series or len(pairs) < 2:
        return []

    def alike(links: Iterable[tuple[tuple[int, int], tuple[int, int]]]) -> list[float]:
        seen = [(shown(*one), shown(*other)) for one, other in links]
        return [likeness(one, other, shown.cameras) for one, other in seen if one and other]

    by_chance = alike(((one, 0), (other, 0)) for one, other in pairwise(pairs))
    of_pairs = alike(((pair, 0), (pair, 1)) for pair in pairs)
    if not (by_chance and of_pairs):
        return []
    chance = float(np.median(by_chance))
    own = float(np.median(of_pairs)) - chance
    for frames in _SHIFTED if own < ALIKE else ():
        linked = alike(((pair, frames[0]), (pair + 1, frames[1])) for pair in pairs)
        other = min(linked) - chance if len(linked) >= _FEWEST else 0.0  # images that stay the same are alike once
        if other > ALIKE and own < UNLIKE * other:
            one, next_one = (f"{recording.exposure} {recording.both[frame]}" for frame in frames)
            found = (
                f"{one} of each pair shows the particles of {next_one} of the next pair, not the particles of its own"
            )
            remedy = "Number the images anew: one too many, or too few, at the start shifts all others"
            return [Warning(code=Code.MISMATCHED, figures={"found": found, "remedy": remedy})]
    return []

"""Check by the focus of the dots where the planes of the board stand.

The slope of a dot's rays over the pupil shows its depth without knowing which dot it is. So it names planes that stand
elsewhere than stated, or in another order, although labels with the wrong names of dots may fit.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from lfpiv.calibration.board.dots import BoardDots
from lfpiv.errors import InputError
from lfpiv.experiment.experiment import CameraSetup, Experiment

APART = 10.0
"""Difference of the defocus of two planes that shows their order [scatter over the dots of a plane]."""
FEWEST_ORDERED = 3
"""Least number of planes that have an order; that of two is reversed, which is told elsewhere."""
FEWEST_DOTS = 6
"""Number of dots of a plane up to which its defocus is not looked at."""
FITS = 0.25
"""Depths fit the focus of the planes if they differ by less, root mean square [median distance of planes]."""
CLEARLY = 0.5
"""Largest misfit of the depths with a mistake put right, relative to the depths as stated."""
NARROWEST, WIDEST = 0.4, 1.4
"""Distance of planes by their focus over the stated one, where optics and medium differ from what is stated: water has
0.75, and 0.57 at an angle."""
UNITS = (0.001, 0.0254, 10.0, 25.4, 1000.0)
"""Millimetres of a micrometre, a thousandth of an inch, a centimetre, an inch and a metre."""
SAME_UNIT = 1.2
"""Largest ratio of the planes' distance by their focus to that in a unit, or the inverse."""


@dataclass(frozen=True, eq=False)
class PlaneFocus:
    """Focus of the planes that show enough dots."""

    number: np.ndarray
    """Numbers of the planes, shape (p,)."""
    seen: np.ndarray
    """Number of dots of each plane, shape (p,)."""
    defocus: np.ndarray
    """Slope of the rays over the pupil in the middle of the field, shape (p,)."""
    scatter: float
    """Median over the planes of the scatter of the slopes of a plane's dots."""

    @classmethod
    def from_dots(cls, experiment: Experiment, dots: BoardDots) -> PlaneFocus:
        """Fit the slope of each plane's dots, linear over the field."""
        plane = dots.measured_dot // math.prod(experiment.board.dots)
        slope = np.trace(dots.slope, axis1=1, axis2=2) / 2
        shown, seen, defocus, scatter = [], [], [], []
        for number in np.unique(plane):
            here = plane == number
            if np.count_nonzero(here) > FEWEST_DOTS:
                seen.append(int(np.count_nonzero(here)))
                field = np.column_stack([np.ones(seen[-1]), dots.chief_mm[here]])
                fitted = np.linalg.lstsq(field, slope[here])[0]
                shown.append(int(number))
                defocus.append(float(fitted[0]))
                scatter.append(float(np.std(slope[here] - field @ fitted)))
        typical = float(np.median(scatter)) if scatter else 0.0
        return cls(np.array(shown, int), np.array(seen, int), np.array(defocus), typical)

    def joined(self, other: PlaneFocus) -> PlaneFocus:
        """Return the focus of each plane by the search for dots that found more in it."""
        both = [np.concatenate(pair) for pair in zip(self._columns, other._columns, strict=True)]
        order = np.lexsort((-both[1], both[0]))
        number, seen, defocus = (column[order] for column in both)
        number, first = np.unique(number, return_index=True)
        return PlaneFocus(number, seen[first], defocus[first], max(self.scatter, other.scatter))

    @property
    def _columns(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.number, self.seen, self.defocus

    def depth_mm(self, setup: CameraSetup) -> np.ndarray:
        """Return the depth z at which a camera of the stated optics has the focus of each plane [mm], shape (p,)."""
        optics, orientation = setup.optics, setup.orientation
        assert orientation is not None
        near = abs(optics.magnification) + self.defocus
        return optics.object_distance_mm * (self.defocus / near) * float(orientation.rotation[2, 2])


def check_depths(experiment: Experiment, setup: CameraSetup, dots: BoardDots) -> None:
    """Refuse planes in each other's place, and depths in another unit, as the focus shows them.

    A single plane elsewhere is not refused here. Its dots do not fit the others, and are left out with a warning.

    Raises
    ------
    InputError
        Names the planes and their files.
    """
    if text := mistaken_depths(experiment, setup, dots, single=False):
        raise InputError(text)


def mistaken_depths(
    experiment: Experiment,
    setup: CameraSetup,
    dots: BoardDots,
    otherwise: BoardDots | None = None,
    *,
    single: bool = True,
) -> str | None:
    """Name two planes in each other's place, one elsewhere, or another unit, as a message; None if none is certain.

    The reverse of the whole order is named elsewhere. A camera without an orientation is not judged. `otherwise` are
    dots that were looked for at other depths. `single` says whether one plane elsewhere is named.
    """
    if setup.orientation is None:
        return None
    focus = PlaneFocus.from_dots(experiment, dots)
    if otherwise is not None:
        focus = focus.joined(PlaneFocus.from_dots(experiment, otherwise))
    if len(focus.number) < FEWEST_ORDERED:
        return None
    stated, seen = np.asarray(experiment.board.planes_mm)[focus.number], focus.depth_mm(setup)
    before = _misfit(stated, seen)
    if before < FITS or _misfit(stated, -seen) < FITS:
        return None
    ratio = _line(stated, seen)[1]
    for unit in UNITS:
        if max(ratio / unit, unit / ratio) < SAME_UNIT and _misfit(unit * stated, seen) < FITS:
            depths = ", ".join(f"{unit * z:.4g}" for z in experiment.board.planes_mm)
            return (
                f"{experiment.path}: board.planes_mm: the dots come into focus as if the planes were {unit:g} times as "
                f"far apart as stated. Check the unit, which is the millimetre; planes_mm = [{depths}] would fit."
            )
    found = min(_mistakes(stated, seen), key=lambda one: one.misfit)
    if not found.misfit < min(FITS, CLEARLY * before) or (len(found.planes) == 1 and not single):
        return None
    text = found.text(focus.number, experiment.board.planes_mm)
    return f"{_images(experiment, setup, focus.number[list(found.planes)])}: {text}"


def _images(experiment: Experiment, setup: CameraSetup, planes: Iterable[int]) -> str:
    """Name a camera's images of some planes, as messages begin."""
    files = ", ".join(str(experiment.board_path(setup.name, int(plane))) for plane in planes)
    return f"{files}: board.images of camera {setup.name!r}"


def reversed_order(experiment: Experiment, setup: CameraSetup, dots: BoardDots) -> str | None:
    """Say which planes come into focus in the reverse order of their depths; None if they do not.

    A camera without an orientation is not judged.
    """
    focus = PlaneFocus.from_dots(experiment, dots)
    if len(focus.number) < 2 or setup.orientation is None:
        return None
    order = np.argsort(np.asarray(experiment.board.planes_mm)[focus.number])
    if not (np.diff(focus.depth_mm(setup)[order]) < 0).all():
        return None
    names = [str(number) for number in focus.number]
    return (
        f"{_images(experiment, setup, focus.number)}: planes {', '.join(names[:-1])} and {names[-1]} come into "
        "focus in the reverse order of their depths in board.planes_mm. Are their images exchanged?"
    )


def check_order(experiment: Experiment, setup: CameraSetup, dots: BoardDots) -> None:
    """Refuse board images whose dots come into focus in another order than that of the stated planes.

    In the middle of the field the defocus grows, or falls, from plane to plane. The reverse of the whole order is named
    elsewhere.

    Raises
    ------
    InputError
        Names the planes and their files.
    """
    focus = PlaneFocus.from_dots(experiment, dots)
    shown, defocus = focus.number, focus.defocus
    if len(shown) < FEWEST_ORDERED:
        return
    stated = np.argsort(np.asarray(experiment.board.planes_mm)[shown])
    steps = np.subtract.outer(defocus, defocus).T[np.ix_(stated, stated)][np.triu_indices(len(shown), 1)]
    growing, falling = (np.count_nonzero(sign * steps > APART * focus.scatter) for sign in (1, -1))
    if min(growing, falling) == 0:
        return
    if text := mistaken_depths(experiment, setup, dots):
        raise InputError(text)
    seen = np.argsort(defocus if growing > falling else -defocus)
    displaced = sorted(map(int, shown[stated[stated != seen]]))
    raise InputError(
        f"{_images(experiment, setup, displaced)}: expected dots that come into focus in the order of "
        f"board.planes_mm, found planes {', '.join(map(str, displaced))} in another order. Are their images exchanged, "
        "or is a depth in board.planes_mm mistyped?"
    )


@dataclass(frozen=True)
class _Mistake:
    """A mistake with the planes, by their places among those that show dots."""

    misfit: float
    """Distance of the depths with the mistake put right from the focus [median distance of planes]."""
    planes: tuple[int, ...]
    """Two planes in each other's place, or one that stands elsewhere."""
    depth_mm: float = 0.0
    """Where the one stands [mm]."""

    def text(self, numbers: np.ndarray, planes_mm: tuple[float, ...]) -> str:
        """Say what was found and what to do."""
        if len(self.planes) == 2:
            one, other = (int(numbers[place]) for place in self.planes)
            return (
                f"planes {one} and {other} come into focus in each other's place. Exchange their images or, if every "
                "camera shows it, their depths in board.planes_mm."
            )
        number = int(numbers[self.planes[0]])
        return (
            f"plane {number} comes into focus as if it stood at about z = {self.depth_mm:.2f} mm, not at "
            f"{planes_mm[number]:g} mm, unlike the other planes whose dots are seen. Correct its depth in "
            "board.planes_mm, or its image if that shows another plane."
        )


def _mistakes(stated: np.ndarray, seen: np.ndarray) -> Iterator[_Mistake]:
    """Return each exchange of two planes, and each plane alone that may stand elsewhere, with their misfits."""
    count = len(stated)
    for one, other in combinations(range(count), 2):
        exchanged = stated.copy()
        exchanged[[one, other]] = stated[[other, one]]
        yield _Mistake(_misfit(exchanged, seen), (one, other))
    for one in range(count):
        others = np.arange(count) != one
        start, ratio = _line(stated[others], seen[others])
        yield _Mistake(_misfit(stated[others], seen[others]), (one,), float((seen[one] - start) / ratio))


def _line(stated: np.ndarray, seen: np.ndarray) -> tuple[float, float]:
    """Return start and ratio of depths by focus over the stated ones. Two planes tell no ratio: it is 1 then."""
    if len(stated) < FEWEST_ORDERED:
        return float(np.mean(seen - stated)), 1.0
    ratio, start = np.polyfit(stated, seen, 1)
    return float(start), float(ratio)


def _misfit(stated: np.ndarray, seen: np.ndarray) -> float:
    """Return the distance of depths by focus from the stated ones, root mean square [median distance of planes].

    It is infinite where their distances differ by more than optics or a medium explain.
    """
    start, ratio = _line(stated, seen)
    if not NARROWEST < ratio < WIDEST:
        return np.inf
    rest = (seen - start) / ratio - stated
    free = len(stated) - (2 if len(stated) >= FEWEST_ORDERED else 1)
    spacing = float(np.median(np.diff(np.sort(stated))))
    return float(np.sqrt((rest**2).sum() / free)) / spacing

"""Belonging: whether the images of a frame show the same particles, and which mistake explains that they do not.

A volume that explains the images of all cameras exists only if they show the same particles. So the light that a few
iterations of SMART leave unexplained is compared with what they leave by chance: with the image that one camera took of
other particles, or, without such an image, with its image turned by half a turn. The images without likely mistakes,
such as exchanged frames or mirrored images, are tried alike. Differences are measured in parts of the sensors, which
gives their standard error. Particles that hardly move between frames fit in either order.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from lfpiv.reconstruction.settings import AUTO, PLAIN, SmartSettings
from lfpiv.reconstruction.solver import SmartSolver
from lfpiv.selfcalibration.mistakes import (
    IN_TIME,
    RIGHT,
    Images,
    Kind,
    Mistake,
    Shown,
    likely_mistakes,
    other_mistakes,
)
from lfpiv.weights.operator import Weights

ITERATIONS = 4
"""SMART iterations of a set of images: two over ordered subsets, two over all rays."""
PART_LENSES = 3.0
"""Edge of the parts of a sensor [microlens pitch]: the light of a particle hardly reaches farther."""
TURN_LENSES = 3
"""Distance from the sensor's centre of the points about which images may be turned [microlens pitch]."""
CLEAR = 4.0
"""Least advantage of images that fit over those of other particles, and of images without a mistake that is named over
those with it [standard errors]."""
SURE = 2.0
"""Disadvantage of all mistakes tried from which the images count as right without further trials [standard errors]."""


class ImageFit:
    """Light of images that no volume explains, in parts of the sensors.

    Parameters
    ----------
    weights : Weights
        The operator of two or more cameras.
    """

    def __init__(self, weights: Weights):
        self.weights = weights
        self._solver = SmartSolver(weights, SmartSettings(iterations=ITERATIONS, **PLAIN | {"subsets": AUTO}))
        self._parts = {name: self._parts_of(name) for name in weights.cameras}
        self.camera_of_part = np.concatenate([np.full(parts[2], name) for name, parts in self._parts.items()])
        """Camera of each part that `unexplained` returns."""

    def unexplained(self, images: Images, turn: str | None = None) -> np.ndarray:
        """Return the unexplained light of each part of each sensor, over all light of the camera, shape (part,).

        `turn` names a camera whose image is turned by half a turn. The light is the squared difference of the roots of
        image and projection, which photon noise makes equally uncertain everywhere.
        """
        if turn is not None:
            images = {**images, turn: self._turned(turn, images[turn])}
        prepared = self._solver.prepare(images)
        projected = self.weights(prepared.solve().volume)
        found = []
        for name, prepared_image in prepared.images.items():
            pixels, part, count = self._parts[name]
            floor, image = np.float32(prepared_image.floor), prepared_image.image[pixels]
            expected = np.float32(prepared_image.camera_gain) * projected[name].ravel()[pixels]
            left = (np.sqrt(image + floor) - np.sqrt(expected + floor)) ** 2
            found.append(np.bincount(part, left, count) / max(float(image.sum(dtype=float)), 1e-30))
        return np.concatenate(found)

    def _turned(self, name: str, image: np.ndarray) -> np.ndarray:
        """Turn an image by half a turn about a point where the microlens array is symmetric."""
        optics, lattice = self.weights.cameras[name].optics, self.weights.cameras[name].lattice
        around = np.stack(np.meshgrid(*[np.arange(-TURN_LENSES, TURN_LENSES + 1)] * 2), -1).reshape(-1, 2)
        sums = np.asarray(lattice.origin_mm) + lattice.centres_mm(around)
        shift = sums * (1 + optics.sensor_per_pupil) / optics.pixel_mm
        column, row = shift[np.abs(shift - np.rint(shift)).sum(1).argmin()]
        return np.roll(image[::-1, ::-1], (round(row), round(column)), (0, 1))

    def _parts_of(self, name: str) -> tuple[np.ndarray, np.ndarray, int]:
        """Return the lit pixels of a camera, the number of the part that each is in, and the number of parts."""
        pixels = self.weights.projector(name).map.pixel
        pixels = np.unique(pixels[self.weights.gain(name).ravel()[pixels] > 0])
        optics = self.weights.cameras[name].optics
        edge = PART_LENSES * optics.microimage_pitch_px
        row, column = (np.asarray(index / edge, int) for index in np.divmod(pixels, optics.sensor_shape[1]))
        _, part = np.unique(row * (1 + int(column.max())) + column, return_inverse=True)
        return pixels, part, int(part.max()) + 1


def advantage(one: Sequence[np.ndarray], other: Sequence[np.ndarray]) -> float:
    """Return how clearly one set of images leaves less light unexplained than another one [standard errors].

    Under chance the differences of all parts have either sign. Frames that only one set has do not count.
    """
    return in_errors([b - a for a, b in zip(one, other, strict=False)])


def in_errors(differences: Sequence[np.ndarray]) -> float:
    """Return the sum of differences over its standard error under chance."""
    difference = np.concatenate(differences)
    scatter = float(np.sqrt(difference @ difference))
    return float(difference.sum()) / scatter if scatter > 0 else 0.0


@dataclass(frozen=True)
class Judgement:
    """What was found about the images of some pairs."""

    left: Mapping[Mistake, Sequence[np.ndarray]]
    """Mistake -> light that is unexplained without it, of each frame that was tried."""
    chance: Sequence[Mistake]
    """What replaces an image by one of other particles."""
    camera_of_part: np.ndarray
    """Camera of each part of the sensors, shape (part,)."""
    turned: Mapping[Mistake, Sequence[np.ndarray]] = field(default_factory=dict)
    """Mistake -> light that is unexplained without it and with an image turned, of the likeliest mistake."""
    apart: int = 1
    """Least distance at which pairs, or instants, show other particles."""

    def margin(self, mistake: Mistake) -> float:
        """Return the advantage of the images as they are over those without a mistake [standard errors]."""
        return advantage(self.left[RIGHT], self.left[mistake])

    @property
    def tried(self) -> list[Mistake]:
        """The mistakes that were tried, the likeliest first."""
        return sorted((one for one in self.left if one.named), key=self.margin)

    @property
    def mistakes(self) -> tuple[Mistake, ...]:
        """The mistake that was clearly made, with others that explain the images as well; empty for none."""
        clear = [one for one in self.tried if self.margin(one) < -CLEAR]
        if not clear or not self._beats_chance(clear[0]):
            return ()
        return tuple(one for one in clear if self.as_good(clear[0], one))

    def _beats_chance(self, best: Mistake) -> bool:
        """Return whether images without a mistake fit clearly better than those of other particles.

        Images that do not fit differ by more than their standard errors, since what a particle leaves reaches over
        several parts. So the spread of their light counts, too. If a camera is late by pairs, the images as they are
        show other particles as well. Turned images leave more light than those of other particles, so they are the last
        resort.
        """
        chance = [one for one in self.chance if one not in self._partners and not self._alike(one, best)]
        others = [self.left[one] for one in chance if one in self.left]
        others += [self.left[RIGHT]] if best.kind is Kind.LATE else []
        others = others or ([self.turned[best]] if best in self.turned else [])
        if not others:
            return False
        count = min(len(frames) for frames in (*others, self.left[best]))
        level, *levels = (sum(float(one.sum()) for one in frames[:count]) for frames in (self.left[best], *others))
        clear = all(advantage(self.left[best], frames) > CLEAR for frames in others)
        return clear and level < 2 * min(levels) - max(levels)

    def _alike(self, one: Mistake, other: Mistake) -> bool:
        """Return whether two mistakes put images of the same particles into a camera."""
        if one == other:
            return True
        images = {Kind.LATE: 2, Kind.SHIFTED: 1}  # single images of a step
        if one.cameras != other.cameras or one.kind not in images or other.kind not in images:
            return False
        return abs(images[one.kind] * one.late - images[other.kind] * other.late) < 2 * self.apart

    @property
    def fits(self) -> bool:
        """Whether the images fit clearly better than by chance, than images of other cameras, and than mirrored images.

        Each frame beats chance, too. The order of frames does not count, since particles that hardly move fit in either
        order.
        """
        if min((in_errors([frame]) for frames in self._over_chance for frame in frames), default=SURE) < SURE:
            return False
        wrong = [one for one in self.tried if one.kind not in IN_TIME]
        return not self.mistakes and self.over_chance > CLEAR and all(self.margin(one) > SURE for one in wrong)

    @property
    def in_order(self) -> bool:
        """Whether the images also fit clearly better than those of other frames."""
        return self.fits and all(self.margin(one) > SURE for one in self.tried)

    @property
    def doubted(self) -> tuple[Mistake, ...]:
        """Exchanged frames that would fit better than the order as it is, the likeliest first, with others as likely.

        Images that fit beat chance, so their order alone is in doubt.
        """
        order = [one for one in self.tried if one.kind is Kind.FRAMES and self.margin(one) < -SURE]
        if not self.fits or not order:
            return ()
        return tuple(one for one in order if self.as_good(order[0], one))

    @property
    def over_chance(self) -> float:
        """Return the least advantage of the images as they are over those of other particles [standard errors]."""
        return min((in_errors(frames) for frames in self._over_chance), default=0.0)

    @property
    def _partners(self) -> list[Mistake]:
        """What replaces the image of the second of two cameras."""
        return [one for one in self.chance if one.kind is Kind.OTHER]

    @property
    def _over_chance(self) -> list[list[np.ndarray]]:
        """Return how much more light images of other particles leave unexplained beside the images, of each frame.

        An image may be explained better than another one whatever is beside it. So an image that is replaced by another
        one does not count: the others do, with it and without it. Of two cameras each is replaced in turn.
        """
        found = []
        for one in self.chance:
            if one.kind is Kind.OTHER or one not in self.left:
                continue
            beside = [one, *(other for other in self._partners if other.late == one.late and other in self.left)]
            each = [self._beside(replaced) for replaced in beside]
            found.append([np.concatenate(frames) for frames in zip(*each, strict=False)])
        return found

    def _beside(self, one: Mistake) -> list[np.ndarray]:
        counts = np.full(self.camera_of_part.shape, True)
        if one.kind is not Kind.CHANCE:  # a turned image is no other one
            counts = self.camera_of_part != one.cameras[0]
        return [(b - a)[counts] for a, b in zip(self.left[RIGHT], self.left[one], strict=False)]

    def as_good(self, mistake: Mistake, rival: Mistake) -> bool:
        """Return whether images without `rival` fit as well as images without `mistake`, or better."""
        return advantage(self.left[mistake], self.left[rival]) < SURE

    def joined(self, other: Judgement) -> Judgement:
        """Return the judgement by the frames of both, about the mistakes that were tried in both."""

        def both(
            mine: Mapping[Mistake, Sequence[np.ndarray]], others: Mapping[Mistake, Sequence[np.ndarray]]
        ) -> dict[Mistake, list[np.ndarray]]:
            return {one: [*mine[one], *others[one]] for one in mine if one in others}

        left = both(self.left, other.left)
        chance = [one for one in self.chance if one in left]
        return Judgement(left, chance, self.camera_of_part, both(self.turned, other.turned), self.apart)


def judge(
    fit: ImageFit,
    shown: Shown,
    pair: int,
    others: Sequence[int],
    near: Sequence[int],
    *,
    images: Sequence[int] = (),
    thorough: bool = False,
) -> Judgement:
    """Judge the images of a pair.

    The first frame and the likely mistakes are tried first, and chance in the second frame of a pair. Where only the
    order of frames is in doubt, it is tried in the second frame, too. Other doubts are followed by all
    mistakes and both frames.

    Parameters
    ----------
    fit : ImageFit
    shown : callable
        Returns images.
    pair : int
        Number of the pair.
    others, near : sequence of int
        Distances of pairs that show other particles, the one to compare with first, and of others that may be mistaken
        for the pair.
    images : sequence of int
        Single images by which a camera may be late.
    thorough : bool
        Try all mistakes in any case.

    Raises
    ------
    ValueError
        If the images of the pair cannot be reconstructed.
    """
    trials = _Trials(fit, shown, pair, others)
    cameras = list(fit.weights.cameras)
    likely = [RIGHT, *trials.chance[: len(cameras)], *likely_mistakes(cameras)]
    found = trials.judged(likely, 1)
    if not thorough and (settled := trials.settled(found, single_images=bool(images))) is not None:
        return settled
    found = trials.judged([*likely, *trials.chance, *other_mistakes(cameras, near, images)], trials.frames)
    likeliest = found.tried[0]
    if found.margin(likeliest) > -SURE:
        return found
    return replace(found, turned={likeliest: trials.turned(likeliest)})


class _Trials:
    """Trials of mistakes with the images of a pair; arguments as of `judge`."""

    def __init__(self, fit: ImageFit, shown: Shown, pair: int, others: Sequence[int]):
        self._fit, self._shown, self._pair = fit, shown, pair
        self._left: dict[Mistake, list[np.ndarray]] = {}
        self._apart = min((abs(number) for number in others), default=1)
        cameras = list(fit.weights.cameras)
        late = [number for number in others if shown(pair + number, 0) is not None]
        kinds = dict.fromkeys(cameras, Kind.LATE) | ({cameras[1]: Kind.OTHER} if len(cameras) == 2 else {})
        of_other_pairs = [Mistake(kind, (name,), number) for number in late for name, kind in kinds.items()]
        self.chance = of_other_pairs or [Mistake(Kind.CHANCE, (name,)) for name in cameras]
        """What replaces an image by one of other particles."""

    @cached_property
    def frames(self) -> int:
        """Number of frames to try: one if both are copies of each other, since the second one tells nothing."""
        first, second = (self._shown(self._pair, frame) or {} for frame in (0, 1))
        copied = first.keys() == second.keys() and all(np.array_equal(first[name], second[name]) for name in first)
        return 1 if copied else 2

    def judged(self, mistakes: Iterable[Mistake], count: int) -> Judgement:
        """Try mistakes with the first `count` frames; return the judgement by all trials so far."""
        for frame in range(count):
            for one in mistakes:
                left = self._left.setdefault(one, [])
                if len(left) == frame and (right := one.undone(self._shown, self._pair, frame)) is not None:
                    left.append(self._fit.unexplained(right, one.cameras[0] if one.kind is Kind.CHANCE else None))
        known = {one: left for one, left in self._left.items() if left}
        chance = [one for one in self.chance if one in known]
        return Judgement(known, chance, self._fit.camera_of_part, apart=self._apart)

    def settled(self, found: Judgement, single_images: bool) -> Judgement | None:
        """Return the judgement if the images fit and at most the order of frames is in doubt, otherwise None.

        `found` is the judgement by the first frame. `single_images`: a camera may be late by single images.
        """
        if found.in_order and not single_images:
            return found
        if found.in_order:
            beside = [one for one in self.chance if one.late == self.chance[0].late or not one.late]
            found = self.judged([RIGHT, *beside[:2]], self.frames)  # no other pair has this second frame
            return found if found.fits else None
        if not found.fits:
            return None
        order = [one for one in self._left if one.kind is Kind.FRAMES]
        found = self.judged([RIGHT, *order], self.frames)
        each = [[self._left[one][at : at + 1] for one in (RIGHT, *order)] for at in range(self.frames)]
        least = min(advantage(right, exchanged) for right, *others in each for exchanged in others)
        return found if found.fits and least > -SURE else None

    def turned(self, mistake: Mistake) -> list[np.ndarray]:
        """Return the light that is unexplained without a mistake and with the image of its camera turned."""
        frames = (mistake.undone(self._shown, self._pair, frame) for frame in (0, 1))
        return [self._fit.unexplained(images, mistake.cameras[0]) for images in frames if images is not None]

"""Check that the images of all cameras belong together, by the first pairs of a run, and refuse what does not.

Images that a mistake brought together give volumes, and vectors that agree with their neighbours. `check` looks for the
mistake before any pair is reconstructed. Its refusals go with the pairs, whose vectors are then not valid.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import chain, islice
from typing import TYPE_CHECKING

from lfpiv.lightfield.frame_comparison import dark_blocks
from lfpiv.reconstruction.image_preparation import DIMMEST
from lfpiv.runs import moved_cameras
from lfpiv.runs.moved_cameras import CameraDisparity, ShownParticles
from lfpiv.runs.other_pairing import refusals_of_all
from lfpiv.selfcalibration import dark_parts
from lfpiv.selfcalibration.belonging import CLEAR, SURE, ImageFit, Judgement, judge
from lfpiv.selfcalibration.disparity import SEARCH_VOXEL, CameraVolumes
from lfpiv.selfcalibration.frame_order import exchanged, own_motion
from lfpiv.selfcalibration.mistakes import FLIPS, IN_TIME, Images, Kind, Mistake
from lfpiv.warn import Code, Warning, name_pairs, warn

if TYPE_CHECKING:
    from lfpiv.experiment.experiment import Experiment
    from lfpiv.weights.operator import Weights

log = logging.getLogger(__name__)

TRIED = 3
"""Largest number of pairs that are judged. One is enough if its images fit each other clearly."""
LEAST_FOR_NOTHING = 2
"""Least number of pairs without common particles that a refusal of them needs."""
UNLIKE_SCALES = 8.0
"""Ratio of the cameras' counts from which on the log states it: scattering angles and apertures hardly make more."""
EXCHANGED = (128.0, 512.0)
"""Ratios of the cameras' counts that exchanged bytes of dim images, or 8 bits, make: 256 times the right ratio."""
NEIGHBOURS = (1, -1, 2, -2)
"""Pairs, or instants, by which a camera may be late."""
FARTHEST = 10
"""Largest such distance that is tried where no pair fits and no other mistake explains it."""


@dataclass(frozen=True, kw_only=True)
class Agreement:
    """What a run knows of its cameras: whether their images belong together, and how far apart they show particles."""

    sentence: str
    """What was found, or why nothing was, for people."""
    disparity: CameraDisparity | None = None
    refusals: tuple[Warning, ...] = ()
    """Why vectors are not valid, each with its pairs; without pairs it concerns all of them."""


def check(experiment: Experiment, weights: Weights, pairs: Iterable[int]) -> Agreement:
    """Judge the images of some pairs, `pairs` first, and measure how far apart the cameras show the same particles.

    The log says what was found; warnings are raised where a camera moved. Refusals go with the result.
    """
    names = list(weights.cameras)
    if len(names) < 2:
        return _told("one camera: its images cannot be compared with those of another")
    first, others = list(pairs), experiment.spread_pairs(TRIED)
    order = chain(first[:1], others[1:], first, experiment.numbers)
    tried = list(islice(experiment.disjoint(dict.fromkeys(order)), TRIED))
    shown = ShownParticles(experiment, weights.cameras, tried)
    as_judged = shown if len(tried) > 1 else replace(shown, pairs=())  # one pair does not tell what stands still
    judged = _judge(as_judged, tried, weights)
    scales = _scales_apart(shown.counts(next(iter(judged)))) if judged else None
    refusals = mistakes_of_pairs(experiment, names, judged)
    if not refusals and judged and not any(one.fits for one in judged.values()):
        refusals = _far_delay(experiment, names, as_judged, weights, list(judged))
    if not refusals and not any(one.in_order for one in judged.values()):
        refusals = _opposite_motion(experiment, as_judged, weights, tried)
    refusals = refusals or refusals_of_all(shown, tried)
    if refusals:
        refusals = refusals if scales is None else [scales]  # such images do not tell what else is wrong
        return _told(
            "; ".join(dict.fromkeys(str(one.figures["found"]) for one in refusals)),
            refusals=tuple(refusals),
            level=logging.WARNING,
        )
    for warning in _dark_warnings(weights, _light(shown, dict.fromkeys((*judged, *tried)))):
        warn(log, warning)
    found = moved_cameras.check(shown, weights, in_time=any(one.in_order for one in judged.values()))
    cameras, used = " and ".join(names), name_pairs(list(judged), experiment.noun)
    if isinstance(found, CameraDisparity):
        return _told(_agreement(cameras, experiment, found) + not_told(names, judged), disparity=found)
    if any(one.fits for one in judged.values()):
        return _told(
            f"{cameras} show the same particles in {used}, how far apart cannot be told{not_told(names, judged)}"
        )
    if len(found) >= LEAST_FOR_NOTHING:
        text = f"{cameras} show no particles in common"
        figures = {"names": cameras, "search": SEARCH_VOXEL, "found": text}
        nothing = Warning(code=Code.NOTHING_IN_COMMON, figures=figures)
        return _told(text, refusals=(nothing,), level=logging.WARNING)
    why = f" from {used}: too few particles, too many, or too much noise" if used else ": no images show particles"
    return _told(f"whether {cameras} show the same particles cannot be told{why}")


def refusals_of(shown: ShownParticles, fit: ImageFit, pair: int) -> list[Warning]:
    """Judge a pair that explains its images worse than others do; return why it is refused, empty if it is not."""
    experiment, names = shown.experiment, list(shown.cameras)
    try:
        light = shown.pair(pair)
        found = _judgement(shown, fit, pair, thorough=True)
    except ValueError as error:  # its images were there before
        log.debug("images of %s are not compared: %s", experiment.name_of(pair), error)
        return []
    if found.mistakes:
        return [_numbered(experiment, refusal(experiment, names, found.mistakes), pair)]
    if found.fits or found.over_chance > SURE or not moved_cameras.all_show_particles(light, shown.cameras):
        return []
    figures = {"found": f"{' and '.join(names)} show different particles", "remedy": "Check the images of this pair"}
    return [_numbered(experiment, Warning(code=Code.MISMATCHED, figures=figures), pair)]


def _light(shown: ShownParticles, pairs: Iterable[int]) -> Iterator[Sequence[Images]]:
    """Yield the images of both frames of the pairs that can be used."""
    for pair in pairs:
        with contextlib.suppress(ValueError):  # a pair that cannot be used fails when it is reconstructed
            yield shown.pair(pair)


def _dark_warnings(weights: Weights, pairs: Iterable[Sequence[Images]]) -> list[Warning]:
    """Return the warnings about parts of sensors that show no particles although other cameras do."""
    return [
        Warning(
            code=Code.DARK_PART,
            subject=part.camera,
            figures={
                **dict(zip(("top", "bottom", "left", "right"), (*part.rows, *part.columns), strict=True)),
                "others": " and ".join(name for name in weights.cameras if name != part.camera),
            },
        )
        for part in dark_parts.find(weights, pairs)
    ]


def _scales_apart(light: Mapping[str, float]) -> Warning | None:
    """Log how far the counts of the cameras differ, if it is much. Return why vectors depend on it, if they do.

    A ratio of up to 1 / `DIMMEST` is divided out.
    """
    bright, dim = max(light, key=light.__getitem__), min(light, key=light.__getitem__)
    if light[dim] <= 0 or (ratio := light[bright] / light[dim]) < UNLIKE_SCALES:
        return None
    text = f"the images of {bright} have {ratio:.0f} times the counts of {dim}"
    if ratio * DIMMEST < 1:
        log.info("cameras: %s; the scale of each camera is divided out", text)
        return None
    text += ", more than can be divided out"
    remedy = "store the images of both on one scale"
    if EXCHANGED[0] < ratio < EXCHANGED[1]:
        remedy = f"look at the order of the bytes of {bright}, and whether its counts are shifted by 8 bits: either "
        remedy += "makes some 256 times the counts"
    log.warning("cameras: %s: %s", text, remedy)
    return Warning(code=Code.MISMATCHED, figures={"found": text, "remedy": remedy[0].upper() + remedy[1:]})


def _told(sentence: str, level: int = logging.INFO, **found: object) -> Agreement:
    agreement = Agreement(sentence=sentence, **found)  # type: ignore[arg-type]
    log.log(level, "cameras: %s", sentence)
    return agreement


def _agreement(cameras: str, experiment: Experiment, found: CameraDisparity) -> str:
    """Return how well cameras agree, for people."""
    used = name_pairs(found.pairs, experiment.noun)
    if found.voxel > found.std_voxel:
        text = f"{cameras} show the particles of {used} {found.voxel:.2f} voxel apart, with a standard error of "
        text += f"{found.std_voxel:.2f}"
    else:
        text = f"{cameras} show the particles of {used} at the same places, within {found.std_voxel:.2f} voxel"
    return text


def not_told(names: Sequence[str], judged: Mapping[int, Judgement]) -> str:
    """Return what the images of the judged pairs do not tell, or put in doubt, for people; empty if they tell all."""
    if any(one.in_order for one in judged.values()):
        return ""
    if not any(one.fits for one in judged.values()):
        return "; they do not tell whether images are exchanged, mirrored or late"
    doubted = [made for one in judged.values() if (made := one.doubted)]
    if len(doubted) < len(judged):
        return "; they do not tell the order of frames"
    named = dict.fromkeys(name for made in doubted for one in made for name in one.cameras)
    either = " or ".join(names if len(names) == 2 else named)
    return f"; the frames of {either} would fit better if they were exchanged: check the order of its images"


def _judge(shown: ShownParticles, pairs: Sequence[int], weights: Weights) -> dict[int, Judgement]:
    """Judge pairs until the images of one fit each other."""
    fit, judged = ImageFit(weights), dict[int, Judgement]()
    for pair in pairs:
        try:
            judged[pair] = _judgement(shown, fit, pair)
        except ValueError as error:  # a pair that cannot be used fails when it is reconstructed
            log.debug("images of %s are not compared: %s", shown.experiment.name_of(pair), error)
            continue
        if judged[pair].fits and not judged[pair].doubted:
            break
    return judged


def _judgement(shown: ShownParticles, fit: ImageFit, pair: int, *, thorough: bool = False) -> Judgement:
    """Judge a pair; raise ValueError if its images cannot be used.

    A frame that is dark in part fits no other camera. So the other frame alone may show that images belong together.
    """
    light, experiment = shown.pair(pair), shown.experiment
    shifts, images = _shifts(experiment, pair), _images(experiment)
    found = judge(fit, shown, pair, *shifts, images=images, thorough=thorough)
    if found.fits or not any(dark_blocks(*(frame[name] for frame in light)) for name in shown.cameras):
        return found
    for whole in (0, 1):

        def repeated(number: int, frame: int, whole: int = whole) -> Images | None:
            return shown(number, whole if number == pair else frame)

        alone = judge(fit, repeated, pair, *shifts, images=images, thorough=thorough)
        if not alone.mistakes and alone.over_chance > SURE:
            return alone
    return found


def _shifts(experiment: Experiment, pair: int) -> tuple[Sequence[int], Sequence[int]]:
    """Return the distances of pairs with other particles, and of those that may be mistaken for a pair.

    Instants of a series show the particles of their neighbours; half a series away there are others.
    """
    near = [late for late in NEIGHBOURS if pair + late in experiment.numbers]
    if not experiment.recording.is_series:
        return near, []
    half = experiment.pairs // 2
    return [late for late in (half, -half) if half > 2 and pair + late in experiment.numbers], near


def _images(experiment: Experiment) -> Sequence[int]:
    """Return the single images by which a camera may be late; in a series these are instants."""
    return () if experiment.recording.is_series else (1, -1)


def mistakes_of_pairs(experiment: Experiment, names: Sequence[str], judged: Mapping[int, Judgement]) -> list[Warning]:
    """Return the refusals of pairs by mistakes that were clearly made.

    If the images of no judged pair fit, a mistake that explains half of them or more was made in all pairs of the run.
    """
    each = {pair: one.mistakes for pair, one in judged.items() if one.mistakes}
    if judged and all(one.doubted for one in judged.values()):
        together = reduce(Judgement.joined, judged.values())
        order = [one for one in together.tried if one.kind is Kind.FRAMES]
        if clear := [one for one in order if together.margin(one) < -CLEAR and together.as_good(order[0], one)]:
            return [refusal(experiment, names, clear)]
    if judged and not any(one.fits for one in judged.values()):
        if made := shared_mistakes(list(judged.values())):
            return [refusal(experiment, names, made)]
        if 2 * len(each) < len(judged):
            return []
    return [_numbered(experiment, refusal(experiment, names, made), pair) for pair, made in each.items()]


def _far_delay(
    experiment: Experiment, names: Sequence[str], shown: ShownParticles, weights: Weights, pairs: Sequence[int]
) -> list[Warning]:
    """Return the refusal of all pairs if a camera is late or early by more pairs than are usually tried."""
    fit, far = ImageFit(weights), [late for late in range(-FARTHEST, FARTHEST + 1) if abs(late) > max(NEIGHBOURS)]
    for pair in pairs:
        recorded = [late for late in far if pair + late in experiment.numbers]
        if not recorded:
            continue
        found = judge(fit, shown, pair, _shifts(experiment, pair)[0], recorded)
        if found.mistakes and found.mistakes[0].kind is Kind.LATE:
            return [refusal(experiment, names, found.mistakes)]
    return []


def _opposite_motion(
    experiment: Experiment, shown: ShownParticles, weights: Weights, pairs: Iterable[int]
) -> list[Warning]:
    """Return the refusal of all pairs if particles move in opposite directions in two cameras."""
    motions = []
    for light in _light(shown, pairs):
        volumes = CameraVolumes(weights)
        for images in light:
            volumes.add(images)
        motions.append(own_motion(volumes.own(), weights.volume))
    cameras = exchanged(motions, weights.cameras, weights.volume) if motions else ()
    made = [Mistake(Kind.FRAMES, (name,)) for name in cameras]
    return [refusal(experiment, list(weights.cameras), made)] if made else []


def shared_mistakes(judged: Sequence[Judgement]) -> Sequence[Mistake]:
    """Return the mistake that was made in all pairs, with others that explain them as well; empty without any.

    Pairs that show mistakes agree on it, or else all pairs together show it in which it can be tried.
    """
    each = [one.mistakes for one in judged if one.mistakes]
    known: dict[Mistake, list[Judgement]] = {}
    for one in judged:
        for mistake in one.tried:
            known.setdefault(mistake, []).append(one)
    joint = {one: reduce(Judgement.joined, found) for one, found in known.items() if 2 * len(found) >= len(judged)}
    made = [one for one in each[0] if all(one in others for others in each)] if 2 * len(each) >= len(judged) > 0 else []
    if not made and joint:
        likeliest = min(joint, key=lambda one: joint[one].margin(one))
        shown = likeliest in joint[likeliest].mistakes and all(likeliest in others for others in each)
        made = [likeliest, *joint[likeliest].mistakes] if shown else []
    if not made:
        return []
    for rival in joint:  # pairs at either end of a recording do not have all delays
        both = [one for one in known[made[0]] if rival in one.left and rival != made[0]]
        if both and reduce(Judgement.joined, both).as_good(made[0], rival):
            made.append(rival)
    return list(dict.fromkeys(made))


def _numbered(experiment: Experiment, warning: Warning, pair: int) -> Warning:
    return experiment.recording.by_result(warning.of_pair(pair))


def refusal(experiment: Experiment, names: Sequence[str], made: Sequence[Mistake]) -> Warning:
    """Return the warning about the mistakes of which one was made."""
    kinds = dict.fromkeys(one.kind for one in made)
    told = [_words(experiment, names, [one for one in made if one.kind is kind]) for kind in kinds]
    found, remedies = (list(dict.fromkeys(texts)) for texts in zip(*told, strict=True))
    return Warning(code=Code.MISMATCHED, figures={"found": ", or ".join(found), "remedy": ". Or: ".join(remedies)})


def _words(experiment: Experiment, names: Sequence[str], made: Sequence[Mistake]) -> tuple[str, str]:
    """Return what is wrong with the images of a camera, or of one of several, and what to do.

    Of `made`, mistakes of one kind, one was made. Of two cameras only the first was tried in time.
    """
    mistake, either_of_two = made[0], made[0].kind in IN_TIME and len(names) == 2
    cameras = list(names) if either_of_two else list(dict.fromkeys(name for one in made for name in one.cameras))
    either = " or ".join(cameras)
    if mistake.kind is Kind.CAMERAS:
        return (
            f"the particle images of {' and '.join(cameras)} are exchanged",
            "Exchange them, or the names of the cameras",
        )
    if mistake.kind is Kind.FRAMES:
        first, second = experiment.recording.both
        what = f"the {experiment.recording.exposure}s {first} and {second} of {either}"
        return f"{what} are exchanged", "Put the images of that camera into order"
    if mistake.kind in FLIPS:
        how = {
            Kind.HORIZONTAL: "left to right",
            Kind.VERTICAL: "upside down",
            Kind.BOTH: "left to right and upside down",
        }[mistake.kind]
        flips = {name: _flipped(experiment.camera(name).image_flip, mistake.kind) for name in cameras}
        keys = " or ".join(f'image_flip = "{flip}" of {name}' for name, flip in flips.items())
        return f"the particle images of {either} are mirrored {how}", (
            f"Set {keys} if white and board images are mirrored, too; otherwise store the particle images as those are"
        )
    noun = "image" if mistake.kind is Kind.SHIFTED else experiment.noun
    remedy = f"Give images of the same instant the same {experiment.noun} and frame"
    if len({one.late for one in made}) > 1:
        return f"the images of {either} are of another {noun}", remedy
    count = f"{abs(mistake.late)} {noun}{'s' if abs(mistake.late) > 1 else ''}"
    when, other = ("late", "early") if mistake.late > 0 else ("early", "late")
    if either_of_two:
        return f"the images of {cameras[0]} are {count} {when}, or those of {cameras[1]} {other}", remedy
    return f"the images of {either} are {count} {when}", remedy


def _flipped(known: str, kind: Kind) -> str:
    """Return the `image_flip` that mirrors images in addition to a known one."""
    along = {"none": (0, 0), "horizontal": (1, 0), "vertical": (0, 1), "both": (1, 1)}
    sides = tuple(one ^ other for one, other in zip(along[known], along[kind.value], strict=True))
    return next(name for name, flip in along.items() if flip == sides)


def refusals_of_pair(experiment: Experiment, refusals: Iterable[Warning], pair: int) -> tuple[Warning, ...]:
    """Return the refusals that concern a pair, as warnings about it."""
    found = (one for one in refusals if not (numbers := one.pairs or one.instants) or pair in numbers)
    return tuple(_numbered(experiment, replace(one, instants=()), pair) for one in found)

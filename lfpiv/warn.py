"""Warnings of a run, for the log, the summary, the report and the exit status.

A `Warning` holds a code, a subject and figures. Files store these three. `Warning.sentence` makes the text for people,
so that a reworded sentence does not break older files.
"""

from __future__ import annotations

import contextlib
import enum
import json
import logging
import math
import string
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from lfpiv import records
from lfpiv.records import RecordError

NAMED_PAIRS = 5
"""Largest number of pairs that a sentence names one by one."""


class Code(enum.Enum):
    """Kind of a warning; the value is stored in files and never changes."""

    # images of a pair
    MISPLACED = "misplaced"
    SATURATED = "saturated"
    UNEVEN = "uneven"
    STANDING = "standing"
    DIM = "dim"
    EMPTY = "empty"
    # white image and microlens array
    APERTURE = "aperture"
    WHITE_SATURATED = "white_saturated"
    LENSES_UNLIT = "lenses_unlit"
    LENSES_DISTORTED = "lenses_distorted"
    LENSES_IRREGULAR = "lenses_irregular"
    # board and mapping
    BOARD_SATURATED = "board_saturated"
    BOARD_MISPLACED = "board_misplaced"
    BOARD_RENAMED = "board_renamed"
    BOARD_EDGE_UNSEEN = "board_edge_unseen"
    DOT_WIDTH = "dot_width"
    DOTS_MISSING = "dots_missing"
    PLANE_EMPTY = "plane_empty"
    PLANE_LEFT_OUT = "plane_left_out"
    PLANE_OFF = "plane_off"
    TURNED = "turned"
    MAGNIFIED = "magnified"
    FEW_LABELS = "few_labels"
    MAPPING_ERROR = "mapping_error"
    # cameras and volume
    OUTSIDE_CALIBRATION = "outside_calibration"
    OUTSIDE_SIGHT = "outside_sight"
    SEEN_BY_ONE = "seen_by_one"
    ONE_CAMERA = "one_camera"
    LIGHT_GUARDED = "light_guarded"
    LIGHT_UNGUARDED = "light_unguarded"
    APART = "apart"
    NOTHING_IN_COMMON = "nothing_in_common"
    NOT_SELF_CALIBRATED = "not_self_calibrated"
    # weights
    WEIGHTS_UNCHECKED = "weights_unchecked"
    WEIGHTS_DIFFER = "weights_differ"
    COUNT_SLOW = "count_slow"
    # volumes and vectors
    DIVERGED = "diverged"
    UNEXPLAINED = "unexplained"
    MOTION_LOST = "motion_lost"
    FEW_VALID = "few_valid"
    UNSEEDED = "unseeded"
    # the run
    FEWER_WORKERS = "fewer_workers"
    ONE_GPU = "one_gpu"
    NO_LOCKS = "no_locks"
    OTHER = "other"
    """A code that this version does not know, or a sentence stored by version 0.1.0."""


_MISPLACED = (
    "light falls between the microimages of the white image. Is it of the same camera, focus, zoom and aperture, and "
    "are f_number and microlens_focal_length_mm right?"
)

SENTENCES: Mapping[Code, str] = {
    Code.MISPLACED: _MISPLACED,
    Code.SATURATED: (
        "{share:percent} % of the bright pixels are saturated; clipped particles make ghosts, lower the laser's "
        "power or the camera's gain"
    ),
    Code.UNEVEN: (
        "{parts:.0f} of 9 parts of the sensor are {ratio:g} times or more as bright in one frame as in the other; "
        "check the laser's pulses and the shutter"
    ),
    Code.STANDING: "light stands still at {place}; it is {share:percent} % of an image's light: {remedy}",
    Code.DIM: (
        "particles hardly rise above the noise (light of near pixels correlates by {structure:.2f}; clear images "
        "give 0.2 or more): displacements are biased towards zero. More light, more particles or larger windows help"
    ),
    Code.EMPTY: (
        "no particles, only noise in the image (light of near pixels correlates by {structure:.3f}; clear images "
        "give 0.2 or more): check laser, trigger and file. If fewer than two cameras saw particles, no vector of the "
        "pair is valid; otherwise do not rely on its vectors"
    ),
    Code.APERTURE: (
        "the microimages are {seen_px:.1f} px wide, not {stated_px:.1f} px as f_number = {f_number:g} and "
        "microlens_focal_length_mm = {microlens_focal_length_mm:g} imply; f_number = {fitting:.3g} would fit. Check "
        "both, and the aperture of all images."
    ),
    Code.WHITE_SATURATED: (
        "{share:percent} % of the white image's bright pixels are saturated, so their response is not known; expose "
        "it to two thirds of the range."
    ),
    Code.LENSES_UNLIT: "lens array: only {lit} of {count} microimages are lit; the others are extrapolated.",
    Code.LENSES_DISTORTED: (
        "lens array: the microimages leave their lattice by a smooth distortion of {rms_px:.3f} px rms, "
        "{largest_px:.3f} px at most; centres follow the lattice."
    ),
    Code.LENSES_IRREGULAR: "microimages lie {rms_px:.2f} px (rms) off a regular lattice; check the white image.",
    Code.BOARD_SATURATED: (
        "{share:percent} % of the bright pixels of {path} are saturated and left out, so the dots are measured less "
        "accurately; expose the board to two thirds of the range."
    ),
    Code.BOARD_MISPLACED: "{path}: " + _MISPLACED,
    Code.BOARD_RENAMED: "the board's dots were renamed by {columns} columns and {rows} rows to match its outline",
    Code.BOARD_EDGE_UNSEEN: (
        "no edge of the board is in view along {axis} ({count} dots, {stated} stated): their numbers are right only "
        "if the camera's axis meets the board within half a spacing ({half_spacing_mm:g} mm) of its middle"
    ),
    Code.DOT_WIDTH: "the board's dots look {seen_mm:.3g} mm wide, not {stated_mm:.3g} mm",
    Code.DOTS_MISSING: (
        "only {found} of {expected} board dots in the field were found; check focus, exposure and the planes listed "
        "in the report.{hint}"
    ),
    Code.PLANE_EMPTY: (
        "no dot was found in plane {plane} of the board (z = {z_mm:g} mm), {path}: look at the image; the "
        "calibration does not use it."
    ),
    Code.PLANE_LEFT_OUT: (
        "{left_out} of {seen} dots of plane {plane} of the board (z = {z_mm:g} mm) do not fit the others and are "
        "left out: check that place in board.planes_mm, and {path}."
    ),
    Code.PLANE_OFF: (
        "plane {plane} of the board stands at z = {fitted_mm:.3f} mm, not at {z_mm:g} mm, shifted by {x_mm:.3f} and "
        "{y_mm:.3f} mm along x and y and tilted by {tilt_deg:.2f} degrees, as its dots show; the calibration corrects "
        "it. Check that place in board.planes_mm, and the stage."
    ),
    Code.TURNED: (
        "the board's dots show the camera turned by {turn_deg:.0f} degrees from where it is stated to be, {nominal}. "
        "Are its pictures turned by 90 degrees? Then x and y are exchanged; otherwise check its nominal orientation."
    ),
    Code.MAGNIFIED: (
        "the board's dots are magnified {magnification:.3f} times, not {stated:g} times as stated. Check "
        "magnification, and board.spacing_mm and board.planes_mm: all lengths and velocities depend on those two."
    ),
    Code.FEW_LABELS: (
        "{dots} dots give the network {values} values for its {parameters} parameters, so it can be wrong between "
        "the dots; use more dots or planes, or fewer nodes (network.hidden)."
    ),
    Code.MAPPING_ERROR: (
        "the mapping is {sigma_nor:.3f} pitch off on held-out dots (sigma_nor), {usual:g} and less is usual; use "
        "more dots or planes, and check the board's images."
    ),
    Code.OUTSIDE_CALIBRATION: (
        "{share:percent} % of the volume lies outside the calibrated region ({region} mm), by up to "
        "{distance_mm:.2f} mm: {advice}."
    ),
    Code.OUTSIDE_SIGHT: "sees only about {share:percent} % of the volume",
    Code.SEEN_BY_ONE: (
        "about {share:percent} % of the volume is seen by fewer than two cameras; vectors there are not valid: {where}"
    ),
    Code.ONE_CAMERA: "one camera hardly resolves depth: do not rely on w, displacement_z and their validation",
    Code.LIGHT_GUARDED: (
        "particles are lit beyond the face {face} of the volume, up to {reach_mm:.2g} mm ({share:percent} % of the "
        "volume's light): guard layers of {guard_mm:.2g} mm are reconstructed there and cut away"
    ),
    Code.LIGHT_UNGUARDED: (
        "particles are lit beyond the face {face} of the volume, {reach_mm:.2g} mm or more ({share:percent} % of the "
        "volume's light), farther than the guard layers of {guard_mm:.2g} mm: their light falls into the volume and "
        "biases vectors near its faces; {reason}"
    ),
    Code.APART: (
        "{names} show the same particles {voxel:.1f} voxel ({mm:.3f} mm) apart: a camera moved since the board was "
        "recorded; {advice}."
    ),
    Code.NOTHING_IN_COMMON: (
        "{names} show no particles in common within {search} voxels: a camera moved by more, their images are of "
        "different instants, or show very few particles."
    ),
    Code.NOT_SELF_CALIBRATED: (
        "self-calibration keeps the calibration of the board: {verdict}. Check the particle images, use more pairs "
        "(self_calibration.pairs), or record the board again if a camera moved."
    ),
    Code.WEIGHTS_UNCHECKED: (
        "sees none of the voxels drawn at random to check its weights against counted rays: they are unchecked. "
        "Check the volume's place and size against what the camera sees"
    ),
    Code.WEIGHTS_DIFFER: (
        "weights as {form} differ from counted rays by {mean:percent1} % (worst voxel {worst:percent1} %), the aim "
        "is {aim_mean:percent} % ({aim_worst:percent1} %). Cause: {cause} (rays depart from second order by "
        "{bent_pitch:.2f}, a voxel's edge is {wide_pitch:.1f} microlens pitch)"
    ),
    Code.COUNT_SLOW: "counting rays for {voxels} voxels; 'footprint' is about a thousand times faster",
    Code.DIVERGED: "SMART: {verdict}",
    Code.UNEXPLAINED: (
        "the volumes explain little of the images' light (residual {residual:.2f}; 0.3 to 0.6 is usual): do not rely "
        "on their vectors before the report shows why"
    ),
    Code.MOTION_LOST: "motion pass {passes}: {share:percent} % valid; {verdict}",
    Code.FEW_VALID: "{share:percent} % of the vectors are valid; {verdict}",
    Code.UNSEEDED: (
        "{share:percent} % of the volume holds no particles; {lost:percent} % of the vectors are not valid for this "
        "reason. Where there is no fluid, state a mask (volume.mask, volume.solid)"
    ),
    Code.FEWER_WORKERS: (
        "{fits} {noun} instead of {planned}: each takes {each_gib:.1f} GiB of memory, in addition to "
        "{weights_gib:.1f} GiB of weights"
    ),
    Code.ONE_GPU: (
        "one of {gpus} GPUs is used: several processes need the package `distributed`. Install it: pip install "
        "'lfpiv[distributed]'"
    ),
    Code.NO_LOCKS: "this file system has no file locks: do not start a second run on this folder",
    Code.OTHER: "{text}",
}
"""Sentence of each code, with its figures in braces. Shares have the format `percent` or `percent1`."""


_FINDING_FIGURES = {
    "misplaced": "gap_light",
    "saturated": "share",
    "uneven": "parts",
    "dim": "structure",
    "empty": "structure",
}  # names of the one figure that version 0.1.0 stored with a finding


@dataclass(frozen=True, kw_only=True)
class Warning:
    """One doubt about a result."""

    code: Code
    subject: str = ""
    """Object of the doubt, such as a camera, or "left, frame a"; empty for the whole run."""
    figures: Mapping[str, object] = field(default_factory=dict)
    """Numbers and names that the sentence shows."""
    pairs: tuple[int, ...] = ()
    """Numbers of the pairs it concerns; empty where it concerns no pair in particular."""
    instants: tuple[int, ...] = ()
    """Numbers of the instants of a series that it concerns, in place of pairs."""

    @property
    def sentence(self) -> str:
        """Sentence for people: subject, pairs and text."""
        heads = [part for part in (self.subject, name_pairs(self.pairs), name_pairs(self.instants, "instant")) if part]
        text = _Words().vformat(SENTENCES[self.code], (), self.figures)
        return f"{', '.join(heads)}: {text}" if heads else text

    def of_pair(self, pair: int) -> Warning:
        """Return the same warning about one pair; one about instants stays as it is."""
        return self if self.instants else replace(self, pairs=(pair,))

    def by_instant(self) -> Warning:
        """Return the same warning with its pairs named by their first instants, for a series."""
        return replace(self, pairs=(), instants=self.pairs) if self.pairs else self

    def to_json(self) -> dict[str, Any]:
        """Return the form that a file stores."""
        figures = {name: asdict(value) if isinstance(value, Span) else value for name, value in self.figures.items()}
        stored = {"code": self.code.value, "subject": self.subject, "figures": figures}
        numbers = {"pairs": list(self.pairs), "instants": list(self.instants)}
        return stored | {name: found for name, found in numbers.items() if found}

    @classmethod
    def from_json(cls, stored: Mapping[str, Any] | str) -> Warning:
        """Read the form that a file stores; sentences and findings of version 0.1.0 too.

        Raises
        ------
        RecordError
            If it has none of these forms, or its figures do not fit its sentence.
        """
        if isinstance(stored, str):
            return cls(code=Code.OTHER, figures={"text": stored})
        if isinstance(stored, Mapping) and "what" in stored:
            return _of_finding(records.validate(_Finding, stored))
        found = records.validate(_Stored, stored)
        numbers = {"pairs": found.pairs, "instants": found.instants}
        if found.code not in {known.value for known in Code}:
            values = ", ".join(f"{name} = {value}" for name, value in found.figures.items())
            text = f"{found.code} ({values})" if values else found.code
            return cls(code=Code.OTHER, subject=found.subject, figures={"text": text}, **numbers)
        figures = {name: math.nan if value is None else value for name, value in found.figures.items()}
        warning = cls(code=Code(found.code), subject=found.subject, figures=figures, **numbers)
        try:
            _ = warning.sentence
        except (KeyError, ValueError, TypeError, IndexError, AttributeError) as error:
            raise RecordError(f"figures of the warning {found.code!r} do not fit it ({error})") from None
        return warning


@dataclass(frozen=True)
class Span:
    """Range of a figure over several pairs."""

    low: float
    high: float


@dataclass(frozen=True, kw_only=True)
class _Stored:
    """A warning as files store it."""

    code: str
    subject: str
    figures: Mapping[str, Span | int | float | str | bool | Sequence[int | float | str] | None]
    pairs: tuple[int, ...] = ()
    instants: tuple[int, ...] = ()


@dataclass(frozen=True, kw_only=True)
class _Finding:
    """A warning as files of version 0.1.0 store it."""

    what: str
    camera: str
    frame: str
    value: float


def _of_finding(found: _Finding) -> Warning:
    if found.what not in _FINDING_FIGURES:
        raise RecordError(f"unknown finding {found.what!r}")
    figures = {_FINDING_FIGURES[found.what]: found.value}
    if found.what == Code.UNEVEN.value:
        figures["ratio"] = 4.0  # the limit of version 0.1.0
    subject = found.camera + (f", frame {found.frame}" if found.frame else "")
    return Warning(code=Code(found.what), subject=subject, figures=figures)


class _Words(string.Formatter):
    """Fill figures into a sentence: a span as "low to high", a share in percent."""

    def format_field(self, value: Any, format_spec: str) -> str:
        if isinstance(value, Span):
            low, high = (self.format_field(end, format_spec) for end in (value.low, value.high))
            return low if low == high else f"{low} to {high}"
        if format_spec.startswith("percent"):
            return f"{100 * value:.{format_spec[7:] or 0}f}"
        return str(super().format_field(value, format_spec))


def to_text(warnings: Iterable[Warning]) -> str:
    """Return the JSON text that an attribute of a file stores."""
    return json.dumps([warning.to_json() for warning in warnings])


def from_text(text: str) -> tuple[Warning, ...]:
    """Read the JSON text that an attribute of a file stores.

    Raises
    ------
    RecordError
        If it is no list of warnings.
    """
    return from_list(records.read_json(text))


def from_list(stored: Any) -> tuple[Warning, ...]:
    """Read the list of warnings that a record holds.

    Raises
    ------
    RecordError
        If it is no list of warnings.
    """
    if not isinstance(stored, list):
        raise RecordError("expected a list of warnings")
    return tuple(map(Warning.from_json, stored))


class Gathering:
    """Warnings of many pairs, merged as they arrive. Memory: 8 bytes per pair and kind of warning."""

    def __init__(self) -> None:
        self._groups: dict[tuple[Code, str, tuple[tuple[str, str], ...]], _Group] = {}

    def add(self, warnings: Iterable[Warning]) -> None:
        """Merge some warnings with those that are there."""
        for warning in warnings:
            fixed = ((name, value if isinstance(value, str) else "") for name, value in warning.figures.items())
            key = (warning.code, warning.subject, tuple(sorted(fixed)))
            if key not in self._groups:
                self._groups[key] = _Group(warning)
            self._groups[key].add(warning)

    def join(self, other: Gathering) -> None:
        """Merge the warnings of another one with those that are there."""
        for key, group in other._groups.items():
            if key in self._groups:
                self._groups[key].join(group)
            else:
                self._groups[key] = group

    def merged(self) -> list[Warning]:
        """Return the merged warnings, sorted by code."""
        order = list(Code)
        return [group.merged() for _, group in sorted(self._groups.items(), key=lambda item: order.index(item[0][0]))]


class _Group:
    """Warnings of equal code, subject and texts."""

    def __init__(self, first: Warning):
        self.first, self.count = first, 0
        self.pairs, self.instants = array("q"), array("q")
        self.spans: dict[str, tuple[Any, Any]] = {}
        """Figure -> lowest and highest number."""
        self.unlike = set[str]()
        """Figures that are no number in some warning."""

    def add(self, warning: Warning) -> None:
        self.count += 1
        _extend(self.pairs, warning.pairs)
        _extend(self.instants, warning.instants)
        for name in self.first.figures:
            value = warning.figures[name]
            if isinstance(value, (int, float)):
                low, high = self.spans.get(name, (value, value))
                self.spans[name] = min(low, value), max(high, value)
            else:
                self.unlike.add(name)

    def join(self, other: _Group) -> None:
        self.count += other.count
        _extend(self.pairs, other.pairs)
        _extend(self.instants, other.instants)
        self.unlike |= other.unlike
        for name, (low, high) in other.spans.items():
            own = self.spans.get(name, (low, high))
            self.spans[name] = min(own[0], low), max(own[1], high)

    def merged(self) -> Warning:
        figures: dict[str, object] = dict(self.first.figures)
        if self.count > 1:
            figures |= {name: Span(*span) for name, span in self.spans.items() if name not in self.unlike}
        pairs, instants = tuple(dict.fromkeys(self.pairs)), tuple(sorted({*self.instants}))
        return replace(self.first, figures=figures, pairs=pairs, instants=instants)


def _extend(known: array[int], numbers: Iterable[int]) -> None:
    """Add numbers, but not one that equals the last one."""
    for number in numbers:
        if not known or number != known[-1]:
            known.append(number)


def gather(warnings: Iterable[Warning]) -> list[Warning]:
    """Merge warnings of equal code, subject and texts: their pairs in one, their numbers as ranges. Sorted by code."""
    found = Gathering()
    found.add(warnings)
    return found.merged()


def name_pairs(pairs: Sequence[int], noun: str = "pair", count: int | None = None) -> str:
    """Name the first pairs, or what else the noun says, and count the others; empty for none.

    `count` is the number of all, where `pairs` are the first ones. Default: all are given.
    """
    count = len(pairs) if count is None else count
    if not count:
        return ""
    names = ", ".join(map(str, pairs[:NAMED_PAIRS]))
    more = f" and {count - NAMED_PAIRS} more" if count > NAMED_PAIRS else ""
    return f"{noun}{'s' if count > 1 else ''} {names}{more}"


_collected: ContextVar[list[Warning] | None] = ContextVar("collected", default=None)


def warn(log: logging.Logger, warning: Warning) -> None:
    """Log a warning, and hand it to the innermost `collected` block, once."""
    log.warning("%s", warning.sentence)
    found = _collected.get()
    if found is not None and warning not in found:
        found.append(warning)


@dataclass(frozen=True)
class FirstOfEachCode:
    """Log the warnings of many pairs: only the first of each code. The summary names all pairs."""

    log: logging.Logger
    logged: set[Code] = field(default_factory=set)
    """Codes that were logged; grows with each call."""

    def __call__(self, warnings: Iterable[Warning]) -> None:
        """Log the warnings whose codes are new."""
        new = [warning for warning in warnings if warning.code not in self.logged]
        for warning in gather(new):
            self.log.warning("%s", warning.sentence)
        self.logged.update(warning.code for warning in new)


@contextlib.contextmanager
def collected() -> Iterator[list[Warning]]:
    """Collect the warnings of a block in a list, at any log level. A block inside another one has its own list."""
    found: list[Warning] = []
    token = _collected.set(found)
    try:
        yield found
    finally:
        _collected.reset(token)

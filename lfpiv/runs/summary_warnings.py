"""What is doubtful about the results in a folder, in words: each caution once, with the pairs that it concerns."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from lfpiv.lightfield.image_checks import MISPLACED, UNEVEN, Fault
from lfpiv.velocity.cross_correlation import Verdict

if TYPE_CHECKING:
    from lfpiv.calibration.cameras import Calibration
    from lfpiv.geometry.grid import Grid

NAMED = 5
"""Pairs that a text names one by one."""

ONE_CAMERA = "one camera hardly sees depth: w and displacement_z are not to be trusted, nor is their validation"

_FAULTS: dict[Fault, Callable[[str], str]] = {
    Fault.MISPLACED: lambda shares: MISPLACED,
    Fault.SATURATED: lambda shares: (
        f"{shares} % of the bright pixels are saturated; clipped particles make ghosts, lower the laser's power or the "
        "camera's gain"
    ),
    Fault.UNEVEN: lambda parts: (
        f"{parts} of 9 parts of the sensor are {UNEVEN:g} times and more as bright in one frame as in the other; check "
        "the laser's pulses and the shutter"
    ),
    Fault.DIM: lambda structure: (
        f"particles hardly rise above the noise (light of near pixels correlates by {structure}; clear images give 0.2 "
        "or more): displacements are drawn towards zero. More light, more particles or larger windows help"
    ),
    Fault.EMPTY: lambda structure: (
        f"no particles, only noise in the image (light of near pixels correlates by {structure}; clear images give 0.2 "
        "or more): check laser, trigger and file. Vectors of such a pair do not count where fewer than two cameras saw "
        "particles; otherwise they are not to be trusted"
    ),
}
"""What each kind of finding means, given how much of it there is."""

_SHOWN: dict[Fault, Callable[[float], str]] = {
    Fault.SATURATED: lambda share: f"{100 * share:.0f}",
    Fault.UNEVEN: lambda parts: f"{parts:.0f}",
    Fault.DIM: lambda structure: f"{structure:.2f}",
    Fault.EMPTY: lambda structure: f"{max(structure, 0):.3f}",
}
"""How much of it, as text."""


def of_rig(calibration: Calibration, grid: Grid) -> list[str]:
    """Say what is doubtful about the calibration, and about how cameras and volume lie to each other."""
    from lfpiv.calibration.cameras import outside_warnings
    from lfpiv.calibration.coverage import sight_warnings

    texts = [text for camera in calibration.cameras.values() for text in camera.report.get("warnings", ())]
    texts += [*outside_warnings(calibration, grid), *sight_warnings(calibration, grid)]
    return [*texts, ONE_CAMERA] if len(calibration.cameras) == 1 else texts


def of_images(pairs: Iterable[Mapping[str, Any]]) -> list[str]:
    """Say what is suspicious about the images, from the ``findings`` that are stored with each pair."""
    found: dict[tuple[Fault, str], dict[int, list[float]]] = {}
    for pair in pairs:
        for finding in pair.get("findings", ()):
            where = finding["camera"] + (f", frame {finding['frame']}" if finding["frame"] else "")
            found.setdefault((Fault(finding["what"]), where), {}).setdefault(pair["pair"], []).append(finding["value"])
    order = list(Fault)
    texts = []
    for (fault, where), values in sorted(found.items(), key=lambda item: order.index(item[0][0])):
        shown = _span([value for some in values.values() for value in some], _SHOWN.get(fault, str))
        texts.append(f"{where}, {named(list(values))}: {_FAULTS[fault](shown)}")
    return texts


def of_pairs(pairs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Say what is doubtful about the volumes and vectors of finished pairs, from their figures in the summary."""
    from lfpiv.reconstruction.volume import Stop

    diverged: dict[str, dict[int, float]] = {}
    lost: dict[str, dict[int, float]] = {}
    poor: dict[str, dict[int, float]] = {}
    for pair in pairs:
        number, motion = pair["pair"], pair.get("motion")
        if Stop.DIVERGED.value in pair.get("stop", {}).values():
            diverged.setdefault(Stop.DIVERGED.value, {})[number] = 0.0
        if motion is not None and not motion["followed"]:
            shares = motion["valid_fraction"]
            lost.setdefault(f"motion pass {len(shares)}: {{}} % valid; {motion['verdict']}", {})[number] = shares[-1]
        if pair["verdict"] != Verdict.GOOD.value:
            poor.setdefault(f"{{}} % of the vectors are valid; {pair['verdict']}", {})[number] = pair["valid_fraction"]
    texts = [f"{named(list(values))}: SMART: {text}" for text, values in diverged.items()]
    for kind, separator in ((lost, ", "), (poor, ": ")):
        for text, values in kind.items():
            shown = _span(values.values(), lambda share: f"{100 * share:.0f}")
            texts.append(named(list(values)) + separator + text.replace("{}", shown, 1))
    return texts


def named(pairs: Sequence[int]) -> str:
    """Name some pairs, and say how many there are where they are many."""
    names = ", ".join(map(str, pairs[:NAMED]))
    return f"pair{'s' if len(pairs) > 1 else ''} {names}" + (
        f" and {len(pairs) - NAMED} more" if len(pairs) > NAMED else ""
    )


def _span(values: Iterable[float], text: Callable[[float], str]) -> str:
    """Write numbers as one, or as the range that they span."""
    values = list(values)
    low, high = text(min(values)), text(max(values))
    return low if low == high else f"{low} to {high}"

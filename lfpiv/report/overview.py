"""Write the report's sections of text: the run, its verdicts and warnings, time and memory, settings and versions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from lfpiv.experiment import axes
from lfpiv.experiment.experiment import CameraSetup, Experiment
from lfpiv.prompt import count, movement
from lfpiv.quantities import quantity
from lfpiv.report import markup, verdicts
from lfpiv.report.markup import number, percent
from lfpiv.report.summary import DampingFigures, Summary, WeightFigures

WARNINGS_SHOWN, WARNINGS_MOST = 12, 300
"""Warnings shown openly, and shown in total with the folded ones. ``summary.json`` holds all."""


def head(experiment: Experiment) -> str:
    """Return the title of the page, and what was measured in two lines."""
    nz, ny, nx = experiment.grid.shape
    voxel = experiment.grid.voxel_mm
    size = " × ".join(f"{n * voxel:g}" for n in (nx, ny, nz))
    apart = f"between {experiment.recording.exposure}s{experiment.recording.later}"
    return f'<h1 id="top">{markup.escape(experiment.name)}</h1>' + markup.paragraph(
        f"Light-field PIV with {count(len(experiment.cameras), 'camera')}, {size} mm (x, y, z), "
        f"{quantity(experiment.dt_s, 's')} {apart}. One voxel of {voxel:g} mm is "
        f"{quantity(voxel / 1000 / experiment.dt_s, 'm/s')}. "
        f"In the recorded pictures {axes.directions(experiment)}; {axes.handedness(experiment)}.",
        "quiet",
    )


def verdict(experiment: Experiment, summary: Summary) -> str:
    """Return the main figures of the run, each judged."""
    return verdicts.cards(verdicts.tiles(experiment, summary))


def warnings(summary: Summary, noun: str = "pair") -> str:
    """List the failed pairs, or instants as `noun` says, then the warnings."""
    failed = [f"{noun.capitalize()} {failure.pair} failed: {failure.reason}" for failure in summary.failed]
    unnamed = summary.pairs_failed - len(failed)
    failed += [f"{unnamed:,} more {noun}s failed"] if unnamed else []
    texts = [*failed, *summary.warnings]
    if not texts:
        return ""
    shown = _list(texts[:WARNINGS_SHOWN])
    rest = texts[WARNINGS_SHOWN:WARNINGS_MOST]
    if rest:
        left = len(texts) - WARNINGS_MOST
        more = markup.paragraph(f"{left:,} more are in summary.json.") if left > 0 else ""
        shown += markup.details(f"{len(texts) - WARNINGS_SHOWN:,} more", _list(rest) + more)
    return f'<section class="warnings" aria-labelledby="warnings"><h2 id="warnings">Warnings</h2>{shown}</section>'


def _list(texts: Sequence[str]) -> str:
    return "<ul>" + "".join(f"<li>{markup.escape(text)}</li>" for text in texts) + "</ul>"


def contents(sections: Mapping[str, str], noun: str) -> str:
    """Return links to the sections that are not empty; `noun` is "pair" or "instant"."""
    names = {
        "truth": "Truth",
        "vectors": "Flow",
        "volumes": "Volumes",
        "pairs": f"{noun.capitalize()}s",
        "run": "Run",
        "calibration": "Calibration",
        "background": "Light",
        "time": "Time",
        "settings": "Settings",
    }
    links = "".join(f'<a href="#{key}">{name}</a>' for key, name in names.items() if sections[key])
    return f'<nav aria-label="Sections">{links}<a class="up" href="#top">↑ Top</a></nav>'


def run_facts(experiment: Experiment, summary: Summary) -> str:
    """Tabulate what the experiment file states and what the run chose."""
    nz, ny, nx = experiment.grid.shape
    voxel, size = experiment.grid.voxel_mm, [n * experiment.grid.voxel_mm for n in (nx, ny, nz)]
    board = experiment.board
    optics = experiment.cameras[0].optics
    same = all(camera.optics == optics for camera in experiment.cameras)
    rows = [
        ("Experiment file", str(experiment.path)),
        ("Volume", f"{size[0]:g} × {size[1]:g} × {size[2]:g} mm (x, y, z), {nx} × {ny} × {nz} voxels of {voxel:g} mm"),
        _interval(experiment),
        _moved(experiment, summary),
        (
            "Cameras",
            ", ".join(f"{camera.name}{_orientation(camera)}" for camera in experiment.cameras)
            + f" (nominal); {'each' if same else 'the first'} f = {optics.focal_length_mm:g} mm, "
            f"f/{optics.f_number:g}, magnification {abs(optics.magnification):g}, "
            f"{optics.sensor_shape[1]} × {optics.sensor_shape[0]} pixels of {1000 * optics.pixel_mm:g} µm, "
            f"{optics.layout} microlenses of {1000 * optics.microlens_pitch_mm:g} µm",
        ),
        (
            "Board",
            f"{board.dots[0]} × {board.dots[1]} dots, {board.spacing_mm:g} mm apart, in {len(board.planes_mm)} planes "
            f"from z = {markup.general(min(board.planes_mm))} to {markup.general(max(board.planes_mm))} mm"
            + (f", with a mark of {len(board.mark)} places without a dot" if board.mark else ""),
        ),
        _recorded(experiment, summary.pairs_finished),
        ("Joint fit", _joint(summary)),
        ("Vectors from links", _links(summary)),
        ("Weights", _weights(summary.weights)),
        ("Cameras against each other", _agreement(summary.weights, experiment.noun)),
        ("Damping by ghosts", _damping(summary.damping)),
        ("Computed on", summary.device.sentence),
    ]
    return '<h2 id="run">What was run</h2>' + markup.facts([row for row in rows if row[1]])


def _interval(experiment: Experiment) -> tuple[str, str]:
    """State the time between the two frames of a vector field and the velocity of one voxel."""
    recording, interval = experiment.recording, quantity(experiment.dt_s, "s", 6)
    speed = f"1 voxel is {quantity(experiment.grid.voxel_mm / 1000 / experiment.dt_s, 'm/s')}"
    return f"Time between {recording.exposure}s", f"{interval}{recording.later}: {speed}"


def _moved(experiment: Experiment, summary: Summary) -> tuple[str, str]:
    """State how far and how fast the particles of the first pair move, for a look at ``dt_s`` and the lengths."""
    pair = next((one for one in summary.pairs if one.moved_voxel is not None), None)
    if pair is None or pair.moved_voxel is None:
        return "Median movement", ""
    text = movement(pair.moved_voxel, experiment.grid.voxel_mm, experiment.dt_s)
    return "Median movement", f"{text}, in {experiment.name_of(pair.number)}"


def _recorded(experiment: Experiment, finished: int) -> tuple[str, str]:
    """State what was recorded, and how much of it has vectors."""
    recording, frames = experiment.recording, experiment.recording.frames
    if not recording.is_series:
        return "Image pairs", f"{finished:,} of {experiment.pairs:,} finished"
    return "Time series", (
        f"instants {frames[0]} to {frames[-1]}; vectors of {finished:,} of the {experiment.pairs:,} that have a "
        f"partner {count(recording.step, 'instant')} later"
    )


def _orientation(camera: CameraSetup) -> str:
    return " in any orientation" if camera.orientation is None else f" {camera.orientation}".replace("-", "−")


def _joint(summary: Summary) -> str:
    """State how many pairs were fitted jointly and how many of their vectors; empty without a joint fit."""
    tried = [pair.joint for pair in summary.pairs if pair.joint is not None]
    if not tried:
        return ""
    fits = [joint for joint in tried if joint.fitted]
    text = f"{count(len(fits), 'pair')} of {len(summary.pairs):,}"
    if fits:
        share, ratio = np.mean([fit.share for fit in fits]), np.median([fit.misfit_ratio for fit in fits])
        text += f"; {percent(float(share))} of the valid vectors; one moving volume explains both frames with "
        text += f"{ratio:.2g} times the misfit of two separate ones"
    return text


def _links(summary: Summary) -> str:
    """State how many pairs have vectors from the links of single particles; empty without such pairs."""
    links = [pair.links for pair in summary.pairs if pair.links is not None]
    if not links:
        return ""
    number, length = np.median([(found.number, found.length) for found in links], axis=0)
    incompressible = sum(found.form == "incompressible" for found in links)
    return (
        f"{count(len(links), 'pair')} of {len(summary.pairs):,}, the others by the correlation; {number:,.0f} "
        f"links, structures of {length:.1f} voxel (medians), incompressible in {incompressible:,}"
    )


def _weights(weights: WeightFigures) -> str:
    """State the method and memory of the weights and their difference from counted rays."""
    if not weights.method:
        return ""
    text = f"{weights.method}, {quantity(weights.memory_mib, 'MiB')}"
    forms = sorted(set(weights.form.values()))
    text += f", stored as {' and '.join(forms)}" if forms else ""
    errors = weights.count_check_l2
    if errors:
        text += (
            f"; {percent(float(np.mean(errors)), 1)} (mean of {len(errors)} voxels), at most "
            f"{percent(max(errors), 1)}, from counted rays"
        )
    return text


def _agreement(weights: WeightFigures, noun: str) -> str:
    """State whether the images of the cameras belong together, and how self-calibration changed the cameras."""
    text = weights.cameras
    corrected = weights.self_calibration
    if corrected is not None and corrected.verdict != "corrected":
        pairs = count(len(corrected.pairs), noun)
        text += f"{'; ' if text else ''}self-calibration by {pairs} changed nothing: {corrected.verdict}"
    elif corrected is not None:
        moved = ", ".join(
            f"{name} by {1000 * float(np.linalg.norm(move.shift_mm)):.0f} µm and "
            f"{float(np.linalg.norm(move.rotation_deg)):.2f}°"
            for name, move in corrected.movements.items()
        )
        text += (
            f"{'; ' if text else ''}self-calibrated by {count(len(corrected.pairs), noun)}: "
            f"{number(corrected.disparity_before_voxel, 2)} voxel before, "
            f"{number(corrected.disparity_voxel, 2)} after; {moved}"
        )
    return text


def _damping(damping: DampingFigures | None) -> str:
    """State the slope of measured on true fluctuations along each axis, and whether it is taken off."""
    if damping is None or not damping.axes:
        return "not measured" + (f": {damping.reason}" if damping is not None else "")
    slopes = ", ".join(
        f"{axis} {found.slope:.3f} ± {found.slope_error:.3f}"
        f"{'' if found.applied or not found.alike else ' (not taken off)'}"
        for axis, found in sorted(damping.axes.items())
    )
    offsets = ", ".join(
        f"{axis} {found.offset:.3f} ± {found.offset_error:.3f}" for axis, found in sorted(damping.axes.items())
    )
    alike = all(found.alike for found in damping.axes.values())
    harder = "" if alike else "not taken off, since simulated pairs are harder to measure than recorded ones; "
    return (
        f"{harder}slope of measured on true fluctuations, from "
        f"{count(damping.simulated, 'simulated pair')}: {slopes}; "
        f"offset [voxel]: {offsets}. This report shows the raw vectors; open_results has both"
    ).replace("-", "−")


def timings(summary: Summary, noun: str = "pair") -> str:
    """Tabulate the time of each stage; list what was reused, and the peak memory."""
    names = {
        "calibration": "calibration, including network training",
        "network_training": "network training alone",
        "weights": "weights",
        "reconstruction": "reconstruction, all volumes",
        "correlation": f"correlation, all {noun}s",
        "bootstrap": "damping by ghosts",
        "rest": "checks of cameras and images, size of particles, background",
        "total": "this run, until the report",
    }
    times = dict(summary.timings_s)
    apart = ("calibration", "weights", "reconstruction", "correlation", "bootstrap")
    rest = (times.get("total") or 0.0) - sum(times.get(key) or 0.0 for key in apart)
    if rest > 0 and not summary.reused:  # of several workers the parts add up to more than the whole
        times["rest"] = rest
    rows = [[text, quantity(times[key], "s")] for key, text in names.items() if key in times]
    reused = ""
    if summary.reused:
        named = ", ".join(summary.reused[:WARNINGS_SHOWN])
        left = len(summary.reused) - WARNINGS_SHOWN
        more = f" and {left:,} more" if left > 0 else ""
        reused = markup.paragraph(f"Reused from an earlier run: {named}{more}.", "quiet")
    memory = markup.paragraph(f"Peak memory: {quantity(summary.peak_memory_mib, 'MiB')}.")
    table = markup.table(["stage", "time"], rows, caption="Time of each stage")
    return f'<h2 id="time">Time and memory</h2>{table}{memory}{reused}'


def settings_and_versions(summary: Summary) -> str:
    """Tabulate settings and versions, folded."""
    settings = [
        [f"{table}.{key}", "default" if value is None else str(value)]
        for table, values in summary.settings.items()
        for key, value in values.items()
    ]
    versions = [[name, version] for name, version in summary.versions.items()]
    return (
        '<h2 id="settings">Settings and versions</h2>'
        + markup.details(
            "Settings", markup.table(["key", "value"], settings, caption="Settings of the run", words=True)
        )
        + markup.details(
            "Versions", markup.table(["package", "version"], versions, caption="Versions of packages", words=True)
        )
    )

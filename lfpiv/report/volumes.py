"""Write the report's section on the volumes: projections, residual per iteration, brightness over the depth."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.colors import Normalize

from lfpiv.experiment.recording import Recording
from lfpiv.report import markup
from lfpiv.report.light_sheet import ENOUGH, LightSheet, find_sheet
from lfpiv.report.markup import number, percent
from lfpiv.report.summary import PairFigures
from lfpiv.report.svg import INK, SERIES, cell_edges, colour_bar, image_panel, new_panel, spread_ticks, style, to_svg
from lfpiv.results import netcdf

FEW_VOLUMES = 6
"""Largest number of volumes with a line each in the chart of residuals. Of more, median and range are drawn."""
LAST_IS_JOINT = (
    " The last value is after the joint fit. There one moving volume explains both frames, which usually leaves more "
    "than a volume of each frame."
)
"""Sentence on the residuals of image pairs that were fitted jointly."""
BAND = (5, 95)
"""Percentiles that bound the range drawn over many volumes."""


def section(pairs: Sequence[PairFigures], vectors: Mapping[int, Path], recording: Recording) -> str:
    """Return the section on the volumes, as HTML; empty where the first file holds nothing about its volumes.

    Parameters
    ----------
    pairs : sequence of PairFigures
        Finished pairs.
    vectors : dict
        Pair -> file of its vectors. The volumes of the first pair are shown.
    recording : Recording
        What was recorded; it names results.
    """
    histories = {
        recording.named(item.number, frame).label: np.asarray(residual, float)
        for item in pairs
        for frame, residual in item.residual.items()
        if residual
    }
    pair = next(iter(vectors))
    first = netcdf.read_reconstruction(vectors[pair])
    if first is None:
        return ""
    parts = ['<h2 id="volumes">Volumes</h2>', _projection_figure(pair, first, recording)]
    joint = any(item.joint is not None and item.joint.fitted for item in pairs)
    parts.append(quality_figure(pair, first, histories, recording, joint))
    parts.append(_images(pairs, recording))
    stops = _stops(pairs, recording)
    if stops:
        parts.append(
            markup.table(["volumes", "why the iteration ended"], stops, caption="Why the iterations ended", words=True)
        )
    return "\n".join(parts)


def _projection_figure(pair: int, first: xr.Dataset, recording: Recording) -> str:
    """Draw the largest intensity along each axis, with a table of percentiles."""
    name = recording.named(pair, str(first["frame"].values[0])).label
    names = (("z", "x", "y"), ("y", "x", "z"), ("x", "y", "z"))
    top = float(np.percentile(first["projection_z"].values[0], 99.7)) or 1.0
    shown = [_projection(first, *axes, top) for axes in names]
    values = [first[f"projection_{axis}"].values[0] for axis, _, _ in names]
    rows = [
        [
            f"along {axis}",
            *(number(float(np.percentile(value, share)), 0) for share in (50, 90, 99)),
            f"{value.max():.0f}",
        ]
        for (axis, _, _), value in zip(names, values, strict=True)
    ]
    table = markup.table(
        ["brightest voxel [counts]", "median line", "90 %", "99 %", "largest"],
        rows,
        caption="Brightness of the projections",
    )
    return markup.figure(
        shown,
        f"Brightest voxel along each axis, {name}. An intensity is about the light of a voxel in all pixels "
        "of a camera together, so it exceeds the largest count of a pixel. Particles of more than one voxel should be "
        "round across the cameras' mean line of sight, usually z; along it they are longer, "
        "the more so the smaller the angle between the cameras.",
        table,
    )


def _projection(first: xr.Dataset, along: str, across: str, up: str, top: float) -> str:
    values = first[f"projection_{along}"].isel(frame=0).transpose(up, across).values
    edges = [cell_edges(first[axis].values) for axis in (across, up)]
    figure, axes, shown = image_panel(values, edges, "magma", Normalize(0, top))
    style(axes, title=f"along {along}", xlabel=f"{across} [mm]", ylabel=f"{up} [mm]")
    spread_ticks(axes)
    colour_bar(figure, shown, axes, "largest intensity [counts]", location="bottom")
    return to_svg(figure, f"Largest intensity of the volume along {along}, over {across} and {up}.")


def quality_figure(
    pair: int, first: xr.Dataset, histories: Mapping[str, np.ndarray], recording: Recording, joint: bool
) -> str:
    """Draw the residuals and the brightness over the depth.

    Parameters
    ----------
    pair : int
        Number of the pair that `first` belongs to.
    first : Dataset
        Condensed volumes of that pair, from `netcdf.read_reconstruction`.
    histories : dict
        Volume -> residual per iteration.
    recording : Recording
        What was recorded; it names results.
    joint : bool
        Whether the last residuals are those after a joint fit of both frames.

    Returns
    -------
    str
        A figure.
    """
    shown, tables, captions = [], [], []
    if histories:
        panel, table = _residuals(histories)
        shown.append(panel)
        tables.append(table)
        captions.append(
            "Part of the images that the projections of the volume do not explain, per iteration of SMART."
            + (LAST_IS_JOINT if joint else "")
        )
    profile = first["profile_z"].isel(frame=0).values
    sheet = find_sheet(first["z"].values, profile)
    panel, table = _brightness(
        first, sheet, [recording.named(pair, str(frame)).within for frame in first["frame"].values]
    )
    shown.append(panel)
    tables.append(table)
    captions.append(f"Mean brightness of the planes along z, {recording.name_of(pair)}. {_judgement(profile, sheet)}")
    return markup.figure(shown, " ".join(captions), "".join(tables))


def _judgement(profile: np.ndarray, sheet: LightSheet | None) -> str:
    """Judge the level of ghosts by the brightness over the depth."""
    if sheet is None:
        quarter = len(profile) // 4
        middle = max(float(profile[quarter : len(profile) - quarter].mean()), 1e-30)
        return (
            "The light sheet fills the volume, so the ghost level cannot be estimated. Reconstruct a deeper volume to "
            f"see it. The first plane is {percent(profile[0] / middle)} and the last "
            f"{percent(profile[-1] / middle)} as bright as the middle half; well above 100 %, they take up light from "
            "outside the volume."
        )
    verdict = "which is good" if sheet.ratio >= ENOUGH else "too little: dense seeding, or a wrong calibration"
    return (
        f"The light sheet (shaded) lies between z = {number(sheet.low_mm, 2)} and {number(sheet.high_mm, 2)} mm; all "
        f"light outside it is ghosts. The volume is {number(sheet.ratio, 1)} times as bright inside as outside, "
        f"{verdict}; a ratio of {ENOUGH:g} or more is commonly required."
    )


def _residuals(histories: Mapping[str, np.ndarray]) -> tuple[str, str]:
    """Draw and tabulate the residual over the iterations: a line per volume, or median and range of many."""
    length = max(map(len, histories.values()))
    every = np.full((len(histories), length), np.nan)
    for row, history in zip(every, histories.values(), strict=True):
        row[: len(history)] = history
        row[len(history) :] = history[-1]  # volumes that stopped earlier keep their last residual
    iteration = np.arange(length)
    figure, axes = new_panel()
    if len(histories) <= FEW_VOLUMES:
        for k, (label, history) in enumerate(histories.items()):
            dashes = "-" if k % 2 == 0 else "--"
            axes.plot(np.arange(len(history)), history, dashes, color=SERIES[k // 2 % len(SERIES)], lw=1.4, label=label)
        columns = {label: every[k] for k, label in enumerate(histories)}
    else:
        low, high = np.percentile(every, BAND, axis=0)
        axes.fill_between(
            iteration, low, high, color=SERIES[0], alpha=0.25, linewidth=0, label=f"{BAND[0]} to {BAND[1]} %"
        )
        axes.plot(iteration, np.median(every, axis=0), color=SERIES[0], lw=1.4, label=f"median of {len(histories):,}")
        columns = {"median": np.median(every, axis=0), f"{BAND[0]} %": low, f"{BAND[1]} %": high}
    axes.set(ylim=(0, None))
    style(axes, title="residual", xlabel="iteration", ylabel="unexplained share", legend=True)
    spread_ticks(axes)
    ends = every[:, -1]
    svg = to_svg(
        figure, f"Residual over the iterations: {np.median(every[:, 0]):.3f} to {np.median(ends):.3f} (median)."
    )
    lengths = np.array([len(history) for history in histories.values()])
    rows = []
    for k in range(length):
        cells = [number(values[k], 4) for values in columns.values()]
        if len(histories) <= FEW_VOLUMES:
            cells = [cell if k < lengths[j] else markup.NONE for j, cell in enumerate(cells)]
        rows.append([str(k), *cells])
    return svg, markup.table(["iteration", *columns], rows, caption="Residual per iteration of SMART")


def _brightness(first: xr.Dataset, sheet: LightSheet | None, frames: Sequence[str]) -> tuple[str, str]:
    """Draw and tabulate the mean brightness over the depth in both frames, with the light sheet if there is one."""
    z = first["z"].values
    profiles = dict(zip(frames, first["profile_z"].values, strict=True))
    digits = 0 if max(profile.max() for profile in profiles.values()) >= 100 else 2
    figure, axes = new_panel()
    if sheet is not None:
        axes.axvspan(sheet.low_mm, sheet.high_mm, color=INK, alpha=0.15, linewidth=0)
        levels = [sheet.inside, sheet.outside]
        axes.hlines(levels, z[0], z[-1], color=INK, linewidth=0.8, linestyle=":")
    for k, (frame, profile) in enumerate(profiles.items()):
        axes.plot(z, profile, "-" if k % 2 == 0 else "--", color=SERIES[k % len(SERIES)], lw=1.4, label=frame)
    axes.axhline(0, color=INK, linewidth=0.6)
    axes.set(ylim=(0, 1.3 * axes.get_ylim()[1]))  # room for the legend
    style(axes, title="brightness over the depth", xlabel="z [mm]", ylabel="mean intensity [counts]", legend=True)
    spread_ticks(axes)
    contrast = "" if sheet is None else f"; {number(sheet.ratio, 1)} times as bright inside the light sheet as outside"
    svg = to_svg(figure, f"Mean brightness over z{contrast}.")
    rows = [
        [number(depth, 3), *(number(float(profile[k]), digits) for profile in profiles.values())]
        for k, depth in enumerate(z)
    ]
    titles = ["z [mm]", *(f"{frame} [counts]" for frame in profiles)]
    table = markup.table(titles, rows, caption="Brightness over the depth")
    if sheet is not None:
        table = _sheet_table(z, profiles) + table
    return svg, table


def _sheet_table(z: np.ndarray, profiles: Mapping[str, np.ndarray]) -> str:
    """Tabulate the light sheet of each frame."""
    rows = []
    for frame, profile in profiles.items():
        sheet = find_sheet(z, profile)
        values = [markup.NONE] * 5
        if sheet is not None:
            values = [number(sheet.low_mm, 2), number(sheet.high_mm, 2), number(sheet.inside, 2)]
            values += [number(sheet.outside, 2), number(sheet.ratio, 2)]
        rows.append([frame, *values])
    titles = ["light sheet", "from z [mm]", "to z [mm]", "inside [counts]", "outside [counts]", "inside / outside"]
    return markup.table(titles, rows, caption="Brightness inside and outside the light sheet")


_IMAGE_FIGURES = ("structure", "camera_gain", "light_outside")  # those of `lfpiv.results.netcdf.OF_IMAGES` in the table


def _images(pairs: Sequence[PairFigures], recording: Recording) -> str:
    """Tabulate medians over the images of each camera: structure, brightness and light beside the volume."""
    found: dict[str, dict[str, dict[str, float]]] = {}  # of camera, figure and volume
    for pair in pairs:
        for name in _IMAGE_FIGURES:
            for frame, cameras in getattr(pair, name).items():
                for camera, value in cameras.items():
                    found.setdefault(camera, {}).setdefault(name, {})[recording.named(pair.number, frame).label] = value
    if not found:
        return ""
    rows = []
    for camera, values in found.items():
        structure, gain, outside = (
            float(np.median(list(values[name].values()))) if name in values else None for name in _IMAGE_FIGURES
        )
        rows.append([camera, number(structure, 2), number(gain, 2), percent(outside)])
    text = (
        "Medians over the images. Near pixels correlate by 0.2 or more where particles stand out from the noise. "
        "Brightness is relative to the brightest camera. Light beside the volume is light of pixels that see no voxel: "
        "the light sheet is wider than the volume, or there are reflections."
    )
    titles = ["camera", "correlation of near pixels", "brightness", "light beside the volume"]
    return markup.paragraph(text) + markup.table(titles, rows, caption="Quality of the images of each camera")


def _stops(pairs: Sequence[PairFigures], recording: Recording) -> list[list[str]]:
    """Count the volumes by the reason why their iteration ended."""
    of_volume = {recording.named(pair.number, frame).label: stop for pair in pairs for frame, stop in pair.stop.items()}
    return [[f"{count:,}", reason] for reason, count in Counter(of_volume.values()).most_common()]

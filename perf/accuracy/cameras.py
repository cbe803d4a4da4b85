"""Compare one, two and three cameras on the same particles and flow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import bench
import numpy as np
import xarray as xr
from bench import Bench, Judged, Pair

from lfpiv.progress import Progress
from lfpiv.reproduce import page, plots, rigs

TITLE = "One, two and three cameras"

SETS = {"one": bench.ONE, "two": bench.TWO, "three": bench.THREE}
PPM = {"small": (0.2, 0.5), "paper": (0.1, 0.2, 0.5, 1.0)}
SLICE_VOXEL = 6
"""Thickness of the slice that is shown, along y [voxel]."""
COLOURS = {"one": "#e0762a", "two": "#2f81d6", "three": "#2ca36b", "truth": plots.COLOURS["truth"]}
NAMES = {"one": "one camera", "two": "two cameras", "three": "three cameras", "truth": "true particles"}


def run(scale: str, work: Path, *, seed: int = 0, progress: Progress) -> dict[str, Any]:
    """Measure the same pairs with every set of cameras; see the package for the arguments."""
    own = bench.open_bench(work.parent / "bench", scale, seed, progress)
    return compute(own, PPM[scale], work, seed=seed, progress=progress)


def compute(own: Bench, ppms: tuple[float, ...], work: Path, *, seed: int, progress: Progress) -> dict[str, Any]:
    """Measure with every set of cameras on a calibrated bench."""
    judged, shown = {}, {}
    todo = [(ppm, name) for ppm in ppms for name in ("truth", *SETS)]
    for done, (ppm, name) in enumerate(todo):
        progress(f"{NAMES[name]}, {ppm:g} ppm", done / len(todo))
        pair = Pair(ppm=ppm)
        signal: dict[str, float] = {}
        if name == "truth":
            volumes = own.true_volumes(pair)
        else:
            volumes, signal = own.volumes(bench.run_name(pair, name), pair=pair, cameras=SETS[name])
        judged[name, ppm] = own.judge(volumes, signal, pair=pair)
        if ppm == ppms[0]:
            shown[name] = volumes[0]
    progress("cameras", 1.0)
    _draw(judged, ppms, shown, work / "cameras.png")
    return _result(own, judged, ppms, seed)


def _result(own: Bench, judged: Mapping[tuple[str, float], Judged], ppms: Sequence[float], seed: int) -> dict[str, Any]:
    densest = ppms[-1]
    rows = [[NAMES[name], ppm, *one.cells(), one.elongation] for (name, ppm), one in judged.items()]
    return page.result(
        {
            "angles_deg": {camera.name: camera.true_yaw_deg for camera in own.rig.scene.camera},
            "size_mm": own.size_mm,
            "mapping_error_pitch": rigs.mapping_errors_pitch(own.rig, own.grid, seed),
            "runs": [{"cameras": name, "ppm": ppm, **one.row()} for (name, ppm), one in judged.items()],
        },
        comparison=[
            row
            for name in SETS
            for row in (
                page.compare(
                    f"mean displacement error, {NAMES[name]}, {densest:g} ppm",
                    judged[name, densest].error.mean,
                    unit="voxel",
                ),
                page.compare(
                    f"of that along depth, {NAMES[name]}", judged[name, densest].error.mean_absolute[2], unit="voxel"
                ),
                page.compare(f"Q, {NAMES[name]}", judged[name, densest].q),
            )
        ],
        figures=[
            (
                "cameras.png",
                f"Top: the volume at {ppms[0]:g} ppm, brightest voxels of a slice {SLICE_VOXEL} voxels thick about "
                "y = 0; depth runs to the right. Bottom: mean absolute error of the displacement along each axis, Q, "
                "and ghosts, peaks that are no particle, for each true particle.",
            )
        ],
        tables=[
            {
                "caption": "Error: mean length against the flow's mean over each window; x, y, z: mean absolute "
                "components; all in voxels, all vectors; ±: standard error of the mean. Ghosts: peaks that "
                "are no particle, for each true one. Elongation: of the particles "
                "found, along depth over across.",
                "columns": ["", "ppm", *bench.COLUMNS, "elongation"],
                "rows": rows,
            }
        ],
        notes=[
            "Cameras at "
            + ", ".join(f"{camera.true_yaw_deg:g}" for camera in own.rig.scene.camera)
            + " degrees, misaligned and noisy, each calibrated from its own images of one board; the flow is the "
            f"paper's ring vortex in {' x '.join(f'{edge:g}' for edge in own.size_mm)} mm. One camera is the middle "
            "one, whose depth is the volume's; two are the outer ones.",
            _about_depth(judged, densest),
            f"One pair of each seeding. {bench.ABOUT_STANDARD_ERROR}",
            "The correlation of the true particles, drawn as blobs on the voxels, shows what the windows themselves "
            "leave. No camera can do better.",
            "R_acc, R_g and ghosts count peaks: a single camera's are few and long. Where particles touch, peaks of "
            "the true volume are displaced or lost too.",
            "A single camera's vectors pass the validation although their depth is wrong: neighbours share the error.",
        ],
    )


def _about_depth(judged: Mapping[tuple[str, float], Judged], ppm: float) -> str:
    """Describe the depth error of each set of cameras."""
    parts = []
    for name in SETS:
        x, y, z = judged[name, ppm].error.mean_absolute
        parts.append(f"{NAMES[name]} {z:.3f} voxel, {2 * z / (x + y):.1f} times the mean of x and y")
    return (
        f"Depth is the weak axis: at {ppm:g} ppm its error is, with {'; '.join(parts)}. A pupil of 7 degrees sees "
        "depth by a parallax of one in eight; cameras at an angle see it as they see x."
    )


def _draw(
    judged: Mapping[tuple[str, float], Judged],
    ppms: tuple[float, ...],
    shown: Mapping[str, xr.DataArray],
    path: Path,
) -> None:
    drawn = plots.figure(10.5, 6.0)
    top, bottom = drawn.subfigures(2, 1, squeeze=False, height_ratios=(1.15, 1))[:, 0]
    for axes, (name, volume) in zip(top.subplots(1, len(shown)), shown.items(), strict=True):
        plots.draw_slice(axes, volume, SLICE_VOXEL, NAMES[name])
    left, middle, right = bottom.subplots(1, 3)
    width = 0.8 / len(SETS) / len(ppms)
    for number, name in enumerate(SETS):
        for second, ppm in enumerate(ppms):
            offset = (number * len(ppms) + second + 0.5) * width - 0.4
            left.bar(
                np.arange(3) + offset,
                judged[name, ppm].error.mean_absolute,
                width,
                color=COLOURS[name],
                alpha=1 - 0.55 * second / max(1, len(ppms) - 1),
                label=NAMES[name] if second == 0 else None,
            )
    left.set_xticks(range(3), ["x", "y", "z (depth)"])
    left.set(ylabel="mean absolute error [voxel]", yscale="log")
    plots.plain_log(left.yaxis, (0.02, 0.05, 0.1, 0.2, 0.5))
    left.set_title(f"from solid to faint: {', '.join(f'{ppm:g}' for ppm in ppms)} ppm", fontsize=8)
    for axes, key, label in ((middle, "q", "Q"), (right, "ghosts", "ghosts per particle")):
        for name in SETS:
            axes.plot(ppms, [getattr(judged[name, ppm], key) for ppm in ppms], "o-", color=COLOURS[name], ms=4)
        axes.set(xlabel="particles per microlens", ylabel=label, ylim=(0, 1 if key == "q" else None))
        axes.set_xlim(0, None)
    for axes in (left, middle, right):
        plots.plain(axes)
    left.legend(frameon=False, fontsize=7, loc="upper left")
    left.set_xlim(-0.5, 2.5)
    plots.save(drawn, path)

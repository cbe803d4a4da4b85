"""Displacement error and Q against noise, and against seeding."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import bench
from bench import DEFAULT, Bench, Judged, Pair

from lfpiv.progress import Progress
from lfpiv.reproduce import page, plots

TITLE = "Noise and seeding"

PPM = {"small": (0.05, 0.2, 0.5, 1.0, 2.0), "paper": (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 1.5, 2.0, 3.0)}
"""Seeding, at the bench's exposure."""
COUNTS = {"small": (300.0, 30.0, 8.0, 2.5), "paper": (300.0, 100.0, 30.0, 15.0, 8.0, 4.0, 2.5)}
"""Level of a pixel lit by one particle [count], at the bench's seeding; the noise stays as it is."""
Signal = dict[str, float]
"""Signal and noise of the images of a run, see `Bench.volumes`."""
Seeding = tuple[float, Judged, Signal, Judged]
"""Seeding [ppm], measurement, its images, and the correlation of the true particles."""
Noise = tuple[float, Judged, Signal]
"""Signal to noise, measurement, and its images."""
AXES = {"x": "#2f81d6", "y": "#2ca36b", "z": "#e0762a"}


def run(scale: str, work: Path, *, seed: int = 0, progress: Progress) -> dict[str, Any]:
    """Measure pairs of every seeding and every exposure; see the package for the arguments."""
    own = bench.open_bench(work.parent / "bench", scale, seed, progress)
    return compute(own, PPM[scale], COUNTS[scale], work, progress=progress)


def compute(
    own: Bench, ppms: tuple[float, ...], counts: tuple[float, ...], work: Path, *, progress: Progress
) -> dict[str, Any]:
    """Measure on a calibrated bench with two cameras."""
    pairs = [replace(DEFAULT, ppm=ppm) for ppm in ppms] + [replace(DEFAULT, counts=level) for level in counts]
    judged: dict[Pair, tuple[Judged, Signal]] = {}
    truth: dict[Pair, Judged] = {}
    for done, pair in enumerate(pairs):
        progress(f"{pair.ppm:g} ppm, {pair.counts:g} counts", done / len(pairs))
        if pair in judged:
            continue
        volumes, signal = own.volumes(bench.run_name(pair, "two"), pair=pair)
        judged[pair] = own.judge(volumes, signal, pair=pair), signal
        if pair.counts == DEFAULT.counts:
            truth[pair] = own.judge(own.true_volumes(pair), {}, pair=pair)
    progress("sweeps", 1.0)
    seeding = [(pair.ppm, *judged[pair], truth[pair]) for pair in pairs[: len(ppms)]]
    noise = [(judged[pair][1]["snr"], *judged[pair]) for pair in pairs[len(ppms) :]]
    _draw(seeding, noise, work / "sweeps.png")
    return _result(own, seeding, noise)


def _result(own: Bench, seeding: Sequence[Seeding], noise: Sequence[Noise]) -> dict[str, Any]:
    best, worst = min(seeding, key=lambda row: row[1].error.mean), max(seeding, key=lambda row: row[1].error.mean)
    return page.result(
        {
            "seeding": [{"ppm": ppm, **signal, **one.row()} for ppm, one, signal, _ in seeding],
            "noise": [{"ppm": DEFAULT.ppm, **signal, **one.row()} for _, one, signal in noise],
            "size_mm": own.size_mm,
        },
        comparison=[
            page.compare(f"smallest mean error over the seeding, at {best[0]:g} ppm", best[1].error.mean, unit="voxel"),
            page.compare(
                f"largest mean error over the seeding, at {worst[0]:g} ppm", worst[1].error.mean, unit="voxel"
            ),
            *(
                page.compare(
                    f"mean error at {_electrons(signal)} electrons per particle and camera",
                    one.error.mean,
                    unit="voxel",
                )
                for _, one, signal in (noise[0], noise[-1])
            ),
        ],
        figures=[
            (
                "sweeps.png",
                "Mean absolute error of the displacement along each axis (top) and Q (bottom) against seeding (left) "
                "and against the images' signal to noise (right). Dotted: the correlation of the true particles, "
                "mean of the axes.",
            )
        ],
        tables=[
            {
                "caption": f"Seeding, at {_electrons(seeding[0][2])} electrons per particle and camera. Errors "
                "in voxels, against the flow's mean over each window; true: of the true particles' correlation.",
                "columns": ["ppm", *bench.COLUMNS, "true", "SNR"],
                "rows": [[ppm, *one.cells(), exact.error.mean, signal["snr"]] for ppm, one, signal, exact in seeding],
            },
            {
                "caption": f"Noise, at {DEFAULT.ppm:g} ppm. Electrons: what one camera receives of one particle.",
                "columns": ["electrons", "SNR", *bench.COLUMNS],
                "rows": [[_electrons(signal), signal["snr"], *one.cells()] for _, one, signal in noise],
            },
        ],
        notes=[
            f"Two cameras of the bench, {' x '.join(f'{edge:g}' for edge in own.size_mm)} mm, one pair each. "
            f"±: standard error of the mean over the pair's vectors. {bench.ABOUT_STANDARD_ERROR}",
            "SNR: brightness of an image, sum I^2 / sum I, over the shot and read-out noise at that level; read-out "
            f"{own.rig.scene.noise.read_noise:g} counts, {own.rig.scene.noise.full_well_e:g} electrons at full scale. "
            "Particles become dimmer, the noise stays; at a low exposure a longer one or more laser power is the "
            "remedy.",
            "Dense volumes are nearly full, the true ones too, and their means agree. So Q does not show how well "
            "particles are found there. With the means subtracted it is a correlation coefficient.",
            "Sparse seeding: few particles in a window, so the true particles' correlation has errors as well. "
            "Dense seeding: particles and ghosts merge, so fewer peaks stand for either and R_acc falls.",
            *_about_saturation(seeding),
        ],
    )


def _electrons(signal: Signal) -> int:
    """Return the electrons of a particle, rounded to two digits."""
    return int(float(f"{signal['electrons']:.2g}"))


def _about_saturation(seeding: Sequence[Seeding]) -> list[str]:
    clipped = [(ppm, signal["saturated"]) for ppm, _, signal, _ in seeding if signal["saturated"] > 1e-4]
    if not clipped:
        return []
    text = ", ".join(f"{100 * share:.2g} % at {ppm:g} ppm" for ppm, share in clipped)
    return [f"The exposure is the same for every seeding, so some pixels saturate: {text}."]


def _draw(seeding: Sequence[Seeding], noise: Sequence[Noise], path: Path) -> None:
    drawn = plots.figure(8.5, 5.2)
    (error_by_ppm, error_by_snr), (q_by_ppm, q_by_snr) = drawn.subplots(2, 2, sharex="col", sharey="row")
    for number, (axis, colour) in enumerate(AXES.items()):
        for axes, rows in ((error_by_ppm, seeding), (error_by_snr, noise)):
            errors = [row[1].error.mean_absolute[number] for row in rows]
            axes.plot([row[0] for row in rows], errors, "o-", color=colour, ms=4, label=axis)
    exact = [sum(row[3].error.mean_absolute) / 3 for row in seeding]
    error_by_ppm.plot(
        [row[0] for row in seeding], exact, ":", color=plots.COLOURS["truth"], label="true particles, mean"
    )
    for axes, rows in ((q_by_ppm, seeding), (q_by_snr, noise)):
        for key, line, label in (("q", "o-", "Q"), ("q_zero_mean", "o:", "Q, means subtracted")):
            values = [getattr(row[1], key) for row in rows]
            axes.plot([row[0] for row in rows], values, line, color=plots.COLOURS["truth"], ms=4, label=label)
    error_by_ppm.set(ylabel="mean absolute error [voxel]", ylim=(0, None))
    q_by_ppm.set(ylabel="Q", xlabel="particles per microlens", ylim=(0, 1), xscale="log")
    q_by_snr.set(xlabel="signal to noise of the images", xscale="log")
    for axes in (error_by_ppm, error_by_snr, q_by_ppm, q_by_snr):
        plots.plain(axes)
    plots.plain_log(q_by_ppm.xaxis, [row[0] for row in seeding])
    plots.plain_log(q_by_snr.xaxis, [row[0] for row in noise])
    for axes in (error_by_ppm, q_by_ppm):
        axes.legend(frameon=False, fontsize=8)
    plots.save(drawn, path)

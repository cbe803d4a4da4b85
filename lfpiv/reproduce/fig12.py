"""Figs. 11 and 12: quality of random particles reconstructed with the network's weights and with ray tracing's."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv import metrics
from lfpiv.metrics.particles import PEAK_SHARE
from lfpiv.progress import Progress
from lfpiv.reproduce import page, plots, rigs, store
from lfpiv.reproduce.voxels import Voxels, demanded
from lfpiv.settings.processing import Correlation, Smart
from lfpiv.velocity.volume_pair import missing_smoothing, preprocess
from lfpiv.weights.operator import Weights

TITLE = "Fig. 12: reconstructed particles; Fig. 11: at 0.1 particles per microlens"

SIZE_MM = {"small": (5.0, 5.0, 5.0), "paper": (10.0, 10.0, 10.0)}
PPM = {"small": (0.1, 0.3, 0.5, 0.7, 1.0), "paper": tuple(round(0.1 * n, 1) for n in range(1, 11))}
MAPPINGS = ("network", "drt")
SCATTER_PPM = 0.1
"""Seeding of Fig. 11."""
PAPER_Q = 0.75
GOAL_Q = 0.80
POINTS_PPM = {"small": (0.1, 0.5, 1.0), "paper": PPM["paper"]}
"""Seeding at which points are reconstructed too, by the network."""
SIZE_PPM = 0.5
"""Seeding of the images that the particles' size is measured in."""
TRUTH_PPM = 0.5
"""Seeding at which SMART also starts from the true particles, to test whether the images distinguish ghosts."""
DARK_SHARE = 1e-3
"""First guess of that run in voxels without a particle, as a share of the brightest voxel."""
VARIANTS: dict[str, dict[str, Any]] = {
    "blobs": {},
    "points": {},
    "from_truth": {"sieve_voxel": 0.0},
    "paper": {
        "iterations": 10,
        "relaxation": 1.0,
        "accelerate": False,
        "floor_share": 0.0,
        "intensity_cap": 0.0,
        "tolerance": 0.0,
        "sieve_voxel": 0.0,
    },
    "no_sieve": {"sieve_voxel": 0.0},
}
"""SMART settings of each kind of run that differ from the defaults. "paper" has the paper's number of iterations and
relaxation, and its voxels: no finer ones, none beyond the volume. "no_sieve" reconstructs voxels instead of Gaussians
of the particles' size. Particles are blobs, in "points" they are points."""
CORRELATED_VOXEL = Correlation().smoothing_voxel
"""Smoothing before the correlation, the sieve's included [voxel]. Q is reported of volumes smoothed like this too."""


FIGURES = (
    (
        "fig12.png",
        "R_acc (Eq. 13), R_g (Eq. 14) and Q against seeding. The paper's mean Q over 0.1 to 1 ppm is 0.75.",
    ),
    (
        "fig11.png",
        f"Fig. 11: particles at {SCATTER_PPM} ppm: true ones, and those found in the volumes; ghosts, with no true "
        "particle within a voxel, are marked. Below, a slice of 1 mm about y = 0.",
    ),
)
TABLES = {
    f"Gaussian particles, sigma {rigs.BLOB_VOXEL} voxel": MAPPINGS,
    f"The same with the paper's SMART: {VARIANTS['paper']['iterations']} iterations, no momentum": ("paper",),
    "The same without a sieve, in voxels of any brightness: the difference is the value of the particles' size, which "
    "the images show": ("no_sieve",),
    "Point particles, Q against the same blobs": ("points",),
}
"""Caption of each table, and the groups of runs in it."""
NOTES = (
    f"A peak counts as a particle above {PEAK_SHARE:g} of the median brightness found at the true particles; the paper "
    "does not state its threshold, on which R_acc and R_g depend.",
    "Points are far smaller than a voxel. A point leaves some pixels of its voxel's footprint dark, which lowers its "
    "brightness. The Q of points is measured against blobs.",
)


@dataclass(frozen=True)
class Job:
    """One volume to reconstruct and judge."""

    mapping: str
    """One of `MAPPINGS`."""
    ppm: float
    """Seeding [particles per microlens]."""
    kind: str
    """Key of `VARIANTS`."""


def run(scale: str, work: Path, *, seed: int = 0, progress: Progress) -> dict[str, Any]:
    """Reconstruct and judge; see `lfpiv.reproduce.study` for the arguments."""
    rig = rigs.numerical_rig(work.parent / "rig", scale, seed, progress)
    size, ppms = SIZE_MM[scale], PPM[scale]
    grid = rigs.volume_grid(size)
    settings = {
        "scale": scale,
        "seed": seed,
        "size_mm": size,
        "smart": Smart().model_dump(),
        "correlated_voxel": CORRELATED_VOXEL,
    }

    def recorded(ppm: float, blob_voxel: float) -> dict[str, np.ndarray]:
        return rigs.particle_images(rig, _positions(size, ppm, seed), _stream(ppm, seed), blob_voxel=blob_voxel)

    voxels = {"paper": Voxels(grid)}
    for kind in ("blobs", "points"):
        images = partial(recorded, SIZE_PPM, _blob_voxel(kind))
        voxels[kind] = demanded(rig, grid, work / f"size_{kind}.npz", {**settings, "kind": kind}, images)
    built: dict[tuple[str, Voxels], Weights] = {}
    runs, found = [], {}
    jobs = _jobs(scale)
    for done, job in enumerate(jobs):

        def compute(job: Job = job, done: int = done) -> dict[str, Any]:
            mine = voxels[_voxels_of(job.kind)]
            if (job.mapping, mine) not in built:
                built.clear()  # one set of weights at a time: memory
                built[job.mapping, mine] = mine.weights(rig, job.mapping)
            smart = Smart.model_validate({**Smart().model_dump(), **VARIANTS[job.kind]})
            step = _part(progress, "reconstruction", done, len(jobs))
            return _judge(
                mine,
                built[job.mapping, mine],
                recorded(job.ppm, _blob_voxel(job.kind)),
                _positions(size, job.ppm, seed),
                smart,
                job.kind == "from_truth",
                step,
            )

        figures = store.cached_arrays(
            work / f"{job.kind}_{job.mapping}_{job.ppm:.2f}.npz",
            {
                **settings,
                "ppm": job.ppm,
                "kind": job.kind,
                **VARIANTS[job.kind],
                "refinement": voxels[_voxels_of(job.kind)].refinement,
            },
            compute,
        )
        scalars = {key: value.tolist() for key, value in figures.items() if key not in ("found_mm", "peaks")}
        runs.append({"mapping": job.mapping, "ppm": job.ppm, "particles": job.kind, **scalars})
        found[job] = figures["found_mm"]
    true_mm = _positions(size, SCATTER_PPM, seed)
    shown = {mapping: found[Job(mapping, SCATTER_PPM, "blobs")] for mapping in MAPPINGS}
    _draw_scatter({"truth": true_mm, **shown}, true_mm, size, work / "fig11.png")
    groups = {
        mapping: [r for r in runs if (r["mapping"], r["particles"]) == (mapping, "blobs")] for mapping in MAPPINGS
    }
    groups |= {kind: [r for r in runs if r["particles"] == kind] for kind in VARIANTS if kind != "blobs"}
    _draw_curves({name: groups[name] for name in (*MAPPINGS, "no_sieve")}, work / "fig12.png")
    mapping_error = rigs.mapping_errors_pitch(rig, grid, seed)
    refinement = {kind: mine.refinement for kind, mine in voxels.items()}
    setup = {"ppm": ppms, "size_mm": size, "mapping_error_pitch": mapping_error, "refinement": refinement, "runs": runs}
    return _result(groups, setup, voxels["blobs"].text)


def _jobs(scale: str) -> list[Job]:
    """Return all volumes of a scale, those of the same weights one after the other."""
    jobs = [Job(mapping, ppm, "blobs") for mapping in MAPPINGS for ppm in PPM[scale]]
    jobs += [Job("network", ppm, kind) for ppm in PPM[scale] for kind in ("paper", "no_sieve")]
    jobs += [Job("network", TRUTH_PPM, "from_truth")]
    jobs += [Job("network", ppm, "points") for ppm in POINTS_PPM[scale]]
    return sorted(jobs, key=lambda job: (job.mapping, _voxels_of(job.kind), job.ppm, job.kind))


def _voxels_of(kind: str) -> str:
    """Return whose voxels a kind of run has: "paper", "points", or else "blobs"."""
    return kind if kind in ("paper", "points") else "blobs"


def _blob_voxel(kind: str) -> float:
    return 0.0 if kind == "points" else rigs.BLOB_VOXEL


def _stream(ppm: float, seed: int) -> list[int]:
    """Return the seed of the random numbers of one seeding."""
    return [seed, 12, round(1000 * ppm)]


def _positions(size: tuple[float, float, float], ppm: float, seed: int) -> np.ndarray:
    return rigs.random_particles(size, ppm, _stream(ppm, seed))


def _result(
    groups: Mapping[str, Sequence[Mapping[str, Any]]], setup: Mapping[str, Any], reconstructed: str
) -> dict[str, Any]:
    q_mean = {mapping: _mean(groups[mapping]) for mapping in MAPPINGS}
    accuracy, ghost_ratio, q_as_correlated = (
        {mapping: _mean(groups[mapping], key) for mapping in MAPPINGS}
        for key in ("accuracy", "ghost_ratio", "q_as_correlated")
    )
    q_paper, q_no_sieve = _mean(groups["paper"]), _mean(groups["no_sieve"])
    smoothed = f"volumes as correlated: smoothed by {CORRELATED_VOXEL:g} voxel less their sieve"
    return page.result(
        {
            "q_mean": q_mean,
            "accuracy_mean": accuracy,
            "ghost_ratio_mean": ghost_ratio,
            "q_mean_paper_settings": q_paper,
            "q_mean_no_sieve": q_no_sieve,
            "q_mean_as_correlated": q_as_correlated,
            "blob_sigma_voxel": rigs.BLOB_VOXEL,
            "smart": Smart().model_dump(),
            **setup,
        },
        comparison=[
            page.compare("mean Q, network", q_mean["network"], paper=PAPER_Q, at_least=GOAL_Q),
            page.compare("mean Q, DRT", q_mean["drt"], paper="similar"),
            page.compare("mean Q, network, the paper's SMART: 10 iterations", q_paper, paper=PAPER_Q),
            page.compare(f"mean Q, network, {smoothed}", q_as_correlated["network"]),
            page.compare("mean Q, network, no sieve: voxels of any brightness", q_no_sieve),
            page.compare("mean R_acc, network", accuracy["network"]),
            page.compare("mean R_acc, DRT", accuracy["drt"]),
            page.compare("mean R_g, network", ghost_ratio["network"]),
            page.compare("mean R_g, DRT", ghost_ratio["drt"]),
        ],
        figures=FIGURES,
        tables=[_table(caption, [row for name in names for row in groups[name]]) for caption, names in TABLES.items()],
        notes=[
            "ppm: particles per microlens of the volume's x-y face.",
            f"SMART as this software runs it by default: at most {Smart().iterations} iterations.",
            f"{reconstructed} The paper's SMART reconstructs these voxels themselves.",
            *NOTES,
            _verdict(q_mean["network"], groups["network"], groups["no_sieve"], groups["from_truth"][0]),
        ],
    )


def _judge(
    voxels: Voxels,
    weights: Weights,
    images: Mapping[str, np.ndarray],
    positions_mm: np.ndarray,
    smart: Smart,
    from_truth: bool,
    step: Callable[[float], None],
) -> dict[str, Any]:
    truth, first = rigs.truth(positions_mm, voxels.volume), None
    if from_truth:  # dark voxels are not quite dark: ghosts may grow
        light = sum(float(image.sum(dtype=np.float64)) for image in images.values()) / len(images)
        start = rigs.truth(positions_mm, voxels.grid)
        first = (start.values + DARK_SHARE * float(start.max())) * np.float32(light / float(start.sum()))
    result = voxels.reconstruct(weights, images, smart, first=first, progress=step)
    quality = metrics.particle_quality(result, positions_mm)
    found = metrics.find_particles(result, quality.threshold)
    return {
        "q": metrics.reconstruction_quality(result, truth),
        "q_as_correlated": metrics.reconstruction_quality(
            result.copy(data=preprocess(result.values, missing_smoothing(CORRELATED_VOXEL, result), 1.0)), truth
        ),
        "q_zero_mean": metrics.reconstruction_quality(result, truth, zero_mean=True),
        "accuracy": quality.accuracy,
        "ghost_ratio": quality.ghost_ratio,
        "precision": quality.precision,
        "recall": quality.recall,
        "rms_mm": quality.rms_mm,
        "elongation": quality.elongation,
        "residual": result.attrs["residual"][-1],
        "sieve_voxel": result.attrs["sieve_voxel"],
        "particles_true": quality.true_count,
        "found_mm": found.positions_mm.astype(np.float32),
        "peaks": found.peaks.astype(np.float32),
    }


def _mean(rows: Sequence[Mapping[str, Any]], key: str = "q") -> float:
    return float(np.mean([row[key] for row in rows]))


def _part(progress: Progress, what: str, done: int, total: int) -> Callable[[float], None]:
    return lambda fraction: progress(what, (done + fraction) / total)


def _table(caption: str, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    columns = ["weights", "ppm", "Q", "Q, as correlated", "R_acc", "R_g", "precision", "recall", "elongation"]
    keys = ("ppm", "q", "q_as_correlated", "accuracy", "ghost_ratio", "precision", "recall", "elongation")
    return {
        "caption": caption,
        "columns": columns,
        "rows": [[plots.NAMES[row["mapping"]], *(row[key] for key in keys)] for row in rows],
    }


def _verdict(
    q_mean: float,
    rows: Sequence[Mapping[str, Any]],
    no_sieve: Sequence[Mapping[str, Any]],
    from_truth: Mapping[str, Any],
) -> str:
    """Describe whether Q reaches its goal, and compare with the run that starts from the true particles."""
    ours = next(row for row in no_sieve if row["ppm"] == from_truth["ppm"])
    return (
        f"Mean Q of the network is {q_mean:.3f}, {min(r['q'] for r in rows):.2f} to {max(r['q'] for r in rows):.2f}, "
        f"goal {GOAL_Q:g}. Without a sieve, at {ours['ppm']:g} ppm, Q is {ours['q']:.2f} with an image residual of "
        f"{ours['residual']:.4f}; the same iterations started from the true particles end at Q {from_truth['q']:.2f} "
        f"with {from_truth['residual']:.4f}. The nearer these residuals, the less can the images of two cameras "
        "distinguish ghosts from particles, with any weights: DRT with the true geometry gives the same Q."
    )


def _draw_curves(blobs: Mapping[str, Sequence[Mapping[str, Any]]], path: Path) -> None:
    drawn = plots.figure(9.5, 3.0)
    panels = (("accuracy", "R_acc"), ("ghost_ratio", "R_g"), ("q", "Q"))
    for axes, (key, label) in zip(drawn.subplots(1, 3), panels, strict=True):
        for (mapping, rows), mark in zip(blobs.items(), ("o-", "s--", "^:"), strict=True):
            ppm = [row["ppm"] for row in rows]
            values = [row[key] for row in rows]
            axes.plot(ppm, values, mark, color=plots.COLOURS[mapping], label=plots.NAMES[mapping], mfc="none", ms=5)
        if key == "q":
            axes.axhline(PAPER_Q, color=plots.COLOURS["paper"], lw=0.9, ls=":", label="paper's mean")
        axes.set_xlabel("particles per microlens")
        axes.set_ylabel(label)
        axes.set_xlim(0, 1.05)
        axes.set_ylim(0, 1 if key != "ghost_ratio" else None)
        axes.legend(frameon=False, fontsize=8)
        plots.plain(axes)
    plots.save(drawn, path)


def _draw_scatter(
    found: Mapping[str, np.ndarray], true_mm: np.ndarray, size_mm: tuple[float, float, float], path: Path
) -> None:
    drawn = plots.figure(11, 7.2)
    drawn.set_layout_engine("constrained", w_pad=0.15, h_pad=0.05)
    half = np.array(size_mm) / 2
    for place, (name, positions) in enumerate(found.items()):
        matched = np.zeros(len(positions), bool)
        matched[metrics.match_particles(positions, true_mm, rigs.VOXEL_MM)[:, 0]] = True
        space: Any = drawn.add_subplot(2, 3, place + 1, projection="3d")  # matplotlib does not type axes in space
        flat = drawn.add_subplot(2, 3, place + 4)
        near = np.abs(positions[:, 1]) < 0.5
        for which, colour, label in ((matched, plots.COLOURS.get(name), "particle"), (~matched, "#c23b3b", "ghost")):
            if not which.any():
                continue
            space.scatter(*positions[which][:, [2, 0, 1]].T, s=2 if label == "particle" else 1, c=colour, alpha=0.7)
            mark: dict[str, Any] = (
                {"s": 9, "c": colour} if label == "particle" else {"s": 14, "c": colour, "marker": "x", "lw": 0.7}
            )
            flat.scatter(*positions[which & near][:, [2, 0]].T, label=label, **mark)
        if name != "truth":
            inside = np.abs(true_mm[:, 1]) < 0.5
            x, _, z = true_mm[inside].T
            flat.scatter(z, x, s=34, facecolors="none", edgecolors="#30363c", lw=0.5, label="true")
        space.set_box_aspect(np.array(size_mm)[[2, 0, 1]], zoom=0.85)
        space.set(xlabel="z [mm]", ylabel="x [mm]", zlabel="y [mm]", title=f"{plots.NAMES[name]}: {len(positions)}")
        space.set(xlim=(-half[2], half[2]), ylim=(-half[0], half[0]), zlim=(-half[1], half[1]))
        flat.set(xlabel="z [mm]", ylabel="x [mm]", xlim=(-half[2], half[2]), ylim=(-half[0], half[0]), aspect="equal")
        if name != "truth":
            flat.legend(frameon=False, fontsize=7, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
        plots.plain(flat)
    plots.save(drawn, path)

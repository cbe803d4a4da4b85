"""Figs. 11 and 12: how well random particles are reconstructed, by the network's weights and by ray tracing's."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv import metrics
from lfpiv.experiment.settings import Correlation, Smart
from lfpiv.metrics.particles import PEAK_SHARE
from lfpiv.reconstruction.volume import reconstruct
from lfpiv.reproduce import page, plots, rigs, store
from lfpiv.reproduce.study import Progress
from lfpiv.velocity.cross_correlation import emphasise, missing_smoothing
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
TRUTH_PPM = 0.5
"""Seeding at which SMART is also started from the true particles: whether the images could tell ghosts at all."""
DARK_SHARE = 1e-3
"""Brightness it starts with where there is no particle, as a part of the brightest voxel."""
VARIANTS: dict[str, dict[str, Any]] = {
    "blobs": {},
    "points": {},
    "from_truth": {"sieve_voxel": 0.0},
    "paper": {
        "iterations": 10,
        "relaxation": 1.0,
        "accelerate": False,
        "floor_share": 0.0,
        "tolerance": 0.0,
        "sieve_voxel": 0.0,
    },
    "no_sieve": {"sieve_voxel": 0.0},
}
"""SMART settings of each kind of run that differ from this software's own. "paper": the paper's number of iterations
and relaxation; "no_sieve": voxels of any brightness, not Gaussians of the size that the images tell; both by the
network. Particles are blobs, but points in "points"."""
CORRELATED_VOXEL = Correlation().smoothing_voxel
"""What volumes are smoothed by before they are correlated, less what their sieve did already; Q is reported of such
volumes as well [voxel]."""


def run(scale: str, work: Path, *, seed: int = 0, progress: Progress) -> dict[str, Any]:
    """Reconstruct and judge; see the package for the arguments."""
    rig = rigs.numerical_rig(work.parent / "rig", scale, seed, progress)
    size, ppms = SIZE_MM[scale], PPM[scale]
    grid = rigs.volume_grid(size)
    smart = Smart()
    settings = {
        "scale": scale,
        "seed": seed,
        "size_mm": size,
        "smart": smart.model_dump(),
        "correlated_voxel": CORRELATED_VOXEL,
    }
    todo = [(mapping, ppm, "blobs") for mapping in MAPPINGS for ppm in ppms]
    todo += [("network", ppm, kind) for ppm in ppms for kind in ("paper", "no_sieve")]
    todo += [("network", TRUTH_PPM, "from_truth")]
    todo += [("network", ppm, "points") for ppm in POINTS_PPM[scale]]
    built: dict[str, Weights] = {}
    rows = []
    for done, (mapping, ppm, kind) in enumerate(sorted(todo)):
        step = _part(progress, "reconstruction", done, len(todo))
        draw = [seed, 12, round(1000 * ppm)]
        positions = rigs.random_particles(size, ppm, draw)

        def compute(
            mapping: str = mapping,
            ppm: float = ppm,
            kind: str = kind,
            step: Callable[[float], None] = step,
            draw: list[int] = draw,
            positions: np.ndarray = positions,
        ) -> dict[str, Any]:
            if mapping not in built:
                built.clear()  # one set of weights at a time: memory
                built[mapping] = rig.weights(grid, mapping)
            images = rigs.particle_images(rig, positions, draw, blob_voxel=0.0 if kind == "points" else rigs.BLOB_VOXEL)
            chosen = Smart.model_validate({**smart.model_dump(), **VARIANTS[kind]})
            return _judge(built[mapping], images, positions, chosen, kind == "from_truth", step)

        name = f"{kind}_{mapping}_{ppm:.2f}"
        figures = store.kept_arrays(
            work / f"{name}.npz", {**settings, "ppm": ppm, "kind": kind, **VARIANTS[kind]}, compute
        )
        scalars = {key: value.tolist() for key, value in figures.items() if key not in ("found_mm", "peaks")}
        rows.append({"mapping": mapping, "ppm": ppm, "particles": kind, **scalars})
        if (mapping, kind, ppm) == ("network", "blobs", SCATTER_PPM):
            network_found = figures["found_mm"]
        if (mapping, kind, ppm) == ("drt", "blobs", SCATTER_PPM):
            drt_found = figures["found_mm"]

    true_mm = rigs.random_particles(size, SCATTER_PPM, [seed, 12, round(1000 * SCATTER_PPM)])
    _draw_scatter({"truth": true_mm, "network": network_found, "drt": drt_found}, true_mm, size, work / "fig11.png")
    blobs = {
        mapping: [r for r in rows if r["mapping"] == mapping and r["particles"] == "blobs"] for mapping in MAPPINGS
    }
    points, paper, no_sieve, from_truth = (
        [r for r in rows if r["particles"] == kind] for kind in ("points", "paper", "no_sieve", "from_truth")
    )
    _draw_curves({**blobs, "no_sieve": no_sieve}, work / "fig12.png")

    def mean(mapping: str, key: str) -> float:
        return _mean(blobs[mapping], key)

    q_mean = {mapping: mean(mapping, "q") for mapping in MAPPINGS}
    return page.result(
        {
            "q_mean": q_mean,
            "accuracy_mean": {mapping: mean(mapping, "accuracy") for mapping in MAPPINGS},
            "ghost_ratio_mean": {mapping: mean(mapping, "ghost_ratio") for mapping in MAPPINGS},
            "q_mean_paper_settings": _mean(paper),
            "q_mean_no_sieve": _mean(no_sieve),
            "q_mean_as_correlated": {mapping: mean(mapping, "q_as_correlated") for mapping in MAPPINGS},
            "ppm": ppms,
            "size_mm": size,
            "blob_sigma_voxel": rigs.BLOB_VOXEL,
            "smart": smart.model_dump(),
            "mapping_error_pitch": rigs.mapping_errors_pitch(rig, grid, seed),
            "runs": rows,
        },
        comparison=[
            page.compare("mean Q, network", q_mean["network"], paper=PAPER_Q, at_least=GOAL_Q),
            page.compare("mean Q, DRT", q_mean["drt"], paper="similar"),
            page.compare("mean Q, network, the paper's SMART: 10 iterations", _mean(paper), paper=PAPER_Q),
            page.compare(
                f"mean Q, network, volumes as correlated: smoothed by {CORRELATED_VOXEL:g} voxel less their sieve",
                mean("network", "q_as_correlated"),
            ),
            page.compare("mean Q, network, no sieve: voxels of any brightness", _mean(no_sieve)),
            page.compare("mean R_acc, network", mean("network", "accuracy")),
            page.compare("mean R_acc, DRT", mean("drt", "accuracy")),
            page.compare("mean R_g, network", mean("network", "ghost_ratio")),
            page.compare("mean R_g, DRT", mean("drt", "ghost_ratio")),
        ],
        figures=[
            (
                "fig12.png",
                "R_acc (Eq. 13), R_g (Eq. 14) and Q against seeding. The paper's mean Q over 0.1 to 1 ppm is 0.75.",
            ),
            (
                "fig11.png",
                f"Fig. 11: particles at {SCATTER_PPM} ppm: true ones, and those found in the volumes; ghosts, with no "
                "true particle within a voxel, are marked. Below, a slice of 1 mm about y = 0.",
            ),
        ],
        tables=[
            _table(f"Gaussian particles, sigma {rigs.BLOB_VOXEL} voxel", [*blobs["network"], *blobs["drt"]]),
            _table(
                f"The same with the paper's SMART: {VARIANTS['paper']['iterations']} iterations, no momentum", paper
            ),
            _table(
                "The same without a sieve, in voxels of any brightness: what is missing is what the particles' size, "
                "which the images tell, is worth",
                no_sieve,
            ),
            _table("Point particles, Q against the same blobs", points),
        ],
        notes=[
            "ppm: particles per microlens of the volume's x-y face.",
            f"SMART as this software runs it by default: at most {smart.iterations} iterations.",
            f"A peak counts as a particle above {PEAK_SHARE:g} of the median brightness found at the true particles; "
            "the paper does not tell its threshold, on which R_acc and R_g depend.",
            "Points are far smaller than a voxel: pixels of a voxel's footprint that a point leaves dark hold its "
            "brightness down, and their Q is held against blobs that they are not.",
            _verdict(q_mean["network"], blobs["network"], no_sieve, from_truth[0]),
        ],
    )


def _judge(
    weights: Weights,
    images: Mapping[str, np.ndarray],
    positions_mm: np.ndarray,
    smart: Smart,
    from_truth: bool,
    step: Callable[[float], None],
) -> dict[str, Any]:
    """Reconstruct a volume and compare it with its particles."""
    truth, first = rigs.truth(positions_mm, weights.grid), None
    if from_truth:  # dark voxels are not quite dark: ghosts may grow
        light = sum(float(image.sum(dtype=np.float64)) for image in images.values()) / len(images)
        first = (truth.values + DARK_SHARE * float(truth.max())) * np.float32(light / float(truth.sum()))
    result = reconstruct(weights, images, first=first, progress=step, **smart.of_one_frame())
    quality = metrics.particle_quality(result, positions_mm)
    found = metrics.find_particles(result, quality.threshold)
    return {
        "q": metrics.reconstruction_quality(result, truth),
        "q_as_correlated": metrics.reconstruction_quality(
            result.copy(data=emphasise(result.values, missing_smoothing(CORRELATED_VOXEL, result), 1.0)), truth
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
    """Say whether the goal for Q is reached, and what the run from the true particles tells of the reason."""
    ours = next(row for row in no_sieve if row["ppm"] == from_truth["ppm"])
    return (
        f"Mean Q of the network is {q_mean:.3f}, {min(r['q'] for r in rows):.2f} to {max(r['q'] for r in rows):.2f}, "
        f"goal {GOAL_Q:g}. Without a sieve, at {ours['ppm']:g} ppm, Q is {ours['q']:.2f} with an image residual of "
        f"{ours['residual']:.4f}; the same iterations started from the true particles end at Q {from_truth['q']:.2f} "
        f"with {from_truth['residual']:.4f}. The nearer these residuals, the less the images of two views can tell "
        "ghosts from particles, whatever the weights: DRT with the true geometry gives the same Q."
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
    """Draw the volumes' particles in space, and a slice of them."""
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

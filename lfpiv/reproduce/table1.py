"""Table 1: error of the mapping by trainer and number of hidden layers, and the error of shallow networks."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv.calibration.board.board import measure_board
from lfpiv.calibration.board.dots import BoardDots, DotBoard
from lfpiv.calibration.levenberg_marquardt import Trainer, levenberg_marquardt
from lfpiv.calibration.measured_camera import MODEL_ERROR_PITCH
from lfpiv.calibration.network import sigma_nor
from lfpiv.calibration.thin_lens_model import fit_thin_lens
from lfpiv.calibration.training import TrainingSettings, train
from lfpiv.calibration.virtual_samples import sampler_between_dots
from lfpiv.geometry.optics import random_on_pupil
from lfpiv.progress import Progress
from lfpiv.reproduce import page, plots, store
from lfpiv.reproduce.rigs import Rig, numerical_rig
from lfpiv.reproduce.trainers import bayesian_regularisation, gradient_descent
from lfpiv.simulation.scene import true_mapping

TITLE = "Table 1: error of the mapping by trainer and depth of the network"

TRAINERS: dict[str, Trainer] = {"LM": levenberg_marquardt, "BR": bayesian_regularisation, "GDM": gradient_descent}
NAMES = {"LM": "Levenberg-Marquardt", "BR": "Bayesian regularisation", "GDM": "gradient descent with momentum"}
NODES = 10
"""Nodes of each hidden layer."""
PAPER = {
    "LM": {5: (0.292, 0.333), 10: (0.043, 0.041), 15: (0.038, 0.040), 20: (0.038, 0.039), 25: (0.048, 0.049)},
    "BR": {5: (0.336, 0.285), 10: (0.040, 0.041), 15: (0.039, 0.040), 20: (0.039, 0.040), 25: (0.048, 0.049)},
    "GDM": {5: (0.399, 0.455), 10: (0.109, 0.111), 15: (0.062, 0.065), 20: (0.066, 0.061), 25: (0.067, 0.070)},
}
PAPER["LM"][30], PAPER["BR"][30], PAPER["GDM"][30] = (0.063, 0.065), (0.066, 0.066), (0.090, 0.091)
PAPER_BEST = 0.038
SHALLOW = ((20,), (10, 10))
"""Hidden layers of the shallow networks. The first is this software's default."""
ESTIMATORS = ("lens_integral", "gaussian")
"""Estimators of the dots: the default, and the Gaussian fits of the paper."""
MUCH_WORSE = 1.2
"""Ratio to the paper's error above which a deep network counts as worse than in the paper."""
TRUE_RAYS = 20_000
"""Number of rays compared with true rays."""
PROBE_SEED = 11
"""Number of the random stream of those rays."""

Fit = dict[str, Any]
"""Result of `fit`, or entry of the shallow networks, JSON-able."""
Deep = dict[str, dict[int, list[Fit]]]
"""Trainer -> hidden layers -> the cameras' fits."""


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """Sizes of the training at one scale."""

    layers: tuple[int, ...]
    """Numbers of hidden layers."""
    samples: int | None
    """Labels drawn for each deep network; None takes all."""
    epochs: int
    """Largest number of epochs of LM and BR."""
    descent_epochs: int
    """The same of GDM, whose epoch takes a thirtieth of the time."""
    shallow_epochs: int = 300
    """The same of the shallow networks."""


SIZES = {
    "small": Sizes(layers=(5, 15, 30), samples=2500, epochs=40, descent_epochs=300),
    "paper": Sizes(layers=(5, 10, 15, 20, 25, 30), samples=None, epochs=1000, descent_epochs=1000),
}


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Training of one network."""

    hidden: tuple[int, ...]
    """Nodes of each hidden layer."""
    trainer: str = "LM"
    """Key of `TRAINERS`."""
    baseline: str = "none"
    """"thin_lens" or "none"."""
    epochs: int
    """Largest number of epochs."""
    samples: int | None = None
    """Labels drawn. None takes all."""
    seed: int
    """Seed of the drawn labels, the training and the compared rays."""


def run(scale: str, work: Path, *, seed: int = 0, progress: Progress) -> dict[str, Any]:
    """Train all networks; see `lfpiv.reproduce.study` for the arguments."""
    rig = numerical_rig(work.parent / "rig", scale, seed, progress)
    return compute(rig, SIZES[scale], work, seed=seed, progress=progress)


def compute(rig: Rig, sizes: Sizes, work: Path, *, seed: int, progress: Progress) -> dict[str, Any]:
    """Train all networks on a rig's labels, except those that `work` holds already."""
    cameras = list(rig.calibration.cameras)
    estimators: dict[str, Callable[[str], BoardDots]] = {
        "lens_integral": rig.labels,
        "gaussian": cache(partial(_gaussian_labels, rig)),
    }

    def fitted(file: str, name: str, estimator: str, recipe: Recipe) -> Fit:
        settings = {"seed": seed, "samples": recipe.samples, "epochs": recipe.epochs}
        path = work / "networks" / f"{file}_{name}.json"
        return store.cached(path, settings, lambda: fit(rig, name, estimators[estimator](name), recipe))

    jobs = [(trainer, layers, name) for layers in sizes.layers for trainer in TRAINERS for name in cameras]
    cost = np.cumsum([layers**2 * (0.1 if trainer == "GDM" else 1) for trainer, layers, _ in jobs])
    deep: Deep = {trainer: {layers: [] for layers in sizes.layers} for trainer in TRAINERS}
    for done, (trainer, layers, name) in enumerate(jobs):
        progress(f"{trainer}, {layers} hidden layers", float(cost[done - 1] / cost[-1]) if done else 0.0)
        epochs = sizes.descent_epochs if trainer == "GDM" else sizes.epochs
        recipe = Recipe(hidden=(NODES,) * layers, trainer=trainer, epochs=epochs, samples=sizes.samples, seed=seed)
        deep[trainer][layers].append(fitted(f"{trainer}_{layers:02d}", name, "lens_integral", recipe))
    shallow = []
    for estimator, baseline, hidden in itertools.product(ESTIMATORS, ("none", "thin_lens"), SHALLOW):
        recipe = Recipe(hidden=hidden, baseline=baseline, epochs=sizes.shallow_epochs, seed=seed)
        file = f"shallow_{estimator}_{baseline}_{'_'.join(map(str, hidden))}"
        fits = [fitted(file, name, estimator, recipe) for name in cameras]
        shallow.append({"estimator": estimator, "baseline": baseline, "hidden": hidden, "cameras": fits})
    progress("networks", 1.0)
    _draw(deep, shallow, work / "table1.png")
    return _result(deep, shallow, {name: len(rig.labels(name).dot) for name in cameras}, sizes)


def fit(rig: Rig, name: str, dots: BoardDots, recipe: Recipe) -> Fit:
    """Train one network on the labels of one camera. Return errors on held-out dots and against true rays [pitch].

    Whole dots are held out, so training sees no ray of a test dot. With the thin lens as baseline, labels are weighted
    by their standard errors and a polynomial gives virtual samples between the dots, as in `lfpiv.calibrate`. The
    paper's network has equal weights and no virtual samples.
    """
    camera = next(camera for camera in rig.scene.camera if camera.name == name)
    pitch = rig.calibration.cameras[name].lattice.pitch_mm
    chosen = np.arange(len(dots.dot))
    if recipe.samples is not None and recipe.samples < len(chosen):
        chosen = np.sort(np.random.default_rng([recipe.seed, 13]).permutation(chosen)[: recipe.samples])
    points, pupil, array = dots.points_mm[chosen], dots.pupil_mm[chosen], dots.array_mm[chosen]
    lens, target, std, sampler = None, array, None, None
    if recipe.baseline == "thin_lens":
        lens = fit_thin_lens(points, pupil, array, camera.optics)
        target, std = array - lens(points, pupil), np.hypot(dots.std_mm[chosen], MODEL_ERROR_PITCH * pitch)
        sampler = sampler_between_dots(points, pupil, target, std, pitch_mm=pitch, seed=recipe.seed)
    training = train(
        np.hstack([points, pupil]),
        target,
        TrainingSettings(
            hidden=recipe.hidden,
            trainer=TRAINERS[recipe.trainer],
            epochs=recipe.epochs,
            shrink=lens is not None,
            seed=recipe.seed,
        ),
        groups=dots.dot[chosen],
        std=std,
        virtual_samples=sampler,
        unit=pitch,
    )
    low, high = dots.points_mm.min(0), dots.points_mm.max(0)
    rng = np.random.default_rng([recipe.seed, PROBE_SEED])
    probe = low + rng.random((TRUE_RAYS, 3)) * (high - low)
    rays = random_on_pupil(camera.optics.pupil_radius_mm, TRUE_RAYS, rng)
    mapped = training.network(np.hstack([probe, rays])) + (0.0 if lens is None else lens(probe, rays))
    return {
        "sigma_nor": training.sigma_nor,
        "true_ray_error": sigma_nor(mapped, true_mapping(camera)(probe, rays), pitch),
        "samples": len(chosen),
        "epochs": training.epochs,
        "stop": training.stop.name,
        "wall_s": training.seconds,
    }


def _gaussian_labels(rig: Rig, name: str) -> BoardDots:
    experiment, camera = rig.experiment, rig.calibration.cameras[name]
    return measure_board(
        [experiment.board_image(name, plane) for plane in range(len(experiment.board.planes_mm))],
        camera.decoder,
        DotBoard.from_settings(experiment.board),
        orientation=experiment.camera(name).orientation,
        estimator="gaussian",
        dark=experiment.dark(name),
    )


def _both(fits: Sequence[Fit], key: str = "sigma_nor") -> list[float]:
    return [fit[key] for fit in fits]


@dataclass(frozen=True)
class Best:
    """The best networks of each kind, judged by their worse camera."""

    deep: float
    """sigma_nor of the best deep network [pitch]."""
    deep_name: str
    shallow: Fit
    """Entry of the best shallow network on integrated dots."""
    paper_like: Fit
    """Entry of the shallow network without a baseline on the paper's labels."""

    @classmethod
    def from_fits(cls, deep: Deep, shallow: Sequence[Fit]) -> Best:
        """Choose the best networks."""
        value, name = min(
            (max(_both(fits)), f"{trainer}, {layers} hidden layers of {NODES}")
            for trainer, rows in deep.items()
            for layers, fits in rows.items()
        )
        integrated = (entry for entry in shallow if entry["estimator"] == "lens_integral")
        return cls(
            deep=value,
            deep_name=name,
            shallow=min(integrated, key=lambda entry: max(_both(entry["cameras"]))),
            paper_like=next(e for e in shallow if (e["estimator"], e["baseline"]) == ("gaussian", "none")),
        )

    @property
    def shallow_sigma_nor(self) -> float:
        """sigma_nor of the best shallow network [pitch]."""
        return max(_both(self.shallow["cameras"]))


def _result(deep: Deep, shallow: Sequence[Fit], labels: Mapping[str, int], sizes: Sizes) -> dict[str, Any]:
    best = Best.from_fits(deep, shallow)
    return page.result(
        {
            "sigma_nor": {trainer: {str(k): _both(fits) for k, fits in rows.items()} for trainer, rows in deep.items()},
            "true_ray_error": {
                trainer: {str(k): _both(fits, "true_ray_error") for k, fits in rows.items()}
                for trainer, rows in deep.items()
            },
            "shallow": shallow,
            "best": min(best.deep, best.shallow_sigma_nor),
            "best_deep": best.deep,
            "best_shallow": best.shallow_sigma_nor,
            "networks": deep,
        },
        comparison=_comparison(best),
        figures=[
            (
                "table1.png",
                "Error by number of hidden layers, mean of the cameras: on held-out dots (solid) and against the true "
                "rays (dashed); the paper's in grey.",
            )
        ],
        tables=_tables(deep, shallow, list(labels)),
        notes=[*_notes(deep, best), *_cut_notes(labels, sizes)],
    )


def _comparison(best: Best) -> list[dict[str, Any]]:
    name, unit = _describe(best.shallow), "pitch"
    overall = min(best.deep, best.shallow_sigma_nor)
    from_truth = max(_both(best.shallow["cameras"], "true_ray_error"))
    alike = max(_both(best.paper_like["cameras"]))
    return [
        page.compare("sigma_nor, best network, worse camera", overall, paper=PAPER_BEST, at_most=0.03, unit=unit),
        page.compare(
            f"sigma_nor, best deep network ({best.deep_name})", best.deep, paper=PAPER_BEST, at_most=0.03, unit=unit
        ),
        page.compare(f"sigma_nor, shallow network ({name})", best.shallow_sigma_nor, at_most=0.03, unit=unit),
        page.compare("its error against the true rays", from_truth, at_most=0.006, unit=unit),
        page.compare(
            "sigma_nor, shallow network without a baseline on the paper's labels", alike, paper=PAPER_BEST, unit=unit
        ),
    ]


def _tables(deep: Deep, shallow: Sequence[Fit], cameras: Sequence[str]) -> list[dict[str, Any]]:
    def beside_paper(trainer: str, layers: int, number: int, sigma_nor: float) -> str:
        if layers not in PAPER[trainer] or number >= 2:
            return f"{sigma_nor:.3g}"
        return f"{sigma_nor:.3g} ({PAPER[trainer][layers][number]:g})"

    columns = ["layers", *(f"{NAMES[trainer]}, {camera}" for trainer in deep for camera in cameras)]
    depths = list(next(iter(deep.values())))
    keys = ("sigma_nor", "true_ray_error", "samples", "epochs", "wall_s")
    return [
        {
            "caption": f"sigma_nor [pitch], hidden layers of {NODES} nodes: ours, the paper's in brackets "
            f"({', '.join(cameras)})",
            "columns": columns,
            "rows": [
                [str(n)] + [beside_paper(t, n, k, fit["sigma_nor"]) for t in deep for k, fit in enumerate(deep[t][n])]
                for n in depths
            ],
        },
        {
            "caption": "The same networks: error against the true rays [pitch] after so many epochs",
            "columns": columns,
            "rows": [
                [str(n)] + [f"{fit['true_ray_error']:.3g} ({fit['epochs']})" for t in deep for fit in deep[t][n]]
                for n in depths
            ],
        },
        {
            "caption": "Shallow networks, Levenberg-Marquardt, worse camera",
            "columns": ["network", "sigma_nor", "against the true rays", "labels", "epochs", "training [s]"],
            "rows": [[_describe(entry), *(max(_both(entry["cameras"], key)) for key in keys)] for entry in shallow],
        },
    ]


def _notes(deep: Deep, best: Best) -> list[str]:
    """Describe the method, and name the deep networks that do worse than in the paper."""
    labels_error, network_error = (max(_both(best.paper_like["cameras"], k)) for k in ("sigma_nor", "true_ray_error"))
    worse = [
        f"{trainer} with {layers} layers ({max(_both(fits)):.2g}, the paper {max(PAPER[trainer][layers]):.2g})"
        for trainer, rows in deep.items()
        for layers, fits in rows.items()
        if layers in PAPER[trainer] and max(_both(fits)) > MUCH_WORSE * max(PAPER[trainer][layers])
    ]
    notes = [
        "The paper's mapping of two cameras is two mappings that share no input but the point: here each camera has "
        "its own network, five inputs and two outputs. Hidden nodes are tanh: a logistic sigmoid with other weights.",
        "sigma_nor (Eq. 8) is measured on whole dots that training does not see (70/15/15). The paper splits labels at "
        "random, so its training sees every test dot as well. The true-ray error is the distance to the simulator's "
        f"rays, {TRUE_RAYS} of them at random in the board's volume. An experiment cannot measure it.",
        "Labels are fits of a dot integrated over microlenses and pixels. The Gaussian fits of the paper are off by a "
        f"twentieth of a pitch, and then sigma_nor ({labels_error:.3f}) shows the labels' error and not the network's "
        f"({network_error:.3f} from the true rays).",
        "GDM uses batches of 64 samples and lowers its rate where it stalls. With one step per epoch, on all samples, "
        "deep networks hardly change.",
    ]
    notes.append(
        f"Worse than in the paper: {'; '.join(worse)}. Many layers of ten nodes in a row have small gradients. "
        "First-order methods hardly change the first layers, second-order methods need many epochs."
        if worse
        else "No deep network does worse than in the paper."
    )
    if best.shallow_sigma_nor < best.deep:
        notes.append(
            f"The best shallow network ({_describe(best.shallow)}) does better than any deep one, in seconds: the "
            "mapping is smooth and needs no depth."
        )
    return notes


def _cut_notes(labels: Mapping[str, int], sizes: Sizes) -> list[str]:
    """Describe what a small scale leaves out."""
    left_out = [layers for layers in PAPER["LM"] if layers not in sizes.layers]
    if sizes.samples is None and not left_out:
        return []
    available = min(labels.values())
    taken = available if sizes.samples is None else min(sizes.samples, available)
    parameters = sum((a + 1) * b for a, b in itertools.pairwise((5, *(NODES,) * 30, 2)))
    return [
        f"Cut at this scale: deep networks see {taken} of {available} labels, at most {sizes.epochs} epochs (GDM "
        f"{sizes.descent_epochs}) instead of 1000, and {', '.join(map(str, left_out)) or 'no'} layers are left out. "
        f"Networks of 30 layers have {parameters} parameters for {2 * round(0.7 * taken)} "
        "values; the deepest suffer most from the cut."
    ]


def _describe(entry: Fit) -> str:
    nodes = " + ".join(map(str, entry["hidden"]))
    base = "on a fitted thin lens" if entry["baseline"] == "thin_lens" else "without a thin lens"
    return f"{nodes} nodes {base}, {'Gaussian dots' if entry['estimator'] == 'gaussian' else 'integrated dots'}"


def _draw(deep: Deep, shallow: Sequence[Fit], path: Path) -> None:
    drawn = plots.figure(9, 3.8)
    axes = drawn.subplots()
    for colour, (trainer, rows) in zip(("#2f81d6", "#2ca36b", "#e0762a"), deep.items(), strict=True):
        layers = list(rows)
        for key, style, label in (("sigma_nor", "o-", NAMES[trainer]), ("true_ray_error", "o--", None)):
            axes.plot(
                layers, [np.mean([f[key] for f in rows[n]]) for n in layers], style, color=colour, label=label, ms=4
            )
        axes.plot(
            list(PAPER[trainer]),
            [np.mean(pair) for pair in PAPER[trainer].values()],
            {"LM": "s:", "BR": "^:", "GDM": "v:"}[trainer],
            color=plots.COLOURS["paper"],
            label=f"the paper's {trainer}",
            ms=4,
            lw=1,
        )
    own = next(e for e in shallow if (e["estimator"], e["baseline"]) == ("lens_integral", "thin_lens"))
    axes.axhline(
        np.mean([f["sigma_nor"] for f in own["cameras"]]), color="#8a6fd1", lw=1, label=f"one layer, {_describe(own)}"
    )
    axes.set(yscale="log", xlabel="hidden layers", ylabel="error [microlens pitch]")
    plots.plain(axes)
    axes.legend(fontsize=7, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    plots.save(drawn, path)

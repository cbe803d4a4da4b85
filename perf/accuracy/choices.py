"""Effect of single choices on one pair: choices that the paper leaves open, and options of this software."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import bench
import numpy as np
import xarray as xr
from bench import DEFAULT, Bench, Judged
from numpy.typing import ArrayLike

from lfpiv.calibration.camera import Calibration
from lfpiv.calibration.cameras import thin_lens
from lfpiv.calibration.thin_lens_model import thin_lens_model
from lfpiv.joint.pair import reconstruct_pair
from lfpiv.progress import Progress
from lfpiv.reproduce import page, plots, rigs, store
from lfpiv.settings.processing import Correlation, Smart

TITLE = "What each choice is worth"

ALMOST_NO_FLOOR = 1e-3
"""Noise floor of "no floor" [count]. The logarithm of a dark pixel needs one."""
SURE, WORTH = 2.0, 0.01
"""A difference counts above so many standard errors and this part of the default error."""


@dataclass(frozen=True, kw_only=True)
class Choice:
    """One departure from the defaults."""

    label: str
    """Description of the choice."""
    smart: Mapping[str, Any] = field(default_factory=dict)
    """Settings of SMART that differ."""
    correlation: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the correlation that differ."""
    network: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the calibration that differ."""
    points: bool = False
    """Particles are points."""
    drt: bool = False
    """Rays by direct ray tracing at the nominal angles."""
    apart_mm: float = 0.0
    """Wrong distance of the cameras' axes along y in ray tracing [mm]."""
    like: str | None = None
    """Choice whose volumes are correlated. Default: this one."""
    floor: float | None = None
    flat_guess: bool = False
    both_frames: bool = False
    """Both frames are reconstructed at once, by a joint fit."""

    @property
    def reconstructs(self) -> bool:
        """Whether the volumes differ from the defaults'."""
        return replace(self, label="", correlation={}) != Choice(label="")


PAPER_SMART = {
    "iterations": 10,
    "accelerate": False,
    "floor_share": 0.0,
    "intensity_cap": 0.0,
    "tolerance": 0.0,
    "sieve_voxel": 0.0,
}
OPEN = {
    "exponent": Choice(label="exponent as printed in Eq. 5, not by the column sum", smart={"normalisation": "paper"}),
    "noise_floor": Choice(label="floor: the measured noise only", smart={"floor_share": 0.0}),
    "no_floor": Choice(
        label=f"floor: {ALMOST_NO_FLOOR:g} count, as good as none", smart={"floor_share": 0.0}, floor=ALMOST_NO_FLOOR
    ),
    "flat_guess": Choice(label="first guess: the same light in every voxel", flat_guess=True),
    "points": Choice(label="particles are points, not blobs", points=True),
    "gaussian_dots": Choice(label="dots by the paper's Gaussian fits", network={"estimator": "gaussian"}),
    "bare_network": Choice(label="network without the thin lens under it", network={"baseline": "none"}),
    "drt": Choice(label="no network: DRT at the nominal angles", drt=True),
    "drt_apart": Choice(label="the same, and one camera 0.1 mm higher than assumed", drt=True, apart_mm=0.1),
}
"""Choices that the paper does not state."""
OWN = {
    "no_momentum": Choice(label="SMART without momentum", smart={"accelerate": False}),
    "ten_iterations": Choice(label="10 SMART iterations", smart={"iterations": 10}),
    "no_sieve": Choice(label="no sieve: voxels of any brightness", smart={"sieve_voxel": 0.0}),
    "joint": Choice(label="joint fit of both frames", smart={"estimate": "joint"}, both_frames=True),
    "unsmoothed": Choice(
        label="no sieve, and volumes correlated unsmoothed",
        smart={"sieve_voxel": 0.0},
        like="no_sieve",
        correlation={"smoothing_voxel": 0.0},
    ),
    "unsmoothed_points": Choice(
        label="points, their volumes correlated unsmoothed",
        points=True,
        like="points",
        correlation={"smoothing_voxel": 0.0},
    ),
    "power_1": Choice(
        label="intensities correlated as they are, not their roots", correlation={"intensity_power": 1.0}
    ),
    "windows_8": Choice(label="last windows of 8 voxels, not 12", correlation={"windows": (24, 16, 8, 8)}),
    "windows_16": Choice(label="last windows of 16 voxels, not 12", correlation={"windows": (32, 16, 16)}),
    "paper": Choice(
        label="the paper's: 10 plain iterations, no smoothing, windows of 8",
        smart=PAPER_SMART,
        correlation={"smoothing_voxel": 0.0, "intensity_power": 1.0, "windows": (24, 16, 8, 8)},
    ),
}
"""This software's own options."""
CHOICES = OPEN | OWN
OFFSET = {"textcoords": "offset points"}


def run(scale: str, work: Path, *, seed: int = 0, progress: Progress) -> dict[str, Any]:
    """Measure one pair with every choice; see the package for the arguments."""
    own = bench.open_bench(work.parent / "bench", scale, seed, progress)
    return compute(own, CHOICES, work, seed=seed, progress=progress)


def compute(own: Bench, choices: Mapping[str, Choice], work: Path, *, seed: int, progress: Progress) -> dict[str, Any]:
    """Measure with some choices on a calibrated bench with two cameras."""
    usual = own.volumes(bench.run_name(DEFAULT, "two"), pair=DEFAULT)
    default = own.judge(*usual, pair=DEFAULT)
    judged, mapping = {}, {"default": _mapping(own, own.rig.calibration, seed)}
    for done, (key, choice) in enumerate(choices.items()):
        progress(choice.label, done / len(choices))
        made, calibration, pair = usual, None, replace(DEFAULT, blob_voxel=0.0) if choice.points else DEFAULT
        if choice.network or choice.drt:
            calibration = _traced(own, choice) if choice.drt else bench.recalibrated(own, key, **choice.network)
            mapping[key] = _mapping(own, calibration, seed)
        if choice.both_frames:
            made = _both_frames(own, f"choice_{key}", Smart(**choice.smart))
        elif choice.reconstructs:
            made = own.volumes(
                f"choice_{choice.like or key}",
                pair=pair,
                calibration=calibration,
                smart=Smart(**choice.smart),
                floor=choice.floor,
                flat_guess=choice.flat_guess,
            )
        judged[key] = own.judge(*made, pair=pair, correlation=Correlation(**choice.correlation))
    progress("choices", 1.0)
    return _result(own, {key: choices[key] for key in judged}, default, judged, mapping, work)


def _result(
    own: Bench,
    choices: Mapping[str, Choice],
    default: Judged,
    judged: Mapping[str, Judged],
    mapping: Mapping[str, float],
    work: Path,
) -> dict[str, Any]:
    gaps = {key: bench.difference(one, default) for key, one in judged.items()}
    _draw(choices, judged, gaps, default, work / "choices.png")
    return page.result(
        {
            "default": default.row(),
            "choices": {
                key: {
                    "what": choices[key].label,
                    "error_difference_voxel": gaps[key][0],
                    "difference_standard_error_voxel": gaps[key][1],
                    "q_difference": one.q - default.q,
                    **one.row(),
                }
                for key, one in judged.items()
            },
            "mapping_error_pitch": mapping,
            "ppm": DEFAULT.ppm,
            "size_mm": own.size_mm,
        },
        comparison=[
            page.compare("mean displacement error with all defaults", default.error.mean, unit="voxel"),
            page.compare("Q with all defaults", default.q),
            *(
                page.compare(f"mean error, {choices[key].label}", judged[key].error.mean, unit="voxel")
                for key in ("paper", "drt")
                if key in judged
            ),
        ],
        figures=[
            (
                "choices.png",
                "Change of the mean displacement error (left; lines: two standard errors) and of Q (right) by each "
                "choice: blue where the paper states nothing, green this software's own options. To the right of the "
                "line the error grows, to the left of it Q falls.",
            )
        ],
        tables=[
            _table(caption, {key: choices[key] for key in choices if (key in OPEN) is is_open}, judged, gaps, default)
            for caption, is_open in (
                ("Choices that the paper does not state", True),
                ("This software's own options", False),
            )
        ],
        notes=[
            f"One pair of the ring vortex at {DEFAULT.ppm:g} ppm, two misaligned cameras, noisy images; every line "
            "changes one thing from the defaults. Errors are mean lengths against the flow's mean "
            "over each window, in voxels; x, y, z: mean absolute components.",
            "The standard error is that of the vector-by-vector difference; with other windows, of the two means. "
            f"{bench.ABOUT_STANDARD_ERROR} It applies to this pair and flow. Another flow or "
            "seeding may change the order of the choices (docs/notebook/accuracy.md).",
            _verdict(choices, gaps, default),
            "Q is measured against blobs of "
            f"{rigs.BLOB_VOXEL:g} voxel, also for points. Choices of the correlation do not change Q.",
            *_about_smoothing(judged),
            *_about_mapping(choices, mapping),
        ],
    )


def _both_frames(own: Bench, name: str, smart: Smart) -> tuple[list[xr.DataArray], dict[str, float]]:
    """Reconstruct the usual pair by a joint fit, or read it from the folder."""
    settings = {
        "seed": own.seed,
        "size_mm": own.size_mm,
        "pair": asdict(DEFAULT),
        "smart": smart.model_dump(),
        "scene": own.rig.scene.model_dump(mode="json"),
    }

    def compute() -> dict[str, ArrayLike]:
        weights = own.weights(own.rig.calibration, bench.TWO)
        light, noise = [], []
        for images in own.images(DEFAULT, bench.TWO):
            levels = {camera: weights.cameras[camera].decoder.background(images[camera]) for camera in bench.TWO}
            light.append({camera: images[camera] - np.float32(level) for camera, (level, _) in levels.items()})
            noise.append({camera: deviation for camera, (_, deviation) in levels.items()})
        found = reconstruct_pair(weights, light, floor=noise, estimate=smart.estimate, **smart.of_one_frame())
        return {
            "volumes": np.stack([volume.values for volume in found]),
            "iterations": np.mean([volume.attrs["iterations"] for volume in found]),
            "sieve_voxel": np.mean([volume.attrs["sieve_voxel"] for volume in found]),
        }

    return own.unpacked(store.cached_arrays(own.folder / f"{name}.npz", settings, compute))


def _traced(own: Bench, choice: Choice) -> Calibration:
    """Return thin lenses at the nominal angles with the choice's error of height."""
    experiment, cameras = own.rig.experiment, {}
    nominal = thin_lens(experiment).cameras
    for sign, name in zip((0.5, -0.5), bench.TWO, strict=True):
        camera = nominal[name]
        lens = thin_lens_model(camera.optics, experiment.camera(name).orientation)
        offset = lens.offset_mm + [0.0, sign * choice.apart_mm, 0.0]
        cameras[name] = replace(camera, baseline=replace(lens, offset_mm=offset))
    return Calibration(cameras)


def _mapping(own: Bench, calibration: Calibration, seed: int) -> float:
    """Return the mean distance from the true rays, worse of the two cameras [pitch]."""
    errors = rigs.ray_errors_pitch(own.rig, calibration, own.grid, seed)
    return max(float(errors[name].mean()) for name in bench.TWO)


def _table(
    caption: str,
    choices: Mapping[str, Choice],
    judged: Mapping[str, Judged],
    gaps: Mapping[str, tuple[float, float]],
    default: Judged,
) -> dict[str, Any]:
    rows: list[list[str | float | None]]
    rows = [["all defaults", default.error.mean, None, None, *default.error.mean_absolute, default.q, None]]
    rows += [
        [
            choice.label,
            judged[key].error.mean,
            *gaps[key],
            *judged[key].error.mean_absolute,
            judged[key].q,
            judged[key].q - default.q,
        ]
        for key, choice in choices.items()
    ]
    columns = ["", "error", "change", "standard error", "x", "y", "z", "Q", "change of Q"]
    return {"caption": caption, "columns": columns, "rows": rows}


def _verdict(choices: Mapping[str, Choice], gaps: Mapping[str, tuple[float, float]], default: Judged) -> str:
    """Name the choices that differ from the defaults by more than chance."""
    notable = {
        key: gap for key, (gap, error) in gaps.items() if abs(gap) > max(SURE * error, WORTH * default.error.mean)
    }
    better = [choices[key].label for key, gap in notable.items() if gap < 0]
    share = ", ".join(
        f"{choices[key].label} ({100 * gaps[key][0] / default.error.mean:+.0f} %)"
        for key in sorted(gaps, key=lambda key: -gaps[key][0])[:3]
    )
    text = (
        f"Beyond {SURE:g} standard errors and {100 * WORTH:g} % of the error, {len(notable) - len(better)} of "
        f"{len(gaps)} choices are worse than the defaults; better: {'; '.join(better) or 'none'}."
    )
    return f"{text} The worst: {share}."


def _about_smoothing(judged: Mapping[str, Judged]) -> list[str]:
    if not {"points", "no_sieve", "unsmoothed", "unsmoothed_points"} <= judged.keys():
        return []
    return [
        "Volumes are smoothed by 0.5 voxel before correlation, which helps if particles are smaller than a voxel. "
        "Volumes of a sieve's Gaussians are already as smooth. Error with and without smoothing here: blobs without "
        f"a sieve {judged['no_sieve'].error.mean:.3f} and {judged['unsmoothed'].error.mean:.3f}, points "
        f"{judged['points'].error.mean:.3f} and {judged['unsmoothed_points'].error.mean:.3f} voxel."
    ]


def _about_mapping(choices: Mapping[str, Choice], mapping: Mapping[str, float]) -> list[str]:
    if len(mapping) == 1:
        return []
    parts = ", ".join(f"{choices[key].label} {value:.4f}" for key, value in mapping.items() if key != "default")
    return [
        "Mapping against the true rays, mean in microlens pitches: defaults "
        f"{mapping['default']:.4f}, {parts}. On a bench, the place of a camera is not known to 0.1 mm, nor its "
        "angle to 0.5 degree. The network needs neither. In a small volume, errors of the place matter more."
    ]


def _draw(
    choices: Mapping[str, Choice],
    judged: Mapping[str, Judged],
    gaps: Mapping[str, tuple[float, float]],
    default: Judged,
    path: Path,
) -> None:
    drawn = plots.figure(9, 1.2 + 0.27 * len(choices))
    left, right = drawn.subplots(1, 2, sharey=True, width_ratios=(1.5, 1))
    place = np.arange(len(choices))[::-1]
    change, error = np.array([gaps[key] for key in choices]).T
    colours = [plots.COLOURS["network"] if key in OPEN else plots.COLOURS["no_sieve"] for key in choices]
    left.barh(place, change, xerr=SURE * error, color=colours, height=0.62, error_kw={"lw": 0.8, "ecolor": "#30363c"})
    comparable = [0.0 if choices[key].points else judged[key].q - default.q for key in choices]
    right.barh(place, comparable, color=colours, height=0.62)
    for at, choice in zip(place, choices.values(), strict=True):
        if choice.points:
            right.annotate("not comparable", (0, at), fontsize=7, ha="right", va="center", xytext=(-4, 0), **OFFSET)
    left.set_yticks(place, [choice.label for choice in choices.values()], fontsize=8)
    left.set_xlabel(f"change of the mean error [voxel]\ndefaults: {default.error.mean:.3f}")
    right.set_xlabel(f"change of Q\ndefaults: {default.q:.3f}")
    for axes in (left, right):
        axes.axvline(0, color=plots.COLOURS["truth"], lw=0.8)
        axes.margins(y=0.02)
        plots.plain(axes)
    plots.save(drawn, path)

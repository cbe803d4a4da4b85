"""Fig. 10: compare the weights of one voxel by the network and by direct ray tracing with converged counts of rays."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv import metrics
from lfpiv.calibration.camera import CalibratedCamera
from lfpiv.geometry.grid import Grid
from lfpiv.progress import Progress
from lfpiv.reproduce import page, plots
from lfpiv.reproduce.rigs import VOXEL_MM, numerical_rig
from lfpiv.weights.counting import PAPER_SAMPLES, count_voxels

TITLE = "Fig. 10: weights of one voxel"

VOXEL_AT_MM = (0.0, 0.0, 2.0)
"""Centre (x, y, z) of the voxel."""
COUNTS = {"small": 16, "paper": 64}
"""Number of independent counts, of 8 million rays each. Their mean is the converged count, their scatter its noise."""
BATCH = 4
"""Counts traced at once."""
PAPER_SSIM = 0.94

CAPTION = (
    f"Weights of the voxel at {VOXEL_AT_MM} mm on the lit part of each sensor: by the network, by DRT, their "
    "difference on the same scale, and DRT's difference from counted rays."
)
NOTES = (
    "The paper does not state its SSIM settings. Over the whole sensor nearly all pixels are dark in both images and "
    "SSIM is close to 1 for any weights, so the goal applies to the lit pixels only.",
    "The cameras of this rig are ideal and stand at exactly 45 degrees. So DRT is exact, and a count through DRT's "
    "mapping is a count through the true optics.",
)


def run(scale: str, work: Path, *, seed: int = 0, progress: Progress) -> dict[str, Any]:
    """Compare the weights; see `lfpiv.reproduce.study` for the arguments."""
    rig = numerical_rig(work.parent / "rig", scale, seed, progress)
    grid = Grid(shape=(1, 1, 1), voxel_mm=VOXEL_MM, first_centre_mm=VOXEL_AT_MM[::-1])
    network, drt = (rig.weights(grid, mapping) for mapping in ("network", "drt"))
    cameras: dict[str, dict[str, float]] = {}
    images = {}
    for number, name in enumerate(rig.calibration.cameras):
        ours, traced = network.image(name, (0, 0, 0)), drt.image(name, (0, 0, 0))
        counts = []
        for place, weights in enumerate((network, drt)):
            counts.append(_count(weights.cameras[name], COUNTS[scale], [seed, number, place], ours.shape))
            progress("counted rays", (2 * number + place + 1) / (2 * len(rig.calibration.cameras)))
        cameras[name] = _figures(ours, traced, *counts)
        images[name] = (ours, traced, counts[1].mean)
    _draw(images, work / "fig10.png")
    return _result(cameras, COUNTS[scale])


@dataclass(frozen=True)
class Count:
    """Rays of one voxel counted on a sensor, images of shape (rows, columns)."""

    mean: np.ndarray
    """Mean of the independent counts: the converged count."""
    noise: float
    """Noise of that mean, relative L2."""
    first: np.ndarray
    """The first count: the paper's sampling."""


def _figures(ours: np.ndarray, traced: np.ndarray, network: Count, drt: Count) -> dict[str, float]:
    """Compare one camera's weights by the network and by DRT, and the counts through both mappings."""
    return {
        "ssim": metrics.weight_ssim(ours, traced),
        "ssim_whole_sensor": metrics.weight_ssim(ours, traced, crop=False),
        "ssim_paper_sampling": metrics.weight_ssim(network.first, drt.first),
        "ssim_converged_counts": metrics.weight_ssim(network.mean, drt.mean),
        "network_against_drt_l2": metrics.relative_l2(ours, traced),
        "network_against_count_l2": metrics.relative_l2(ours, network.mean),
        "drt_against_count_l2": metrics.relative_l2(traced, drt.mean),
        "network_against_true_count_l2": metrics.relative_l2(ours, drt.mean),
        "count_noise_l2": max(network.noise, drt.noise),
        "paper_sampling_against_count_l2": metrics.relative_l2(drt.first, drt.mean),
        "pixels": int((ours > 0).sum()),
    }


def _result(cameras: Mapping[str, Mapping[str, float]], counts: int) -> dict[str, Any]:

    def worst(key: str, choose: Callable[[Iterable[float]], float] = max) -> float:
        return choose(figures[key] for figures in cameras.values())

    ssim = worst("ssim", min)
    against_count = ("network_against_count_l2", "drt_against_count_l2")
    return page.result(
        {
            "ssim": ssim,
            "voxel_mm": VOXEL_AT_MM,
            "ssim_settings": "Gaussian window, sigma 1.5 pixel (11 x 11), K1 0.01, K2 0.03, data range 0 to the "
            "largest weight, population covariance; mean over the bounding box of the lit pixels",
            "cameras": cameras,
        },
        comparison=[
            page.compare("SSIM of network and DRT, lit pixels, worst camera", ssim, paper=PAPER_SSIM, at_least=0.97),
            page.compare("the same over the whole sensor", worst("ssim_whole_sensor", min)),
            page.compare("the same, rays counted as the paper samples them", worst("ssim_paper_sampling", min)),
            *(
                page.compare(f"{name}'s weights against its converged count, relative L2", worst(key), at_most=0.02)
                for name, key in zip(("network", "DRT"), against_count, strict=True)
            ),
            page.compare(
                "network's weights against a converged count through the true optics",
                worst("network_against_true_count_l2"),
            ),
            page.compare("the paper's sampling against the converged count", worst("paper_sampling_against_count_l2")),
        ],
        figures=[("fig10.png", CAPTION)],
        tables=[
            {
                "caption": "Every figure, by camera",
                "columns": ["figure", *cameras],
                "rows": [
                    [key, *(figures[key] for figures in cameras.values())] for key in next(iter(cameras.values()))
                ],
            }
        ],
        notes=[
            *NOTES,
            f"Converged count: mean of {counts} independent counts, each of 512 points in the voxel and one ray per "
            f"0.05 degree; from their scatter its noise is {100 * worst('count_noise_l2'):.2f} %. One such count is "
            "the paper's sampling. Comparing two of them shows the effect of sampling noise on SSIM.",
        ],
    )


def _count(camera: CalibratedCamera, counts: int, seed: list[int], shape: tuple[int, int]) -> Count:
    images = _counted_images(camera, counts, seed, shape)
    first = next(images)
    total, squares = first.copy(), first**2
    for image in images:
        total += image
        squares += image**2
    mean = total / counts
    variance = np.maximum(squares / counts - mean**2, 0.0) / (counts - 1)
    return Count(mean, float(np.sqrt(variance.sum()) / np.linalg.norm(mean)), first)


def _counted_images(
    camera: CalibratedCamera, counts: int, seed: list[int], shape: tuple[int, int]
) -> Iterator[np.ndarray]:
    for start in range(0, counts, BATCH):
        draw = int(np.random.default_rng([*seed, start]).integers(2**31))
        centres = np.tile(VOXEL_AT_MM, (min(BATCH, counts - start), 1))
        windows, rays, corners = count_voxels(camera, centres, VOXEL_MM, samples=PAPER_SAMPLES, seed=draw)
        for window, number, (column, row) in zip(windows, rays, corners, strict=True):
            image = np.zeros(shape)
            image[row : row + window.shape[0], column : column + window.shape[1]] = window / number
            image *= camera.gain
            yield image


def _draw(images: Mapping[str, tuple[np.ndarray, np.ndarray, np.ndarray]], path: Path) -> None:
    drawn = plots.figure(11, 2.45 * len(images))
    axes = drawn.subplots(len(images), 4, squeeze=False)
    for row, (name, (ours, traced, counted)) in zip(axes, images.items(), strict=True):
        lit = np.argwhere(np.maximum(ours, traced) > 0)
        (top, left), (bottom, right) = lit.min(0) - 4, lit.max(0) + 5
        window = (slice(max(top, 0), bottom), slice(max(left, 0), right))
        peak = max(ours.max(), traced.max())
        shown = (ours, traced, ours - traced, traced - counted)
        for place, (axis, image) in enumerate(zip(row, shown, strict=True)):
            signed = place >= 2
            drawing = axis.imshow(
                image[window],
                cmap="RdBu_r" if signed else "magma",
                vmin=-peak / 20 if signed else 0,
                vmax=peak / 20 if signed else peak,
                extent=(left - 0.5, right - 0.5, bottom - 0.5, top - 0.5),
                interpolation="nearest",
            )
            axis.tick_params(labelsize=7)
            if place in (1, 3):
                bar = drawn.colorbar(drawing, ax=row[place - 1 : place + 1].tolist(), shrink=0.85, pad=0.01)
                bar.ax.tick_params(labelsize=7)
                bar.ax.ticklabel_format(axis="y", style="sci", scilimits=(0, 0))
                bar.ax.yaxis.get_offset_text().set_fontsize(7)
        for axis, title in zip(row, ("network", "DRT", "network − DRT (×20)", "DRT − count (×20)"), strict=True):
            axis.set_title(f"{name}: {title}", fontsize=9)
        row[0].set_ylabel("row [pixel]")
        for axis in row:
            axis.set_xlabel("column [pixel]", fontsize=8)
    plots.save(drawn, path)

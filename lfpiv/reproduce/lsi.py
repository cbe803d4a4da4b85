"""Figs. 20 to 22: the low-swirl injector's mean flow by light-field PIV of two cameras and by planar PIV."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
from scipy.interpolate import CubicSpline, RegularGridInterpolator

from lfpiv.progress import Progress
from lfpiv.reproduce import page
from lfpiv.reproduce.injector import experimental_rig
from lfpiv.reproduce.lsi_plots import NAMES, draw_planes, draw_profiles
from lfpiv.reproduce.lsi_twin import (
    DIAMETER_MM,
    ITERATIONS,
    PARTICLES_PER_MICROLENS,
    PROFILE_D,
    TURBULENCE_SHARE,
    WINDOWS,
    LightField,
    Sheet,
    Sizes,
    Twin,
    light_field_mean,
    planar_mean,
    window_mm,
)
from lfpiv.reproduce.planar_piv import require_openpiv
from lfpiv.reproduce.rigs import VOXEL_MM, Rig, true_field

TITLE = "Figs. 20 to 22: low-swirl injector, light-field PIV against planar PIV"

PAPER_ERROR = {"u": 0.0905, "v": 0.0989}

FIGURES = (
    (
        "fig22.png",
        f"Mean velocity along the injector's axis at x/D = {PROFILE_D:g} in three depths: light-field PIV, planar PIV "
        "and the true flow of the recorded instants, at points and averaged over the light field's windows.",
    ),
    (
        "fig20_21.png",
        "Mean velocity in three depths by planar PIV (top) and light-field PIV (bottom); colours: axial velocity, "
        "arrows: in-plane velocity. The box is the light field's volume.",
    ),
)

SIZES = {
    "small": Sizes(
        volume_mm=(3.2, 6.4, 12.0),
        centre_x_mm=PROFILE_D * DIAMETER_MM,
        pairs=20,
        planar_pairs=20,
        same_instants=True,
        field_mm=None,
    ),
    "paper": Sizes(
        volume_mm=(13.0, 10.0, 12.0),
        centre_x_mm=3.5,
        pairs=150,
        planar_pairs=600,
        same_instants=False,
        field_mm=((-18.5, 0.0), (18.5, 29.7)),
    ),
}


def run(scale: str, work: Path, *, seed: int = 0, progress: Progress) -> dict[str, Any]:
    """Record and measure the injector's flow both ways; see `lfpiv.reproduce.study` for the arguments."""
    require_openpiv()
    rig = experimental_rig(work.parent / "experimental_rig", scale, seed, progress)
    return compute(rig, SIZES[scale], work, seed=seed, progress=progress)


def compute(rig: Rig, sizes: Sizes, work: Path, *, seed: int, progress: Progress) -> dict[str, Any]:
    """Record and measure on a calibrated rig, except the pairs that `work` holds already."""
    require_openpiv()
    twin = Twin(sizes, seed)
    planar = planar_mean(twin, work, progress)
    volume = light_field_mean(rig, twin, work, progress)
    profiles = sample_profiles(twin, volume, planar)
    return _result(twin, volume, planar, profiles, work)


def sample_profiles(twin: Twin, volume: LightField, planar: Sequence[Sheet]) -> dict[str, np.ndarray]:
    """Return mean in-plane velocities along y at x/D = 0.2 in every plane [m/s], shape (plane, y, 2).

    Returns
    -------
    dict of ndarray
        ``y_mm``, shape (y,). ``light_field`` and ``planar``: measured. ``recorded``: true flow, mean of the instants
        that the light field recorded. ``mean``: true mean flow. ``windows``, ``mean_windows`` and ``planar_windows``:
        ``recorded``, ``mean`` and ``planar`` averaged over the light field's windows.
    """
    y_mm = volume["axes_mm"][1]
    half = np.array(window_mm(twin)[:2]) / 2
    sampled = {
        "light_field": along_profiles(twin, volume["axes_mm"], volume["displacement_mm"][..., :2]),
        "windows": along_profiles(twin, volume["axes_mm"], volume["truth_mm"][..., :2]),
        "mean_windows": true_field(twin.mean, [twin.depths_mm, y_mm, [twin.profile_x_mm]], window_mm(twin))[
            :, :, 0, :2
        ],
    }
    planes: dict[str, list[np.ndarray]] = {name: [] for name in ("planar", "planar_windows", "recorded", "mean")}
    for depth, plane in zip(twin.depths_mm, planar, strict=True):
        points = np.stack([np.full_like(y_mm, twin.profile_x_mm), y_mm, np.full_like(y_mm, depth)], axis=1)
        instants = [twin.instant(pair)(points) for pair in range(twin.sizes.pairs)]
        planes["recorded"].append(np.mean(instants, axis=0)[:, :2])
        planes["mean"].append(twin.mean(points)[:, :2])
        sheet = RegularGridInterpolator((plane["y_mm"], plane["x_mm"]), plane["displacement_mm"])
        planes["planar"].append(sheet(points[:, 1::-1]))
        near_x = np.abs(plane["x_mm"] - twin.profile_x_mm) <= half[0]
        near_y = [np.abs(plane["y_mm"] - y) <= half[1] for y in y_mm]
        planes["planar_windows"].append(
            np.array([np.nanmean(plane["displacement_mm"][rows][:, near_x], axis=(0, 1)) for rows in near_y])
        )
    sampled |= {name: np.array(values) for name, values in planes.items()}
    to_m_s = 1 / 1000 / twin.dt_s
    return {"y_mm": y_mm} | {name: to_m_s * values for name, values in sampled.items()}


def along_profiles(twin: Twin, axes_mm: list[np.ndarray], field: np.ndarray) -> np.ndarray:
    """Interpolate a field (z, y, x, ...) to the profiles, linear in x, by a cubic spline in z, shape (plane, y, ...).

    Linear interpolation midway between two layers of windows would average over 1.5 times their depth.
    """
    z_mm, _, x_mm = axes_mm
    line = RegularGridInterpolator((x_mm,), np.moveaxis(field, 2, 0))([[twin.profile_x_mm]])[0]
    linear = RegularGridInterpolator((z_mm,), line)(np.array(twin.depths_mm)[:, None])
    filled = np.where(np.isfinite(line), line, np.nanmean(line))
    return np.where(np.isfinite(linear), CubicSpline(z_mm, filled)(twin.depths_mm), np.nan)


def relative_error(values: np.ndarray, reference: np.ndarray) -> float:
    """Return the mean distance of values from a reference over the reference's mean magnitude. Ignore NaN."""
    good = np.isfinite(values) & np.isfinite(reference)
    return float(np.abs(values - reference)[good].mean() / np.abs(reference)[good].mean())


class ByPairs(TypedDict):
    """Errors by the number of averaged pairs."""

    pairs: list[int]
    error: list[list[float]]
    chance: list[list[float]]


def error_by_pairs(twin: Twin, volume: LightField, reference: np.ndarray) -> ByPairs:
    """Compare the profiles averaged over more and more pairs with the truth in the same windows.

    Parameters
    ----------
    twin : Twin
        The flow and the places of the profiles.
    volume : LightField
        From `light_field_mean`.
    reference : ndarray, shape (plane, y, 2)
        Velocities whose mean magnitude the errors are relative to [m/s].

    Returns
    -------
    ByPairs
        ``pairs``: numbers of pairs. ``error``: mean distance of the average of so many pairs, for (u, v). ``chance``:
        error expected from the scatter between pairs without bias, sqrt(2 / pi) of the standard error.
    """
    scale = 1 / 1000 / twin.dt_s / np.abs(reference).mean(axis=(0, 1))
    each = np.moveaxis(volume["departures_mm"][..., :2], 0, -2)
    sampled = np.moveaxis(along_profiles(twin, volume["axes_mm"], each), -2, 0) * scale
    total = len(sampled)
    counts = sorted({n for n in (1, 2, 5, 10, 20, 50, 100, 150) if n < total} | {total})
    scatter = np.nanstd(sampled, axis=0, ddof=1) if total > 1 else np.full(sampled.shape[1:], np.nan)
    return {
        "pairs": counts,
        "error": [np.abs(np.nanmean(sampled[:n], axis=0)).mean(axis=(0, 1)).tolist() for n in counts],
        "chance": [(np.sqrt(2 / np.pi / n) * np.nanmean(scatter, axis=(0, 1))).tolist() for n in counts],
    }


COMPARED = {
    "planar": ("light_field", "planar", "light field against planar PIV"),
    "planar_windows": (
        "light_field",
        "planar_windows",
        "light field against planar PIV averaged over the light field's windows",
    ),
    "truth": ("light_field", "recorded", "light field against the truth of its instants"),
    "truth_windows": (
        "light_field",
        "windows",
        "light field against the same averaged over its windows: the measurement",
    ),
    "smoothing": ("windows", "recorded", "that average against the truth at points: smoothing by the windows"),
    "smoothing_mean": (
        "mean_windows",
        "mean",
        "the same of the mean flow, without turbulence: smoothing at any number of pairs",
    ),
    "mean_flow": ("light_field", "mean", "light field against the mean flow"),
    "planar_truth": ("planar", "mean", "planar PIV against the truth"),
    "sampling": ("recorded", "mean", "mean of the light field's instants against the mean flow: turbulence left"),
}
"""Profiles compared: key of the error -> the profile, its reference, and the words for both."""

Errors = Mapping[str, Mapping[str, float]]
"""Relative errors by component and key of `COMPARED`."""


def _result(
    twin: Twin, volume: LightField, planar: Sequence[Sheet], profiles: Mapping[str, np.ndarray], work: Path
) -> dict[str, Any]:
    errors = _errors(profiles, same_instants=twin.sizes.same_instants)
    off = volume["displacement_mm"] - volume["truth_mm"]
    voxel = [float(np.nanmean(np.abs(off[..., axis]))) / VOXEL_MM for axis in range(3)]
    by_pairs = error_by_pairs(twin, volume, profiles["recorded"])
    draw_profiles(twin, profiles, work / "fig22.png")
    draw_planes(twin, volume, planar, work / "fig20_21.png")
    measured = {f"error_{name}": errors[name]["planar"] for name in "uv"}
    measured |= {f"error_{name}_{key}": errors[name][key] for name in "uv" for key in COMPARED if key != "planar"}
    return page.result(
        {
            **measured,
            "swirl_number": twin.mean.swirl_number,
            "pairs": twin.sizes.pairs,
            "planar_pairs": twin.sizes.planar_pairs,
            "valid": volume["valid"],
            "planar_valid": [plane["valid"] for plane in planar],
            "error_by_pairs": by_pairs,
            "mean_field_error_voxel": dict(zip("xyz", voxel, strict=True)),
            "profiles_m_s": profiles,
            "depths_mm": twin.depths_mm,
        },
        comparison=[row for name in "uv" for row in _comparison(NAMES[name], errors[name], PAPER_ERROR[name])],
        figures=FIGURES,
        tables=_tables(errors, by_pairs),
        notes=[
            *_notes(twin, volume["valid"], voxel),
            _about_errors(twin, errors, by_pairs),
            *_about_scale(twin, errors),
        ],
    )


def _errors(profiles: Mapping[str, np.ndarray], *, same_instants: bool) -> dict[str, dict[str, float]]:
    """Compare the profiles of `COMPARED`, and planar PIV of the same instants with the flow of these instants."""
    pairs = {key: (first, second) for key, (first, second, _) in COMPARED.items()}
    if same_instants:
        pairs["planar_truth"] = ("planar", "recorded")
    return {
        name: {
            key: relative_error(profiles[first][..., number], profiles[second][..., number])
            for key, (first, second) in pairs.items()
        }
        for number, name in enumerate("uv")
    }


def _comparison(name: str, errors: Mapping[str, float], paper: float) -> list[dict[str, Any]]:
    return [
        page.compare(f"{name}, light field against planar PIV", errors["planar"], paper=paper, at_most=0.05),
        page.compare(
            f"{name}, light field against planar PIV averaged over the light field's windows", errors["planar_windows"]
        ),
        page.compare(f"{name}, light field against the true flow recorded", errors["truth"], at_most=0.05),
        page.compare(f"{name}, light field against the same averaged over its windows", errors["truth_windows"]),
        page.compare(f"{name}, planar PIV against the true flow", errors["planar_truth"]),
    ]


def _tables(errors: Errors, by_pairs: ByPairs) -> list[dict[str, Any]]:
    rows = zip(by_pairs["pairs"], by_pairs["error"], by_pairs["chance"], strict=True)
    return [
        {
            "caption": "Relative errors of the profiles: mean difference over mean magnitude, all depths",
            "columns": ["", *(NAMES[name] for name in "uv")],
            "rows": [[what, *(errors[n][key] for n in "uv")] for key, (_, _, what) in COMPARED.items()],
        },
        {
            "caption": "Light field against the truth in its windows by the number of pairs averaged; by chance: "
            "expected from the scatter between pairs without bias",
            "columns": ["pairs", "u", "u by chance", "v", "v by chance"],
            "rows": [[count, error[0], chance[0], error[1], chance[1]] for count, error, chance in rows],
        },
    ]


def _notes(twin: Twin, valid: float, voxel: Sequence[float]) -> list[str]:
    """Describe recording and measurement. `voxel` holds the mean errors along x, y, z."""
    sizes = twin.sizes
    instants = "the same instants" if sizes.same_instants else "other instants"
    return [
        f"The flow is the library's swirling jet with the paper's swirl number ({twin.mean.swirl_number:g}), bulk "
        f"velocity and size, with homogeneous turbulence of {100 * TURBULENCE_SHARE:.0f} % of the bulk velocity, "
        "another realisation for every pair. It is a model of the injector, not its measured flow.",
        f"{sizes.pairs} pairs of {PARTICLES_PER_MICROLENS:g} particles per microlens (5 um, with camera noise), "
        f"{ITERATIONS} SMART iterations, last window {WINDOWS[-1]} voxels. Planar PIV: {sizes.planar_pairs} pairs "
        f"at each depth, {instants}, a light sheet 1 mm thick, OpenPIV with a last window of 32 pixels.",
        f"Mean error of the averaged vectors over the volume, against the true flow in their windows: "
        f"{voxel[0]:.3f}, {voxel[1]:.3f} and {voxel[2]:.3f} voxel along x, y and z; {100 * valid:.0f} % of the "
        "vectors valid.",
        "The relative error divides by the mean magnitude of the reference over the profiles. u is small, so the same "
        "error in voxels is a larger relative error.",
    ]


def _about_scale(twin: Twin, errors: Errors) -> list[str]:
    """Describe what the small scale leaves out."""
    if not twin.sizes.same_instants:
        return []
    return [
        f"Cut at this scale: a volume of {' x '.join(f'{s:g}' for s in twin.sizes.volume_mm)} mm around the profiles "
        f"instead of 13 x 10 x 12 mm, {twin.sizes.pairs} pairs instead of 150 (planar: 600). Both record the "
        "same instants, because the turbulence of so few other instants would differ by "
        f"{100 * errors['u']['sampling']:.1f} % of u and {100 * errors['v']['sampling']:.1f} % of v."
    ]


def _about_errors(twin: Twin, errors: Errors, by_pairs: ByPairs) -> str:
    """Describe the parts of smoothing, chance and bias in the error."""
    edge = " x ".join(f"{edge:g}" for edge in window_mm(twin))
    parts = []
    for number, name in enumerate("uv"):
        error, chance = by_pairs["error"][-1][number], by_pairs["chance"][-1][number]
        parts.append(
            f"of {name}'s {100 * errors[name]['truth']:.1f} % against the true flow at points, "
            f"{100 * errors[name]['smoothing']:.1f} % are smoothing by the windows of {edge} mm "
            f"({100 * errors[name]['smoothing_mean']:.1f} % in the mean flow; the rest is turbulence finer than the "
            f"windows, which more pairs average out); against the flow in these windows {100 * error:.1f} % are left, "
            f"and {100 * chance:.1f} % are expected from the scatter of {by_pairs['pairs'][-1]} pairs"
        )
    alike = (
        "Planar PIV sees the same instants, so the turbulence left in so few of them cancels between the two."
        if twin.sizes.same_instants
        else "Planar PIV sees other instants, as in the paper, so the turbulence left in both averages adds to their "
        "difference."
    )
    return (
        f"Where the error comes from: {'; '.join(parts)}. {alike} The goal applies to the vectors of both methods, as "
        "in the paper. Planar PIV resolves 0.4 mm, so a fairer comparison first averages it over the light field's "
        f"windows: {100 * errors['u']['planar_windows']:.1f} % and "
        f"{100 * errors['v']['planar_windows']:.1f} %."
    )

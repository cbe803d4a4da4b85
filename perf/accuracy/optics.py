"""Windows, a liquid and aberrations: direct ray tracing ignores these optics, the network learns them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import bench
import numpy as np
import xarray as xr
from bench import DEFAULT, Bench, Judged

from lfpiv.calibration.camera import Calibration
from lfpiv.calibration.cameras import thin_lens
from lfpiv.progress import Progress
from lfpiv.reproduce import page, plots, rigs
from lfpiv.simulation.scene import Scene, true_mapping

TITLE = "Real optics: where ray tracing fails and the network does not"

ANGLE_DEG = 45.0
"""Exact angle of the cameras to either side. The optics are the only error of ray tracing."""
GLASS = {"thickness_mm": 10.0, "index": 1.52}
COMA = {"coma_pitch": 0.3, "distortion_percent": 1.0, "centre_mm": (-1.5, 0.8)}
SPHERICAL = {"spherical_pitch": 0.2}
"""Third-order aberrations of a main lens, the first one decentred. Fast lenses have aberrations of this order."""


@dataclass(frozen=True, kw_only=True)
class Optics:
    """Optics between particles and sensors."""

    label: str
    short: str
    """Label in pictures, with line breaks."""
    shared: Mapping[str, Any] = field(default_factory=dict)
    """Tables of the scene."""
    water: bool = False
    """The particles are in water, behind 8 mm of acrylic glass facing each camera."""
    measured: bool = False
    """Whether both cameras measure a pair through it. Otherwise the rays of one camera are compared."""

    @property
    def name(self) -> str:
        """Label on one line."""
        return self.short.replace("\n", " ")


OPTICS = {
    "ideal": Optics(label="ideal lens, nothing in between", short="ideal"),
    "window": Optics(
        label="one window of 10 mm glass, parallel to x-y, for both cameras",
        short="window",
        shared={"window": {"point_mm": (0.0, 0.0, 20.0), "normal": (0.0, 0.0, 1.0), **GLASS}},
        measured=True,
    ),
    "coma": Optics(
        label="decentred lens with coma of 0.3 pitch and 1 % distortion",
        short="coma,\ndistortion",
        shared={"aberrations": COMA},
    ),
    "spherical": Optics(
        label="lens with spherical aberration of 0.2 pitch",
        short="spherical\naberration",
        shared={"aberrations": SPHERICAL},
    ),
    "water": Optics(label="water behind 8 mm of acrylic glass that faces the camera", short="water", water=True),
    "both": Optics(
        label="the window, tilted by 16 degrees, and lenses with all these aberrations",
        short="tilted window,\naberrated lens",
        shared={
            "window": {"point_mm": (0.0, 0.0, 25.0), "normal": (0.25, 0.15, 1.0), **GLASS},
            "aberrations": COMA | SPHERICAL,
        },
        measured=True,
    ),
}
MAPPINGS = ("network", "fitted", "drt")
COLUMNS = ("drt", "fitted", "network", "labels")
CORRELATED = ("network", "drt")
"""Mappings that measure a pair."""
NAMES = {"network": "network", "fitted": "fitted thin lens", "drt": "DRT", "truth": "true particles"}
NAMES |= {"labels": "the dots' own rays"}
COLOURS = {"network": plots.COLOURS["network"], "fitted": plots.COLOURS["no_sieve"], "drt": plots.COLOURS["drt"]}
RayErrors = dict[str, dict[str, float]]
"""Mapping, or "labels" -> "mean" and "largest" distance from the true rays [pitch]."""
SMALLEST_PITCH = 2e-4
"""Lowest ray error shown [pitch]. DRT has none through ideal optics."""
FURTHER = 1.5
"""Ratio of the fitted lens's error to the nominal lens's above which it is described."""
SLICE_VOXEL = 2
"""Thickness of the slices that are shown [voxel]."""


def run(scale: str, work: Path, *, seed: int = 0, progress: Progress) -> dict[str, Any]:
    """Calibrate through every optics and measure through some; see the package for the arguments."""
    return compute(scale, work, OPTICS, seed=seed, progress=progress)


def compute(scale: str, work: Path, optics: Mapping[str, Optics], *, seed: int, progress: Progress) -> dict[str, Any]:
    """Calibrate and measure through some optics."""
    size = bench.SIZE_MM[scale]
    errors, judged, shown = {}, {}, {}
    for done, (key, one) in enumerate(optics.items()):

        def step(what: str, fraction: float, done: int = done, one: Optics = one) -> None:
            progress(f"{one.name}: {what}", (done + fraction) / len(optics))

        rig = rigs.calibrated_rig(optics_scene(scale, seed, one), work / key / "rig", step)
        own = Bench(rig, size, work / key / "runs", seed)
        mappings = ways(rig)
        errors[key] = {name: _ray_errors(own, mapping, seed) for name, mapping in mappings.items()}
        errors[key]["labels"] = _label_errors(rig)
        if not one.measured:
            continue
        for number, name in enumerate(CORRELATED):
            step(f"pair by {NAMES[name]}", (1 + number) / (1 + len(CORRELATED)))
            volumes, signal = own.volumes(name, pair=DEFAULT, calibration=mappings[name])
            judged[key, name] = own.judge(volumes, signal, pair=DEFAULT)
            shown[key, name] = volumes[0]
        volumes = own.true_volumes(DEFAULT)
        judged[key, "truth"], shown[key, "truth"] = own.judge(volumes, {}, pair=DEFAULT), volumes[0]
    progress("optics", 1.0)
    _draw(optics, errors, judged, work / "optics.png")
    _draw_slices(optics, shown, work / "optics_volumes.png")
    return _result(optics, errors, judged, size)


def optics_scene(scale: str, seed: int, optics: Optics) -> Scene:
    """Return the scene of two cameras behind some optics, or of one if only its rays are compared."""
    cameras = {"left": ANGLE_DEG, "right": -ANGLE_DEG} if optics.measured else {"left": ANGLE_DEG}
    tables: dict[str, dict[str, Any]] = {name: {"nominal_angle_deg": angle} for name, angle in cameras.items()}
    if optics.water:
        for name, angle in cameras.items():
            towards = np.array([np.sin(np.radians(angle)), 0.0, np.cos(np.radians(angle))])
            tables[name]["window"] = {
                "point_mm": tuple((15.0 * towards).tolist()),
                "normal": tuple(towards.tolist()),
                "thickness_mm": 8.0,
                "index": 1.49,
                "medium_index": 1.333,
            }
    return bench.scene(scale, seed, tables, name=optics.label, **optics.shared)


def ways(rig: rigs.Rig) -> dict[str, Calibration]:
    """Map by a rig's network, by the thin lens fitted to the same dots, and by DRT at the true angles."""
    fitted = {name: replace(camera, network=None) for name, camera in rig.calibration.cameras.items()}
    return dict(zip(MAPPINGS, (rig.calibration, Calibration(fitted), thin_lens(rig.experiment)), strict=True))


def _ray_errors(own: Bench, mapping: Calibration, seed: int) -> dict[str, float]:
    """Return mean and largest distance from the true rays, worst camera [pitch]."""
    errors = list(rigs.ray_errors_pitch(own.rig, mapping, own.grid, seed).values())
    return {"mean": max(float(e.mean()) for e in errors), "largest": max(float(e.max()) for e in errors)}


def _label_errors(rig: rigs.Rig) -> dict[str, float]:
    """Return mean and largest distance of the dots' rays from the true ones, worst camera [pitch]."""
    errors = []
    for camera in rig.scene.camera:
        dots = rig.labels(camera.name)
        miss = dots.array_mm - true_mapping(camera)(dots.points_mm, dots.pupil_mm)
        errors.append(np.linalg.norm(miss, axis=1) / camera.microlens_pitch_mm)
    return {"mean": max(float(e.mean()) for e in errors), "largest": max(float(e.max()) for e in errors)}


def _result(
    optics: Mapping[str, Optics],
    errors: Mapping[str, RayErrors],
    judged: Mapping[tuple[str, str], Judged],
    size: tuple[float, float, float],
) -> dict[str, Any]:
    measured = [key for key, one in optics.items() if one.measured]
    return page.result(
        {
            "mapping_error_pitch": errors,
            "pairs": {key: {name: judged[key, name].row() for name in (*CORRELATED, "truth")} for key in measured},
            "size_mm": size,
        },
        comparison=_comparison(optics, errors, judged),
        figures=[
            (
                "optics.png",
                "Left: mean distance of the mapped rays from the true ones over volume and pupil. Right: mean "
                "absolute error of the displacement along each axis, measured through the optics named.",
            ),
            (
                "optics_volumes.png",
                f"The same particles reconstructed by each mapping: brightest voxels of a slice {SLICE_VOXEL} voxels "
                "thick about y = 0.",
            ),
        ],
        tables=[
            {
                "caption": "Mapped against true rays, mean (and largest) distance in microlens pitches, worst camera",
                "columns": ["optics", *(NAMES[name] for name in COLUMNS)],
                "rows": [
                    [one.label] + [f"{errors[key][n]['mean']:.4f} ({errors[key][n]['largest']:.3f})" for n in COLUMNS]
                    for key, one in optics.items()
                ],
            },
            {
                "caption": f"A ring vortex at {DEFAULT.ppm:g} ppm measured through them: errors in voxels against the "
                "flow's mean over each window",
                "columns": ["optics", "mapping", "error", "x", "y", "z", "valid", "Q", "R_acc", "R_g", "ghosts"],
                "rows": [
                    [optics[key].name, NAMES[name], one.error.mean, *one.error.mean_absolute]
                    + [one.valid, one.q, one.accuracy, one.ghost_ratio, one.ghosts]
                    for (key, name), one in judged.items()
                ],
            },
        ],
        notes=[
            "The cameras stand exactly at 45 degrees to either side and are in focus through their windows, as on a "
            "bench. So the optics are DRT's only error. The simulator refracts every ray exactly "
            "at the window's faces and adds the lens's third-order aberrations; the calibration sees only the images.",
            "Fitted thin lens: pose and scale free, fitted to the same dots as the network. It corrects "
            "shift and defocus, such as by water behind a wall that faces the camera.",
            "The network is as good as its labels, the dots' own rays. A dot's rays are fitted as quadratics of the "
            "pupil point, which hold coma and the window's astigmatism; cubic terms, which spherical aberration needs, "
            "are fitted once for all dots of a camera.",
            *_about_fits(optics, errors),
            "A voxel's rays that miss by a part of a microlens light wrong pixels of the microimage; where they no "
            "longer meet in the particle, it is smeared, split or lost, and ghosts grow.",
            *(_about_pair(optics[key], {name: judged[key, name] for name in CORRELATED}) for key in measured),
        ],
    )


def _comparison(
    optics: Mapping[str, Optics], errors: Mapping[str, RayErrors], judged: Mapping[tuple[str, str], Judged]
) -> list[dict[str, Any]]:
    rows = []
    for key, one in optics.items():
        for name in ("drt", "network"):
            goal = 0.015 if name == "network" else None
            what = f"rays off by, {NAMES[name]}, {one.name}"
            rows.append(page.compare(what, errors[key][name]["mean"], at_most=goal, unit="pitch"))
    for key, one in optics.items():
        for name in ("drt", "network") if one.measured else ():
            what = f"displacement error, {NAMES[name]}, {one.name}"
            rows.append(page.compare(what, judged[key, name].error.mean, unit="voxel"))
    return rows


def _about_fits(optics: Mapping[str, Optics], errors: Mapping[str, RayErrors]) -> list[str]:
    """Name the optics where the fitted thin lens is worse than the nominal one."""
    lost = [
        one.label
        for key, one in optics.items()
        if key != "ideal" and errors[key]["fitted"]["mean"] > FURTHER * errors[key]["drt"]["mean"]
    ]
    if not lost:
        return []
    return [
        f"Further off by the fit than by DRT: {'; '.join(lost)}. There the fitted pose is far from the data sheet. "
        "Within the board, the network corrects the rest."
    ]


def _about_pair(optics: Optics, judged: Mapping[str, Judged]) -> str:
    network, drt = judged["network"], judged["drt"]
    parts = ", ".join(
        f"{axis} {drt.error.mean_absolute[k]:.3f} against {network.error.mean_absolute[k]:.3f}"
        for k, axis in enumerate("xyz")
    )
    return (
        f"{optics.label[0].upper()}{optics.label[1:]}: by DRT the mean error is {drt.error.mean:.3f} voxel where the "
        f"network has {network.error.mean:.3f}, {drt.error.mean / network.error.mean:.1f} times as much ({parts}); Q "
        f"{drt.q:.2f} against {network.q:.2f}."
    )


def _draw(
    optics: Mapping[str, Optics],
    errors: Mapping[str, RayErrors],
    judged: Mapping[tuple[str, str], Judged],
    path: Path,
) -> None:
    measured = [key for key, one in optics.items() if one.measured]
    drawn = plots.figure(11, 3.4)
    axes = drawn.subplots(1, 1 + len(measured), width_ratios=(1.9, *(1.0,) * len(measured)), squeeze=False)[0]
    width = 0.8 / len(MAPPINGS)
    for number, name in enumerate(reversed(MAPPINGS)):
        place = np.arange(len(optics)) + (number + 0.5) * width - 0.4
        axes[0].bar(place, [errors[key][name]["mean"] for key in optics], width, color=COLOURS[name], label=NAMES[name])
    axes[0].set_xticks(range(len(optics)), [one.short for one in optics.values()], fontsize=8)
    axes[0].set(ylabel="mean ray error [pitch]", yscale="log")
    axes[0].set_ylim(SMALLEST_PITCH, None)
    width = 0.8 / len(CORRELATED)
    for panel, key in zip(axes[1:], measured, strict=True):
        for number, name in enumerate(reversed(CORRELATED)):
            one = judged[key, name]
            place = np.arange(3) + (number + 0.5) * width - 0.4
            panel.bar(place, one.error.mean_absolute, width, color=COLOURS[name], label=f"Q {one.q:.2f}")
        panel.set_xticks(range(3), ["x", "y", "z"])
        panel.set_title(optics[key].name, fontsize=9)
        panel.set_ylabel("mean absolute error [voxel]")
    top = max(one.error.mean_absolute[k] for (_, name), one in judged.items() if name in CORRELATED for k in range(3))
    for panel in axes:
        plots.plain(panel)
        if panel is not axes[0]:
            panel.set_ylim(0, 1.05 * top)
        panel.legend(frameon=False, fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.07), ncols=3)
    plots.save(drawn, path)


def _draw_slices(optics: Mapping[str, Optics], shown: Mapping[tuple[str, str], xr.DataArray], path: Path) -> None:
    measured = [key for key, one in optics.items() if one.measured]
    drawn = plots.figure(8, 3.4 * max(1, len(measured)))
    columns = ("truth", *CORRELATED)
    for row, key in zip(drawn.subplots(len(measured), len(columns), squeeze=False), measured, strict=True):
        for axes, name in zip(row, columns, strict=True):
            plots.draw_slice(axes, shown[key, name], SLICE_VOXEL, f"{optics[key].name}:\n{NAMES[name]}")
    plots.save(drawn, path)

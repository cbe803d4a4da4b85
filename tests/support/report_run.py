"""Make a finished run to report on: calibrated on simulated boards; vectors, volumes and summary by formula."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from support import scenes

import lfpiv
from lfpiv.calibration.camera import Calibration
from lfpiv.experiment.experiment import Experiment
from lfpiv.results import netcdf
from lfpiv.simulation.simulator import simulate
from lfpiv.velocity.cross_correlation import Verdict
from lfpiv.velocity.settings import CorrelationSettings

NAME = """Ring <b>&"1'</b>"""
"""Name of the experiment, with all characters that have a meaning in HTML."""
EVIL = '</script><img src=x onerror="alert(1)"> & "more"'
"""Text of a warning and of a failure, which would run a script if it were not escaped."""

OMEGA, STRETCH = 40.0, 25.0
"""Rotation about z [rad/s] and gradient of w along z [1/s]; the vorticity is 2 OMEGA everywhere."""
DT_S, VOXEL_MM = 1e-3, 0.1
PAIRS = 3
"""Number of pairs. The last one has no valid vector."""
SHEET_MM = 0.3
"""Half the thickness of the light sheet in the volumes [mm]."""
EDGE_LEVEL = 0.2
"""Brightness of the volumes outside the light sheet, relative to inside."""


@dataclass(frozen=True)
class Run:
    """The arguments of `write_report`, and the report."""

    experiment: Experiment
    calibration: Calibration
    summary: dict
    vectors: dict[int, Path]
    page: Path
    """The report."""

    def write(self, path: Path, **changed) -> str:
        """Write the report with some arguments changed; return its text."""
        parts = {name: getattr(self, name) for name in ("experiment", "calibration", "summary", "vectors")} | changed
        lfpiv.write_report(**parts, path=path)
        return path.read_text("utf-8")


def make_run(folder: Path) -> Run:
    scene = scenes.scene(
        NAME,
        [scenes.camera(name, angle, (280, 260)) for name, angle in (("left", 35.0), ("right.2", -35.0))],
        planes_mm=(-0.5, 0.0, 0.5),
        spacing_mm=0.3,
        size_mm=(1.4, 1.2, 1.0),
        particles={"count": 4, "pairs": PAIRS, "sigma_mm": 0.05},
        displacement_mm=(0.05, 0.0, 0.0),
        dt_s=DT_S,
        network={"hidden": (6,), "epochs": 20, "estimator": "gaussian"},
    )
    experiment = lfpiv.open_experiment(simulate(scene, folder / "data"))
    calibration = lfpiv.calibrate(experiment)
    vectors = {}
    for pair in range(PAIRS):
        vectors[pair] = folder / "vectors" / f"pair_{pair:04d}.nc"
        netcdf.write_vectors(field(pair), vectors[pair], attributes={}, reconstruction=reconstruction())
    summary = make_summary(experiment, calibration, vectors)
    run = Run(experiment, calibration, summary, vectors, folder / "report.html")
    run.write(run.page)
    return run


def field(pair: int, shape: tuple[int, int, int] = (5, 6, 7)) -> xr.Dataset:
    """Return a rotation about z that grows by a tenth per pair, with a stretch along z; some vectors are invalid."""
    axes = {name: 0.2 * (np.arange(n) - (n - 1) / 2) for name, n in zip("zyx", shape, strict=True)}
    z, y, x = np.meshgrid(*axes.values(), indexing="ij")
    factor = 1 + 0.1 * pair
    parts = {"u": 5.0 - OMEGA * factor * y, "v": 3.0 + OMEGA * factor * x, "w": 2.0 + STRETCH * z}  # mm/s
    valid = np.random.default_rng(pair).random(shape) < 0.9
    valid[0] = True
    if pair == PAIRS - 1:
        valid[:] = False
    variables = {name: (("z", "y", "x"), (part / 1000).astype(np.float32)) for name, part in parts.items()}
    for name, axis in zip("uvw", "xyz", strict=True):
        variables[f"displacement_{axis}"] = (("z", "y", "x"), variables[name][1] * 1000 * DT_S / VOXEL_MM)
    variables |= {
        "valid": (("z", "y", "x"), valid),
        "peak_ratio": (("z", "y", "x"), np.full(shape, 2.5, np.float32)),
        "uncertainty": (("z", "y", "x"), np.where(valid, 0.1, np.nan).astype(np.float32)),
    }
    vectors = xr.Dataset(variables, {name: (name, axis, {"units": "mm"}) for name, axis in axes.items()})
    for name, unit in netcdf.VECTOR_UNITS.items():
        vectors[name].attrs["units"] = unit
    settings = CorrelationSettings(
        windows=((4, 4, 4),), overlap=0.5, max_displacement_voxel=None, smoothing_voxel=0.5, intensity_power=0.5
    )
    return vectors.assign_attrs(
        settings=settings.to_json(), dt_s=DT_S, voxel_mm=[VOXEL_MM] * 3, verdict=Verdict.GOOD.value
    )


def reconstruction() -> xr.Dataset:
    """Return condensed volumes of a light sheet that ends inside them."""
    axes = {name: VOXEL_MM * (np.arange(n) - (n - 1) / 2) for name, n in (("z", 14), ("y", 12), ("x", 14))}
    sheet = np.where(np.abs(axes["z"]) < SHEET_MM, 1.0, EDGE_LEVEL)[:, None, None]
    grain = np.random.default_rng(0).random((14, 12, 14))
    volume = xr.DataArray(
        (1000 * sheet * (0.5 + 0.5 * grain)).astype(np.float32),
        axes,
        ("z", "y", "x"),
        attrs={"residual": [0.8, 0.4, 0.3], "stop": "iteration limit reached"},
    )
    return netcdf.build_reconstruction({"a": volume, "b": volume})


def make_summary(experiment: Experiment, calibration: Calibration, vectors: dict[int, Path]) -> dict:
    """Return the content of summary.json."""
    pairs = []
    for pair in vectors:
        found = field(min(pair, PAIRS - 1))
        good = found["valid"].values
        spread = {
            name: {"mean": float(found[name].values[good].mean()), "sd": float(found[name].values[good].std())}
            if good.any()
            else {"mean": None, "sd": None}
            for name in "uvw"
        }
        pairs.append(
            {
                "pair": pair,
                "file": f"pair_{pair:04d}.nc",
                "vectors": list(good.shape),
                "valid_fraction": float(good.mean()),
                "verdict": Verdict.GOOD.value,
                "velocity_m_per_s": spread,
                "uncertainty_voxel": 0.1 if good.any() else None,
                "peak_ratio": 2.5 if good.any() else None,
                "residual": {"a": [0.8, 0.4, 0.3], "b": [0.7, 0.35]},
                "stop": {"a": "iteration limit reached", "b": "misfit no longer falls"},
            }
        )
    return {
        "device": {"kind": "cpu", "threads": 2, "reason": ""},
        "versions": {"lfpiv": lfpiv.__version__, "numpy": np.__version__},
        "settings": {"smart": {"iterations": 2}, "correlation": {"windows": None}},
        "timings_s": {"calibration": 1.0, "total": 2.0},
        "peak_memory_mib": 300.0,
        "calibration": {name: camera.report.to_json() for name, camera in calibration.cameras.items()},
        "weights": {"method": "footprint", "memory_mib": 3.0, "form": {"left": "profiles"}, "count_check_l2": [0.01]},
        "pairs": pairs,
        "pairs_finished": len(pairs),
        "valid_fraction": float(np.mean([pair["valid_fraction"] for pair in pairs])),
        "warnings": [f"left: {EVIL}"],
        "failed": [{"pair": 7, "reason": EVIL}],
        "pairs_failed": 1,
        "reused": ["calibration"],
    }

"""Compare stated standard deviations of displacements with true errors, over many rigs, flows, particles and images.

    python perf/accuracy/stated_errors.py [--cases chosen,checked] [--first 80] [--by condition,cameras,axis]

The constants of `lfpiv.velocity.systematic` and `lfpiv_kernels.correlation.uncertainty` were chosen with the cases
`chosen`. The cases `checked` have other rigs, flows and seeds. Volumes are stored outside the repository and
reconstructed once, so that another formula takes a minute: remove the folder `volumes` there after a change of the
reconstruction.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from headlines import BINS
from reconstruction_bench import CACHE, vectors_of
from reconstruction_cases import Case, make_rig, record, true_field
from reconstruction_ways import WAYS

from lfpiv.geometry.grid import AXES
from lfpiv.reproduce import store

RIGS = {
    "chosen": ((45.0, -45.0), (30.0, -30.0), (45.0, 0.0, -45.0), (45.0, 15.0, -15.0, -45.0)),
    "checked": ((40.0, -40.0), (50.0, -20.0), (60.0, -60.0), (40.0, 0.0, -40.0), (50.0, 20.0, -20.0, -50.0)),
}
"""Angles of the cameras about y [degree]."""
FIRST_RIG = 0.4
"""Share of the cases with the first rig."""
FLOWS = {"chosen": ("ring", "shear", "turbulent"), "checked": ("swirl", "uniform", "turbulent", "ring")}
FIRST_SEED = {"chosen": 100, "checked": 300}
DRAWN_BY = {"chosen": (77, 1), "checked": (77, 2)}
"""Seeds of what is drawn."""
COUNT = 80
LEAST_VECTORS = 10
"""Least number of valid vectors of a case that is judged."""


def cases_of(name: str) -> list[Case]:
    """Draw the cases of a set."""
    rng, rigs, found = np.random.default_rng(DRAWN_BY[name]), RIGS[name], []
    others = (1 - FIRST_RIG) / (len(rigs) - 1)
    for number in range(COUNT):
        flow, ppm = str(rng.choice(FLOWS[name])), float(rng.choice([0.05, 0.1, 0.2, 0.5, 0.5, 1.0]))
        blob_voxel = float(rng.choice([0.7, 0.7, 1.0, 0.0]))
        condition = str(rng.choice(["clean", "clean", "real", "real", "poly"]))
        angles_deg = rigs[int(rng.choice(len(rigs), p=[FIRST_RIG] + [others] * (len(rigs) - 1)))]
        speed = float(rng.choice([0.5, 1.0, 1.0, 1.5]))
        found.append(
            Case(
                flow=flow,
                ppm=ppm,
                seed=FIRST_SEED[name] + number,
                blob_voxel=blob_voxel,
                condition=condition,
                angles_deg=angles_deg,
                speed=speed,
            )
        )
    return found


@dataclass(frozen=True, kw_only=True)
class Judged:
    """Errors and stated standard deviations of the valid vectors of a case, shape (vector, 3), order (z, y, x)."""

    case: Case
    error: np.ndarray
    stated: np.ndarray
    face: np.ndarray
    """True where the window touches a face of the volume across z, shape (vector,)."""

    @property
    def within(self) -> float:
        """Share of the errors within two stated standard deviations."""
        return float((np.abs(self.error) <= 2 * self.stated).mean())

    @property
    def ratio(self) -> float:
        """Root mean square of the errors over that of the stated standard deviations."""
        return float(np.sqrt(np.square(self.error).mean() / np.square(self.stated).mean()))


def judge(case: Case, folder: Path) -> Judged | None:
    """Compare the vectors of a case with the truth; None if hardly any is valid."""
    (vectors,) = vectors_of(case, _volumes(case, folder), {})
    edge = json.loads(vectors.attrs["settings"])["windows"][-1]
    exact = true_field(case, [vectors[axis].values for axis in AXES], edge)[..., ::-1]
    found, stated = (
        np.stack([vectors[f"{name}_{axis}"].values for axis in AXES], -1).astype(float)
        for name in ("displacement", "uncertainty")
    )
    known = vectors["valid"].values & np.isfinite(stated).all(-1)
    if known.sum() < LEAST_VECTORS:
        return None
    layer = np.indices(known.shape)[0][known]
    face = (layer == 0) | (layer == len(known) - 1)
    return Judged(case=case, error=(found - exact)[known], stated=stated[known], face=face)


def _volumes(case: Case, folder: Path) -> list[xr.DataArray]:
    """Reconstruct both frames, or read them from the folder."""
    rig = make_rig(case.scale, case.angles_deg)

    def reconstructed() -> dict[str, np.ndarray]:
        volumes = WAYS["ours"].reconstruct(rig, record(case, folder / "images"), {}).volumes
        attributes = [[np.atleast_1d(one.attrs["residual"])[-1], one.attrs.get("sieve_voxel", 0.0)] for one in volumes]
        return {"light": np.stack([one.values for one in volumes]), "attributes": np.array(attributes)}

    name = f"{case.seed}_{case.flow}_{case.condition}_{case.ppm:g}.npz"
    stored = store.cached_arrays(folder / "volumes" / name, asdict(case), reconstructed)
    return [
        xr.DataArray(light, rig.grid.coordinates(), AXES, attrs={"residual": residual, "sieve_voxel": sieve})
        for light, (residual, sieve) in zip(stored["light"], stored["attributes"], strict=True)
    ]


def groups(judged: Sequence[Judged], key: str) -> Iterator[tuple[str, list[Judged]]]:
    """Yield the cases of equal value of a key: of the case, its number of cameras, or parts by axis and by face."""
    if key in ("axis", "face"):
        for axis, name in enumerate(AXES):
            for faces in (None,) if key == "axis" else (True, False):
                label = name if faces is None else f"{name}, {'beside' if faces else 'away from'} a z face"
                yield label, [_part(one, axis, faces) for one in judged]
        return

    def value(one: Judged) -> float | str:
        return len(one.case.angles_deg) if key == "cameras" else getattr(one.case, key)

    for found in sorted({value(one) for one in judged}):
        yield f"{key} {found}", [one for one in judged if value(one) == found]


def _part(one: Judged, axis: int, faces: bool | None) -> Judged:
    chosen = np.ones_like(one.face) if faces is None else one.face == faces
    return Judged(case=one.case, error=one.error[chosen, axis], stated=one.stated[chosen, axis], face=one.face[chosen])


def line(label: str, judged: Sequence[Judged]) -> str:
    """Return a row: shares within two of all errors and of a tenth of the cases, ratios of cases and of groups."""
    judged = [one for one in judged if len(one.error)]
    error, stated = (np.concatenate([getattr(one, name).ravel() for one in judged]) for name in ("error", "stated"))
    lowest = np.quantile([one.within for one in judged], 0.1)
    low, middle, high = np.quantile([one.ratio for one in judged], (0.1, 0.5, 0.9))
    curve = [
        f"{np.sqrt(np.square(error[members]).mean() / np.square(stated[members]).mean()):.2f}"
        for members in np.array_split(np.argsort(stated), BINS)
    ]
    within = (np.abs(error) <= 2 * stated).mean()
    return (
        f"{label:28s} | {100 * within:5.1f} | {100 * lowest:5.1f} | {middle:.2f} ({low:.2f} to {high:.2f}) | "
        + ", ".join(curve)
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", default="chosen,checked", help=", ".join(RIGS))
    parser.add_argument("--first", type=int, default=COUNT, help="cases of each set")
    parser.add_argument("--by", default="condition,cameras,blob_voxel,ppm,flow,axis", help="what rows differ in")
    parser.add_argument("--cache", type=Path, default=CACHE, help="folder of images and volumes")
    options = parser.parse_args(arguments)
    print("within two [%] of all, of a tenth of the cases; rms error over stated of cases; from surest to least sure")
    everything: list[Judged] = []
    for name in options.cases.split(","):
        found = [judge(case, options.cache) for case in cases_of(name)[: options.first]]
        judged = [one for one in found if one is not None]
        everything += judged
        print(line(f"{name}, {len(judged)} cases", judged), flush=True)
    for key in options.by.split(","):
        for label, members in groups(everything, key):
            print(line(label, members), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Say what an export leaves out of the results, and why."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import xarray as xr

from lfpiv.results import pivpy_planes
from lfpiv.velocity.derived import LEAST_VECTORS

SHOWN = 8
"""Largest number of names that the text shows."""


@dataclass(frozen=True)
class LeftOut:
    """Something that results have, or usually have, and an export has not."""

    what: tuple[str, ...]
    """Names of variables or files."""
    why: str
    is_loss: bool = False
    """Whether other results would have it in this format."""

    def __str__(self) -> str:
        more = f" and {len(self.what) - SHOWN} more" if len(self.what) > SHOWN else ""
        return f"{', '.join(self.what[:SHOWN])}{more}: left out, {self.why}"


def too_few(vectors: xr.Dataset) -> str:
    """Return why vectors have no derivatives, "" if they have: there are too few along an axis."""
    thin = [axis for axis in "xyz" if vectors.sizes[axis] < LEAST_VECTORS]
    counts = ", ".join(f"{vectors.sizes[axis]} along {axis}" for axis in thin)
    return f"vectors are too few for derivatives, which need {LEAST_VECTORS} along each axis: {counts}" if thin else ""


def of_export(
    to: str, results: xr.Dataset, *, with_particles: bool, unfit_volumes: Iterable[Path]
) -> Iterator[LeftOut]:
    """Yield what an export leaves out.

    Parameters
    ----------
    to : str
        Name of the format.
    results : Dataset
        Vectors of the run.
    with_particles : bool
        Whether the run has linked particles.
    unfit_volumes : iterable of Path
        Stored volumes that do not belong to the vectors.
    """
    if to == "vti" and (why := too_few(results)):
        yield LeftOut(("vorticity", "q_criterion"), why, is_loss=True)
    if unfit := tuple(path.name for path in unfit_volumes):
        why = "made with other settings or images than the vectors; `lfpiv run --keep-volumes` makes volumes that fit"
        yield LeftOut(unfit, why, is_loss=True)
    if to == "pivpy":
        others = tuple(str(name) for name in results.data_vars if name not in pivpy_planes.VARIABLES)
        yield LeftOut(others, "pivpy has no place for them: netcdf, zarr, csv and vti have them")
    if to == "tecplot" and (
        gaps := tuple(f"NaN of {name}" for name, one in results.data_vars.items() if one.isnull().any())
    ):
        yield LeftOut(gaps, "Tecplot's text has no NaN, so 0 is written")
    if to == "vtp":
        yield LeftOut(tuple(map(str, results.data_vars)), "this format is of particles: vti has the vectors")
    if with_particles and to not in ("csv", "vtp"):
        yield LeftOut(("linked particles",), "csv and vtp have them")

"""`export_results`: write vectors of a run in formats of other programs: ParaView, NetCDF, Zarr, CSV, Tecplot, pivpy.

A file appears under its name only when it is complete. Existing files are replaced as a whole.
"""

from __future__ import annotations

import enum
import logging
import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from lfpiv.errors import InputError
from lfpiv.experiment.recording import Recording
from lfpiv.files import writing
from lfpiv.progress import Progress, StepProgress, ignore_progress
from lfpiv.records import read_object
from lfpiv.results import (
    image_identity,
    left_out,
    netcdf,
    paraview,
    particles,
    pivpy_planes,
    provenance,
    stores,
    track_files,
)
from lfpiv.results import tables as csv_tables
from lfpiv.results.folder import Folder, make_writable
from lfpiv.results.left_out import LeftOut
from lfpiv.results.reader import open_results
from lfpiv.results.stacked_files import INSTANT, PAIR, StackedFiles
from lfpiv.velocity import derived
from lfpiv.version import versions

log = logging.getLogger(__name__)

FOLDER = "export"
"""Default folder of exports inside the folder of the run."""


class Format(enum.Enum):
    """Formats of exported vectors. The text describes the files."""

    VTI = "one .vti image per pair or instant and one per stored volume, with .pvd collections: ParaView, pyvista"
    NETCDF = "vectors.nc, one NetCDF4 file of all pairs or instants: xarray, MATLAB"
    ZARR = "vectors.zarr, one Zarr store of all pairs or instants: xarray, dask"
    CSV = "a table per pair or instant, a row per vector; of its linked particles; of all tracks; with units"
    TECPLOT = "one .dat file of Tecplot's text per pair or instant"
    VTP = "one .vtp file of linked particles per pair or instant, with a .pvd collection; one of tracks: ParaView"
    PIVPY = "one NetCDF file per depth, planes of u and v of all pairs or instants: pivpy"


def export_results(
    folder: str | Path,
    to: str,
    *,
    out: str | Path | None = None,
    pairs: tuple[int, int | None] | None = None,
    depth_mm: float | None = None,
    interval_s: float | None = None,
    progress: Progress | None = None,
) -> list[Path]:
    """Write the vectors of a run in a format that other programs read.

    Parameters
    ----------
    folder : str or Path
        Folder of the run.
    to : {"vti", "netcdf", "zarr", "csv", "tecplot", "vtp", "pivpy"}
        The format, see `Format` and docs/conventions.md.
    out : str or Path, optional
        Folder to write to. Default: `FOLDER` inside `folder`.
    pairs : tuple, optional
        (A, B): only pairs A to B - 1; B may be None.
    depth_mm : float, optional
        For "pivpy": only the plane of vectors nearest to this z [mm]. Default: all planes.
    interval_s : float, optional
        Time between the first frames of successive pairs [s], which makes times in "vti", "netcdf", "zarr", "tecplot"
        and "pivpy" seconds. Default: the number of the pair is used as time. The times of a time series are known.
    progress : callable, optional
        Called as ``progress("export", fraction)``.

    Returns
    -------
    list of Path
        The files to open: the collections for "vti", otherwise all written files.

    Raises
    ------
    InputError
        If an argument is out of range, the folder has no vectors, its pairs differ in settings or axes, or `out` cannot
        be written.
    StorageError
        If the disk is full or writing fails. Finished files are complete.

    Examples
    --------
    This example writes the vectors itself. Usually `lfpiv run` has written them.

    >>> import tempfile
    >>> from pathlib import Path
    >>> import numpy as np, lfpiv
    >>> from lfpiv.results.netcdf import write_vectors
    >>> folder = Path(tempfile.mkdtemp())
    >>> volume = np.random.default_rng(0).random((16, 16, 16))
    >>> vectors = lfpiv.correlate(volume, np.roll(volume, 1, axis=2), windows=(8,), dt_s=1e-4, voxel_mm=0.1)
    >>> write_vectors(vectors, folder / "vectors" / "pair_0000.nc", attributes={"pair": 0})
    >>> [path.name for path in lfpiv.export_results(folder, "csv")]
    ['pair_0000.csv']
    >>> (folder / "export" / "pair_0000.csv").read_text().splitlines()[0][:39]
    'x [mm],y [mm],z [mm],u [m/s],v [m/s],w '
    """
    return export(folder, to, out=out, pairs=pairs, depth_mm=depth_mm, interval_s=interval_s, progress=progress).files


@dataclass(frozen=True)
class Exported:
    """Files that an export wrote, and what they leave out."""

    files: list[Path]
    """The files to open: the collections for "vti" and "vtp", otherwise all written files."""
    left_out: tuple[LeftOut, ...]


def export(
    folder: str | Path,
    to: str,
    *,
    out: str | Path | None = None,
    pairs: tuple[int, int | None] | None = None,
    depth_mm: float | None = None,
    interval_s: float | None = None,
    progress: Progress | None = None,
) -> Exported:
    """Export as `export_results`; return the files together with what they leave out, which is logged too."""
    form = _checked_form(to, depth_mm, interval_s)
    tables = _particles(Path(folder), pairs, required=form is Format.VTP)
    files = StackedFiles(Path(folder), pairs)
    if interval_s is not None and files.dimension == INSTANT:
        raise InputError("interval: expected for image pairs only; the times of a time series are known. Leave it out.")
    results = open_results(folder, pairs=pairs)
    planes = results["z"].values if depth_mm is None else _nearest(results["z"], depth_mm)
    target = Path(folder) / FOLDER if out is None else Path(out)
    unfit = _unfit_volumes(results, _folder(Path(folder), files)) if form is Format.VTI else frozenset()
    omitted = tuple(left_out.of_export(to.lower(), results, with_particles=bool(tables), unfit_volumes=sorted(unfit)))
    for one in omitted:
        log.log(logging.WARNING if one.is_loss else logging.INFO, "%s", one)
    made = make_writable(target)

    def step(fraction: float) -> None:
        (progress or ignore_progress)("export", fraction)

    try:
        with writing(target):
            if form is Format.VTI:
                written = _write_vti(results, _folder(Path(folder), files), target, interval_s, step, unfit)
            elif form in (Format.NETCDF, Format.ZARR):
                written = _write_stacked(form, files, target, interval_s, step)
            elif form is Format.CSV:
                written = _write_tables(results, tables, Path(folder), target, step)
            elif form is Format.TECPLOT:
                written = _write_tecplot(results, target, interval_s, step)
            elif form is Format.VTP:
                written = _write_vtp(tables, Path(folder), target, _times_by_number(results, interval_s))
            else:
                written = _write_pivpy(results, planes, target, interval_s, step)
            return Exported(written, omitted)
    finally:
        for path in made:
            if path.is_dir() and not any(path.iterdir()):
                path.rmdir()


def _checked_form(to: str, depth_mm: float | None, interval_s: float | None) -> Format:
    """Return the format of a name; refuse arguments that do not fit it."""
    try:
        form = Format[to.upper()]
    except (KeyError, AttributeError):
        known = ", ".join(form.name.lower() for form in Format)
        raise InputError(f"to: expected one of {known}, found {to!r}.") from None
    if depth_mm is not None and form is not Format.PIVPY:
        raise InputError(f"depth: expected with pivpy only, whose files are planes, found it with {to}. Leave it out.")
    if interval_s is not None and not (math.isfinite(interval_s) and interval_s > 0):
        raise InputError(f"interval: expected a time above 0 s between pairs, found {interval_s!r}.")
    return form


def _folder(path: Path, files: StackedFiles) -> Folder:
    """Return the folder of the run with the names of its results."""
    if files.dimension == PAIR:
        return Folder(path)
    first, step = int(files.numbers[0]), int(files.first.attrs.get("step", 1))
    return Folder(path, Recording.of_series(len(files) + step, first, step))


def _nearest(depths: xr.DataArray, depth_mm: float) -> np.ndarray:
    """Return the depth of the nearest plane of vectors, as an array of one. It must be within half a spacing."""
    planes = depths.values
    half = abs(planes[-1] - planes[0]) / max(len(planes) - 1, 1) / 2 if len(planes) > 1 else math.inf
    nearest = planes[np.abs(planes - depth_mm).argmin()] if math.isfinite(depth_mm) else math.nan
    if not abs(nearest - depth_mm) <= half * (1 + 1e-9):
        raise InputError(
            f"depth: expected a z among the vectors, {planes.min():g} to {planes.max():g} mm, found {depth_mm:g} mm."
        )
    return np.array([nearest])


def _times(results: xr.Dataset, interval_s: float | None) -> np.ndarray:
    """Return the time of each instant [s], or of each pair, or its number if the interval is not known."""
    if INSTANT in results.dims:
        return np.asarray(results["time"].values)
    return results["pair"].values * (1.0 if interval_s is None else interval_s)


def _times_by_number(results: xr.Dataset, interval_s: float | None) -> dict[int, float]:
    """Return the time of each pair or instant by its number."""
    return dict(zip(results[_along(results)].values.tolist(), _times(results, interval_s).tolist(), strict=True))


def _along(results: xr.Dataset) -> str:
    """Return the dimension over the results, which is also the first part of the files' names."""
    return INSTANT if INSTANT in results.dims else PAIR


def _stem(results: xr.Dataset, number: int) -> str:
    """Return the name of the files of a pair, or of an instant and the one `step` after it, without suffix."""
    return f"instant_{number:06d}" if INSTANT in results.dims else f"pair_{number:04d}"


def _each_pair(results: xr.Dataset, progress: StepProgress) -> Iterator[tuple[int, xr.Dataset]]:
    """Load and yield one pair after the other."""
    along = _along(results)
    total = results.sizes[along]
    for done in range(total):
        progress(done / total)
        one = results.isel({along: done}, drop=True).drop_vars("time", errors="ignore")
        yield int(results[along][done]), one.load()
    progress(1.0)


# -- ParaView ----------------------------------------------------------------------------------------------------------


def _write_vti(
    results: xr.Dataset,
    folder: Folder,
    target: Path,
    interval_s: float | None,
    progress: StepProgress,
    unfit: Collection[Path],
) -> list[Path]:
    times = _times_by_number(results, interval_s)
    collections: dict[str, dict[Path, float]] = {}
    for pair, vectors in _each_pair(results, progress):
        path = target / f"{_stem(results, pair)}.vti"
        paraview.write_image(_vector_arrays(vectors), vectors, path)
        collections.setdefault("vectors", {})[path] = times[pair]
        for stored in folder.new_volumes(pair):
            if not stored.is_file() or stored in unfit:
                continue
            volume = netcdf.read_volume(stored)
            _, number, *frame = stored.stem.split("_")
            path = target / f"{'_'.join(['volume', number, *frame])}.vti"
            paraview.write_image({"intensity": volume.values}, volume, path)
            collections.setdefault("_".join(["volumes", *frame]), {})[path] = times[pair]
    written = []
    for name, files in collections.items():
        path = target / f"{name}.pvd"
        paraview.write_collection(files, path)
        written.append(path)
    return written


def _unfit_volumes(results: xr.Dataset, folder: Folder) -> frozenset[Path]:
    """Return the stored volumes that were made from other settings or images than the vectors."""
    stored = ((pair, path) for pair in results[_along(results)].values.tolist() for path in folder.new_volumes(pair))
    return frozenset(path for pair, path in stored if path.is_file() and not _same_origin(path, folder.vectors(pair)))


def _same_origin(volume: Path, vectors: Path) -> bool:
    """Return whether a volume and vectors were made from equal settings and images, as far as both files state them."""
    one, other = (read_object(provenance.require_marks(path).depends_on or "{}") for path in (volume, vectors))
    known = (name for name in one.keys() & other.keys() if name != "images" or None not in (one[name], other[name]))
    return all(image_identity.same(one[name], other[name]) for name in known)


def _vector_arrays(vectors: xr.Dataset) -> dict[str, Any]:
    """Return the point data of an image by name, in (z, y, x) order; vectors are tuples of three components."""
    arrays: dict[str, Any] = {
        "velocity": tuple(vectors[name].values for name in "uvw"),
        "displacement": tuple(vectors[f"displacement_{axis}"].values for axis in "xyz"),
    }
    if not left_out.too_few(vectors):
        curl = derived.vorticity(vectors)
        arrays["vorticity"] = tuple(curl[f"vorticity_{axis}"].values for axis in "xyz")
        arrays["q_criterion"] = derived.q_criterion(vectors).values
    for name, variable in vectors.data_vars.items():
        if name not in ("u", "v", "w", "displacement_x", "displacement_y", "displacement_z"):
            arrays[str(name)] = variable.values
    return arrays


# -- NetCDF, text, pivpy -----------------------------------------------------------------------------------------------


def _write_stacked(
    form: Format, files: StackedFiles, target: Path, interval_s: float | None, progress: StepProgress
) -> list[Path]:
    write = stores.write_netcdf if form is Format.NETCDF else stores.write_zarr
    path = target / ("vectors.nc" if form is Format.NETCDF else "vectors.zarr")
    write(files, path, {"versions": versions()}, interval_s, progress)
    return [path]


def _write_tables(
    results: xr.Dataset, tables: dict[int, Path], folder: Path, target: Path, progress: StepProgress
) -> list[Path]:
    written, of_particles = _write_csv(results, target, progress), _write_particle_csv(tables, target)
    columns = {name: {"units": unit} for name, unit in particles.PARTICLE_UNITS.items()}
    described = dict.fromkeys(written, csv_tables.columns_of(results)) | dict.fromkeys(of_particles, columns)
    of_tracks = [target / "tracks.csv"] if Folder(folder).tracks.is_file() else []
    for path in of_tracks:
        rows = track_files.open_tracks(folder).to_dataframe()
        csv_tables.write_columns(rows, path, track_files.TRACK_UNITS)
        described[path] = {name: {"units": unit} for name, unit in track_files.TRACK_UNITS.items()}
    csv_tables.describe(described, target)
    return written + of_particles + of_tracks


def _write_pivpy(
    results: xr.Dataset, depths: np.ndarray, target: Path, interval_s: float | None, progress: StepProgress
) -> list[Path]:
    return pivpy_planes.write_planes(
        results,
        depths,
        target,
        times=_times(results, interval_s),
        known_interval=interval_s is not None,
        files=[f"{_stem(results, number)}.nc" for number in results[_along(results)].values.tolist()],
        progress=progress,
    )


def _write_csv(results: xr.Dataset, target: Path, progress: StepProgress) -> list[Path]:
    written = []
    for pair, vectors in _each_pair(results, progress):
        written.append(target / f"{_stem(results, pair)}.csv")
        csv_tables.write_vectors(vectors, written[-1])
    return written


def _write_tecplot(results: xr.Dataset, target: Path, interval_s: float | None, progress: StepProgress) -> list[Path]:
    times, written = _times_by_number(results, interval_s), []
    for number, vectors in _each_pair(results, progress):
        written.append(target / f"{_stem(results, number)}.dat")
        csv_tables.write_tecplot(vectors, written[-1], times[number])
    return written


def _particles(folder: Path, pairs: tuple[int, int | None] | None, *, required: bool) -> dict[int, Path]:
    """Return the files of linked particles; none where there are none and they are not required."""
    try:
        return particles.particle_files(folder, pairs)
    except InputError:
        if required:
            raise
        return {}


def _write_particle_csv(tables: dict[int, Path], target: Path) -> list[Path]:
    written = []
    for path in tables.values():
        written.append(target / f"particles_{path.stem}.csv")
        rows = particles.read_particles(path).to_dataframe()
        csv_tables.write_columns(rows, written[-1], particles.PARTICLE_UNITS)
    return written


def _write_vtp(tables: dict[int, Path], folder: Path, target: Path, times: dict[int, float]) -> list[Path]:
    files = {}
    for number, path in tables.items():
        written = target / f"particles_{path.stem}.vtp"
        particles.write_vtp(particles.read_particles(path), written)
        files[written] = times.get(number, float(number))
    collection = target / "particles.pvd"
    paraview.write_collection(files, collection)
    if not Folder(folder).tracks.is_file():
        return [collection]
    track_files.write_track_vtp(track_files.open_tracks(folder), target / "tracks.vtp")
    return [collection, target / "tracks.vtp"]

"""`export_results`: write vectors of a run in formats of other programs: ParaView (vti), NetCDF, Zarr, CSV, pivpy.

A file appears under its name only when it is complete. Existing files are replaced as a whole.
"""

from __future__ import annotations

import enum
import logging
import math
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from pyevtk.hl import imageToVTK
from pyevtk.vtk import VtkGroup

from lfpiv.errors import InputError
from lfpiv.experiment.settings import Series
from lfpiv.files import state_origin, writing
from lfpiv.geometry.grid import AXES
from lfpiv.progress import Progress, StepProgress, ignore_progress
from lfpiv.records import read_object
from lfpiv.results import datasets, image_identity, netcdf, particles, provenance, stores
from lfpiv.results import tables as csv_tables
from lfpiv.results.folder import FRAME_NAMES, Folder, make_writable
from lfpiv.results.reader import open_results
from lfpiv.results.stacked_files import INSTANT, PAIR, TIME_ATTRIBUTES, StackedFiles
from lfpiv.velocity import derived
from lfpiv.version import versions

log = logging.getLogger(__name__)

FOLDER = "export"
"""Default folder of exports inside the folder of the run."""

_MM_PER_M = 1000.0


class Format(enum.Enum):
    """Formats of exported vectors. The text describes the files."""

    VTI = "one .vti image per pair or instant and one per stored volume, with .pvd collections: ParaView, pyvista"
    NETCDF = "vectors.nc, one NetCDF4 file of all pairs or instants: xarray, MATLAB"
    ZARR = (
        "vectors.zarr, one Zarr store of all pairs or instants, to which a later export adds what is new: xarray, dask"
    )
    CSV = "one table per pair or instant, a row per vector, and one of its linked particles; units in the header"
    VTP = "one .vtp file of linked particles per pair or instant, with a .pvd collection: ParaView, pyvista"
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
    to : {"vti", "netcdf", "zarr", "csv", "vtp", "pivpy"}
        The format, see `Format` and docs/conventions.md.
    out : str or Path, optional
        Folder to write to. Default: `FOLDER` inside `folder`.
    pairs : tuple, optional
        (A, B): only pairs A to B - 1; B may be None.
    depth_mm : float, optional
        For "pivpy": only the plane of vectors nearest to this z [mm]. Default: all planes.
    interval_s : float, optional
        Time between the first frames of successive pairs [s], which makes times in "vti", "netcdf", "zarr" and "pivpy"
        seconds. Default: the number of the pair is used as time. The times of a time series are known.
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
    try:
        form = Format[to.upper()]
    except (KeyError, AttributeError):
        known = ", ".join(form.name.lower() for form in Format)
        raise InputError(f"to: expected one of {known}, found {to!r}.") from None
    if depth_mm is not None and form is not Format.PIVPY:
        raise InputError(f"depth: expected with pivpy only, whose files are planes, found it with {to}. Leave it out.")
    if interval_s is not None and not (math.isfinite(interval_s) and interval_s > 0):
        raise InputError(f"interval: expected a time above 0 s between pairs, found {interval_s!r}.")
    tables = _particles(Path(folder), pairs, required=form is Format.VTP)
    files = StackedFiles(Path(folder), pairs)
    if interval_s is not None and files.dimension == INSTANT:
        raise InputError("interval: expected for image pairs only; the times of a time series are known. Leave it out.")
    results = open_results(folder, pairs=pairs)
    planes = results["z"].values if depth_mm is None else _nearest(results["z"], depth_mm)
    target = Path(folder) / FOLDER if out is None else Path(out)
    made = make_writable(target)

    def step(fraction: float) -> None:
        (progress or ignore_progress)("export", fraction)

    try:
        with writing(target):
            if form is Format.VTI:
                return _write_vti(results, _folder(Path(folder), files), target, interval_s, step)
            if form in (Format.NETCDF, Format.ZARR):
                write = stores.write_netcdf if form is Format.NETCDF else stores.write_zarr
                path = target / ("vectors.nc" if form is Format.NETCDF else "vectors.zarr")
                write(files, path, {"versions": versions()}, interval_s, step)
                return [path]
            if form is Format.CSV:
                written, of_particles = _write_csv(results, target, step), _write_particle_csv(tables, target)
                columns = {name: {"units": unit} for name, unit in particles.PARTICLE_UNITS.items()}
                described = dict.fromkeys(written, csv_tables.columns_of(results))
                csv_tables.describe(described | dict.fromkeys(of_particles, columns), target)
                return written + of_particles
            if form is Format.VTP:
                times = dict(
                    zip(results[files.dimension].values.tolist(), _times(results, interval_s).tolist(), strict=True)
                )
                return _write_vtp(tables, target, times)
            return _write_pivpy(results, planes, target, interval_s, step)
    finally:
        for path in made:
            if path.is_dir() and not any(path.iterdir()):
                path.rmdir()


def _folder(path: Path, files: StackedFiles) -> Folder:
    """Return the folder of the run with the names of its results."""
    if files.dimension == PAIR:
        return Folder(path)
    first, step = int(files.numbers[0]), int(files.first.attrs.get("step", 1))
    return Folder(path, Series(instants=len(files) + step, first=first, step=step))


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
    results: xr.Dataset, folder: Folder, target: Path, interval_s: float | None, progress: StepProgress
) -> list[Path]:
    times = dict(zip(results[_along(results)].values.tolist(), _times(results, interval_s).tolist(), strict=True))
    collections: dict[str, dict[Path, float]] = {}
    mismatched: list[Path] = []
    for pair, vectors in _each_pair(results, progress):
        path = target / f"{_stem(results, pair)}.vti"
        _write_image(_vector_arrays(vectors), vectors, path)
        collections.setdefault("vectors", {})[path] = times[pair]
        for frame, name in enumerate(FRAME_NAMES if folder.series is None else FRAME_NAMES[:1]):
            stored = folder.volume(pair, frame)
            if not stored.is_file():
                continue
            if not _same_origin(stored, folder.vectors(pair)):
                mismatched.append(stored)
                continue
            volume = netcdf.read_volume(stored)
            path = target / f"volume_{pair:04d}_{name}.vti"
            if folder.series is not None:
                path = target / f"volume_{pair:06d}.vti"
            _write_image({"intensity": volume.values}, volume, path)
            kind = f"volumes_{name}" if folder.series is None else "volumes"
            collections.setdefault(kind, {})[path] = times[pair]
    if mismatched:
        log.warning(
            "%s%s: not exported, made with other settings or images than the vectors. Run `lfpiv run` with "
            "--keep-volumes for volumes that fit",
            mismatched[0],
            f" and {len(mismatched) - 1} other volumes" if len(mismatched) > 1 else "",
        )
    written = []
    for name, files in collections.items():
        path = target / f"{name}.pvd"
        _write_collection(files, path)
        written.append(path)
    return written


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
    if min(vectors.sizes[axis] for axis in AXES) >= 3:
        curl = derived.vorticity(vectors)
        arrays["vorticity"] = tuple(curl[f"vorticity_{axis}"].values for axis in "xyz")
        arrays["q_criterion"] = derived.q_criterion(vectors).values
    for name, variable in vectors.data_vars.items():
        if name not in ("u", "v", "w", "displacement_x", "displacement_y", "displacement_z"):
            arrays[str(name)] = variable.values
    return arrays


def _write_image(arrays: dict[str, Any], places: xr.Dataset | xr.DataArray, path: Path) -> None:
    """Write point data on an even grid [mm] as VTK image data."""
    axes = [np.asarray(places[axis], float) for axis in "xyz"]
    steps = [(axis[-1] - axis[0]) / (len(axis) - 1) if len(axis) > 1 else math.nan for axis in axes]
    single = next((step for step in steps if math.isfinite(step)), 1.0)  # thickness of a single layer
    spacing = tuple(float(step if math.isfinite(step) else single) for step in steps)

    def ordered(values: np.ndarray) -> np.ndarray:
        kind = np.uint8 if values.dtype == bool else np.float32
        return np.ascontiguousarray(values, kind).transpose(2, 1, 0)  # VTK order (x, y, z), x fastest

    points = {
        name: tuple(map(ordered, item)) if isinstance(item, tuple) else ordered(item) for name, item in arrays.items()
    }
    with tempfile.TemporaryDirectory(prefix=".export-", dir=path.parent) as scratch:
        origin = tuple(float(axis[0]) for axis in axes)
        written = imageToVTK(str(Path(scratch) / "image"), origin=origin, spacing=spacing, pointData=points)
        state_origin(Path(written))
        os.replace(written, path)


def _write_collection(files: dict[Path, float], path: Path) -> None:
    """Write a ParaView collection of files, with relative paths, and their times."""
    with tempfile.TemporaryDirectory(prefix=".export-", dir=path.parent) as scratch:
        group = VtkGroup(str(Path(scratch) / "collection"))
        for file, time in files.items():
            group.addFile(str(Path(scratch) / file.name), sim_time=time)
        group.save()
        state_origin(Path(scratch) / "collection.pvd")
        os.replace(Path(scratch) / "collection.pvd", path)


# -- NetCDF, text, pivpy -----------------------------------------------------------------------------------------------


def _write_csv(results: xr.Dataset, target: Path, progress: StepProgress) -> list[Path]:
    written = []
    for pair, vectors in _each_pair(results, progress):
        written.append(target / f"{_stem(results, pair)}.csv")
        csv_tables.write_vectors(vectors, written[-1])
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
        particles.write_csv(particles.read_particles(path), written[-1], csv_tables.DIGITS)
    return written


def _write_vtp(tables: dict[int, Path], target: Path, times: dict[int, float]) -> list[Path]:
    files = {}
    for number, path in tables.items():
        written = target / f"particles_{path.stem}.vtp"
        particles.write_vtp(particles.read_particles(path), written)
        files[written] = times.get(number, float(number))
    collection = target / "particles.pvd"
    _write_collection(files, collection)
    return [collection]


def _write_pivpy(
    results: xr.Dataset, depths: np.ndarray, target: Path, interval_s: float | None, progress: StepProgress
) -> list[Path]:
    written = []
    for number, depth in enumerate(depths):
        progress(number / len(depths))
        path = target / f"plane_z{depth:+.3f}mm.nc"
        datasets.write_dataset(_plane(results.sel(z=depth), interval_s), path)
        written.append(path)
    progress(1.0)
    return written


def _plane(results: xr.Dataset, interval_s: float | None) -> xr.Dataset:
    """Return one plane of vectors in pivpy's form: dims y, x, t, velocities in mm/s because lengths are in mm."""
    dims, along = ("y", "x", "t"), _along(results)
    names = {"u": "u", "v": "v", "w": "velocity_z"}  # pivpy keeps derived scalars in w
    variables: dict[str, Any] = {}
    for name, variable in names.items():
        values = results[name].transpose("y", "x", along).values.astype(float) * _MM_PER_M
        standard = {"standard_name": f"{name}_velocity"} if name == variable else {}
        text = f"velocity along {derived.COMPONENTS[name]}"
        variables[variable] = (dims, values, {"units": "mm/s", "long_name": text, **standard})
    flags = results["valid"].transpose("y", "x", along).values.astype(float)
    if "masked" in results:
        flags[results["masked"].transpose("y", "x", along).values] = -1
    text = "1: measured, 0: replaced, -1: masked"
    variables["chc"] = (dims, flags, {"standard_name": "validity_flag", "long_name": text})
    time = {"units": "frame", "long_name": "number of the pair"}
    if interval_s is not None:
        time = {"units": "s", "long_name": stores.PAIR_TIME_ATTRIBUTES["long_name"]}
    elif along == INSTANT:
        time = {"units": "s", "long_name": TIME_ATTRIBUTES["long_name"]}
    coordinates = {
        "x": ("x", results["x"].values, {"units": "mm"}),
        "y": ("y", results["y"].values, {"units": "mm"}),
        "t": ("t", _times(results, interval_s).astype(float), time),
        "z": ((), float(results["z"]), {"units": "mm", "long_name": "depth of the plane"}),
    }
    attributes = {
        "delta_t": float(results.attrs["dt_s"]),
        "files": [f"{_stem(results, number)}.nc" for number in results[along].values.tolist()],
        "pivpy_schema_version": "1",
    }
    return xr.Dataset(variables, coordinates, attributes)

"""`export_results`: vectors of a run in the forms other programs read. ParaView (vti), one NetCDF, CSV, pivpy.

Every file appears under its name only when it is complete; one that is there already is replaced as a whole.
"""

from __future__ import annotations

import enum
import json
import logging
import math
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from pyevtk.hl import imageToVTK
from pyevtk.vtk import VtkGroup

from lfpiv.errors import InputError
from lfpiv.files import replacing, writing
from lfpiv.geometry.grid import AXES
from lfpiv.results import netcdf
from lfpiv.results.folder import FRAME_NAMES, Folder, make_writable
from lfpiv.results.reader import open_results
from lfpiv.velocity import derived
from lfpiv.version import versions

log = logging.getLogger(__name__)

Progress = Callable[[str, float], None]
"""Called as ``progress(step, fraction)``, fraction from 0 to 1."""

FOLDER = "export"
"""Folder inside that of the run where exports go unless another one is named."""

CSV_DIGITS = 9
"""Significant digits in text: as many as single precision can hold."""

_MM_PER_M = 1000.0


class Format(enum.Enum):
    """What vectors can be exported to; the text says what is written."""

    VTI = "one .vti image per pair and one per kept volume, with .pvd collections over the pairs: ParaView, pyvista"
    NETCDF = "vectors.nc, one NetCDF4 file over all pairs: xarray, MATLAB"
    CSV = "one table per pair, a row per vector, units in the header"
    PIVPY = "one NetCDF file per depth, planes of u and v over all pairs: pivpy"


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
    """Write the vectors of a run in a form that other programs read.

    Parameters
    ----------
    folder : str or Path
        Folder of the run.
    to : {"vti", "netcdf", "csv", "pivpy"}
        The form, see `Format` and docs/conventions.md.
    out : str or Path, optional
        Folder to write to. Default: `FOLDER` inside `folder`.
    pairs : tuple, optional
        (A, B): pairs A to B - 1 only; B may be None.
    depth_mm : float, optional
        For "pivpy": only the plane of vectors nearest to this z [mm]. Default: all planes.
    interval_s : float, optional
        Time between the first frames of successive pairs [s]: times in "vti", "netcdf" and "pivpy" are seconds then.
        Default: the number of the pair stands for the time.
    progress : callable, optional
        Called as ``progress("export", fraction)``.

    Returns
    -------
    list of Path
        The files to open: the collections for "vti", else all that were written.

    Raises
    ------
    InputError
        If an argument is out of range, the folder holds no vectors that belong together, or `out` is no folder that can
        be written.
    StorageError
        If the disk is full, or writing fails otherwise. What is finished is whole.

    Examples
    --------
    Here the files are written first, which `lfpiv run` does otherwise:

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
    results = open_results(folder, pairs=pairs)
    chosen = results["z"].values if depth_mm is None else _nearest(results["z"], depth_mm)
    target = Path(folder) / FOLDER if out is None else Path(out)
    made = make_writable(target)
    tick = _ticker(progress)
    try:
        with writing(target):
            if form is Format.VTI:
                return _write_vti(results, Folder(Path(folder)), target, interval_s, tick)
            if form is Format.NETCDF:
                return _write_netcdf(results, target, interval_s, tick)
            if form is Format.CSV:
                return _write_csv(results, target, tick)
            return _write_pivpy(results, chosen, target, interval_s, tick)
    finally:
        for path in made:
            if path.is_dir() and not any(path.iterdir()):
                path.rmdir()


def _ticker(progress: Progress | None) -> Callable[[int, int], None]:
    return (lambda done, total: None) if progress is None else (lambda done, total: progress("export", done / total))


def _nearest(depths: xr.DataArray, depth_mm: float) -> np.ndarray:
    """Depth of the plane of vectors nearest to a depth, which must lie within half a spacing of them."""
    planes = depths.values
    half = abs(planes[-1] - planes[0]) / max(len(planes) - 1, 1) / 2 if len(planes) > 1 else math.inf
    nearest = planes[np.abs(planes - depth_mm).argmin()] if math.isfinite(depth_mm) else math.nan
    if not abs(nearest - depth_mm) <= half * (1 + 1e-9):
        raise InputError(
            f"depth: expected a z among the vectors, {planes.min():g} to {planes.max():g} mm, found {depth_mm:g} mm."
        )
    return np.array([nearest])


def _times(results: xr.Dataset, interval_s: float | None) -> np.ndarray:
    """Time of each pair: [s] where the interval is known, else its number."""
    return results["pair"].values * (1.0 if interval_s is None else interval_s)


def _each_pair(results: xr.Dataset, tick: Callable[[int, int], None]) -> Iterator[tuple[int, xr.Dataset]]:
    """Load one pair after the other."""
    total = results.sizes["pair"]
    for done in range(total):
        tick(done, total)
        yield int(results["pair"][done]), results.isel(pair=done, drop=True).load()
    tick(total, total)


# -- ParaView ----------------------------------------------------------------------------------------------------------


def _write_vti(
    results: xr.Dataset, folder: Folder, target: Path, interval_s: float | None, tick: Callable[[int, int], None]
) -> list[Path]:
    times = dict(zip(results["pair"].values.tolist(), _times(results, interval_s).tolist(), strict=True))
    collections: dict[str, dict[Path, float]] = {}
    strange: list[Path] = []
    for pair, vectors in _each_pair(results, tick):
        path = target / f"pair_{pair:04d}.vti"
        _write_image(_vector_arrays(vectors), vectors, path)
        collections.setdefault("vectors", {})[path] = times[pair]
        for frame, name in enumerate(FRAME_NAMES):
            stored = folder.volume(pair, frame)
            if not stored.is_file():
                continue
            if not _belongs(stored, folder.vectors(pair)):
                strange.append(stored)
                continue
            volume = netcdf.read_volume(stored)
            path = target / f"volume_{pair:04d}_{name}.vti"
            _write_image({"intensity": volume.values}, volume, path)
            collections.setdefault(f"volumes_{name}", {})[path] = times[pair]
    if strange:
        log.warning(
            "%s%s: not exported, made with other settings or images than the vectors. Run `lfpiv run` with "
            "--keep-volumes for volumes that fit",
            strange[0],
            f" and {len(strange) - 1} other volumes" if len(strange) > 1 else "",
        )
    written = []
    for name, files in collections.items():
        path = target / f"{name}.pvd"
        _write_collection(files, path)
        written.append(path)
    return written


def _belongs(volume: Path, vectors: Path) -> bool:
    """Whether a volume was made as the vectors were: of what both depend on nothing differs; raw images may be gone."""
    one, other = (json.loads(netcdf.read_attributes(path).get("depends_on", "{}")) for path in (volume, vectors))
    known = (name for name in one.keys() & other.keys() if name != "images" or None not in (one[name], other[name]))
    return all(one[name] == other[name] for name in known)


def _vector_arrays(vectors: xr.Dataset) -> dict[str, Any]:
    """Arrays of an image by their name: vectors as tuples of components, scalars as they are; order (z, y, x)."""
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
    single = next((step for step in steps if math.isfinite(step)), 1.0)  # a lone layer is as thick as others are apart
    spacing = tuple(float(step if math.isfinite(step) else single) for step in steps)

    def ordered(values: np.ndarray) -> np.ndarray:
        kind = np.uint8 if values.dtype == bool else np.float32
        return np.ascontiguousarray(values, kind).transpose(2, 1, 0)  # VTK wants (x, y, z), x fastest

    points = {
        name: tuple(map(ordered, item)) if isinstance(item, tuple) else ordered(item) for name, item in arrays.items()
    }
    with tempfile.TemporaryDirectory(prefix=".export-", dir=path.parent) as scratch:
        origin = tuple(float(axis[0]) for axis in axes)
        written = imageToVTK(str(Path(scratch) / "image"), origin=origin, spacing=spacing, pointData=points)
        os.replace(written, path)


def _write_collection(files: dict[Path, float], path: Path) -> None:
    """Write a ParaView collection: files and their times, named relative to it."""
    with tempfile.TemporaryDirectory(prefix=".export-", dir=path.parent) as scratch:
        group = VtkGroup(str(Path(scratch) / "collection"))
        for file, time in files.items():
            group.addFile(str(Path(scratch) / file.name), sim_time=time)
        group.save()
        os.replace(Path(scratch) / "collection.pvd", path)


# -- NetCDF, text, pivpy -----------------------------------------------------------------------------------------------


def _write_netcdf(
    results: xr.Dataset, target: Path, interval_s: float | None, tick: Callable[[int, int], None]
) -> list[Path]:
    path = target / "vectors.nc"
    if interval_s is not None:
        attributes = {
            "units": "s",
            "standard_name": "time",
            "long_name": "first frame of the pair after that of pair 0",
        }
        results = results.assign_coords(time=("pair", _times(results, interval_s), attributes))
    tick(0, 1)
    netcdf.write_dataset(results, path, attributes={"versions": versions()})
    tick(1, 1)
    return [path]


def _write_csv(results: xr.Dataset, target: Path, tick: Callable[[int, int], None]) -> list[Path]:
    written = []
    for pair, vectors in _each_pair(results, tick):
        units = {name: vectors[name].attrs.get("units", "1") for name in vectors.variables}
        names = ["x", "y", "z", *vectors.data_vars]
        titles = [str(name) if units[name] == "1" else f"{name} [{units[name]}]" for name in names]
        table = vectors.assign(valid=vectors["valid"].astype(np.uint8)).to_dataframe(dim_order=list(AXES))
        path = target / f"pair_{pair:04d}.csv"
        with replacing(path) as scratch:
            table.reset_index().to_csv(
                scratch, columns=names, header=titles, index=False, float_format=f"%.{CSV_DIGITS}g", encoding="utf-8"
            )
        written.append(path)
    return written


def _write_pivpy(
    results: xr.Dataset,
    depths: Sequence[float] | np.ndarray,
    target: Path,
    interval_s: float | None,
    tick: Callable[[int, int], None],
) -> list[Path]:
    written = []
    for number, depth in enumerate(depths):
        tick(number, len(depths))
        path = target / f"plane_z{depth:+.3f}mm.nc"
        netcdf.write_dataset(_plane(results.sel(z=depth), interval_s), path)
        written.append(path)
    tick(1, 1)
    return written


def _plane(results: xr.Dataset, interval_s: float | None) -> xr.Dataset:
    """Put one plane of vectors into pivpy's form: dims y, x, t; u, v [mm/s], so that derivatives over mm are right."""
    dims = ("y", "x", "t")
    names = {"u": "u", "v": "v", "w": "velocity_z"}  # pivpy keeps derived scalars in w
    variables: dict[str, Any] = {}
    for name, variable in names.items():
        values = results[name].transpose("y", "x", "pair").values.astype(float) * _MM_PER_M
        standard = {"standard_name": f"{name}_velocity"} if name == variable else {}
        text = f"velocity along {derived.COMPONENTS[name]}"
        variables[variable] = (dims, values, {"units": "mm/s", "long_name": text, **standard})
    flags = results["valid"].transpose("y", "x", "pair").values.astype(float)
    variables["chc"] = (dims, flags, {"standard_name": "validity_flag", "long_name": "1: measured, 0: replaced"})
    time = {"units": "frame" if interval_s is None else "s", "long_name": "number of the pair"}
    if interval_s is not None:
        time["long_name"] = "first frame of the pair after that of pair 0"
    coordinates = {
        "x": ("x", results["x"].values, {"units": "mm"}),
        "y": ("y", results["y"].values, {"units": "mm"}),
        "t": ("t", _times(results, interval_s).astype(float), time),
        "z": ((), float(results["z"]), {"units": "mm", "long_name": "depth of the plane"}),
    }
    attributes = {
        "delta_t": float(results.attrs["dt_s"]),
        "files": [f"pair_{number:04d}.nc" for number in results["pair"].values],
        "pivpy_schema_version": "1",
    }
    return xr.Dataset(variables, coordinates, attributes)

"""Write files of ParaView: images of point data on an even grid, points and lines, and collections of files."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import xarray as xr
from pyevtk.hl import imageToVTK
from pyevtk.vtk import VtkGroup

from lfpiv.files import replacing, scratch_folder, state_origin


def write_image(arrays: dict[str, Any], places: xr.Dataset | xr.DataArray, path: Path) -> None:
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
    with scratch_folder(path) as scratch:
        origin = tuple(float(axis[0]) for axis in axes)
        written = imageToVTK(str(scratch / "image"), origin=origin, spacing=spacing, pointData=points)
        state_origin(Path(written))
        os.replace(written, path)


def write_poly_data(
    table: xr.Dataset,
    path: Path,
    vectors: Mapping[str, Iterable[str]],
    scalars: Iterable[str],
    cells: str,
    ends: np.ndarray,
) -> None:
    """Write a table of points (x, y, z) as VTK poly data, as text.

    Parameters
    ----------
    table : Dataset
        Points, one after the other.
    vectors : mapping
        Name of a vector -> names of its components in the table.
    scalars : iterable of str
        Further names.
    cells : {"Verts", "Lines"}
        What successive points make.
    ends : ndarray of int
        End of each cell among the points.
    """
    sizes = dict.fromkeys(("Points", "Verts", "Lines", "Strips", "Polys"), 0)
    sizes |= {"Points": table["x"].size, cells: len(ends)}
    root = ElementTree.Element("VTKFile", type="PolyData", version="0.1", byte_order="LittleEndian")
    whole = ElementTree.SubElement(root, "PolyData")
    piece = ElementTree.SubElement(whole, "Piece", {f"NumberOf{name}": str(size) for name, size in sizes.items()})
    data = ElementTree.SubElement(piece, "PointData", Vectors=next(iter(vectors)))
    for name, parts in vectors.items():
        _add_array(data, name, np.stack([table[part].values for part in parts], axis=1))
    for name in scalars:
        _add_array(data, name, table[name].values)
    points = ElementTree.SubElement(piece, "Points")
    _add_array(points, "position", np.stack([table[axis].values for axis in "xyz"], axis=1))
    made = ElementTree.SubElement(piece, cells)
    _add_array(made, "connectivity", np.arange(table["x"].size))
    _add_array(made, "offsets", ends)
    with replacing(path) as scratch:
        ElementTree.ElementTree(root).write(scratch, encoding="utf-8", xml_declaration=True)
        state_origin(scratch)


def _add_array(parent: ElementTree.Element, name: str, values: np.ndarray) -> None:
    """Add an array to an element, as text."""
    whole = values.dtype.kind in "iub"
    about = {"type": "Int64" if whole else "Float64", "Name": name, "format": "ascii"}
    if values.ndim == 2:
        about["NumberOfComponents"] = str(values.shape[1])
    text: Sequence[str] = [str(int(v)) if whole else f"{v:.9g}" for v in values.ravel()]
    ElementTree.SubElement(parent, "DataArray", about).text = " ".join(text)


def write_collection(files: dict[Path, float], path: Path) -> None:
    """Write a ParaView collection of files, with relative paths, and their times."""
    with scratch_folder(path) as scratch:
        group = VtkGroup(str(scratch / "collection"))
        for file, time in files.items():
            group.addFile(str(scratch / file.name), sim_time=time)
        group.save()
        state_origin(scratch / "collection.pvd")
        os.replace(scratch / "collection.pvd", path)

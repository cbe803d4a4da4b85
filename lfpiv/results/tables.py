"""Tables of vectors as CSV and for Tecplot, and the description of all CSV tables in a folder.

A table has a header and nothing before it, so that every program reads it. What the columns are, and when and by which
program tables were written, is in ``csv-metadata.json`` beside them, in the form of the W3C's "CSV on the Web" [1]_.

.. [1] https://www.w3.org/TR/tabular-metadata/
.. [2] Tecplot, Inc., "Tecplot 360 Data Format Guide", chapter 4, ASCII data
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from lfpiv.files import replacing, write_json
from lfpiv.geometry.grid import AXES
from lfpiv.version import SOURCE, history

if TYPE_CHECKING:
    import pandas as pd

DESCRIPTION = "csv-metadata.json"
"""Name of the description, which readers of "CSV on the Web" look for beside a table."""

DIGITS = 9
"""Significant digits in text, enough for single precision."""


def write_vectors(vectors: xr.Dataset, path: Path) -> None:
    """Write vectors (z, y, x) as text, a row per vector, as of `write_columns`."""
    rows = vectors.to_dataframe(dim_order=list(AXES)).reset_index()
    write_columns(rows, path, {name: about["units"] for name, about in columns_of(vectors).items()})


def write_tecplot(vectors: xr.Dataset, path: Path, time: float) -> None:
    """Write vectors (z, y, x) as an ordered zone of Tecplot's text [2]_, atomically; 0 stands for NaN.

    Readers know coordinates by their plain names, so the title has their unit.
    """
    rows, columns = vectors.to_dataframe(dim_order=list(AXES)).reset_index(), columns_of(vectors)
    units = {name: "1" if name in AXES else about["units"] for name, about in columns.items()}
    titles = " ".join(f'"{title(name, unit)}"' for name, unit in units.items())
    size = ", ".join(f"{letter}={vectors.sizes[axis]}" for letter, axis in zip("IJK", "xyz", strict=True))
    zone = f'ZONE T="{path.stem}", {size}, DATAPACKING=POINT, STRANDID=1, SOLUTIONTIME={time:.{DIGITS}g}'
    rows = rows[list(columns)].fillna(0).astype({name: np.uint8 for name in columns if rows[name].dtype == bool})
    with replacing(path) as scratch:
        text = rows.to_csv(sep=" ", index=False, header=False, float_format=f"%.{DIGITS}g")
        scratch.write_text(
            f'TITLE="{path.stem}, x, y, z in {columns["x"]["units"]}"\nVARIABLES={titles}\n{zone}\n{text}', "utf-8"
        )


def write_columns(rows: pd.DataFrame, path: Path, units: Mapping[str, str]) -> None:
    """Write the columns of a table that have units as text, units in the header, atomically."""
    rows = rows.astype({name: np.uint8 for name in units if rows[name].dtype == bool})
    titles = [title(name, unit) for name, unit in units.items()]
    with replacing(path) as scratch:
        rows.to_csv(
            scratch, columns=list(units), header=titles, index=False, float_format=f"%.{DIGITS}g", encoding="utf-8"
        )


def columns_of(vectors: xr.Dataset) -> dict[str, dict[str, str]]:
    """Return the name of each column of a table of vectors with its unit and, where it is known, its meaning."""
    columns = {}
    for name in ("x", "y", "z", *map(str, vectors.data_vars)):
        stated = vectors[name].attrs
        columns[name] = {"units": "1"} | {key: stated[key] for key in ("units", "long_name") if key in stated}
    return columns


def title(name: str, unit: str) -> str:
    """Return the title of a column."""
    return name if unit == "1" else f"{name} [{unit}]"


def describe(tables: Mapping[Path, Mapping[str, Mapping[str, str]]], folder: Path, **attributes: Any) -> None:
    """Write what the columns of the tables in a folder are, with program and time, atomically.

    Parameters
    ----------
    tables : mapping
        Path of a table -> its columns, as of `columns_of`.
    folder : Path
        Folder of the tables.
    **attributes
        What is said of all tables.
    """
    described = [
        {"url": path.name, "tableSchema": {"columns": [_column(name, about) for name, about in columns.items()]}}
        for path, columns in tables.items()
    ]
    content = {"@context": "http://www.w3.org/ns/csvw", "dc:source": SOURCE, "dc:provenance": history(), **attributes}
    write_json({**content, "tables": described}, folder / DESCRIPTION)


def _column(name: str, about: Mapping[str, str]) -> dict[str, str]:
    unit = about["units"]
    column = {"name": name, "titles": title(name, unit), "schema:unitText": unit}
    return column | ({"dc:description": about["long_name"]} if "long_name" in about else {})

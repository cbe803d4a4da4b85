"""Put vector fields into the page: a sample of the pairs, their mean and their fluctuation.

At most `MOST_READ` files are read and `MOST_VECTORS` vectors stored, for any number of pairs. Values are quantised to
two bytes, gzipped and written in base64; ``static/fields.js`` unpacks them.
"""

from __future__ import annotations

import base64
import dataclasses
import gzip
import json
import logging
import math
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import xarray as xr

from lfpiv import hdf5
from lfpiv.experiment.recording import Recording
from lfpiv.geometry.grid import AXES
from lfpiv.report import flow
from lfpiv.results import netcdf

log = logging.getLogger(__name__)

MOST_READ = 500
"""Largest number of files read for mean and fluctuation."""
MOST_SHOWN = 6
"""Largest number of pairs that can be selected on the page."""
MOST_VECTORS = 180_000
"""Largest number of vectors of all fields together."""
MOST_IN_FIELD = 40_000
"""Largest number of vectors of one field. Larger fields are thinned out along x and y."""

NO_NUMBER = -32768
"""Stored integer that means not-a-number."""
STEPS = 32767
"""Quantisation steps from zero to the largest magnitude."""

COLOUR_STOPS = 33
"""Number of colours that define a colour map in the page, which interpolates between them."""


@dataclass(frozen=True, kw_only=True)
class Survey:
    """Fields of a sample of the finished pairs."""

    shown: dict[int, xr.Dataset]
    """Pair -> vectors of the pairs that can be selected."""
    mean: xr.Dataset | None
    """Mean ``u``, ``v``, ``w`` [m/s] over the valid vectors, ``valid`` where there is one; None for a single pair."""
    fluctuation: xr.Dataset | None
    """Standard deviations over the pairs [m/s], ``valid`` where there are two or more; None for a single pair."""
    read: int
    """Number of pairs in mean and fluctuation."""


def survey(vectors: Mapping[int, Path], recording: Recording) -> Survey:
    """Read an evenly spaced sample of the pairs; average one file after the other.

    Parameters
    ----------
    vectors : dict
        Pair -> file of its vectors; at least one.
    recording : Recording
        What was recorded; it names results.

    Raises
    ------
    InputError
        If a file that is read cannot be read or holds no vectors.
    """
    chosen = evenly(array("q", vectors), MOST_READ)
    first = netcdf.read_vectors(vectors[chosen[0]])
    most = max(min(MOST_VECTORS // min(first["u"].size, MOST_IN_FIELD) - 2, MOST_SHOWN), 1)
    shown = {pair: netcdf.read_vectors(vectors[pair]) for pair in evenly(chosen, most)}
    total = np.zeros((3, *first["u"].shape))
    square, count, read = np.zeros_like(total), np.zeros(first["u"].shape, int), 0
    for pair in chosen:
        velocity, valid, axes = _read_velocity(vectors[pair])
        if any(not np.array_equal(axis, first[name]) for name, axis in axes.items()):
            names = recording.name_of(pair), recording.name_of(chosen[0])
            log.warning("%s: its vectors lie elsewhere than those of %s; it is not in the mean", *names)
            continue
        good = valid & np.isfinite(velocity).all(0)
        velocity = np.where(good, velocity, 0.0)
        total, square, count, read = total + velocity, square + velocity**2, count + good, read + 1
    if read < 2:
        return Survey(shown=shown, mean=None, fluctuation=None, read=read)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.where(count > 0, total / count, np.nan)
        spread = np.where(count > 1, np.sqrt(np.maximum(square - count * mean**2, 0) / (count - 1)), np.nan)
    build = {"mean": (mean, count > 0), "fluctuation": (spread, count > 1)}
    fields = {name: _like(first, values, valid) for name, (values, valid) in build.items()}
    return Survey(shown=shown, read=read, **fields)


def _read_velocity(path: Path) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Read velocity (component, z, y, x) [m/s], validity and axes [mm] directly from HDF5, faster than as a dataset."""
    with hdf5.opened(path) as file:
        velocity = np.stack([file[name][()] for name in "uvw"]).astype(float)
        return velocity, file["valid"][()].astype(bool), {axis: file[axis][()] for axis in "zyx"}


def evenly(items: Sequence[int], most: int) -> list[int]:
    """Return at most `most` evenly spread items, including the first and the last."""
    if len(items) <= most:
        return list(items)
    return [items[place] for place in np.unique(np.linspace(0, len(items) - 1, most).round().astype(int))]


def _like(first: xr.Dataset, velocity: np.ndarray, valid: np.ndarray) -> xr.Dataset:
    """Build a dataset of a velocity field on the axes of another."""
    variables = {name: (AXES, part, {"units": "m/s"}) for name, part in zip("uvw", velocity, strict=True)}
    coordinates = {axis: first[axis].variable for axis in "zyx"}
    masked = {"masked": first["masked"].variable} if "masked" in first else {}
    return xr.Dataset({**variables, "valid": (AXES, valid), **masked}, coordinates)


def embed(found: Survey, view: flow.View, recording: Recording) -> tuple[str, int]:
    """Encode the fields of a survey for the scripts.

    All fields share one block of little-endian 16-bit integers, which is gzipped and written in base64. A JSON text
    gives the offset and scale of each quantity.

    Parameters
    ----------
    found : Survey
        From `survey`.
    view : flow.View
        What the first field is shown by at the start.
    recording : Recording
        What was recorded; it names results.

    Returns
    -------
    html : str
        Two script elements, the JSON text and the block.
    thinning : int
        Largest step along x and y at which vectors are in the page.
    """
    fields = [(recording.name_of(pair), vectors, "velocity") for pair, vectors in found.shown.items()]
    first = fields[0][1]
    kinds = flow.describe(first)
    if found.mean is not None and found.fluctuation is not None:
        count = f"{found.read:,} {recording.noun}s"
        fields += [(f"mean of {count}", found.mean, "velocity")]
        fields += [(f"fluctuation (standard deviation), {count}", found.fluctuation, "fluctuation")]
    block, described, thinning = bytearray(), [], 1
    for label, vectors, kind in fields:
        step = max(math.ceil(math.sqrt(vectors["u"].size / MOST_IN_FIELD)), 1)
        thinning = max(thinning, step)
        described.append({"label": label, "kind": kind, **_encode(vectors, kind, step, block)})
    place = {axis: int(k) // (1 if axis == "z" else thinning) for axis, k in view.place.items()}
    meta = {
        "fields": described,
        "colours": {name: colour_stops(map_) for name, map_ in _COLOUR_MAPS.items()},
        "quantities": {name: dataclasses.asdict(kind) for name, kind in kinds.items()},
        "voxel": flow.voxel_velocity(first) * kinds["speed"].factor,
        "start": dataclasses.asdict(view) | {"place": place},
    }
    text = json.dumps(meta, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    data = base64.b64encode(gzip.compress(bytes(block), 9, mtime=0)).decode()
    return (
        f'<script type="application/json" id="field-list">{text}</script>\n'
        f'<script type="text/plain" id="field-values">{data}</script>',
        thinning,
    )


def _encode(vectors: xr.Dataset, kind: str, step: int, block: bytearray) -> dict[str, Any]:
    """Append a field to the block, every `step`-th vector along x and y; return offsets, scales and axes."""
    cut = {"x": slice(None, None, step), "y": slice(None, None, step)}
    thin = vectors.isel(cut)
    values = flow.stored(vectors) if kind == "velocity" else {name: vectors[name] for name in "uvw"}
    entry: dict[str, Any] = {"values": {}}
    fine = {name: field.isel(cut).values for name, field in values.items()}
    curl = [part for name, part in fine.items() if name.startswith("vorticity_")]
    for name, part in fine.items():
        stored, scale = quantise(part, largest(*curl) if name.startswith("vorticity_") else largest(part))
        entry["values"][name] = {"offset": len(block), "scale": scale}
        block += stored.tobytes()
    entry["valid"] = len(block)
    block += thin["valid"].values.astype("<i2").tobytes()
    if "masked" in thin and thin["masked"].values.any():
        entry["masked"] = len(block)
        block += thin["masked"].values.astype("<i2").tobytes()
    return entry | {axis: [round(float(value), 6) for value in thin[axis].values] for axis in "xyz"}


_COLOUR_MAPS = {"signed": "RdBu_r", "positive": "viridis"}


def largest(*parts: np.ndarray) -> float:
    """Return the largest finite magnitude of arrays; 0 without any."""
    return max(float(np.abs(part[np.isfinite(part)]).max(initial=0.0)) for part in parts)


def quantise(values: np.ndarray, top: float) -> tuple[np.ndarray, float]:
    """Return 16-bit integers for values up to `top` in magnitude, and the scale that converts them back."""
    values = np.asarray(values, float)
    finite = np.isfinite(values)
    scale = top / STEPS if top > 0 else 1.0
    stored = np.full(values.shape, NO_NUMBER, "<i2")
    stored[finite] = np.rint(values[finite] / scale)
    return stored, scale


def colour_stops(name: str) -> list[str]:
    """Return evenly spaced colours of a matplotlib colour map, as #rrggbb."""
    colours = matplotlib.colormaps[name](np.linspace(0, 1, COLOUR_STOPS))
    return [matplotlib.colors.to_hex(colour) for colour in colours]

"""Prepare a vector field to be shown: quantities in people's units, and the slice that shows the flow best."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr

from lfpiv.geometry.grid import AXES
from lfpiv.quantities import Scale, scale_of
from lfpiv.velocity import derived

IN_SLICE = {"z": ("x", "y"), "y": ("x", "z"), "x": ("y", "z")}
"""Axis normal to a slice -> its horizontal and its vertical axis."""
VELOCITIES = ("u", "v", "w", "speed")
"""Quantities in the unit of the velocity."""
SIGNIFICANT = 2.0
"""Least ratio of a slice's rms vorticity to its noise for which it is shown as vorticity."""

_LARGEST = 99.9  # percentile of the magnitude that a unit suits


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """How a quantity is written."""

    label: str
    unit: str
    signed: bool
    factor: float = 1.0
    """Factor from the SI unit to the unit."""

    @property
    def title(self) -> str:
        """Return the label with the unit."""
        return f"{self.label} [{self.unit}]"


@dataclass(frozen=True, kw_only=True)
class View:
    """A slice of a field, a quantity to colour it by, and a line in it."""

    normal: str
    """Axis normal to the slice."""
    place: dict[str, int]
    """Axis -> index of the vector through which the slice and the line go."""
    quantity: str
    along: str
    """Axis of the line."""


def velocity_scale(vectors: xr.Dataset) -> Scale:
    """Return the unit in which the velocities of a field are handy numbers."""
    return _scale(np.sqrt(sum(vectors[name].values.astype(float) ** 2 for name in "uvw")), vectors, "m/s")


def _scale(values: np.ndarray, vectors: xr.Dataset, unit: str) -> Scale:
    """Return the unit in which the values of the valid vectors are handy numbers."""
    known = np.abs(values[vectors["valid"].values & np.isfinite(values)])
    return scale_of(float(np.percentile(known, _LARGEST)) if known.size else 0.0, unit)


def describe(vectors: xr.Dataset) -> dict[str, Quantity]:
    """Return how each quantity of a field is written."""
    scale, values = velocity_scale(vectors), stored(vectors)
    found = {
        name: Quantity(label=name, unit=scale.unit, signed=name != "speed", factor=scale.factor) for name in VELOCITIES
    }
    if "q" in values:
        found["vorticity"] = Quantity(label="vorticity", unit="1/s", signed=False)
        for axis in "xyz":
            found[f"vorticity_{axis}"] = Quantity(label=f"vorticity {axis}", unit="1/s", signed=True)
        scale = _scale(values["q"].transpose(*AXES).values, vectors, "1/s²")
        found["q"] = Quantity(label="Q", unit=scale.unit, signed=True, factor=scale.factor)
    if "uncertainty" in values:
        found["uncertainty"] = Quantity(label="uncertainty", unit="voxel", signed=False)
    return found


def stored(vectors: xr.Dataset) -> dict[str, xr.DataArray]:
    """Return the quantities of a measured field in SI units, without those that follow from others.

    Vorticity [1/s] and Q [1/s^2] are left out for fields of fewer than three layers.
    """
    values = {name: vectors[name] for name in "uvw"}
    if min(vectors.sizes[axis] for axis in AXES) >= 3:
        curl = derived.vorticity(vectors)
        values |= {name: curl[name] for name in ("vorticity_x", "vorticity_y", "vorticity_z")}
        values["q"] = derived.q_criterion(vectors)
    if "uncertainty" in vectors:
        values["uncertainty"] = vectors["uncertainty"]
    return values


def shown(vectors: xr.Dataset, kinds: dict[str, Quantity]) -> xr.Dataset:
    """Return all quantities of a measured field in their units, with ``valid`` and ``masked``."""
    values = {name: field.transpose(*AXES).values.astype(float) for name, field in stored(vectors).items()}
    values["speed"] = np.sqrt(values["u"] ** 2 + values["v"] ** 2 + values["w"] ** 2)
    if "q" in values:
        x, y, z = (values[f"vorticity_{axis}"] for axis in "xyz")
        values["vorticity"] = np.sqrt(x**2 + y**2 + z**2)
    fields = {name: (AXES, kinds[name].factor * part) for name, part in values.items()}
    return xr.Dataset(
        {**fields, "valid": (AXES, vectors["valid"].values), "masked": (AXES, masked_of(vectors))},
        {axis: vectors[axis].variable for axis in AXES},
    )


def masked_of(vectors: xr.Dataset) -> np.ndarray:
    """Return which vectors are masked, in the shape of ``u``; none without the flag."""
    if "masked" in vectors:
        return np.asarray(vectors["masked"].values, bool)
    return np.zeros(vectors["u"].shape, bool)


def voxel_velocity(vectors: xr.Dataset) -> float:
    """Return the velocity of a displacement of one voxel [m/s]; 0 where the file does not state it."""
    edges, dt_s = np.asarray(vectors.attrs.get("voxel_mm", ())), vectors.attrs.get("dt_s")
    return float(edges.max() * 1e-3 / dt_s) if edges.size and dt_s else 0.0


def best_view(vectors: xr.Dataset) -> View:
    """Choose the slice that holds most vorticity across it, and the line through its strongest vortex.

    Only valid vectors inside the slice count: derivatives at its border are noisier. Where no slice has a vorticity
    that stands out from the noise, the middle of the widest slice is shown, coloured by speed.
    """
    values = stored(vectors)
    best: tuple[float, str, tuple[int, ...]] = (0.0, "", ())
    for normal in IN_SLICE if "vorticity_x" in values else ():
        field = values[f"vorticity_{normal}"].transpose(*AXES)
        inner = {axis: slice(1, -1) for axis in IN_SLICE[normal]}
        counted = np.zeros(field.shape, bool)
        counted[tuple(inner.get(axis, slice(None)) for axis in AXES)] = True
        counted &= vectors["valid"].values & np.isfinite(field.values)
        square = np.where(counted, field.values, 0.0) ** 2
        others = tuple(AXES.index(axis) for axis in IN_SLICE[normal])
        total, count = square.sum(others), counted.sum(others)
        layer = int(total.argmax())
        rms = float(np.sqrt(total[layer] / max(count[layer], 1)))
        if total[layer] > best[0] and rms > SIGNIFICANT * _noise(vectors):
            within = square.take([layer], AXES.index(normal))
            place = [int(k) for k in np.unravel_index(int(within.argmax()), within.shape)]
            place[AXES.index(normal)] = layer
            best = float(total[layer]), normal, tuple(place)
    if best[1]:
        normal, through = best[1], dict(zip(AXES, best[2], strict=True))
        return View(normal=normal, place=through, quantity=f"vorticity_{normal}", along=_longer(vectors, normal))
    normal = max(IN_SLICE, key=lambda axis: np.prod([vectors.sizes[other] for other in IN_SLICE[axis]]))
    middle = {axis: vectors.sizes[axis] // 2 for axis in AXES}
    return View(normal=normal, place=middle, quantity="speed", along=_longer(vectors, normal))


def _longer(vectors: xr.Dataset, normal: str) -> str:
    """Return the axis of a slice with more vectors."""
    return max(IN_SLICE[normal], key=lambda axis: vectors.sizes[axis])


def _noise(vectors: xr.Dataset) -> float:
    """Return the standard deviation of a component of the vorticity by the uncertainty of the vectors [1/s].

    A central difference of independent errors s over the spacing h has 0.7 s/h; a component is of two of them.
    """
    if "uncertainty" not in vectors:
        return 0.0
    known = vectors["uncertainty"].values[vectors["valid"].values]
    known = known[np.isfinite(known)]
    spacing = min(float(np.diff(vectors[axis].values).mean()) for axis in AXES)
    return float(np.median(known)) * voxel_velocity(vectors) / (1e-3 * spacing) if known.size else 0.0

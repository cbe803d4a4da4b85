"""Names and units of quantities in anybody's files: which variable is the velocity along x, and in which unit."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from lfpiv.errors import InputError

POSITION, VELOCITY, DISPLACEMENT = ("x", "y", "z"), ("u", "v", "w"), ("dx", "dy", "dz")
UNCERTAINTY, VALID, NUMBER = ("sx", "sy", "sz"), "valid", "number"
ROLES = (*POSITION, *VELOCITY, *DISPLACEMENT, *UNCERTAINTY, VALID, NUMBER)
"""What a variable may be: position, velocity, displacement, standard deviation of either, flag, number of the pair."""
GROUPS = {"position": POSITION, "velocity": VELOCITY, "displacement": DISPLACEMENT, "uncertainty": UNCERTAINTY}
"""Names for three roles that share a unit."""


def _along(axis: str, u: str) -> dict[str, tuple[str, ...]]:
    """Return the common names of the quantities along one axis; `u` is the velocity's."""
    velocity = "{u} v{x} v_{x} u{x} velocity_{x} {x}_velocity {u}_velocity vel_{x} velocity_{u} vel{x}"
    displacement = "d{x} displacement_{x} {x}_displacement disp_{x} shift_{x} delta_{x} delta{x}"
    spread = [f"{stem}_{name}" for stem in ("uncertainty", "sigma", "std") for name in ("{x}", "{u}", "d{x}", "v{x}")]
    known = {
        axis: "{x} {x}_mm {x}_m pos_{x} position_{x} coord_{x}",
        u: velocity,
        f"d{axis}": displacement,
        f"s{axis}": " ".join([*spread, "{u}_uncertainty {u}_sigma {u}_std"]),
    }
    return {role: tuple(text.format(x=axis, u=u).split()) for role, text in known.items()}


COMMON_NAMES: dict[str, tuple[str, ...]] = {
    **_along("x", "u"),
    **_along("y", "v"),
    **_along("z", "w"),
    VALID: ("valid", "isvalid", "is_valid", "chc"),
    NUMBER: ("pair", "instant", "pair_number", "instant_number", "image_pair"),
}
"""Names that are in use, in small letters."""

LENGTHS_MM = {"mm": 1.0, "m": 1e3, "cm": 10.0, "um": 1e-3, "µm": 1e-3, "μm": 1e-3}
"""Unit of length -> millimetres."""
VOXEL_UNITS = ("voxel", "voxels", "vox", "vx")
_PER_SECOND = re.compile(r"^(.+?)(?:\s*/\s*(?:s|sec|second)|[\s.*·]+s(?:\^|\*\*)?(?:-1|⁻¹))$")
_TITLE = re.compile(r"^(.*?)\s*[\[(]\s*([^\])]*?)\s*[\])]$")


def find_names(variables: Sequence[str], given: Mapping[str, str], source: str) -> dict[str, str]:
    """Return which variable has which role.

    A name that is given counts first, then `COMMON_NAMES`, in small or large letters.

    Parameters
    ----------
    variables : sequence of str
        Names of the variables.
    given : mapping
        Role -> name of a variable.
    source : str
        The file, for messages.

    Raises
    ------
    InputError
        If a given name is unknown, two variables could have one role, or a position or a component is missing.
    """
    found = {}
    for role in ROLES:
        fitting = [given[role]] if role in given else [one for one in variables if one.lower() in COMMON_NAMES[role]]
        if role in given and given[role] not in variables:
            raise InputError(
                f"{source}: expected the variable {given[role]!r} of --name {role}, found {_listed(variables)}."
            )
        if len(fitting) > 1:
            text = f"found {_listed(fitting)}. Choose one by --name {role}=NAME."
            raise InputError(f"{source}: expected one variable for {role}, {text}")
        if fitting:
            found[role] = fitting[0]
    moved = next((roles for roles in (VELOCITY, DISPLACEMENT) if found.keys() >= set(roles)), None)
    moved = moved or (DISPLACEMENT if found.keys() & set(DISPLACEMENT) else VELOCITY)
    for quantity, role in [("position", role) for role in POSITION] + [(group_of(moved[0]), role) for role in moved]:
        if role not in found:
            text = f"found {_listed(variables)}. Name it by --name {role}=NAME."
            raise InputError(f"{source}: expected the {quantity} {role}, {text}")
    return found


def group_of(role: str) -> str:
    """Return the name of the roles that share a unit with a role."""
    return next((group for group, members in GROUPS.items() if role in members), role)


def _listed(names: Iterable[str]) -> str:
    names = list(names)
    return ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")


def split_title(title: str) -> tuple[str, str | None]:
    """Return name and unit of a column's title, such as ``x [mm]``, ``x (mm)`` or ``x_mm``; None without a unit."""
    match = _TITLE.match(title.strip())
    if match:
        return match[1].strip(), match[2]
    name, _, unit = title.strip().rpartition("_")
    return (name, unit) if name and unit in LENGTHS_MM else (title.strip(), None)


def stated_unit(role: str, name: str, attribute: object, given: Mapping[str, str], source: str) -> str:
    """Return the unit of a variable: the given one for its role or group, or its attribute ``units``.

    Raises
    ------
    InputError
        If neither states it.
    """
    group = group_of(role)
    unit = given.get(role) or given.get(group) or attribute
    if unit is None or not str(unit).strip():
        raise InputError(f"{source}: expected the unit of {name!r}, found none. State it by --unit {group}=UNIT.")
    return str(unit).strip()


def to_mm(
    values: np.ndarray, unit: str, source: str, *, dt_s: float | None = None, voxel_mm: float | None = None
) -> np.ndarray:
    """Return lengths in millimetres, or velocities times `dt_s`.

    Parameters
    ----------
    values : ndarray
        Numbers in `unit`.
    unit : str
        A unit of length; a length per second if `dt_s` is given; or voxels if `voxel_mm` is given.
    source : str
        The file and variable, for messages.
    dt_s : float, optional
        Time between the two frames [s].
    voxel_mm : float, optional
        Edge of a voxel [mm].

    Raises
    ------
    InputError
        If the unit is another.

    Examples
    --------
    >>> from lfpiv.benchmark.names import to_mm
    >>> to_mm(np.array([2.0]), "m s-1", "result.nc", dt_s=1e-4).tolist()
    [0.2]
    """
    per_second = _PER_SECOND.match(unit)
    if per_second and dt_s is not None and per_second[1].strip() in LENGTHS_MM:
        return np.asarray(values, float) * LENGTHS_MM[per_second[1].strip()] * dt_s
    if unit in LENGTHS_MM:
        return np.asarray(values, float) * LENGTHS_MM[unit]
    if unit.lower() in VOXEL_UNITS and voxel_mm is not None:
        return np.asarray(values, float) * voxel_mm
    known = "mm or m" if dt_s is None else "m/s, mm/s, mm, m or voxel"
    raise InputError(f"{source}: expected it in {known}, found the unit {unit!r}. State it by --unit.")

"""Write quantities in the units that people use: 50 µs instead of 5e-05 s."""

from __future__ import annotations

import math
from dataclasses import dataclass

MINUS, UNKNOWN = "−", "–"
"""Sign of a negative number, and the text in place of an unknown one."""

_UNITS = {
    "s": (("s", 1.0), ("ms", 1e3), ("µs", 1e6), ("ns", 1e9)),
    "m": (("m", 1.0), ("mm", 1e3), ("µm", 1e6), ("nm", 1e9)),
    "m/s": (("m/s", 1.0), ("mm/s", 1e3), ("µm/s", 1e6)),
    "1/s²": (("1/ms²", 1e-6), ("1/s²", 1.0)),
    "MiB": (("GiB", 1 / 1024), ("MiB", 1.0)),
}
_LEAST = {
    "m/s": 0.1,
    "1/s²": 0.1,
}  # least number in a unit before the next smaller unit is taken; 1 where it is not named
_DIGITS = 3


@dataclass(frozen=True)
class Scale:
    """Unit for people, and the factor from the SI unit to it."""

    unit: str
    factor: float


def scale_of(magnitude: float, unit: str) -> Scale:
    """Choose the unit in which a magnitude is a handy number.

    Parameters
    ----------
    magnitude : float
        Largest magnitude that is shown. The unit itself is chosen for 0 and for what is not finite.
    unit : str
        Unit of `magnitude`: "s", "m", "m/s", "1/s²" or "MiB". Any other is kept.
    """
    kinds = _UNITS.get(unit, ((unit, 1.0),))
    size = abs(magnitude)
    if not (math.isfinite(size) and size > 0):
        return next(Scale(name, factor) for name, factor in kinds if factor == 1)
    size = float(f"{size:.{_DIGITS}g}")
    least = _LEAST.get(unit, 1.0)
    return next((Scale(*kind) for kind in kinds if size * kind[1] >= least * (1 - 1e-9)), Scale(*kinds[-1]))


def quantity(value: float | None, unit: str, digits: int = _DIGITS) -> str:
    """Write a quantity with significant digits and a handy unit.

    Examples
    --------
    >>> quantity(5e-05, "s"), quantity(0.02, "m/s"), quantity(2430.0, "1/s"), quantity(None, "s")
    ('50 µs', '20 mm/s', '2430 1/s', '–')
    """
    if value is None or not math.isfinite(value):
        return UNKNOWN
    scale = scale_of(value, unit)
    return f"{significant(value * scale.factor, digits)} {scale.unit}"


def significant(value: float | None, digits: int = _DIGITS) -> str:
    """Write a number with significant digits, without an exponent between 1e-4 and 1e6."""
    if value is None or not math.isfinite(value):
        return UNKNOWN
    rounded = float(f"{value:.{digits}g}")
    if rounded == 0 or 1e-4 <= abs(rounded) < 1e6:
        text = f"{rounded:.12f}".rstrip("0").rstrip(".")
        return ("0" if rounded == 0 else text).replace("-", MINUS)
    mantissa, _, power = f"{rounded:.{digits - 1}e}".partition("e")
    mantissa = mantissa.rstrip("0").rstrip(".") if "." in mantissa else mantissa
    return f"{mantissa}e{int(power)}".replace("-", MINUS)


def duration(seconds: float) -> str:
    """Write a time for people, as the times of runs.

    Examples
    --------
    >>> duration(0.234), duration(40), duration(299), duration(7800), duration(400_000)
    ('0.23 s', '40 s', '5 min', '2 h 10 min', '4 d 15 h')
    """
    minutes, hours = round(seconds / 60), round(seconds / 3600)
    if seconds < 90:
        return f"{seconds:.0f} s" if seconds >= 10 or seconds == 0 else f"{seconds:.2g} s"
    if minutes < 90:
        return f"{minutes} min"
    return f"{minutes // 60} h {minutes % 60} min" if hours < 48 else f"{hours // 24} d {hours % 24} h"

"""List of the cases: what each varies, and how large it is."""

from __future__ import annotations

from typing import Any

from lfpiv.benchmark.cases import Case, case_list, tables_of
from lfpiv.benchmark.fingerprint import record


def rows() -> list[dict[str, Any]]:
    """Return what a user must know of each case to choose one.

    Returns
    -------
    list of dict
        ``case``, ``varies``, ``purpose``, ``cameras``, ``per_microlens``, ``flow``, ``pairs`` or ``instants``,
        ``voxels`` (x, y, z), ``sensor_px`` (columns, rows), ``needs_tracers``, and ``size_mib`` and ``make_s`` where
        they are recorded.
    """
    return [_row(case) for case in case_list().case]


def _row(case: Case) -> dict[str, Any]:
    tables = tables_of(case)
    volume, particles, camera = tables["volume"], tables["particles"], tables["camera"][0]
    known = record().cases.get(case.name)
    kind = tables["flow"]["kind"]
    return {
        "case": case.name,
        "varies": case.varies,
        "purpose": case.purpose,
        "cameras": len(tables["camera"]),
        "per_microlens": particles["per_microlens"],
        "flow": "turbulence" if "turbulence" in tables else "DNS" if kind == "tracers" else kind,
        **{name: particles[name] for name in ("pairs", "instants") if name in particles},
        "voxels": [round(edge / volume["voxel_mm"]) for edge in volume["size_mm"]],
        "sensor_px": [camera["sensor_width_px"], camera["sensor_height_px"]],
        "needs_tracers": case.tracers is not None,
        "size_mib": None if known is None else known.size_mib,
        "make_s": None if known is None else known.make_s,
    }

"""Tables of tracks as datasets: particles of a time series with velocity and acceleration, fitted along each track.

A false particle is a crossing of lines of sight of true particles, which hardly lasts. So tracks that are
short are left out, and so are those that move unlike their neighbours.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from lfpiv.geometry.names import COMPONENTS, PARTICLE
from lfpiv.tracking.following import TrackedParticles
from lfpiv.tracking.linking import agreeing
from lfpiv.tracking.trajectory import State, smooth

SHORTEST = 4
"""Least number of instants in which the particle of a track is found."""
REASONS = ("none", "short", "unlike_neighbours")
"""Why a track is left out, by the number in the table."""
FITTED_ROWS = 50_000
"""About the largest number of positions that are fitted at once."""
MOST_UNLIKE = 0.5
"""Largest share of the instants of a track in which it moves unlike its neighbours."""


def track_table(followed: TrackedParticles, *, voxel_mm: float, dt_s: float) -> xr.Dataset:
    """Return the table of tracks.

    Parameters
    ----------
    voxel_mm : float
        Edge of a voxel [mm].
    dt_s : float
        Time between successive instants [s].

    Returns
    -------
    Dataset
        Over ``particle``, a row for each particle that was found at an instant, by track and then in time: ``track``,
        ``instant``, ``x``, ``y``, ``z`` [mm], ``u``, ``v``, ``w`` [m/s], ``acceleration_x``, ``_y``, ``_z`` [m/s^2],
        all from the fit along the track, their standard errors ``uncertainty_x``, ``uncertainty_u``,
        ``uncertainty_acceleration_x`` and so on, in voxel, m/s and m/s^2, ``found_x``, ``_y``, ``_z``, the position as
        the images of the instant show it [mm], ``intensity`` [counts], ``signal_to_noise``, ``track_length``,
        ``valid``, and ``reason``, why a track is left out.
    """
    state = _fitted(followed)
    length = np.bincount(followed.track)[followed.track] if len(followed.track) else followed.track
    long = length >= SHORTEST
    reason = np.where(long, 0, REASONS.index("short"))
    reason[_unlike(followed, state, long)] = REASONS.index("unlike_neighbours")
    data = {
        "track": (followed.track, _about("1", "number of the track")),
        "instant": (followed.instant, _about("1", "number of the instant")),
    }
    error = np.sqrt(np.einsum("raii->rai", state.variance))
    speed, rise = voxel_mm * 1e-3 / dt_s, voxel_mm * 1e-3 / dt_s**2
    for k, (axis, name) in enumerate(COMPONENTS.items()):
        for title, order, scale, units, words in (
            (axis, 0, voxel_mm, "mm", "position"),
            (name, 1, speed, "m/s", "velocity"),
            (f"acceleration_{axis}", 2, rise, "m/s2", "acceleration"),
        ):
            data[title] = (state.mean[:, k, order] * scale, _about(units, f"{words} along {axis}"))
            of_error = _about("voxel" if not order else units, f"standard error of the {words} along {axis}")
            data[f"uncertainty_{title}"] = (error[:, k, order] * (scale if order else 1.0), of_error)
        place = followed.positions_voxel[:, k] * voxel_mm
        data[f"found_{axis}"] = (place, _about("mm", f"position along {axis} as the images of the instant show it"))
    about = "light of the particle, mean of the cameras"
    data["intensity"] = (followed.light, _about("counts", about))
    about = "light over its standard error, least of the cameras"
    data["signal_to_noise"] = (followed.signal_to_noise, _about("1", about))
    data["track_length"] = (length, _about("1", "instants in which the particle of the track is found"))
    data["valid"] = (reason == 0, _about("1", "true: the track is long enough and moves as its neighbours"))
    flags = {"flag_values": np.arange(len(REASONS), dtype=np.int8), "flag_meanings": " ".join(REASONS)}
    data["reason"] = (reason.astype(np.int8), _about("1", "why the track is left out") | flags)
    motion = followed.motion
    return xr.Dataset(
        {name: (PARTICLE, values, about) for name, (values, about) in data.items()},
        {PARTICLE: (PARTICLE, np.arange(len(followed.track)), {"long_name": "number of the row"})},
        {
            "title": "tracks of single particles",
            "dt_s": dt_s,
            "voxel_mm": voxel_mm,
            "tracks": len(np.unique(followed.track[reason == 0])),
            "acceleration_voxel": list(motion.acceleration),
            "memory_instants": list(motion.memory),
            "error_factor": list(motion.factor),
        },
    )


def _about(units: str, words: str) -> dict[str, Any]:
    return {"units": units, "long_name": words}


def _fitted(followed: TrackedParticles) -> State:
    """Return the state of each row, shapes (row, axis, 3) and (row, axis, 3, 3)."""
    count = len(followed.track)
    mean, variance = np.zeros((count, 3, 3)), np.zeros((count, 3, 3, 3))
    length = np.bincount(followed.track)
    order = np.argsort(length, kind="stable")  # tracks of about one length together
    for part in np.array_split(order, -(-count // FITTED_ROWS)) if count else ():
        measured = followed.measured(np.sort(part))
        state, is_measured = smooth(followed.motion, measured), measured.is_measured
        rows = np.isin(followed.track, part)
        mean[rows], variance[rows] = state.mean[is_measured], state.variance[is_measured]
    return State(mean, variance)


def _unlike(followed: TrackedParticles, state: State, long: np.ndarray) -> np.ndarray:
    """Return the rows of long tracks that move unlike their neighbours in most of their instants, bool."""
    unlike = np.zeros(len(long), bool)
    rows_of_long = np.flatnonzero(long)
    ordered = rows_of_long[np.argsort(followed.instant[long], kind="stable")]
    for rows in np.split(ordered, np.flatnonzero(np.diff(followed.instant[ordered])) + 1):
        error = np.sqrt(state.variance[rows, :, 1, 1])
        unlike[rows] = ~agreeing(state.mean[rows, :, 0], state.mean[rows, :, 1], error)
    count = followed.track.max(initial=-1) + 1
    share = np.bincount(followed.track, unlike, minlength=count) / np.maximum(
        np.bincount(followed.track, minlength=count), 1
    )
    return long & (share[followed.track] > MOST_UNLIKE)

"""Particles of a time series: one population that the flow carries through all instants.

Positions follow the flow's velocity, its displacement within ``dt_s`` divided by ``dt_s``. Particles that leave the
seeded region are removed, and others enter through its faces, so a flow without divergence keeps the density. In a wall
a particle emits no light. Instants are counted from 0 here; in names of files the scene's `first` is added.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lfpiv.errors import InputError
from lfpiv.simulation.flows import Tracers, tracer_series
from lfpiv.simulation.light import Brightness, pulse_light
from lfpiv.simulation.particles import LEAST_INTENSITY, log, seeded_count, seeded_size_mm
from lfpiv.simulation.scene import Scene
from lfpiv.simulation.turbulence import TurbulentFlow

SUBSTEPS = 4
"""Steps of the Runge-Kutta method within ``dt_s``."""

MIDPOINTS = 5
"""Iterations that find the point midway between two instants of a tracer file."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SeriesInstant:
    """Particles that emit light at one instant of a series."""

    index: np.ndarray
    """Numbers of the particles, constant over the series, shape (particle,)."""
    position_mm: np.ndarray
    """Positions (x, y, z) [mm], shape (particle, 3)."""
    displacement_mm: np.ndarray | None
    """Displacements to `step` instants later, also of particles that have left by then [mm], shape (particle, 3); None
    for the last instants, which have no partner."""
    intensity: np.ndarray
    """Intensities relative to the mean, shape (particle,)."""
    diameter: np.ndarray
    """Diameters relative to the median, shape (particle,)."""
    power: float
    """Power of the instant's pulse."""
    brightness: np.ndarray
    """Light of each particle in each camera, relative to the mean, shape (camera, particle)."""


@dataclass(frozen=True, eq=False)
class _State:
    """Particles that are followed at one instant."""

    index: np.ndarray
    position_mm: np.ndarray
    lit: np.ndarray


class _Traits(NamedTuple):
    """What a particle keeps over the series; the last axis is that of the particles."""

    intensity: np.ndarray
    diameter: np.ndarray
    camera_factor: np.ndarray


def place_series(scene: Scene) -> list[SeriesInstant]:
    """Place the particles of a time series and follow them through all instants.

    Parameters
    ----------
    scene : Scene
        A scene with `particles.instants`.

    Returns
    -------
    list of SeriesInstant
        One for each instant, in order. A shorter series of the same scene is the beginning of a longer one.

    Raises
    ------
    InputError
        If the scene has less than one particle, its walls leave none, or its tracer file has too few instants.
    """
    if scene.particles.instants is None:
        raise ValueError("scene: expected a scene with particles.instants, got pairs. Call place_particles.")
    flow = scene.flow
    as_given = isinstance(flow, Tracers) and flow.as_given
    tracers = tracer_series(flow)
    if tracers is not None and len(tracers.positions()) < scene.particles.instants:
        raise InputError(
            f"particles.instants: expected at most the {len(tracers.positions())} instants of {tracers.file}, found "
            f"{scene.particles.instants}. Lower it."
        )
    states, traits = _given(scene) if as_given else _carried(scene)
    return [_instant(scene, number, states, traits) for number in range(len(states))]


def _instant(scene: Scene, number: int, states: list[_State], traits: _Traits) -> SeriesInstant:
    """Return what emits light at one instant."""
    state = states[number]
    lit = np.logical_and(state.lit, ~scene.solid(state.position_mm))
    if not lit.any():
        raise InputError(
            f"particles: expected particles at every instant, found none at instant {number}: none in the volume, or "
            "all of them in walls. Raise particles.count, or shrink the walls."
        )
    index, position = state.index[lit], state.position_mm[lit]
    displacement, later = None, number + scene.particles.step
    if later < len(states):
        displacement = states[later].position_mm[np.searchsorted(states[later].index, index)] - position
    intensity = traits.intensity[index]
    rng = np.random.default_rng([scene.seed, 33, number])
    in_cameras = intensity * traits.camera_factor[:, index]
    power, brightness = pulse_light(scene.sheet, in_cameras, position, number % 2, rng)
    return SeriesInstant(
        index=index,
        position_mm=position,
        displacement_mm=displacement,
        intensity=intensity,
        diameter=traits.diameter[index],
        power=power,
        brightness=brightness,
    )


def _inside(scene: Scene, position_mm: np.ndarray) -> np.ndarray:
    """Return which points (n, 3) are in the seeded region, shape (n,)."""
    return np.all(np.abs(position_mm - scene.volume.centre_mm) <= seeded_size_mm(scene) / 2, axis=1)


def _given(scene: Scene) -> tuple[list[_State], _Traits]:
    """Return tracers of a file that move as given: a choice with the wanted mean number in the seeded region."""
    assert isinstance(scene.flow, Tracers) and scene.particles.instants is not None
    positions = scene.flow.positions()[: scene.particles.instants]
    count, tracers = seeded_count(scene), positions.shape[1]
    inside = np.stack([_inside(scene, position) for position in positions])
    available = float(inside.sum(1).mean())
    if available < count:
        log.warning("%d particles wanted, the tracer file has %.0f in the volume", count, available)
    share = min(1.0, count / max(available, 1.0))
    chosen = np.sort(np.random.default_rng([scene.seed, 31]).permutation(tracers)[: round(share * tracers)])
    traits = _draw_traits(scene, tracers, 0)
    return [_State(chosen, at[chosen], within[chosen]) for at, within in zip(positions, inside, strict=True)], traits


def _carried(scene: Scene) -> tuple[list[_State], _Traits]:
    """Place particles at random and carry them with the flow; others enter where they come from outside the region."""
    assert scene.particles.instants is not None
    count, move = seeded_count(scene), _motion(scene)
    position, index, traits = _drawn(scene, count, 0), np.arange(count), [_draw_traits(scene, count, 0)]
    absent = np.zeros(count, int)  # instants since a particle left the region
    states = [_State(index, position, absent == 0)]
    for instant in range(1, scene.particles.instants):
        position = move(position, instant - 1, 1)
        absent = np.where((absent > 0) | ~_inside(scene, position), absent + 1, 0)
        followed = absent <= scene.particles.step  # a displacement from inside to outside is still wanted
        drawn = _drawn(scene, count, instant)
        enters = ~_inside(scene, move(drawn, instant - 1, -1))
        added = int(enters.sum())
        born = sum(len(part.intensity) for part in traits)
        index = np.concatenate([index[followed], born + np.arange(added)])
        position = np.concatenate([position[followed], drawn[enters]])
        absent = np.concatenate([absent[followed], np.zeros(added, int)])
        traits.append(_Traits(*(part[..., enters] for part in _draw_traits(scene, count, instant))))
        states.append(_State(index, position, absent == 0))
    return states, _Traits(*(np.concatenate(part, axis=-1) for part in zip(*traits, strict=True)))


def _draw_traits(scene: Scene, count: int, instant: int) -> _Traits:
    """Draw intensity, diameter and factors of the cameras of particles that enter at an instant."""
    rngs = [np.random.default_rng([scene.seed, 32, instant, kind]) for kind in range(3)]
    intensity = np.maximum(LEAST_INTENSITY, 1 + scene.particles.intensity_sd * rngs[0].standard_normal(count))
    scatter = scene.brightness or Brightness()
    diameter = scatter.diameters(count, rngs[1])
    factor = scatter.camera_factors(len(scene.camera), count, rngs[2])
    return _Traits(intensity * scatter.intensity_of(diameter), diameter, factor)


def _drawn(scene: Scene, count: int, instant: int) -> np.ndarray:
    """Draw points in the seeded region, shape (count, 3) [mm]."""
    rng = np.random.default_rng([scene.seed, 31, instant])
    return scene.volume.centre_mm + rng.uniform(-0.5, 0.5, (count, 3)) * seeded_size_mm(scene)


def _motion(scene: Scene) -> Callable[[np.ndarray, int, int], np.ndarray]:
    """Return the function of positions (n, 3), an instant and a sense that carries particles by one instant.

    With the sense 1 positions are those at the instant and the result those at the next; with -1 it is the reverse.
    """
    step, tracers = scene.particles.step, tracer_series(scene.flow)
    if tracers is None:
        steady = scene.flow_of(scene.particles.first)
        substeps = -(-SUBSTEPS // step)
        return lambda position, _, sense: runge_kutta(steady, position, sense / step, substeps)
    turbulence = None if scene.turbulence is None else scene.flow_of(scene.particles.first)

    def unsteady(position: np.ndarray, instant: int, sense: int) -> np.ndarray:
        between, middle = tracers.between(instant, instant + 1), position
        for _ in range(MIDPOINTS):
            moved = between(middle)
            if isinstance(turbulence, TurbulentFlow):
                moved = moved + turbulence.fluctuation(middle) / step
            middle = position + sense * moved / 2
        return position + sense * moved

    return unsteady


def runge_kutta(
    flow: Callable[[np.ndarray], np.ndarray], position_mm: np.ndarray, duration: float, steps: int
) -> np.ndarray:
    """Carry particles with a steady flow by the classical Runge-Kutta method of fourth order.

    Parameters
    ----------
    flow : callable
        Displacement (n, 3) within one unit of time at points (n, 3) [mm].
    position_mm : ndarray, shape (n, 3)
        Positions [mm].
    duration : float
        Time, in the flow's unit; negative: backwards.
    steps : int
        Number of steps.

    Returns
    -------
    ndarray, shape (n, 3)
        Positions after that time [mm].
    """
    position, step = np.asarray(position_mm, float), duration / steps
    for _ in range(steps):
        first = flow(position)
        second = flow(position + step / 2 * first)
        third = flow(position + step / 2 * second)
        fourth = flow(position + step * third)
        position = position + step / 6 * (first + 2 * second + 2 * third + fourth)
    return position

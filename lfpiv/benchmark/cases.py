"""Cases of the benchmark: read them, and turn each into a scene of the simulator.

A case starts from its parent and changes some keys. The root of all is the case ``base`` on the rig of ``rig.toml``.
"""

from __future__ import annotations

import functools
import importlib.resources
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from lfpiv.errors import InputError
from lfpiv.experiment.toml import parse, read_text, validated
from lfpiv.settings import bounds
from lfpiv.settings.bounds import Name, Seed
from lfpiv.settings.table import Table
from lfpiv.simulation.flows import Tracers
from lfpiv.simulation.scene import Scene

ROOT = "base"
"""Name of the case that all others start from."""

CaseName = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9.-]{0,39}$")]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class TracerSource(Table):
    """Table ``[case.tracers]``: the file that a case needs beside this package."""

    form: str
    """Arrays of the file."""
    source: str
    """Where the data are from."""
    licence: Name
    """Licence of the data."""
    sha256: Sha256
    """Checksum of the file that the fingerprints were made with."""


class Case(Table):
    """Table ``[[case]]``: a case of the benchmark, and what it changes in its parent."""

    name: CaseName
    """Name on the command line and of folders."""
    varies: Literal["base", "seeding", "cameras", "images", "flow", "sequence", "size"]
    """What it varies."""
    purpose: str
    """What it is for, one sentence."""
    parent: CaseName = ROOT
    """Case it starts from."""
    cameras: tuple[Name, ...] | None = None
    """Cameras of the rig, in order; absent: the parent's."""
    pairs: Annotated[int, Field(strict=True, ge=1, le=bounds.MOST_SIMULATED_PAIRS)] | None = None
    """Number of pairs; absent: the parent's."""
    instants: Annotated[int, Field(strict=True, ge=2, le=bounds.MOST_SIMULATED_PAIRS)] | None = None
    """Number of instants of a sequence, in place of pairs."""
    camera: dict[str, dict[str, Any]] = Field(default_factory=dict)
    """Keys of single cameras that differ, by their names."""
    scene: dict[str, Any] = Field(default_factory=dict)
    """Tables of the scene that differ."""
    tracers: TracerSource | None = None
    """File of tracers that the flow is made of; absent: the case needs no file."""

    @model_validator(mode="after")
    def _pairs_or_instants(self) -> Case:
        if self.pairs is not None and self.instants is not None:
            raise ValueError("either pairs or instants")
        return self


class CaseList(Table):
    """File ``cases.toml``."""

    version: Annotated[str, Field(pattern=r"^\d+(\.\d+)*$")]
    """Version of the benchmark. Figures of different versions cannot be compared."""
    case: tuple[Case, ...]
    """The cases."""

    @model_validator(mode="after")
    def _named_once_after_their_parents(self) -> CaseList:
        known: set[str] = set()
        for case in self.case:
            if case.name in known:
                raise ValueError(f"one case {case.name!r}")
            if case.name != ROOT and case.parent not in known:
                raise ValueError(f"the parent of {case.name!r} before it, found none of the name {case.parent!r}")
            known.add(case.name)
        return self


@functools.lru_cache(maxsize=1)
def case_list() -> CaseList:
    """Return the benchmark's version and cases."""
    return validated(_table("cases.toml"), Path("cases.toml"), CaseList)


def names() -> tuple[str, ...]:
    """Return the names of the cases, in order."""
    return tuple(case.name for case in case_list().case)


def case_of(name: str) -> Case:
    """Return a case; raise InputError if there is no case of that name."""
    for case in case_list().case:
        if case.name == name:
            return case
    raise InputError(f"{name!r}: expected the name of a case, {', '.join(names())}. See `lfpiv benchmark list`.")


def scene_of(case: Case, *, seed: int | None = None, tracers: str | Path | None = None) -> Scene:
    """Return the scene of a case.

    Parameters
    ----------
    seed : int, optional
        Seed in place of the benchmark's. Particles, noise and turbulence are then others; the rig is the same.
    tracers : path, optional
        File of tracers, for a case with a table `tracers`.

    Raises
    ------
    InputError
        If the case needs a file of tracers that is missing or unsuitable, or a file is stated that it does not need.
    """
    if (case.tracers is None) != (tracers is None):
        raise InputError(_tracers_message(case, tracers))
    tables = tables_of(case)
    tables["name"] = case.name
    if seed is not None:
        tables["seed"] = validated({"seed": seed}, Path("--seed"), _Seeded).seed
    if tracers is not None:
        tables["flow"]["file"] = str(Path(tracers).absolute())
    scene = validated(tables, Path(f"case {case.name}"), Scene)
    if isinstance(scene.flow, Tracers):
        scene.flow.positions()  # refuse a missing or unsuitable file before any work
    return scene


def public_seed(case: Case) -> int:
    """Return the seed of a case that everybody knows."""
    return tables_of(case)["seed"]


class _Seeded(Table):
    """A seed that is checked as that of a scene."""

    seed: Seed


def _tracers_message(case: Case, tracers: str | Path | None) -> str:
    if case.tracers is None:
        return f"--tracers {tracers}: expected no file of tracers, the flow of the case {case.name} needs none."
    return (
        f"case {case.name}: expected a file of tracers, found none. State it as --tracers FILE. {case.tracers.form} "
        f"From: {case.tracers.source} ({case.tracers.licence}), SHA-256 {case.tracers.sha256}."
    )


def _table(name: str) -> dict[str, Any]:
    """Return the values of a TOML file of this package."""
    with importlib.resources.as_file(importlib.resources.files("lfpiv.benchmark") / name) as path:
        return parse(read_text(path), Path(name))


def tables_of(case: Case) -> dict[str, Any]:
    """Return the tables of a case's scene as a scene file has them, changes of its parents included."""
    line = [case]
    while line[-1].name != ROOT:
        line.append(case_of(line[-1].parent))
    tables = _table("rig.toml")
    rig = {camera["name"]: camera for camera in tables["camera"]}
    chosen: tuple[str, ...] = ()
    for one in reversed(line):
        chosen = one.cameras or chosen
        tables = merged(tables, one.scene)
        rig = merged(rig, one.camera)
        count = {name: getattr(one, name) for name in ("pairs", "instants") if getattr(one, name) is not None}
        if count:
            kept = {key: value for key, value in tables["particles"].items() if key not in ("pairs", "instants")}
            tables["particles"] = kept | count
    tables["camera"] = [rig[name] for name in chosen]
    return tables


def merged(tables: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return tables with changed keys. Tables are merged key by key; one that states its `kind` replaces the other.

    Examples
    --------
    >>> from lfpiv.benchmark.cases import merged
    >>> merged({"noise": {"background": 40, "read_noise": 3}}, {"noise": {"read_noise": 2}})
    {'noise': {'background': 40, 'read_noise': 2}}
    >>> merged({"flow": {"kind": "ring", "radius_mm": 1}}, {"flow": {"kind": "uniform"}})
    {'flow': {'kind': 'uniform'}}
    """
    result = dict(tables)
    for key, value in changes.items():
        old = result.get(key)
        if isinstance(value, Mapping) and isinstance(old, Mapping) and "kind" not in value:
            result[key] = merged(old, value)
        else:
            result[key] = value
    return result

"""Make cases of the benchmark: images, boards and experiment file in one folder, the truth in it or apart."""

from __future__ import annotations

import glob
import hashlib
import json
import logging
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv.benchmark import fingerprint
from lfpiv.benchmark.cases import Case, case_list, case_of, names, public_seed, scene_of
from lfpiv.benchmark.fingerprint import Fingerprint, Verdict
from lfpiv.benchmark.plain_truth import (
    FLOW_FILE,
    PARTICLES_FILE,
    flow_truth,
    measured_numbers,
    recommended_grid,
    write_particles,
)
from lfpiv.benchmark.readme import README, readme
from lfpiv.benchmark.truth import ABOUT, TRUTH
from lfpiv.errors import InputError
from lfpiv.files import remove_leftovers, replacing_folder, require_empty, scratch_path, write_json, writing
from lfpiv.progress import Progress, ignore_progress
from lfpiv.records import RecordError, read_object, read_text
from lfpiv.results.datasets import write_dataset
from lfpiv.simulation.flows import Tracers
from lfpiv.simulation.scene import Scene
from lfpiv.simulation.simulator import simulate
from lfpiv.version import versions

log = logging.getLogger(__name__)

ALL = "all"
"""Name that stands for all cases that need no further file."""

TRACERS = "tracers.npz"
"""Copy of the file of tracers in a truth."""


@dataclass(frozen=True, kw_only=True)
class Made:
    """A made case."""

    case: str
    """Its name."""
    folder: Path
    """Folder of the data set."""
    truth: Path
    """Folder of its truth."""
    verdict: Verdict
    """Comparison with the recorded fingerprint."""
    reason: str = ""
    """Versions of libraries that differ, or why nothing is compared; empty where images and truth are identical."""


def make(
    cases: Sequence[str],
    out: str | Path,
    *,
    truth: str | Path | None = None,
    seed: int | None = None,
    tracers: str | Path | None = None,
    progress: Progress | None = None,
) -> list[Made]:
    """Make cases of the benchmark. A case that the folder already holds is kept.

    Parameters
    ----------
    cases : sequence of str
        Names of cases, or "all"; without a file of tracers that leaves out the cases that need one.
    out : path
        Folder of the data set; of several cases, the folder in which each has one of its name.
    truth : path, optional
        Folder of the truth, for a test in which it is not known; of several cases as `out`. Default: ``truth`` in the
        data set.
    seed : int, optional
        Seed in place of the benchmark's. Nobody who does not know it can make the same images.
    tracers : path, optional
        File of tracers for cases that need one.
    progress : callable, optional
        Called with (step, finished fraction).

    Raises
    ------
    InputError
        If a case is unknown, a file of tracers is missing or unsuitable, or a folder is not empty or not writable.
    """
    chosen = _chosen(cases, with_tracers=tracers is not None)
    many = len(chosen) > 1 or ALL in cases
    scenes = [scene_of(case, seed=seed, tracers=tracers if case.tracers else None) for case in chosen]
    if tracers is not None and not any(case.tracers for case in chosen):
        scene_of(chosen[0], tracers=tracers)  # refuses it
    places = []
    for case in chosen:
        folder = Path(out) / case.name if many else Path(out)
        apart = folder / TRUTH if truth is None else Path(truth) / case.name if many else Path(truth)
        places.append((folder, apart))
    report = progress or ignore_progress
    return [
        _make_or_keep(case, scene, folder, apart, report)
        for case, scene, (folder, apart) in zip(chosen, scenes, places, strict=True)
    ]


def _chosen(cases: Sequence[str], *, with_tracers: bool) -> list[Case]:
    """Return the cases of some names, each once, in the order of the list."""
    known = case_list().case
    wanted = {case_of(name).name for name in cases if name != ALL}
    if ALL in cases:
        wanted |= {case.name for case in known if with_tracers or case.tracers is None}
    if not wanted:
        raise InputError(f"expected the name of a case, or {ALL}; found none. The cases are {', '.join(names())}.")
    return [case for case in known if case.name in wanted]


def _make_or_keep(case: Case, scene: Scene, folder: Path, truth: Path, progress: Progress) -> Made:
    """Make a case in its folders, unless they hold it already."""
    known = _made_before(case, scene, folder, truth)
    if known is not None:
        log.info("%s: made before, kept", case.name)
        return known
    if truth != folder / TRUTH and _overlap(folder.resolve(), truth.resolve()):
        raise InputError(f"--truth {truth}: expected a folder outside {folder}, not around it. Name another one.")
    if not folder.exists() and _is_of(_about_of(truth), case, scene):
        shutil.rmtree(truth)  # of a command that was killed between truth and data
    for place in (folder, truth):
        require_empty(place)
    with writing(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        truth.parent.mkdir(parents=True, exist_ok=True)
        remove_leftovers(folder.parent, f".{glob.escape(folder.name)}.*.tmp")
        scratch = scratch_path(folder)
        scratch.mkdir()
        try:
            made = _write(case, scene, scratch / "data", folder, truth, lambda _, done: progress(case.name, done))
            require_empty(folder)  # another command may have made it meanwhile
            if truth != folder / TRUTH:
                _move(scratch / "data" / TRUTH, truth)
            os.replace(scratch / "data", folder)
        finally:
            shutil.rmtree(scratch, ignore_errors=True)
    if made.verdict == "differs":
        log.warning("%s: images or truth differ from the recorded ones: %s", case.name, made.reason or "same versions")
    return made


def _overlap(one: Path, other: Path) -> bool:
    """Return whether one of two folders is the other, or lies in it."""
    return one == other or one in other.parents or other in one.parents


def _move(source: Path, target: Path) -> None:
    """Move a folder, to another disk too; it appears under its name when it is complete."""
    remove_leftovers(target.parent, f".{glob.escape(target.name)}.*.tmp")
    with replacing_folder(target) as near:
        shutil.move(source, near)


def _made_before(case: Case, scene: Scene, folder: Path, truth: Path) -> Made | None:
    """Return a case that its folders hold complete, with the same seed."""
    about = [_about_of(place) for place in (folder, truth)]
    if not (_is_of(about[0] | {"seed": scene.seed}, case, scene) and _is_of(about[1], case, scene)):
        return None
    if not {"verdict", "reason"} <= about[1].keys():
        return None
    return Made(case=case.name, folder=folder, truth=truth, verdict=about[1]["verdict"], reason=about[1]["reason"])


def _about_of(place: Path) -> dict[str, Any]:
    """Return what a folder says of itself; empty if it says nothing."""
    try:
        return read_object(read_text(place / ABOUT))
    except (OSError, RecordError):
        return {}


def _is_of(about: Mapping[str, Any], case: Case, scene: Scene) -> bool:
    """Return whether a folder says that it belongs to a case, made with the seed of the scene."""
    stated = tuple(about.get(name) for name in ("benchmark", "case", "seed"))
    return stated == (case_list().version, case.name, scene.seed)


def _write(case: Case, scene: Scene, data: Path, folder: Path, truth: Path, progress: Progress) -> Made:
    """Write a data set with its truth into `data`."""
    simulate(scene, data, progress=progress)
    inside = data / TRUTH
    write_dataset(flow_truth(scene), inside / FLOW_FILE)
    with np.load(inside / "particles.npz") as arrays:
        write_particles(dict(arrays), inside / PARTICLES_FILE)
    if isinstance(scene.flow, Tracers):
        keep_tracers(Path(scene.flow.file), inside)
    found = fingerprint.fingerprint_of(data, inside)
    verdict, reason = _verdict(case, scene, found)
    public = _about(case, scene) | {"images_sha256": found.images_sha256}
    write_json(public, data / ABOUT)
    (data / README).write_text(readme(case, scene), "utf-8")
    secret = {"seed": scene.seed, "truth_sha256": found.truth_sha256, "verdict": verdict, "reason": reason}
    write_json(public | secret | {"versions": versions()}, inside / ABOUT)
    return Made(case=case.name, folder=folder, truth=truth, verdict=verdict, reason=reason)


def keep_tracers(file: Path, truth: Path) -> None:
    """Copy a file of tracers into a truth, whose scene then names it relative to its own folder.

    Parameters
    ----------
    file : Path
        The file of tracers.
    truth : Path
        Folder of the truth, with ``spec.json``.
    """
    shutil.copyfile(file, truth / TRACERS)
    spec = json.loads((truth / "spec.json").read_text("utf-8"))
    spec["flow"]["file"] = TRACERS
    (truth / "spec.json").write_text(json.dumps(spec, indent=1) + "\n", "utf-8")


def _about(case: Case, scene: Scene) -> dict[str, Any]:
    """Return what a data set says of itself, nothing of its truth."""
    grid = recommended_grid(scene)
    sequence = scene.particles.instants is not None
    return {
        "benchmark": case_list().version,
        "case": case.name,
        "purpose": case.purpose,
        "dt_s": scene.dt_s,
        "voxel_mm": scene.volume.voxel_mm,
        "instants" if sequence else "pairs": list(measured_numbers(scene)),
        "grid": {
            "window_mm": grid.window_mm,
            "spacing_mm": grid.spacing_mm,
            "x_mm": grid.x,
            "y_mm": grid.y,
            "z_mm": grid.z,
        },
    }


def _verdict(case: Case, scene: Scene, found: Fingerprint) -> tuple[Verdict, str]:
    """Compare a made case with its recorded fingerprint."""
    record = fingerprint.record()
    if case.name not in record.cases:
        return "not compared", "no fingerprint is recorded"
    if scene.seed != public_seed(case):
        return "not compared", "the seed is another one"
    if case.tracers is not None and isinstance(scene.flow, Tracers):
        if hashlib.sha256(Path(scene.flow.file).read_bytes()).hexdigest() != case.tracers.sha256:
            return "not compared", "the file of tracers is another one"
    verdict = fingerprint.compare(found, record.cases[case.name])
    return verdict, "" if verdict == "identical" else fingerprint.other_versions(record.versions)

"""Guard layers of a run: voxels beyond the volume's faces that are reconstructed and cut away.

Light from beyond the volume reaches the same pixels as light from within. Without guard layers SMART puts it into the
volume. `keep_or_measure` measures once per output folder how far light reaches beyond each face, and stores the
outcome. With ``volume.guard_mm = "auto"`` the guard layers follow from it.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from lfpiv.geometry.grid import AXES, NO_LAYERS, Layers
from lfpiv.reconstruction.beyond import FaceLight, light_beyond
from lfpiv.records import RecordError, validate
from lfpiv.results import stamps, stored_outcome
from lfpiv.results.provenance import Marks
from lfpiv.runs import memory
from lfpiv.warn import Code, Warning

if TYPE_CHECKING:
    from lfpiv.calibration.camera import Calibration
    from lfpiv.experiment.experiment import Experiment
    from lfpiv.results.folder import Folder

log = logging.getLogger(__name__)

LEAST_LAYERS = 1
"""Least number of layers beyond each face with ``volume.guard_mm = "auto"``: particles at a face protrude from it."""

SampledLight = Callable[[], Mapping[int, Sequence[Mapping[str, np.ndarray]]]]
"""Reads pairs that stand for the experiment, as `lfpiv.runs.frame_light.sampled_light` does."""


@dataclass(frozen=True, kw_only=True)
class Guard:
    """Guard layers, and the light beyond the volume that they follow from."""

    pairs: tuple[int, ...]
    """Pairs that the light was measured with; empty if it could not be measured."""
    faces: tuple[FaceLight, ...]
    """Faces of the volume with light beyond them."""
    layers: Layers
    """Layers of voxels that "auto" demands."""
    short: bool = False
    """Whether the memory allows fewer layers than the light demands."""

    def to_json(self) -> dict[str, Any]:
        """Return the form that a file stores."""
        return asdict(self)

    @classmethod
    def from_json(cls, stored: Any) -> Guard:
        """Read the form that a file stores; raise RecordError if it has another form, or numbers out of range."""
        found = validate(cls, stored)
        counts = [count for pair in found.layers for count in pair]
        lengths = [value for face in found.faces for value in (face.reach_mm, face.share, face.guard_mm)]
        sides = [face for face in found.faces if face.axis not in (0, 1, 2) or face.side not in (0, 1)]
        if min(counts) < 0 or sides or not np.isfinite(lengths).all():
            raise RecordError("its layers or faces are out of range")
        return found


def read(folder: Folder) -> tuple[Guard, Marks] | None:
    """Read the stored outcome, whether it fits or not, and its marks; None if it is missing or damaged."""
    return stored_outcome.read(folder.guard, lambda content: Guard.from_json(content.get("guard")))


def layers(experiment: Experiment, guard: Guard | None) -> Layers:
    """Return the guard layers of an experiment: stated in its file, or measured, at least `LEAST_LAYERS`."""
    if experiment.guard_mm != "auto":
        return experiment.grid.layers(experiment.guard_mm)
    measured = NO_LAYERS if guard is None else guard.layers
    z, y, x = ((max(low, LEAST_LAYERS), max(high, LEAST_LAYERS)) for low, high in measured)
    return z, y, x


def with_guard(experiment: Experiment, guard: Layers) -> Experiment:
    """Return the experiment with the padded grid."""
    return replace(experiment, grid=experiment.grid.padded(guard))


def keep_or_measure(
    experiment: Experiment,
    folder: Folder,
    stamp_hash: str,
    background: str | None,
    calibration: Calibration,
    light: SampledLight,
) -> Guard:
    """Return the stored outcome, or measure the light beyond the volume and store the outcome.

    `stamp_hash` is the hash of the stamp of the board's calibration, `background` that of the subtracted light.
    """
    if (found := read(folder)) is not None:
        known, marks = found
        if stamps.of_guard(experiment, stamp_hash, known.pairs, background).fits(marks):
            log.info("light beyond the volume: measured before, kept")
            return known
    start = time.perf_counter()
    instants = light()
    faces = light_beyond(calibration, experiment.grid, list(instants.values())) if instants else ()
    demanded = _demanded(experiment, faces)
    allowed = _fitting(experiment, demanded)
    guard = Guard(pairs=tuple(instants), faces=faces, layers=allowed, short=allowed != demanded)
    found_text = ", ".join(_name(experiment, face) for face in faces) or "none"
    log.info("faces of the volume with light beyond them: %s (%.1f s)", found_text, time.perf_counter() - start)
    stamp = stamps.of_guard(experiment, stamp_hash, guard.pairs, background)
    stored_outcome.write({"guard": guard.to_json()}, stamp, folder.guard)
    return guard


def warnings(experiment: Experiment, guard: Guard | None) -> list[Warning]:
    """Return a warning for each face of the volume with light beyond it."""
    if guard is None:
        return []
    found, voxel_mm, used = [], experiment.grid.voxel_mm, layers(experiment, guard)
    for face in guard.faces:
        guard_mm = used[face.axis][face.side] * voxel_mm
        covered = guard_mm >= face.reach_mm - voxel_mm / 2 and not face.farther
        figures = {
            "face": _name(experiment, face),
            "reach_mm": face.reach_mm,
            "share": face.share,
            "guard_mm": guard_mm,
        }
        if covered:
            found.append(Warning(code=Code.LIGHT_GUARDED, figures=figures))
        else:
            figures["reason"] = _reason(experiment, guard, face)
            found.append(Warning(code=Code.LIGHT_UNGUARDED, figures=figures))
    return found


def _demanded(experiment: Experiment, faces: Sequence[FaceLight]) -> Layers:
    """Return whole layers of voxels that hold the light beyond the faces."""
    counts = [[0, 0], [0, 0], [0, 0]]
    for face in faces:
        counts[face.axis][face.side] = round(face.guard_mm / experiment.grid.voxel_mm)
    z, y, x = ((low, high) for low, high in counts)
    return z, y, x


def _fitting(experiment: Experiment, demanded: Layers) -> Layers:
    """Return the layers that fit into the memory: the demanded ones, or all in proportion thinner."""
    if demanded == NO_LAYERS:
        return demanded
    limit = memory.allowed_bytes(experiment)
    for part in (1.0, 0.75, 0.5, 0.25):
        z, y, x = ((int(low * part), int(high * part)) for low, high in demanded)
        padded = with_guard(experiment, (z, y, x))
        if memory.run_bytes(padded, memory.weights_bytes(padded), 1) <= limit:
            return z, y, x
    return NO_LAYERS


def _name(experiment: Experiment, face: FaceLight) -> str:
    grid = experiment.grid
    edge = grid.axis_mm(face.axis)[-1 if face.side else 0] + (0.5 if face.side else -0.5) * grid.voxel_mm
    return f"{AXES[face.axis]} = {round(edge, 6) + 0.0:g} mm"


def _reason(experiment: Experiment, guard: Guard, face: FaceLight) -> str:
    if experiment.guard_mm != "auto":
        return 'raise volume.guard_mm, or set it to "auto"'
    if guard.short:
        return "thicker guard layers would not fit into the memory: raise compute.memory_gib or volume.voxel_mm"
    return f"beyond that lies {face.limit}: make the sheet thinner or the volume larger"

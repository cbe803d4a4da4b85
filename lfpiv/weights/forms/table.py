"""All forms of the weights, in the order in which they are tried. A new form is named here."""

from __future__ import annotations

from collections.abc import Callable

from lfpiv.progress import StepProgress
from lfpiv.weights.forms.counted import Counted
from lfpiv.weights.forms.form import Form, Rig
from lfpiv.weights.forms.nodes import Nodes
from lfpiv.weights.forms.shared_profiles import SharedProfiles
from lfpiv.weights.forms.voxels import Voxels
from lfpiv.weights.stored_grid import StoredGrid
from lfpiv_kernels.reconstruction.ray_projector import RayProjector

FORMS: tuple[type[Form], ...] = (Counted, SharedProfiles, Nodes, Voxels)


def suitable_forms(rig: Rig) -> dict[str, Form]:
    """Return the first form that suits each camera. Nothing large is allocated."""
    found: dict[str, Form] = {}
    for kind in FORMS:
        form = kind(rig, [name for name in rig.cameras if name not in found])
        found |= dict.fromkeys(form.suits, form)
    return found


def build(rig: Rig, step: Callable[[str], StepProgress]) -> tuple[StoredGrid, dict[str, RayProjector]]:
    """Build each camera's weights in the first form that suits it, fits and is accurate; see `Form.build`.

    Returns
    -------
    stored : StoredGrid
        The voxels in the order of the weights.
    projectors : dict of str to RayProjector
    """
    stored, built = rig.stored, dict[str, RayProjector]()
    for kind in FORMS:
        form = kind(rig, [name for name in rig.cameras if name not in built])
        if found := form.build(step):
            stored = form.stored
            built |= found
    return stored, {name: built[name] for name in rig.cameras}


def form_of(projector: RayProjector) -> type[Form]:
    """Return the form of a projector's weights."""
    return next(form for form in FORMS if form.projector is type(projector))


def form_named(name: str) -> type[Form]:
    """Return a form by the name of its class; raise ValueError for an unknown one."""
    for form in FORMS:
        if form.__name__ == name:
            return form
    raise ValueError(f"weights of an unknown form {name!r}")

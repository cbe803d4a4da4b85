"""Vectors of a pair: correlate its volumes and state what the vectors cannot show.

A camera may have recorded no particles, which changes what the vectors are worth.
"""

from __future__ import annotations

import xarray as xr

from lfpiv.experiment.experiment import Experiment
from lfpiv.joint.vectors import joint_vectors
from lfpiv.lightfield import image_checks
from lfpiv.results.pair_files import PairVolumes
from lfpiv.warn import Code, collected

NO_PARTICLES = "no particles in the images: none of the vectors counts"
"""Verdict on the vectors of a pair if the images of one frame show only noise."""
MISPLACED = "an image does not belong to its camera's white image: none of the vectors counts"
"""Verdict on the vectors of a pair if the light of an image lies beside the microimages."""
UNLIKE_PARTICLES = "the images of the cameras do not belong together: none of the vectors counts"
"""Verdict on the vectors of a pair whose images of one instant show different particles."""

REFUSED = (NO_PARTICLES, MISPLACED, UNLIKE_PARTICLES)
"""Verdicts on the vectors of pairs of which none is valid."""


def measure_vectors(first: xr.DataArray, second: xr.DataArray, experiment: Experiment) -> xr.Dataset:
    """Return the vectors of two frames, of a joint fit or of the correlation of both volumes.

    That few vectors are valid is not logged: the pair may be refused.
    """
    with collected(quiet=True):
        return joint_vectors((first, second), dt_s=experiment.dt_s, **experiment.correlation.model_dump())


def without_unmeasured(vectors: xr.Dataset, volumes: PairVolumes) -> xr.Dataset:
    """Mark all vectors as not valid if images do not belong where they are, or too few cameras saw particles."""
    cameras = len(volumes.records[0].structure)
    warnings = [record.warnings for record in volumes.records]
    if image_checks.unmeasured(warnings, cameras):
        verdict = NO_PARTICLES
    elif any(warning.code in (Code.MISMATCHED, Code.NOTHING_IN_COMMON) for warning in volumes.between):
        verdict = UNLIKE_PARTICLES
    elif image_checks.misplaced(warnings):
        verdict = MISPLACED
    else:
        return vectors
    return refused(vectors, verdict)


def refused(vectors: xr.Dataset, verdict: str) -> xr.Dataset:
    """Mark all vectors as not valid."""
    valid = xr.zeros_like(vectors["valid"])  # keeps its attributes
    names = [name for name in vectors.data_vars if str(name).startswith("uncertainty")]
    changed = {"valid": valid, **{str(name): vectors[name].where(valid) for name in names}}
    seen = vectors.attrs["seen_fraction"]  # no part of the volume is blamed for it
    attributes = {"valid_fraction": 0.0, "measurable_fraction": seen, "unseeded_fraction": 0.0}
    return vectors.assign(changed).assign_attrs(verdict=verdict, **attributes)

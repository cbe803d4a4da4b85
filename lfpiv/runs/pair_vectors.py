"""Vectors of a pair: correlate its volumes and state what the vectors cannot show.

The motion passes share light between the frames, and a camera may have recorded no particles: both change what the
vectors are worth.
"""

from __future__ import annotations

import numpy as np
import xarray as xr

from lfpiv.experiment.experiment import Experiment
from lfpiv.lightfield import image_checks
from lfpiv.reconstruction.motion import Motion, unshared_quality
from lfpiv.results.pair_files import PairVolumes
from lfpiv.velocity.cross_correlation import correlate
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
    """Correlate the volumes of two frames. That few vectors are valid is not logged: the pair may be refused."""
    with collected(quiet=True):
        vectors = correlate(first, second, dt_s=experiment.dt_s, **experiment.correlation.model_dump())
    return _with_motion(vectors, (first, second))


def without_unmeasured(vectors: xr.Dataset, volumes: PairVolumes) -> xr.Dataset:
    """Mark all vectors as not valid if images do not belong where they are, or too few cameras saw particles."""
    cameras = len(volumes.records[0].structure)
    warnings = [record.warnings for record in volumes.records]
    if any(warning.code in (Code.MISMATCHED, Code.NOTHING_IN_COMMON) for warning in volumes.between):
        verdict = UNLIKE_PARTICLES
    elif image_checks.misplaced(warnings):
        verdict = MISPLACED
    elif image_checks.unmeasured(warnings, cameras):
        verdict = NO_PARTICLES
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


def _with_motion(vectors: xr.Dataset, volumes: tuple[xr.DataArray, xr.DataArray]) -> xr.Dataset:
    """Return vectors with the outcome of the motion passes and with a quality that does not count shared light."""
    attributes = volumes[0].attrs
    if attributes.get("motion", Motion.OFF.value) == Motion.OFF.value:
        return vectors
    shares = np.atleast_1d(attributes["motion_valid"]).tolist()
    return unshared_quality(vectors, volumes).assign_attrs(motion=attributes["motion"], motion_valid=shares)

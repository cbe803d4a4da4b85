"""Figures of a pair of no run, for tests of what is made of them."""

from lfpiv.runs.pair_figures import PairFigures, Spread


def pair_figures(valid_fraction, **changed) -> PairFigures:
    """Return figures with a share of valid vectors; `changed` has other values of the fields."""
    fields = {
        "vectors": [1, 2, 3],
        "valid_fraction": valid_fraction,
        "finite_fraction": 1.0,
        "seen_fraction": 1.0,
        "measurable_fraction": 1.0,
        "verdict": "good",
        "warnings": (),
        "reconstruction_s": 1.0,
        "correlation_s": 1.0,
        "velocity_m_per_s": dict.fromkeys("uvw", Spread(mean=None, sd=None, min=None, max=None)),
        "uncertainty_voxel": None,
        "peak_ratio": None,
    }
    return PairFigures(**fields | changed)

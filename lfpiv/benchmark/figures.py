"""Figures of merit of the benchmark: name, unit, definition and source of each.

The page of the benchmark and the pages of scores show these texts.
"""

from __future__ import annotations

from dataclasses import dataclass

OUTLIER_VOXEL = 1.0
"""Length of the error above which a vector is an outlier [voxel], where no other limit is stated."""
OUTLIER_NORMALISED, OUTLIER_FLOOR_VOXEL = 5.0, 0.1
"""A vector is a normalised outlier if its error exceeds this many times the median error plus the floor [voxel]."""
PARTS = (0.5, 0.8, 0.9, 0.95)
"""Parts of the measurable region at which errors are compared."""
MATCH_VOXEL = 1.0
"""Largest distance of a found particle from the true one that it is [voxel]."""
BLOB_VOXEL = 0.7
"""Standard deviation of the blobs of the true volume [voxel]."""

PIV4 = "kahler2016"
LPT = "sciacchitano2021"
QUALITY = "elsinga2006"
PAPER = "zhu2024"
UNCERTAINTY = "sciacchitano2015"
OUTLIERS = "westerweel2005"
DIVERGENCE = "zhang1997"
SOURCES = {
    PIV4: 'C. J. Kähler et al., "Main results of the 4th International PIV Challenge", Exp. Fluids 57 (2016) 97, '
    "doi:10.1007/s00348-016-2173-1",
    LPT: 'A. Sciacchitano, B. Leclaire, A. Schröder, "Main results of the first Lagrangian Particle Tracking '
    'Challenge", 14th International Symposium on Particle Image Velocimetry (2021), https://onera-flow-benchmarks.fr',
    QUALITY: 'G. E. Elsinga, F. Scarano, B. Wieneke, B. W. van Oudheusden, "Tomographic particle image velocimetry", '
    "Exp. Fluids 41 (2006) 933-947, doi:10.1007/s00348-006-0212-z",
    PAPER: 'X. Zhu, C. Xu, M. M. Hossain, Y. Liu, B. C. Khoo, "Accurate weight coefficient estimation of multi-camera '
    'light field PIV through backpropagation neural network", Measurement (2024) 114096, '
    "doi:10.1016/j.measurement.2023.114096",
    UNCERTAINTY: 'A. Sciacchitano et al., "Collaborative framework for PIV uncertainty quantification: comparative '
    'assessment of methods", Meas. Sci. Technol. 26 (2015) 074004, doi:10.1088/0957-0233/26/7/074004',
    OUTLIERS: 'J. Westerweel, F. Scarano, "Universal outlier detection for PIV data", Exp. Fluids 39 (2005) 1096-1100, '
    "doi:10.1007/s00348-005-0016-6",
    DIVERGENCE: 'J. Zhang, B. Tao, J. Katz, "Turbulent flow measurement in a square duct with hybrid holographic PIV", '
    "Exp. Fluids 23 (1997) 373-381, doi:10.1007/s003480050124",
}
"""Sources by key."""


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A figure of merit."""

    key: str
    title: str
    unit: str
    """Unit: "voxel", "mm", "%", "s", ...; "1" for a ratio. Parts are stored as ratios and shown in percent."""
    text: str
    """Definition."""
    source: str = ""
    """Key of `SOURCES`; empty: defined here."""
    axes: bool = False
    """Whether there is one of each axis, with `_x`, `_y` and `_z` behind the key."""


VECTOR_FIGURES = (
    Figure(
        key="completeness",
        title="completeness",
        unit="%",
        text="Part of the measurable region, half a reference window inside the faces and outside walls, for which a "
        "kept vector stands. A vector on a lattice stands for its cell, at most a reference window wide.",
        source=LPT,
    ),
    Figure(
        key="error",
        title="mean error",
        unit="voxel",
        text="Mean length of measured minus true displacement, over the kept vectors in the measurable region. The "
        "truth is averaged over the result's window where it states one, else taken at the point.",
        source=PIV4,
    ),
    Figure(key="error_mm", title="mean error", unit="mm", text="The same in millimetres."),
    Figure(
        key="error_percent",
        title="mean error of the peak",
        unit="%",
        text="The same relative to the largest displacement in the measurable region.",
    ),
    Figure(key="rms", title="rms error", unit="voxel", text="Root mean square of those lengths.", source=PIV4),
    Figure(key="median", title="median error", unit="voxel", text="Median of those lengths."),
    Figure(
        key="error_point",
        title="error against the point value",
        unit="voxel",
        text="Mean length of measured displacement minus the true one at the point. It includes what a window averages "
        "away, so it compares windows of unlike size.",
    ),
    Figure(
        key="error_all",
        title="error with replaced vectors",
        unit="voxel",
        text="Mean error of all vectors that are numbers, also those that the result states as not valid.",
    ),
    Figure(
        key="error_interior",
        title="error inside",
        unit="voxel",
        text="Mean error of kept vectors a reference window and more inside the faces.",
    ),
    Figure(key="error_edge", title="error at edges", unit="voxel", text="Mean error of the other kept vectors."),
    *(
        Figure(
            key=f"error_at_{round(100 * part)}",
            title=f"error in {round(100 * part)} %",
            unit="voxel",
            text=f"Error that is not exceeded in {round(100 * part)} % of the measurable region"
            + (
                "; a gap counts as larger than any error, so nothing is gained by leaving out difficult vectors."
                if part == PARTS[0]
                else "."
            ),
        )
        for part in PARTS
    ),
    Figure(
        key="rms",
        title="rms error",
        unit="voxel",
        text="Root mean square of one component of the error.",
        source=PIV4,
        axes=True,
    ),
    Figure(
        key="slope",
        title="slope",
        unit="1",
        text="Slope of the straight line through measured against true components, least squares: 1 where fluctuations "
        "are measured in full. Not stated where the true component varies by less than 0.1 voxel.",
        axes=True,
    ),
    Figure(
        key="offset",
        title="offset",
        unit="voxel",
        text="Mean of measured minus true component, which is the line's height at the mean.",
        source=PIV4,
        axes=True,
    ),
    Figure(
        key="outliers",
        title="outliers kept",
        unit="%",
        text="Part of the kept vectors whose error exceeds a limit, 1 voxel where no other is stated.",
    ),
    Figure(
        key="outliers_normalised",
        title="outliers kept, normalised",
        unit="%",
        text=f"Part of the kept vectors whose error exceeds {OUTLIER_NORMALISED:g} times the sum of the median error "
        f"and {OUTLIER_FLOOR_VOXEL:g} voxel.",
        source=OUTLIERS,
    ),
    Figure(
        key="divergence",
        title="divergence",
        unit="%",
        text="Root mean square of the difference of the divergences of measured and true displacement, by central "
        "differences on the result's lattice where all neighbours are kept. In a flow without divergence that of the "
        "measured displacement.",
        source=DIVERGENCE,
    ),
    Figure(
        key="within_one",
        title="within one sigma",
        unit="%",
        text="Part of the components whose error is within one stated standard deviation; 68.3 % for normal errors.",
        source=UNCERTAINTY,
    ),
    Figure(key="within_two", title="within two sigma", unit="%", text="Within two; 95.4 %.", source=UNCERTAINTY),
    Figure(
        key="sigma_width",
        title="width of error over sigma",
        unit="1",
        text="Root mean square of error over stated standard deviation; above 1 where uncertainties are too small.",
        source=UNCERTAINTY,
    ),
    Figure(
        key="error_steady",
        title="steady error",
        unit="voxel",
        text="Root mean square over places of the error's mean over pairs or instants; of three and more with the same "
        "places.",
    ),
    Figure(
        key="error_unsteady",
        title="unsteady error",
        unit="voxel",
        text="Root mean square of what is left of the error when that mean is subtracted.",
    ),
    Figure(key="seconds", title="time", unit="s", text="Computing time of a pair, as stated; median of the pairs."),
    Figure(key="memory", title="memory", unit="MiB", text="Largest memory, as stated."),
)
"""Figures of vectors."""

PARTICLE_FIGURES = (
    Figure(
        key="found",
        title="particles found",
        unit="%",
        text=f"Part of the true particles in the volume that a found one matches, at most {MATCH_VOXEL:g} voxel away, "
        "one to one.",
        source=LPT,
    ),
    Figure(
        key="false", title="false particles", unit="%", text="Part of the found particles that match none.", source=LPT
    ),
    Figure(
        key="position",
        title="position error",
        unit="voxel",
        text="Root mean square of found minus true position of the matched particles.",
        source=LPT,
        axes=True,
    ),
    Figure(
        key="matched_error",
        title="displacement error of matched",
        unit="voxel",
        text="Mean length of the error of the matched particles' displacements.",
        source=LPT,
    ),
)
"""Figures of particles, beside those of vectors."""

VOLUME_FIGURES = (
    Figure(
        key="quality",
        title="Q",
        unit="1",
        text=f"Correlation of the volume with the true particles as blobs of {BLOB_VOXEL:g} voxel: "
        "sum(E E') / sqrt(sum(E^2) sum(E'^2)).",
        source=QUALITY,
    ),
    Figure(
        key="ghost_share",
        title="ghosts among peaks",
        unit="%",
        text="Part of the volume's peaks that match no true particle within a voxel.",
        source=QUALITY,
    ),
    Figure(
        key="ghosts",
        title="ghosts per particle",
        unit="1",
        text="Number of peaks that match no true particle, over the number of true particles.",
        source=PAPER,
    ),
)
"""Figures of volumes."""


def keys_of(figure: Figure) -> tuple[str, ...]:
    """Return the keys of a figure, three where there is one of each axis."""
    return tuple(f"{figure.key}_{axis}" for axis in "xyz") if figure.axes else (figure.key,)


def all_figures() -> tuple[Figure, ...]:
    """Return all figures in the order of tables."""
    return VECTOR_FIGURES + PARTICLE_FIGURES + VOLUME_FIGURES

"""Codes of the warnings, and their sentences for people."""

from __future__ import annotations

import enum
from collections.abc import Mapping


class Code(enum.Enum):
    """Kind of a warning; the value is stored in files and never changes."""

    # images of a pair
    SHIFTED = "shifted"
    OTHER_LATTICE = "other_lattice"
    MISPLACED = "misplaced"
    SATURATED = "saturated"
    TONE_CURVE = "tone_curve"
    UNEVEN = "uneven"
    DOUBLE = "double"
    STANDING = "standing"
    COPIED = "copied"
    DARK_PART = "dark_part"
    DIM = "dim"
    EMPTY = "empty"
    # white image and microlens array
    APERTURE = "aperture"
    LENS_PITCH = "lens_pitch"
    WHITE_SATURATED = "white_saturated"
    LENSES_UNLIT = "lenses_unlit"
    LENSES_DISTORTED = "lenses_distorted"
    LENSES_IRREGULAR = "lenses_irregular"
    # board and mapping
    BOARD_SATURATED = "board_saturated"
    BOARD_MISPLACED = "board_misplaced"
    BOARD_RENAMED = "board_renamed"
    BOARD_EDGE_UNSEEN = "board_edge_unseen"
    DOT_WIDTH = "dot_width"
    DOTS_MISSING = "dots_missing"
    FLIP_UNSTATED = "flip_unstated"
    PLANE_EMPTY = "plane_empty"
    PLANE_LEFT_OUT = "plane_left_out"
    PLANE_OFF = "plane_off"
    TURNED = "turned"
    MAGNIFIED = "magnified"
    MEDIUM = "medium"
    SCALES = "scales"
    FEW_LABELS = "few_labels"
    MAPPING_ERROR = "mapping_error"
    SMALL_DOTS = "small_dots"
    PUPIL_ZONE = "pupil_zone"
    # cameras and volume
    OUTSIDE_CALIBRATION = "outside_calibration"
    OUTSIDE_SIGHT = "outside_sight"
    SEEN_BY_ONE = "seen_by_one"
    ONE_CAMERA = "one_camera"
    LIGHT_GUARDED = "light_guarded"
    LIGHT_UNGUARDED = "light_unguarded"
    COARSE_VOXELS = "coarse_voxels"
    APART = "apart"
    MOVED_FRAMES = "moved_frames"
    NOTHING_IN_COMMON = "nothing_in_common"
    MISMATCHED = "mismatched"
    NOT_SELF_CALIBRATED = "not_self_calibrated"
    # weights
    WEIGHTS_UNCHECKED = "weights_unchecked"
    WEIGHTS_DIFFER = "weights_differ"
    # volumes and vectors
    DIVERGED = "diverged"
    UNEXPLAINED = "unexplained"
    NOT_JOINT = "not_joint"
    FEW_VALID = "few_valid"
    NOT_FOLLOWED = "not_followed"
    REPEATED = "repeated"
    OUT_OF_ORDER = "out_of_order"
    UNSEEDED = "unseeded"
    REVERSED = "reversed"
    STILL = "still"
    OTHER_SCALE = "other_scale"
    UNLIKE_PULSES = "unlike_pulses"
    FEW_VECTORS = "few_vectors"
    CROWDED = "crowded"
    UNLINKED = "unlinked"
    # the run
    TIME = "time"
    FEWER_WORKERS = "fewer_workers"
    ONE_GPU = "one_gpu"
    NO_LOCKS = "no_locks"
    OTHER = "other"
    """A code that this version does not know."""


_MISPLACED = (
    "light falls between the microimages of the white image. Is it of the same camera, focus, zoom and aperture, and "
    "are f_number and microlens_focal_length_mm right?"
)

SHIFTED_LIGHT = (
    "light lies {shift_px:.1f} px ({shift_pitch:.2f} microlens pitch) beside the microimages of the white image; {fit}"
)
"""Sentence on an image whose light lies beside the microimages."""
OTHER_LIGHT = "light does not follow the microimages of the white image; {fit}"
"""Sentence on an image whose light is that of another lattice."""
_INVALID = ". No vector from this image is valid"

SENTENCES: Mapping[Code, str] = {
    Code.SHIFTED: SHIFTED_LIGHT + _INVALID,
    Code.OTHER_LATTICE: OTHER_LIGHT + _INVALID,
    Code.MISPLACED: _MISPLACED,
    Code.SATURATED: (
        "{share:percent} % of the bright pixels are saturated; clipped particles make ghosts, lower the laser's "
        "power or the camera's gain"
    ),
    Code.TONE_CURVE: (
        "counts are not proportional to light, but to light after a gamma curve of about {exponent:.1f}. Record "
        "without gamma or another tone curve, or undo it before lfpiv reads the images"
    ),
    Code.UNEVEN: (
        "{parts:.0f} of 9 parts of the sensor are {ratio:g} times or more as bright in one frame as in the other; "
        "check the laser's pulses, the shutter, and whether counts of one frame are shifted by some bits"
    ),
    Code.DOUBLE: (
        "the {holding} frame shows the light of the {held} one at the same pixels, beside its own: both pulses of the "
        "laser are in one exposure, which draws displacements towards zero. Check the exposures of this camera against "
        "the pulses"
    ),
    Code.STANDING: "light stands still at {place}; it is {share:percent} % of an image's light: {remedy}",
    Code.COPIED: (
        "an image has the same pixels, all or nearly all, as an image of {noun} {first:.0f}, so the same light counts "
        "twice. Check particles.images, and what was copied"
    ),
    Code.DARK_PART: (
        "rows {top} to {bottom}, columns {left} to {right} show no particles where {others} would have them, although "
        "the white image is lit there: that part of the sensor is dark, or something stands before it. Look at the "
        "particle images; vectors there rest on the other views alone"
    ),
    Code.DIM: (
        "particles hardly rise above the noise (light of near pixels correlates by {structure:.2f}; clear images "
        "give 0.2 or more): displacements are biased towards zero. More light, more particles or larger windows help"
    ),
    Code.EMPTY: (
        "no particles, only noise in the image (light of near pixels correlates by {structure:.3f}; clear images "
        "give 0.2 or more): check laser, trigger and file. If fewer than two cameras saw particles, no vector of the "
        "pair is valid; otherwise do not rely on its vectors"
    ),
    Code.APERTURE: (
        "the microimages are {seen_px:.1f} px wide, not {stated_px:.1f} px as f_number = {f_number:g} and "
        "microlens_focal_length_mm = {microlens_focal_length_mm:g} imply; f_number = {fitting:.3g} would fit. Check "
        "both, and the aperture of all images."
    ),
    Code.LENS_PITCH: (
        "the microimages are {seen_px:.2f} px apart, not {stated_px:.2f} px as microlens_pitch_mm = "
        "{microlens_pitch_mm:g} and pixel_um = {pixel_um:g} imply; pixel_um = {fitting_um:.3g} or microlens_pitch_mm = "
        "{fitting_mm:.3g} would fit. Check both: magnification and aperture seem wrong where one of them is."
    ),
    Code.WHITE_SATURATED: (
        "{share:percent} % of the white image's bright pixels are saturated, so their response is not known; expose "
        "it to two thirds of the range."
    ),
    Code.LENSES_UNLIT: (
        "lens array: only {lit} of {count} microimages are lit; the others are extrapolated. Light the white image "
        "evenly if they show the volume."
    ),
    Code.LENSES_DISTORTED: (
        "lens array: the microimages leave their lattice by a smooth distortion of {rms_px:.3f} px rms, "
        "{largest_px:.3f} px at most; centres follow the lattice. The arrows in the report show where."
    ),
    Code.LENSES_IRREGULAR: "microimages lie {rms_px:.2f} px (rms) off a regular lattice; check the white image.",
    Code.BOARD_SATURATED: (
        "{share:percent} % of the bright pixels of {path} are saturated and left out, so the dots are measured less "
        "accurately; expose the board to two thirds of the range."
    ),
    Code.BOARD_MISPLACED: "{path}: " + _MISPLACED,
    Code.BOARD_RENAMED: (
        "the board's dots were renamed by {columns} columns and {rows} rows to match its outline. Look at the pictures "
        "of lfpiv check: the names are wrong if an edge of the board is hidden"
    ),
    Code.BOARD_EDGE_UNSEEN: (
        "no edge of the board is in view along {axis} ({count} dots, {stated} stated): their numbers are right only "
        "if the camera's axis meets the board within half a spacing ({half_spacing_mm:g} mm) of its middle"
    ),
    Code.DOT_WIDTH: (
        "the board's dots look {seen_mm:.3g} mm wide, not {stated_mm:.3g} mm; the calibration takes what is seen. "
        "Check board.dot_diameter_mm, focus and exposure. If the lens bends its outer rays, use a higher f-number"
    ),
    Code.DOTS_MISSING: (
        "only {found} of {expected} board dots in the field were found; check focus, exposure and the planes listed "
        "in the report.{hint}"
    ),
    Code.FLIP_UNSTATED: (
        "image_flip is not stated, and cameras along the depth axis do not show whether pictures are mirrored: the "
        "pictures of {cameras} are read as mirrored left to right, so x points left in them. Set image_flip = "
        '"horizontal" if they show the scene as it is seen, "none" if they are mirrored'
    ),
    Code.PLANE_EMPTY: (
        "no dot was found in plane {plane} of the board (z = {z_mm:g} mm), {path}: look at the image, and check that "
        "place in board.planes_mm; the calibration does not use it."
    ),
    Code.PLANE_LEFT_OUT: (
        "{left_out} of {seen} dots of plane {plane} of the board (z = {z_mm:g} mm) do not fit the others and are "
        "left out: check that place in board.planes_mm, and {path}."
    ),
    Code.PLANE_OFF: (
        "plane {plane} of the board stands at z = {fitted_mm:.3f} mm, not at {z_mm:g} mm, shifted by {x_mm:.3f} and "
        "{y_mm:.3f} mm along x and y and tilted by {tilt_deg:.2f} degrees, as its dots show; the calibration corrects "
        "it. Check that place in board.planes_mm, and the stage."
    ),
    Code.TURNED: (
        "the board's dots show the camera turned by {turn_deg:.0f} degrees from where it is stated to be, {nominal}. "
        "Are its pictures turned by 90 degrees? Then x and y are exchanged; otherwise check its nominal orientation."
    ),
    Code.MAGNIFIED: (
        "the board's dots are magnified {magnification:.3f} times, not {stated:g} times as stated. Check "
        "magnification, and board.spacing_mm and board.planes_mm: all lengths and velocities depend on those two."
    ),
    Code.MEDIUM: (
        "the board looks {depth:.2f} times as deep as stated. That is right in a medium of the refractive index "
        "{index:.2f}, such as water (1.33), and the calibration holds. Otherwise check board.planes_mm, "
        "focal_length_mm and f_number: depth and w depend on the planes."
    ),
    Code.SCALES: (
        "the board's planes and dots contradict each other: {found}. {remedy}. Velocities are wrong by as much"
    ),
    Code.FEW_LABELS: (
        "{dots} dots give the network {values} values for its {parameters} parameters, so it can be wrong between "
        "the dots; use more dots or planes, or fewer nodes (network.hidden)."
    ),
    Code.MAPPING_ERROR: (
        "the mapping is {sigma_nor:.3f} pitch off (sigma_nor), {usual:g} and less is usual; use more dots or planes, "
        "and check the board's images."
    ),
    Code.SMALL_DOTS: (
        "the light of {share:percent} % of the dots stays within one microlens from side to side, which does not show "
        "where in the microlens they lie: the mapping may be off by more than is stated. Use dots of {diameter_mm:.2g} "
        "mm or more (microlens_pitch_mm / |magnification|)."
    ),
    Code.PUPIL_ZONE: (
        "the dots' light lies up to {off_pitch:.3f} pitch beside the fitted rays, most at ({u:.1f}, {v:.1f}) pupil "
        "radii (u, v): the lens bends rays in a way that the calibration does not follow. The stated error has it; "
        "an f-number above {f_number:g} lowers it."
    ),
    Code.OUTSIDE_CALIBRATION: (
        "{share:percent} % of the volume lies outside the calibrated region ({region} mm), by up to "
        "{distance_mm:.2f} mm: {advice}."
    ),
    Code.OUTSIDE_SIGHT: (
        "sees only about {share:percent} % of the volume. Check volume.centre_mm and volume.size_mm, or turn the camera"
    ),
    Code.SEEN_BY_ONE: (
        "about {share:percent} % of the volume is seen by fewer than two cameras; vectors there are not valid: {where}"
    ),
    Code.ONE_CAMERA: (
        "one camera hardly resolves depth: do not rely on velocities along its line of sight (w, displacement_z for a "
        "camera on the z axis), nor on their validation; vectors from single particles resolve it better: seed thinly, "
        'and leave tracking.vectors at "auto"'
    ),
    Code.LIGHT_GUARDED: (
        "particles are lit beyond the face {face} of the volume, up to {reach_mm:.2g} mm ({share:percent} % of the "
        "volume's light): guard layers of {guard_mm:.2g} mm are reconstructed there and cut away. A sheet within the "
        "volume leaves fewer ghosts"
    ),
    Code.LIGHT_UNGUARDED: (
        "particles are lit beyond the face {face} of the volume, {reach_mm:.2g} mm or more ({share:percent} % of the "
        "volume's light), farther than the guard layers of {guard_mm:.2g} mm: their light falls into the volume and "
        "biases vectors near its faces; {reason}"
    ),
    Code.COARSE_VOXELS: (
        "particles of {size:.2f} voxel demand that voxels of {demanded_mm:.3g} mm are reconstructed, the memory allows "
        "{used_mm:.3g} mm: expect more ghosts; raise compute.memory_gib or shrink volume.size_mm"
    ),
    Code.APART: "{names} show the same particles {voxel:.1f} voxel ({mm:.3f} mm) apart: {cause}; {advice}.",
    Code.MOVED_FRAMES: (
        "beside the other cameras, the second frames show the particles {voxel:.1f} voxel from where the first frames "
        "show them, {lenses:.1f} microlenses in the image: the camera moved between its exposures, or {cause}. Vectors "
        "are wrong by about as much; compare both frames of the camera where nothing moves"
    ),
    Code.NOTHING_IN_COMMON: (
        "{names} show no particles in common within {search} voxels, so no vector is valid: particles are lit outside "
        "the volume (volume.centre_mm), a camera moved by more, or their images are of different instants or show very "
        "few particles."
    ),
    Code.MISMATCHED: "{found}, as the particles show, so no vector is valid. {remedy}, and run again.",
    Code.NOT_SELF_CALIBRATED: (
        "self-calibration keeps the calibration of the board: {verdict}. Check the particle images, use more pairs "
        "(self_calibration.pairs), or record the board again if a camera moved."
    ),
    Code.WEIGHTS_UNCHECKED: (
        "sees none of the voxels drawn at random to check its weights against counted rays: they are unchecked. "
        "Check the volume's place and size against what the camera sees"
    ),
    Code.WEIGHTS_DIFFER: (
        "weights as {form} differ from counted rays by {mean:percent1} % (worst voxel {worst:percent1} %), the aim "
        "is {aim_mean:percent} % ({aim_worst:percent1} %). Cause: {cause} (rays depart from third order by "
        "{bent_pitch:.2f}, a voxel's edge is {wide_pitch:.1f} microlens pitch)"
    ),
    Code.DIVERGED: "SMART: {verdict}",
    Code.UNEXPLAINED: (
        "the volumes explain little of the images' light (residual {residual:.2f}; 0.3 to 0.6 is usual): do not rely "
        "on their vectors. Check the names of the files, the trigger, and whether a camera moved"
    ),
    Code.NOT_JOINT: "no joint fit, vectors of the correlation: {verdict}",
    Code.NOT_FOLLOWED: (
        "the particles are not where the instant before and the flow put them (the misfit is {ratio:.2f} times that of "
        "particles in other places), so the volume starts from its images alone. Check the laser's pulses, and whether "
        "images are missing or the flow changed"
    ),
    Code.REPEATED: (
        "the image of {camera} is the one of instant {before}, pixel by pixel, so the volume starts from its images "
        "alone. Check the recording for repeated images"
    ),
    Code.OUT_OF_ORDER: (
        "the images before and after it are more like each other than like it: images of this camera are out of order "
        "or repeated, and vectors there are wrong. Check the numbers of its images"
    ),
    Code.FEW_VALID: "{share:percent} % of the vectors are valid; {verdict}",
    Code.TIME: (
        "the recording says that the two frames of a vector are {recorded} apart, dt_s says {stated}. Velocities are "
        "wrong by the ratio of the two if dt_s is wrong: correct it"
    ),
    Code.UNSEEDED: (
        "{share:percent} % of the volume holds no particles; {lost:percent} % of the vectors are not valid for this "
        "reason. Where there is no fluid, state a mask (volume.mask, volume.solid)"
    ),
    Code.REVERSED: (
        "the flow runs against {others}: unless it turned, the frames of a pair are exchanged in every camera. Check "
        "the order of its images"
    ),
    Code.STILL: (
        "particles move by at most {voxel:.2g} voxel, which is hardly told from rest: unless the fluid rests, both "
        "frames show the same exposure, or the time between them is too short. Compare both frames"
    ),
    Code.OTHER_SCALE: (
        "the counts relative to {others} are about {ratio:.0f} times as {how} as in the other pairs: gain, exposure, "
        "or the scale of the files changed. Each camera's scale is divided out in every pair, up to 25 times"
    ),
    Code.UNLIKE_PULSES: (
        "second frames are {ratio:.2f} times as bright, relative to first frames, as those of {other}, although all "
        "cameras see the same pulses. If light of first frames stays on the sensor (afterglow), displacements are "
        "wrong. Record with the second pulse blocked: second frames must be dark. Unlike exposures do no harm"
    ),
    Code.FEW_VECTORS: (
        "few vectors: {counts}; derivatives need {least:.0f} along each axis, so report, exports and lfpiv.derived are "
        "without vorticity, Q-criterion, divergence and strain rate. They need {advice} (correlation.windows, "
        "volume.size_mm, volume.voxel_mm)"
    ),
    Code.CROWDED: (
        "too few cameras see {share:percent} % of the particles without the image of another one over half of theirs "
        "({limit:percent} % is the limit; {per_microlens:.2g} particles per microlens were found): some particles are "
        "missed and some found are none. Rely on the correlation, or use less seeding"
    ),
    Code.UNLINKED: (
        "{share:percent} % of the particles found in a frame have a partner in the other one (usual are more than "
        "{limit:percent} %): many of them may be no particles, or have left the volume. Widen the guard "
        "layers (volume.guard_mm) if particles are lit beyond the volume, or use less seeding"
    ),
    Code.FEWER_WORKERS: (
        "{fits} {noun} instead of {planned}: each takes {each_gib:.1f} GiB of memory, in addition to "
        "{weights_gib:.1f} GiB of weights. Results are the same"
    ),
    Code.ONE_GPU: (
        "one of {gpus} GPUs is used: several processes need the package `distributed`. Install it: pip install "
        "'lfpiv[distributed]'"
    ),
    Code.NO_LOCKS: "this file system has no file locks: do not start a second run on this folder",
    Code.OTHER: "{text}",
}
"""Sentence of each code, with its figures in braces. Shares have the format `percent` or `percent1`."""

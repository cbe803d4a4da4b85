"""Orientations of a camera of which nothing is known, from the lattice of dots in a view through a part of its pupil.

Through a small part of the pupil dots are sharp at any depth. The two plane waves that fit the blobs of such a view
give the matrix from board to picture. Its singular values are 1 and the cosine of the board's tilt, so it is the corner
of two rotations: the board is tilted one way or the other.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np
from scipy import ndimage

from lfpiv.calibration.board.dots import DotBoard
from lfpiv.calibration.board.planes import Signals
from lfpiv.calibration.board.pose import Blobs, CameraPose, Rectifier
from lfpiv.geometry.optics import Optics
from lfpiv.geometry.orientation import Orientation
from lfpiv.lightfield.decoder import LightFieldDecoder

PUPIL = 0.4
"""Radius of the part of the pupil that the view is taken through, as a share of the pupil's radius."""
SHORTEST, LONGEST = 0.17, 1.12
"""Limits of the matrix's singular values: the cosine of the steepest tilt, and the largest error of a magnification."""
WAVES, CANDIDATES = 12, 4
"""Number of plane waves that are paired, and of pairs that are tried."""
REACH_SPACINGS = 6.0
"""Standard deviation of the blobs' weight about the middle of the view; further away perspective bends the waves."""
FEWEST_BLOBS = 6
"""Least number of blobs of a view."""
APART_LENSES = 1.2
"""Least distance of blobs in the view [microlens]."""


def rotations_of(corner: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the rotations whose upper left part, (2, 2), is nearest to a matrix: two, or one for a board seen head-on.

    The camera is on the side of +z where the matrix's determinant is positive.
    """
    left, size, right = np.linalg.svd(corner)
    cosine = min(float(size[1] / size[0]), 1.0)
    sine = np.sqrt(1 - cosine**2)
    part = left @ np.diag([1, cosine]) @ right
    for sign in (1, -1) if sine > 0 else (1,):
        side = sign * sine * left[:, 1:]  # third column: the rows of a rotation are unit vectors normal to each other
        upper = np.hstack([part, side])
        yield np.vstack([upper, np.cross(upper[0], upper[1])])


def plans_without_pose(signals: Signals, decoder: LightFieldDecoder, board: DotBoard, plane: int) -> list[CameraPose]:
    """Return poses of a camera on the side of +z that may explain the lattice in the image of a plane, best first.

    The lattice's directions are arbitrary. Empty if the image shows no lattice.
    """
    optics = decoder.optics
    frontal = CameraPose.from_plan(optics, Orientation(0.0))
    half = np.array(optics.sensor_shape[::-1]) * optics.pixel_mm / abs(optics.magnification) / 2
    cell = optics.microlens_pitch_mm / abs(optics.magnification)
    rectify = Rectifier(decoder, (float(half[0]), float(half[1])), board.diameter_mm, pupil_share=PUPIL)
    view = rectify(signals.of_plane(plane), frontal, 0.0)
    corners: list[tuple[float, np.ndarray]] = []
    for sign in (1, -1):
        blobs = view.peaks(APART_LENSES * cell, sign)
        if blobs.strong.sum() >= FEWEST_BLOBS:
            strong = Blobs(blobs.position_mm[blobs.strong], blobs.contrast[blobs.strong])
            corners += _corners(strong, board.spacing_mm, cell)
    corners.sort(key=lambda found: -found[0])
    return [_plan(optics, rotation) for _, corner in corners[:CANDIDATES] for rotation in rotations_of(corner)]


def _plan(optics: Optics, rotation: np.ndarray) -> CameraPose:
    nominal = (abs(optics.magnification), optics.object_distance_mm)
    return CameraPose(parameters=9 * (0.0,), nominal_rotation=rotation, nominal=nominal)


def _corners(blobs: Blobs, spacing_mm: float, cell_mm: float) -> list[tuple[float, np.ndarray]]:
    """Return matrices from board to picture that fit the blobs, each with the power of its waves."""
    position = blobs.position_mm - np.median(blobs.position_mm, axis=0)
    weight = np.minimum(blobs.contrast, 3 * np.median(blobs.contrast))
    weight = weight * np.exp(-0.5 * (position**2).sum(1) / (REACH_SPACINGS * spacing_mm) ** 2)
    weight /= weight.sum()
    spread = float(np.sqrt(weight @ (position**2).sum(1) / 2))
    largest = min(1 / SHORTEST / spacing_mm, 0.5 / cell_mm * 1.2)
    step = 0.15 / max(spread, spacing_mm)
    along = np.arange(0, largest + step, step)
    across = np.concatenate([-along[:0:-1], along])
    first = np.exp(2j * np.pi * np.multiply.outer(across, position[:, 0]))
    second = np.exp(2j * np.pi * np.multiply.outer(along, position[:, 1]))
    power = np.abs((first * weight) @ second.T)  # of the waves (across, along)
    norm = np.hypot(across[:, None], along[None])
    top = (power == ndimage.maximum_filter(power, 3)) & (norm > 1 / LONGEST / spacing_mm) & (norm < largest)
    top[: len(along), 0] = False  # opposite to another wave
    at = np.argwhere(top)
    at = at[np.argsort(-power[tuple(at.T)], kind="stable")][:WAVES]
    waves = [_refined(np.array([across[i], along[j]]), position, weight, step) for i, j in at]
    found = []
    for (p, one), (q, two) in combinations(waves, 2):
        inverse = np.stack([one, two])
        if abs(np.linalg.det(inverse)) < 1e-9 * norm.max() ** 2:
            continue
        corner = np.linalg.inv(inverse) / spacing_mm
        if np.linalg.det(corner) < 0:
            corner = corner * (1, -1)
        large, small = np.linalg.svd(corner, compute_uv=False)
        if small > SHORTEST and 1 / LONGEST < large < LONGEST:
            found.append((min(p, q) - abs(np.log(large)), corner))
    found.sort(key=lambda pair: -pair[0])
    return found[:CANDIDATES]


def _refined(wave: np.ndarray, position: np.ndarray, weight: np.ndarray, step: float) -> tuple[float, np.ndarray]:
    """Return the power and the place of the maximum near a wave vector."""

    def power(at: np.ndarray) -> float:
        return float(np.abs(np.exp(2j * np.pi * position @ at) @ weight))

    best, at = power(wave), wave
    while step > 1e-3 * np.hypot(*wave):
        around = [at + step / 2 * np.array(move) for move in ((1, 0), (-1, 0), (0, 1), (0, -1))]
        values = [power(place) for place in around]
        if max(values) > best:
            best, at = max(values), around[int(np.argmax(values))]
        else:
            step /= 2
    return best, at

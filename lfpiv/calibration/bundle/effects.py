"""Unknown errors of a board: which of them the labels can show, and how they displace the dots."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from lfpiv.calibration.board.dots import DotBoard
from lfpiv.calibration.board.errors import COMPONENTS, KINDS
from lfpiv.lightfield.decoder import NORMAL_MAD

LEAST_PLANES = 3
"""Least number of planes. Two planes show no error that a sheared world does not show."""
OFF = 2.5
"""A plane has no part in the choice of the world if it is farther off than this in the world of the majority [robust
standard deviation of its planes]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Effects:
    """Unknown errors of the board: coefficients of bases without what a moved or sheared world shows as well."""

    kind: np.ndarray  # each unknown's kind, of `KINDS`, (size,)
    plane: np.ndarray  # errors of the planes per unknown, (plane, 6, size)
    site: np.ndarray  # errors of the dots along x and y per unknown [mm], (site, 2, size)
    used_planes: np.ndarray  # planes with dots, (plane,), bool
    used_sites: np.ndarray  # sites with dots, (site,), bool

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return len(self.kind)

    @classmethod
    def from_dots(cls, board: DotBoard, dot: np.ndarray) -> Effects | None:
        """Return the unknowns that the dots can show; None if there are too few planes."""
        planes, sites = (np.unique(part) for part in np.divmod(dot, board.size))
        if len(planes) < LEAST_PLANES:
            return None
        depth = np.array(board.planes_mm, float)[planes]
        line = np.stack([np.ones(len(planes)), depth - depth.mean()], axis=1)
        shifts, rotations = _complement(line), _complement(line[:, :1])
        place = board.points_mm(0)[sites, :2]
        scatter = _complement(np.hstack([np.ones((len(sites), 1)), place]))
        bases = [(c, kind, shifts if c < 3 else rotations) for kind, part in COMPONENTS.items() for c in part]
        bases.sort(key=lambda entry: list(KINDS).index(entry[1]))
        size = sum(basis.shape[1] for _, _, basis in bases) + 2 * scatter.shape[1]
        plane, site = np.zeros((len(board.planes_mm), 6, size)), np.zeros((board.size, 2, size))
        kinds: list[str] = []
        for component, kind, basis in bases:
            plane[planes, component, len(kinds) : len(kinds) + basis.shape[1]] = basis
            kinds += [kind] * basis.shape[1]
        for axis in range(2):
            site[sites, axis, len(kinds) : len(kinds) + scatter.shape[1]] = scatter
            kinds += ["dots"] * scatter.shape[1]
        return cls(
            kind=np.array(kinds), plane=plane, site=site,
            used_planes=np.isin(np.arange(len(plane)), planes), used_sites=np.isin(np.arange(len(site)), sites),
        )  # fmt: skip

    def as_most_planes(self, values: np.ndarray, depth: np.ndarray) -> Effects:
        """Return the unknowns with the moved world chosen in which most planes stand where they are stated to be.

        Least squares would move the world towards a single plane that is far off. So planes that are off in the world
        of the majority are left out of them ([1]_).

        References
        ----------
        .. [1] P. J. Rousseeuw and A. M. Leroy, "Robust Regression and Outlier Detection", Wiley (1987), chapter 5.
        """
        plane = self.plane.copy()
        used = self.used_planes
        for component in range(6):
            line = np.stack([np.ones(used.sum()), depth[used]], axis=1)[:, : 2 if component < 3 else 1]
            basis = self.plane[used, component]
            weighted = line * _agreeing(line, basis @ values)[:, None]
            share = np.linalg.solve(weighted.T @ line, weighted.T)
            plane[used, component] = basis - line @ (share @ basis)
        return replace(self, plane=plane)

    def displacement(self, board: DotBoard, dot: np.ndarray) -> np.ndarray:
        """Return the displacement of dots per unknown [mm], shape (n, 3, size)."""
        plane, site = np.divmod(dot, board.size)
        x, y = board.points_mm(0)[site, :2, None].transpose(1, 0, 2)
        error = self.plane[plane]
        moved = error[:, :3].copy()
        moved[:, :2] += self.site[site]
        moved[:, 0] -= error[:, 5] * y
        moved[:, 1] += error[:, 5] * x
        moved[:, 2] += error[:, 3] * y - error[:, 4] * x
        return moved


def _agreeing(line: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return which planes stand where they are stated to be, in the world in which most of them do so best, bool.

    Through as few planes as determine a world, all worlds are tried. With three planes none of them is the majority,
    and all count.
    """
    planes, terms = line.shape
    some = np.array(list(combinations(range(planes), terms)))
    worlds = np.linalg.solve(line[some], error[some][..., None])[..., 0]
    rest = np.abs(error - worlds @ line.T)
    typical = np.partition(rest, (planes + terms - 1) // 2, axis=1)[:, (planes + terms - 1) // 2]
    best = int(typical.argmin())
    scatter = NORMAL_MAD * (1 + 5 / (planes - terms)) * typical[best]
    return np.asarray(rest[best] <= max(OFF * scatter, np.finfo(float).tiny))


def _complement(columns: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis of the vectors orthogonal to columns."""
    left, strength, _ = np.linalg.svd(columns)
    rank = int((strength > 1e-9 * strength[0]).sum())
    return left[:, rank:]

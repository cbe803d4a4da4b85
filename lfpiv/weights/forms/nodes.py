"""Nodes on planes across a camera's line of sight, whose weights stand for those of all voxels.

Along its line of sight a point's image changes slowly: a ray through the pupil's edge moves by a sixteenth of the way
at f/4 and unit magnification. So the image of a voxel is interpolated between those of nodes on planes several layers
apart, at the places where its line of sight meets the planes: W = V R with the nodes' weights V, and R of
`lfpiv_kernels.reconstruction.depth_planes`. This is the factorisation of shear and warp [1]_, here with an image of
the optics per node. It needs a third of the weights, and of the time of a projection. `choose_nodes` takes the widest
distance of planes with which images of voxels agree with their own footprints.

Images of voxels change fast across the line of sight. So nodes lie whole voxels aside from one another where a lattice
direction is near: 0 or 45 degrees from an axis, up to some degrees beside it. Then nothing is interpolated across the
line of sight. Where none is near along an axis across it, nodes lie along the line of sight itself, and voxels are
first shared among lines of sight along this axis, see `lfpiv.weights.forms.line_shares`. Images of single voxels are
not the same then, but those of particles are, up to the steps that voxels have at their edges. These are compared
instead.

.. [1] P. Lacroute, M. Levoy, "Fast volume rendering using a shear-warp factorization of the viewing transformation",
   SIGGRAPH 1994, 451-458, doi:10.1145/192161.192283.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import sparse

from lfpiv.progress import StepProgress
from lfpiv.weights.blocks import WHOLE, Cuts, Places
from lfpiv.weights.counting import draw_seen
from lfpiv.weights.forms.form import Form
from lfpiv.weights.forms.image_errors import (
    PARTICLE_ERROR,
    PARTICLE_VOXEL,
    PARTICLES,
    SEEDS,
    WORST_PARTICLE_ERROR,
    Sample,
    blobs_about,
)
from lfpiv.weights.forms.node_grid import NodeGrid, slopes_of
from lfpiv.weights.forms.voxels import Voxels
from lfpiv.weights.stored_grid import StoredGrid
from lfpiv_kernels.reconstruction.depth_planes import PlaneShares
from lfpiv_kernels.reconstruction.node_projector import NodeProjector
from lfpiv_kernels.reconstruction.weight_blocks import Blocks

if TYPE_CHECKING:
    from lfpiv.calibration.camera import CalibratedCamera

log = logging.getLogger(__name__)

DISTANCES: tuple[int, ...] = (10, 8, 7, 6, 5, 4, 3, 2)
"""Distances of planes that are tried, widest first [layer of voxels]."""
VOXEL_ERROR, WORST_VOXEL_ERROR = 0.015, 0.03
"""Largest root mean square, and largest, of the relative L2 differences of voxels' interpolated images from their own
ones: for points and particles of unknown size."""
FARTHEST_ASIDE = 1.0
"""Rows or columns by which a line of sight may leave its nodes from one plane to the next. From 0.6 on images no longer
agree."""
LEAST_GAIN = 1.5
"""Least ratio of voxels to nodes with which nodes are used."""
NEAR_LATTICE = 0.02
"""Difference of the line of sight from a lattice direction up to which voxels are not shared [voxel/layer]."""
FEWEST_VOXELS = 100_000
"""Voxels of a volume from which on nodes are used. The weights of smaller ones take little time and memory."""


class Nodes(Voxels):
    """Weights of nodes, among which voxels are shared. They suit single cameras."""

    projector = NodeProjector
    parts = (Blocks, PlaneShares)
    count_errors = staticmethod(Form.count_errors)

    @property
    def suits(self) -> Sequence[str]:
        """Cameras whose images are accurate by fewer nodes than voxels."""
        return tuple(self._nodes)

    @cached_property
    def _nodes(self) -> dict[str, NodeGrid]:
        """Nodes of each camera that they suit."""
        rig, found = self.rig, dict[str, NodeGrid]()
        for name in self.names if rig.shared else ():
            choice = rig.choice(name)
            nodes = choose_nodes(self.stored, rig.cameras[name], choice.form, choice.cuts, rig.particle_voxel)
            if nodes is not None:
                found[name] = nodes
        return found

    def _places(self, name: str) -> Places:
        """Return the nodes."""
        return self._nodes[name]

    def _build_parts(self, name: str, progress: StepProgress, allow: Callable[[int], None]) -> tuple[Any, ...]:
        """Return the weights of the nodes, and the voxels' shares."""
        return (*super()._build_parts(name, progress, allow), self._nodes[name].shares)


def choose_nodes(
    stored: StoredGrid, camera: CalibratedCamera, form: str, cuts: Cuts = WHOLE, particle_voxel: float = 0.0
) -> NodeGrid | None:
    """Choose the nodes of a camera: the fewest whose images are accurate enough.

    Parameters
    ----------
    form : {"profiles", "pixels"}
        Form of the weights.
    cuts : tuple of int
        Parts of a voxel along x, y, z.
    particle_voxel : float
        Standard deviation of the particles [voxel]; 0 for points and where it is unknown. From `PARTICLE_VOXEL` on
        images of particles count in place of those of voxels, and voxels may be shared among lines of sight.

    Returns
    -------
    NodeGrid or None
        None if the weights of all voxels are to be stored.
    """
    if stored.grid.size < FEWEST_VOXELS:
        return None
    seen = np.unique(np.concatenate([draw_seen(stored, camera, seed) for seed in SEEDS]))
    if not len(seen):
        return None
    slopes = slopes_of(stored, camera)[1]
    aside, ways = np.abs(slopes - np.rint(slopes)), _ways_to_share(slopes)
    if particle_voxel >= PARTICLE_VOXEL:
        kind, largest, worst = "particles", PARTICLE_ERROR, WORST_PARTICLE_ERROR
        sample = Sample(camera, *blobs_about(stored, seen[:: len(seen) // PARTICLES + 1]), form, cuts)
    else:
        kind, largest, worst, ways = "voxels", VOXEL_ERROR, WORST_VOXEL_ERROR, ways[:1]
        sample = Sample(camera, seen[:, None], np.ones((len(seen), 1)), form, cuts)
    own, chosen = sample.own_images(stored), None
    for lines in ways:
        kept = aside[~np.array(lines)].max(initial=0)
        for distance in (one for one in DISTANCES if one * kept <= FARTHEST_ASIDE):
            nodes = NodeGrid.for_camera(stored, camera, distance, lines=lines)
            if LEAST_GAIN * nodes.size > stored.grid.size or (chosen is not None and nodes.size >= chosen.size):
                break
            errors = interpolation_errors(nodes, sample, own)
            error = float(np.sqrt(np.mean(np.square(errors))))
            if error <= largest and max(errors) <= worst:
                text = "%s: planes %d layers apart, shared along (rows, columns) %s: images of %s differ by %.1f %%"
                log.debug(text, camera.name, distance, lines, kind, 100 * error)
                chosen = nodes
                break
    return chosen


def _ways_to_share(slopes: np.ndarray) -> list[tuple[bool, bool]]:
    """Return along which of rows and columns to share voxels: neither, where a lattice direction is farther, both.

    Shares among lines of sight that move slowly are the least accurate, so one axis alone is often better than both.
    """
    aside = np.abs(slopes - np.rint(slopes))
    along_rows = bool(aside[0] > aside[1])
    ways = [(False, False), (along_rows, not along_rows), (True, True)]
    return ways[: 1 + int((aside > NEAR_LATTICE).sum())]


def interpolation_errors(nodes: NodeGrid, sample: Sample, own: list[sparse.csr_array]) -> list[float]:
    """Compare interpolated images of groups of voxels with those from their own footprints.

    Parameters
    ----------
    sample : Sample
        The groups of voxels.
    own : list of csr_array
        Their images, from `Sample.own_images`.

    Returns
    -------
    list of float
        Relative L2 difference of each group that the camera sees; infinity alone if it sees none.
    """
    errors: list[float] = []
    for part, exact in zip(sample.parts, own, strict=True):
        voxels, light = sample.voxels[part], sample.light[part]
        found = [nodes.shares.nodes_of(int(voxel)) for voxel in voxels.ravel()]
        used, place = np.unique(np.concatenate([node for node, _ in found]), return_inverse=True)
        shares = np.concatenate(
            [brightness * share for brightness, (_, share) in zip(light.ravel(), found, strict=True)]
        )
        first = np.cumsum([0, *(len(node) for node, _ in found)])[:: voxels.shape[1]]
        of_nodes = sparse.csr_array((shares, place, first), (len(voxels), len(used)))
        apart = exact - sample.images(nodes.centres_mm(used), nodes.voxel_mm, of_nodes)
        norms, differences = (np.sqrt(one.power(2).sum(axis=1)) for one in (exact, apart))
        errors += (differences[norms > 0] / norms[norms > 0]).tolist()
    return errors or [math.inf]

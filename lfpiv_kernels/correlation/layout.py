"""Structures that the correlation's kernels share: where voxels, statistics and sums lie in memory.

Neighbouring windows are the lanes of a vector. A layer of windows or blocks is numbered by lane: the one at row ky and
column kx is lane ``ky * pitch + kx``. Each row ends with padding lanes, so a neighbour lies at a fixed distance in
lanes. Volumes are stored by phase, ``[plane, y % stride, x % stride, lane]``: at any offset from a window's corner, the
voxels of neighbouring windows are neighbours in memory.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import warp as wp

from lfpiv_kernels.correlation.plan import LANES, Plan, Triple, whole_groups
from lfpiv_kernels.transfer import to_device


@wp.struct
class Phased:
    """Voxels stored by phase."""

    values: wp.array(dtype=float)
    along_y: wp.array(dtype=int)  # distance in memory for each offset along y and x [voxel]
    along_x: wp.array(dtype=int)
    plane: int  # elements per plane


@wp.struct
class Statistics:
    """Statistics of windows at every lag, stored by phase."""

    mean: wp.array(dtype=float)
    scale: wp.array(dtype=float)  # 1 / sqrt(sum of squared deviations), 0 where there is no signal
    along_y: wp.array(dtype=int)  # as in `Phased`, the offsets being lags
    along_x: wp.array(dtype=int)
    plane: int
    centre: wp.vec3i  # index of lag 0


@wp.struct
class Lattice:
    """Windows or blocks of a volume, and the phases stored of it; triples in the order (z, y, x)."""

    corner: wp.vec3i  # voxel of plane 0, phase (0, 0), lane 0
    stride: wp.vec3i  # distance of windows or blocks [voxel]
    phases: wp.vec3i  # offsets stored per axis, at most `stride`
    planes: int
    pitch: int  # lanes per row
    lanes: int  # lanes per phase


@wp.struct
class Extent:
    """A volume with zeros around it, and the windows that fit; triples in the order (z, y, x)."""

    shape: wp.vec3i  # of the volume
    margin: wp.vec3i  # zeros on either side
    window: wp.vec3i
    factors: wp.vec2i  # of the window's edges along y and x


@wp.struct
class Layers:
    """Layers of blocks whose sums of products a launch forms, (layer, lag, lane)."""

    block: wp.vec3i  # edges of a block [voxel]
    stride: wp.vec3i  # distance of blocks [voxel]
    lags: wp.vec3i  # lags per axis
    begin: int  # first layer
    ring: int  # layers that the sums have memory for: layer i lies at i % ring
    groups: int  # groups of lanes, each of which is a task
    group: int  # lanes per group
    lanes: int  # lanes per lag


@wp.struct
class Sums:
    """Sums of products of blocks, (layer, lag, lane)."""

    ahead: wp.array(dtype=float)  # of blocks of the first volume
    behind: wp.array(dtype=float)  # of blocks of the second volume: lags count backwards
    symmetric: int  # 1: average both; 0: `behind` is not read


@wp.struct
class Windows:
    """Windows whose peaks a launch finds, and the memory of their sums, coefficients and peaks."""

    voxels: int  # in a window
    blocks: wp.vec3i  # blocks per window and axis that are still to be added up
    block_step: int  # layers of blocks from one layer of windows to the next
    stride: int  # distance of layers of blocks [voxel]
    reach: int  # lags around the highest coefficient that belong to its peak
    lags: wp.vec3i
    begin: int  # first layer of windows
    ring: int  # layers of blocks that the sums have memory for: layer i lies at i % ring
    groups: int  # groups of lanes
    group: int  # lanes per group: a multiple of `LANES` on the CPU, 1 on CUDA
    pitch: int  # lanes per row
    lanes: int  # lanes per lag
    slot_pitch: wp.int64  # elements of scratch memory per slot
    score_pitch: int  # elements from one lag's coefficients to the next; on a GPU from one window's to the next
    peak_pitch: wp.int64  # elements per value of the peaks


@dataclass(frozen=True)
class Storage:
    """Memory layout of values at every offset from a lattice, (plane, phase y, phase x, lane)."""

    shape: tuple[int, int, int, int]
    phases: Triple
    along_y: wp.array
    """Distance in memory for each offset along y [voxel]."""
    along_x: wp.array

    @classmethod
    def from_plan(cls, plan: Plan, reach: Triple) -> Storage:
        """Return the layout for the offsets 0 to ``reach - 1`` from the plan's blocks."""
        phases = tuple(min(s, r) for s, r in zip(plan.stride, reach, strict=True))
        past = [(r - 1) // s for r, s in zip(reach, plan.stride, strict=True)]
        lanes = whole_groups(plan.lanes + past[1] * plan.pitch + past[2] + LANES)
        shape = ((plan.block_grid[0] - 1) * plan.stride[0] + reach[0], phases[1], phases[2], lanes)
        along_y = _distances(reach[1], plan.stride[1], phases[2] * lanes, plan.pitch)
        return cls(shape, phases, along_y, _distances(reach[2], plan.stride[2], lanes, 1))

    @property
    def plane(self) -> int:
        """Elements per plane."""
        return math.prod(self.shape[1:])

    @property
    def size(self) -> int:
        """Elements."""
        return math.prod(self.shape)

    def lattice(self, plan: Plan, corner: Triple) -> Lattice:
        """Return the lattice whose first window or block lies at `corner`."""
        lattice = Lattice()
        lattice.corner, lattice.stride = wp.vec3i(*corner), wp.vec3i(*plan.stride)
        lattice.phases = wp.vec3i(*self.phases)
        lattice.planes, lattice.pitch, lattice.lanes = self.shape[0], plan.pitch, self.shape[3]
        return lattice


@functools.lru_cache
def _distances(reach: int, stride: int, phase_pitch: int, lane_pitch: int) -> wp.array:
    """Distance in memory for the offsets 0 to ``reach - 1`` along one axis."""
    offset = np.arange(reach, dtype=np.int32)
    return to_device(offset % stride * phase_pitch + offset // stride * lane_pitch, int)


def make_layers(plan: Plan, layers: range, ring: int, group: int) -> Layers:
    """Return the structure of some layers of blocks, with lanes in groups of `group`."""
    blocks = Layers()
    blocks.block, blocks.stride, blocks.lags = (wp.vec3i(*triple) for triple in (plan.block, plan.stride, plan.lags))
    blocks.begin, blocks.ring = layers.start, ring
    blocks.groups, blocks.group, blocks.lanes = -(-plan.lanes // group), group, plan.lanes
    return blocks

"""Projection by the weights of nodes on planes across the line of sight: voxels -> nodes -> rays, and back."""

import numpy as np

from lfpiv_kernels import runtime
from lfpiv_kernels.reconstruction import voxels
from lfpiv_kernels.reconstruction.depth_planes import DepthPlanes, PlaneShares
from lfpiv_kernels.reconstruction.pixel_rays import ALL
from lfpiv_kernels.reconstruction.projector import Projector
from lfpiv_kernels.reconstruction.weight_blocks import Blocks
from lfpiv_kernels.transfer import Given, Values, overwrite, to_device, to_host, zeros


class NodeProjector(Projector):
    """The map of weights of nodes, among which voxels are shared.

    Parameters
    ----------
    blocks : Blocks
        The weights of the nodes.
    shares : PlaneShares
        How voxels are shared among them.
    """

    def __init__(self, blocks: Blocks, shares: PlaneShares):
        super().__init__(blocks)
        self.parts = (blocks, shares)
        self.shares = shares
        self._planes = DepthPlanes(shares)

    def scatter(self, volume: Values, ray_set: int = ALL) -> None:
        """Send the light of `volume`, shape (voxel,), to the rays of some lenses. The other rays become dark."""
        super().scatter(self._planes.spread(to_device(volume, float)), ray_set)

    def gather(self, out: Given, active: Values | None = None, ray_set: int = ALL) -> Given:
        """Add the weighted sum of the light on each voxel's rays of some lenses to `out`, shape (voxel,). Return `out`.

        Voxels whose `active`, shape (voxel,), float32, is zero stay as they are.
        """
        volume, mask = to_device(out, float), None if active is None else to_device(active, float)
        if mask is not None and runtime.device().form == "cpu" and to_host(mask).all():
            mask = None
        lit = None if mask is None else self._planes.spread(voxels.indicator(mask), absolute=True)
        of_nodes = super().gather(zeros(self.shares.size), lit, ray_set)
        voxels.add(self._planes.collect(of_nodes), volume, mask)
        overwrite(out, volume)
        return out

    def entries(self, voxel: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the rays of one voxel and their weights, shapes (entry,). A ray may occur several times."""
        nodes, shares = self.shares.nodes_of(voxel)
        rays, weights = zip(*(self.blocks.entries(int(node)) for node in nodes), strict=True)
        return np.concatenate(rays), np.concatenate([own * share for own, share in zip(weights, shares, strict=True)])

    def count_lit(self) -> np.ndarray:
        """Count the rays that each voxel lights, shape (voxel,), int32: a weighted mean of its nodes' counts."""
        of_nodes = super().count_lit().astype(np.float32)
        return np.rint(np.maximum(self._planes.collect(of_nodes), 0)).astype(np.int32)

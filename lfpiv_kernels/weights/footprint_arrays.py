"""Structures that the kernels of footprints share, on the CPU and on a GPU."""

import warp as wp


@wp.struct
class Inputs:
    """What the kernels read, the same for all voxels."""

    model: wp.array(dtype=float)
    """Ray models, (voxel, MODEL_SIZE), flat."""
    geometry: wp.array(dtype=float)
    """The camera's, (GEOMETRY_SIZE,)."""
    lenses: wp.vec4i
    """First i and j, lenses along i and j."""
    corners: wp.array(dtype=int)
    """First pixel (column, row) of each lens's block, (lens along j, lens along i, 2), flat."""
    cuts: wp.vec3i
    """Parts of a voxel along x, y, z."""
    profiles: bool


@wp.struct
class Outline:
    """Outline of a lens's cell, from ``lattice.cell_steps``."""

    extent: wp.array(dtype=float)
    """Half extents along a and b, (step, 2), flat."""
    steps: int
    square: bool


@wp.struct
class BlockArrays:
    """Blocks of voxels on the device, and where each voxel's begin."""

    first_block: wp.array(dtype=int)
    first_value: wp.array(dtype=int)
    ray: wp.array(dtype=int)
    height: wp.array(dtype=wp.uint8)
    width: wp.array(dtype=wp.uint8)
    value: wp.array(dtype=wp.uint8)

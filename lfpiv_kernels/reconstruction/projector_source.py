"""C++ of the projector's innermost loops: a voxel's blocks against the rays, one row of a block as one vector.

Both see the arguments of the functions in ``project`` that they are the text of.
"""

from lfpiv_kernels.native import read_native

# A row of 8 floats or bytes in C++: a vector of the compiler on the CPU, a plain loop on a GPU. What lies in a row
# beyond its block is another block's: `within` puts 0 there.
_ROWS = read_native("projector_rows.inc")

GATHER = _ROWS + read_native("projector_gather.inc")

SCATTER = _ROWS + read_native("projector_scatter.inc")

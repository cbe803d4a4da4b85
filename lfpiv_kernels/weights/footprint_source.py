"""C++ of the area-integrated weights: how much room a voxel's blocks need, and the blocks; see ``footprint``."""

from lfpiv_kernels.native import read_native
from lfpiv_kernels.weights.ray_model import LANES, LEVELS, RAYS, SMEARS, VECTORS

SIDE_LAYERS = 1
"""Versions of a microimage to either side of the plain one, for weights that fall or rise outwards at its edge."""
LAYERS = 2 * SIDE_LAYERS + 1
LAYER_FALL = 0.6
"""Relative fall of the weight per pixel, outwards at the pupil's edge, between one version and the next."""
HEADROOM = 1.04
"""Largest value that a profile or weight can take, over that at the pupil's centre."""
TALLEST = 64
"""Rows of a block at most."""
RIM = 0.05
"""Width around the pupil within which a pixel still counts as touching it [pixel]: more than its share's rounding."""
MOST_PARTS = 64
"""Parts of a voxel at most."""
MOST_STEPS = 8
"""Steps of a cell's outline at most."""


def _source(text: str) -> str:
    """Complete a function's text: vectors and the ray model before it, values for `@NAME` in it."""
    for name, value in (
        ("TALLEST", TALLEST),
        ("LANES", LANES),
        ("SIDE_LAYERS", SIDE_LAYERS),
        ("LAYERS", LAYERS),
        ("LAYER_FALL", f"{LAYER_FALL}f"),
        ("LEVELS", f"{LEVELS}f"),
        ("HEADROOM", f"{HEADROOM}f"),
        ("RIM", f"{RIM}f"),
        ("MOST_PARTS", MOST_PARTS),
        ("MOST_STEPS", MOST_STEPS),
    ):
        text = text.replace(f"@{name}", str(value))
    return VECTORS + RAYS + SMEARS + text


MEASURE = _source(read_native("footprint_measure.inc"))
"""Counts the blocks and bytes of values that voxel `voxel` needs at most."""

FILL = _source(read_native("footprint_fill.inc"))
"""Computes the blocks of voxel `voxel` where there is room for them, without gaps from block to block."""

PACK = read_native("footprint_pack.inc")
"""Copies a voxel's blocks."""

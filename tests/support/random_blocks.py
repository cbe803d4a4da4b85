"""Random blocks of weights, and the same as a matrix."""

import numpy as np

from lfpiv_kernels import runtime
from lfpiv_kernels.reconstruction.pixel_rays import ALL
from lfpiv_kernels.reconstruction.projector import Blocks
from lfpiv_kernels.weights.microimages import LAYERS, lens_rays
from lfpiv_kernels.weights.ray_model import BLOCK_WIDTH, ROW_GROUP

VOXELS, LENSES = 70, 4


def random_blocks(form: str, edge: int, seed: int = 0) -> Blocks:
    """Blocks of lenses of two sets, some outside of their microimage's lit part, some voxels without any."""
    runtime.device()
    rng = np.random.default_rng(seed)
    centre = np.stack(np.meshgrid(*[(np.arange(LENSES) + 0.5) * (edge - 1)] * 2), axis=-1)
    microimages = lens_rays((0, 0), centre, 0.45 * edge, edge, (LENSES * edge, LENSES * edge))
    first_block, first_value, even_blocks, even_values = [0], [0], [], []
    rays, heights, widths, values = [], [], [], []
    for _ in range(VOXELS):
        blocks = []
        for _ in range(int(rng.integers(0, 40))):
            lens, layer = rng.integers(0, LENSES, 2), int(rng.integers(LAYERS))
            width = BLOCK_WIDTH if form == "profiles" else int(rng.integers(1, min(BLOCK_WIDTH, edge) + 1))
            lit = int(rng.integers(1, edge + 1))
            row, lit_columns = int(rng.integers(0, edge - lit + 1)), int(rng.integers(1, min(width, edge) + 1))
            column = int(rng.integers(0, edge - (lit_columns if form == "profiles" else width) + 1))
            ray = (((lens[0] * LAYERS + layer) * LENSES) + lens[1]) * edge**2 + row * edge + column
            if form == "profiles":
                height = -(-lit // ROW_GROUP) * ROW_GROUP
                across, down = np.zeros(width, np.uint8), np.zeros(height, np.uint8)
                across[:lit_columns] = rng.integers(1, 256, lit_columns)
                down[:lit] = rng.integers(1, 256, lit)
                value = np.concatenate([across, down])
            else:
                height, value = lit, rng.integers(0, 256, lit * width).astype(np.uint8)
            blocks.append((int(lens.sum()) % 2, height, width, int(ray), value))
        blocks.sort(key=lambda block: block[:2])
        even = [block for block in blocks if block[0] == 0]
        even_blocks.append(len(even))
        even_values.append(sum(len(block[4]) for block in even))
        for _, height, width, ray, value in blocks:
            heights.append(height), widths.append(width), rays.append(ray), values.append(value)
        first_block.append(len(rays))
        first_value.append(first_value[-1] + sum(len(block[4]) for block in blocks))
    return Blocks(
        form=form,
        first_block=np.array(first_block, np.int32),
        first_value=np.array(first_value, np.int64),
        ray=np.array(rays, np.int32),
        height=np.array(heights, np.uint8),
        width=np.array(widths, np.uint8),
        value=np.concatenate([*values, np.zeros(BLOCK_WIDTH, np.uint8)]),
        scale=rng.uniform(0.5, 1.5, VOXELS).astype(np.float32) / 65025,
        microimages=microimages,
        even_blocks=np.array(even_blocks, np.int32),
        even_values=np.array(even_values, np.int32),
    )


def matrix_of(blocks: Blocks, lenses: int = ALL) -> np.ndarray:
    """Weights (ray, voxel) in float64."""
    matrix = np.zeros((blocks.microimages.size, len(blocks.scale)))
    edge, row = blocks.microimages.edge, LAYERS * LENSES * blocks.microimages.edge**2
    for voxel in range(len(blocks.scale)):
        ray, weight = blocks.entries(voxel)
        lens = ray // edge**2 % LENSES + ray // row
        kept = (weight > 0) & ((lenses == ALL) | (lens % 2 == lenses))
        np.add.at(matrix[:, voxel], ray[kept], weight[kept])
    return matrix

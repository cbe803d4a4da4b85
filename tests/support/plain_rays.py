"""Every pixel as one ray: the simplest microimages."""

import numpy as np

from lfpiv_kernels.weights.microimages import Microimages
from lfpiv_kernels.weights.ray_model import BLOCK_WIDTH


def plain(sensor_shape):
    """Return every pixel as one ray, in rows padded by BLOCK_WIDTH."""
    rows, columns = sensor_shape
    pixel = np.full((rows, columns + BLOCK_WIDTH), -1, np.int32)
    pixel[:, :columns] = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    return Microimages(
        first_lens=(0, 0),
        corner=np.zeros((1, 1, 2), np.int32),
        edge=columns + BLOCK_WIDTH,
        pixel=pixel.ravel(),
        share=(pixel.ravel() >= 0).astype(np.float32),
        sensor_shape=(rows, columns),
    )

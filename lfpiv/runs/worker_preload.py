"""Everything that a worker process imports, read once by the process that the workers of a machine are forked from.

Reading it takes most of a worker's start. No device is started here: each worker does so itself, once.
"""
# ruff: noqa: F401

import dask.array
import distributed
import h5netcdf
import imagecodecs
import taichi
import tifffile
import warp

from lfpiv.calibration import cameras
from lfpiv.reconstruction import motion
from lfpiv.runs import dispatch, worker
from lfpiv.velocity import cross_correlation
from lfpiv.weights import storage

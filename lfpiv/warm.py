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

from lfpiv import calibration, crew, motion, vectors, weightstore, worker

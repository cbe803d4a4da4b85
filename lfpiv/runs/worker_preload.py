"""Imports of a worker process. The process that workers are forked from imports this module once.

Imports take most of the time that a worker needs to start. No device is started here: each worker starts its own.
"""
# ruff: noqa: F401

import dask.array
import distributed
import h5netcdf
import imagecodecs
import tifffile
import warp

from lfpiv.calibration import cameras
from lfpiv.joint import pair
from lfpiv.runs import dispatch, worker
from lfpiv.velocity import cross_correlation
from lfpiv.weights import storage
from lfpiv_kernels.libraries import ti

"""Warp: sweeps over the voxels of flat volumes on the device: products, quotients, masks. Twins: NumPy's operators.

Volumes have shape (voxel,), float32. A sweep may overwrite one of its arguments.
"""

import warp as wp

from lfpiv_kernels import native, runtime
from lfpiv_kernels.launch import Call, launch, parts_of
from lfpiv_kernels.transfer import empty

wp.set_module_options(native.options("voxels.h"))

VOXELS_OF_RUN: int = native.constant("voxels.h", "VOXELS_OF_RUN")
"""Voxels that a thread of the CPU goes through."""
FEWEST_VOXELS = 2**18
"""Smallest part of a launch. Two threads take longer than one for 150,000 voxels, and as long for a million."""


@native.kernel("lfpiv::multiply(run, size, one.data, factor, other.data, product_out.data);")
def _multiply(
    # in
    one: wp.array(dtype=float),
    factor: float,
    other: wp.array(dtype=float),
    size: int,
    first_run: int,
    # out
    product_out: wp.array(dtype=float),
): ...


@native.kernel("lfpiv::divide(run, size, numerator.data, denominator.data, least, quotient_out.data);")
def _divide(
    # in
    numerator: wp.array(dtype=float),
    denominator: wp.array(dtype=float),
    least: float,
    size: int,
    first_run: int,
    # out
    quotient_out: wp.array(dtype=float),
): ...


@native.kernel("lfpiv::indicate(run, size, volume.data, lit_out.data);")
def _indicate(
    # in
    volume: wp.array(dtype=float),
    size: int,
    first_run: int,
    # out
    lit_out: wp.array(dtype=float),
): ...


@native.kernel("lfpiv::add_masked(run, size, added.data, mask.data, volume_out.data);")
def _add(
    # in
    added: wp.array(dtype=float),
    mask: wp.array(dtype=float),
    size: int,
    first_run: int,
    # out
    volume_out: wp.array(dtype=float),
): ...


@native.kernel("lfpiv::darken(run, size, volume.data, darkened_out.data);")
def _darken(
    # in
    volume: wp.array(dtype=float),
    size: int,
    first_run: int,
    # out
    darkened_out: wp.array(dtype=float),
): ...


def multiply(one: wp.array, other: wp.array, out: wp.array | None = None, *, factor: float = 1.0) -> wp.array:
    """Return one * factor * other; write it to `out` if given."""
    found = empty(one.size) if out is None else out
    sweep_runs(_multiply, [one, float(factor), other], [found])
    return found


def divide(numerator: wp.array, denominator: wp.array, least: float, out: wp.array | None = None) -> wp.array:
    """Return numerator / max(denominator, least); write it to `out` if given."""
    found = empty(numerator.size) if out is None else out
    sweep_runs(_divide, [numerator, denominator, float(least)], [found])
    return found


def indicator(volume: wp.array) -> wp.array:
    """Return 1 where the volume is not 0, else 0."""
    lit = empty(volume.size)
    sweep_runs(_indicate, [volume], [lit])
    return lit


def add(added: wp.array, out: wp.array, mask: wp.array | None = None) -> None:
    """Add a volume to `out`, where `mask` is not 0 if one is given."""
    sweep_runs(_add, [added, mask], [out])


def darken(out: wp.array, volume: wp.array) -> None:
    """Overwrite `out` by 0 where `volume` is 0."""
    sweep_runs(_darken, [volume], [out])


def ones(size: int) -> wp.array:
    """Return a volume of ones."""
    found = empty(size)
    found.fill_(1.0)
    return found


def sweep_runs(kernel: wp.Kernel, inputs: list[object], outputs: list[wp.array | None]) -> None:
    """Launch a kernel on all runs of voxels of the first output, whose number is a further input."""
    size = outputs[0].size
    runs = size if runtime.device().form == "gpu" else -(-size // VOXELS_OF_RUN)
    launch(Call(kernel, runs, [*inputs, size], outputs), parts=parts_of(size, FEWEST_VOXELS))


def sweep(kernel: wp.Kernel, size: int, inputs: list[object], outputs: list[wp.array | None]) -> None:
    """Launch a kernel on all voxels. An array that is None has no elements there."""
    launch(Call(kernel, size, inputs, outputs), parts=parts_of(size, FEWEST_VOXELS))

"""Warp: SMART's pointwise steps. Twin: ``reference.smart``."""

import sys

import warp as wp

from lfpiv_kernels import runtime

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _log_ratio(
    # in
    first_pixel: int,
    image: wp.array(dtype=float),
    gain: wp.array(dtype=float),
    floor: float,
    projected: wp.array(dtype=float),
    # out
    ratio_out: wp.array(dtype=float),
):
    pixel = first_pixel + wp.tid()
    light = gain[pixel]
    ratio = float(0.0)
    if light > 0.0:
        ratio = light * wp.log((image[pixel] + floor) / (light * projected[pixel] + floor))
    ratio_out[pixel] = ratio


@wp.kernel
def _update(
    # in
    first_voxel: int,
    exponent: wp.array(dtype=float),
    step: wp.array(dtype=float),
    # out
    volume_out: wp.array(dtype=float),
):
    voxel = first_voxel + wp.tid()
    volume_out[voxel] = volume_out[voxel] * wp.exp(step[voxel] * exponent[voxel])


def log_ratio(image, gain, floor, projected, out):
    """SMART's log ratio gain * log((image + floor) / (gain * projected + floor)); zero where gain is zero.

    All arrays float32, shape (pixel,); returns `out`.
    """
    where = runtime.device().warp
    arrays = [wp.array(array, dtype=float, device=where, copy=False) for array in (image, gain, projected, out)]
    wp.load_module(sys.modules[__name__], device=where)

    def launch(_, first, last):
        wp.launch(
            _log_ratio,
            dim=last - first,
            inputs=[first, arrays[0], arrays[1], float(floor), arrays[2]],
            outputs=[arrays[3]],
            device=where,
        )

    runtime.run_chunks(len(out), launch)
    if where != "cpu":
        out[:] = arrays[3].numpy()
    return out


def update(volume, exponent, step):
    """SMART's step volume *= exp(step * exponent), in place; float32, shape (voxel,); returns `volume`."""
    where = runtime.device().warp
    arrays = [wp.array(array, dtype=float, device=where, copy=False) for array in (volume, exponent, step)]
    wp.load_module(sys.modules[__name__], device=where)

    def launch(_, first, last):
        wp.launch(_update, dim=last - first, inputs=[first, arrays[1], arrays[2]], outputs=[arrays[0]], device=where)

    runtime.run_chunks(len(volume), launch)
    if where != "cpu":
        volume[:] = arrays[0].numpy()
    return volume

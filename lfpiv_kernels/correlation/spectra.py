"""Correlation of blocks with their surroundings by transforms along z and y, where that is cheaper than `blocks`.

Planes are transformed along z once (`planes`), rows along y once per group of lanes. Along x the products are summed
lag by lag at every pair of frequencies, and transformed back. `transforms` gives folds and waves. CPU only: a GPU has
enough multipliers, and no memory near them for the spectra of a block.
"""

from dataclasses import dataclass

import warp as wp

from lfpiv_kernels import native, runtime
from lfpiv_kernels.correlation.layout import Layers, Phased, make_layers
from lfpiv_kernels.correlation.memory import new_array
from lfpiv_kernels.correlation.plan import GROUP, Plan, whole_groups
from lfpiv_kernels.correlation.planes import PART, transform_call
from lfpiv_kernels.correlation.transforms import ROWS, Spectrum, Transform
from lfpiv_kernels.launch import Call, launch

wp.set_module_options(native.options("spectra.h", contract="fast"))


@native.kernel("""
#if !LFPIV_GPU
    const auto scratch = scratch_out.data + (int64_t)slot * scratch_pitch;
    lfpiv::correlate_spectra(first, second, transform, layers, past, task, scratch, sum_out.data);
#endif
""")
def _correlate_spectra(
    # in
    first: Phased,  # spectra of layers of blocks, (layer, row, element), see `planes`
    second: Phased,  # the same of their surroundings
    transform: Transform,
    layers: Layers,
    past: int,  # lanes behind a group's last whose voxels it reaches
    scratch_pitch: wp.int64,  # elements of scratch memory per slot
    slot: int,
    first_task: int,
    # out
    scratch_out: wp.array(dtype=float),
    sum_out: wp.array(dtype=float),  # sums of products, (layer, lag, lane)
): ...


@dataclass(frozen=True)
class SpectralProducts:
    """Sums of products of blocks, formed from transforms along z and y."""

    plan: Plan
    ring: int
    """Layers that the sums have memory for."""
    spectra: tuple[wp.array, wp.array]
    """Planes of blocks and of their surroundings, transformed along z."""
    scratch: wp.array
    scratch_pitch: int

    @classmethod
    def prepare(cls, plan: Plan, ring: int, plane: int) -> "SpectralProducts":
        """Allocate memory for the spectra of planes of at most `plane` elements, and for one group of lanes."""
        spectrum = Spectrum.for_block(plan.block, plan.search)
        folds, folds_around = (len(quads) for quads in spectrum.folds)
        reach, half = plan.block[2] + plan.lags[2] - 1, spectrum.size[1] // 2 + 1
        wide = min(plan.stride[2], reach) * whole_groups(GROUP + _lanes_past(plan))
        pitch = GROUP * plan.block[2] * (8 * folds + 6 * ROWS) + wide * (8 * folds_around + 6 * ROWS)
        pitch += GROUP * plan.lags[2] * (4 * half + (spectrum.size[0] + 2) * plan.lags[1]) + whole_groups(reach)
        pitch = max(pitch, *(len(planes.quads) * PART for planes in spectrum.planes))
        spectra = tuple(new_array(ring * spectrum.size[0] * plane) for _ in range(2))
        return cls(plan, ring, spectra, new_array(runtime.CHUNKS * pitch), pitch)

    def sum(self, first: Phased, second: Phased, layers: range, sums: wp.array) -> None:
        """Sum the products of some layers of blocks and their surroundings at every lag."""
        plan, scratch = self.plan, (self.scratch, self.scratch_pitch)
        spectrum = Spectrum.for_block(plan.block, plan.search)
        transforms = zip((first, second), spectrum.planes, self.spectra, strict=True)
        launch(
            *(
                transform_call(volume, planes.transform, layers, plan.stride[0], *scratch, out)
                for volume, planes, out in transforms
            )
        )
        tasks = make_layers(plan, layers, self.ring, GROUP)
        transformed = [_with_values(*pair) for pair in zip((first, second), self.spectra, strict=True)]
        inputs = [*transformed, spectrum.transform, tasks, _lanes_past(plan), self.scratch_pitch]
        size = len(layers) * tasks.groups
        launch(Call(_correlate_spectra, size, inputs, [self.scratch, sums], scratch=True))


def _with_values(volume: Phased, values: wp.array) -> Phased:
    """Return other values stored like those of a volume."""
    other = Phased()
    other.values, other.along_y, other.along_x, other.plane = values, volume.along_y, volume.along_x, volume.plane
    return other


def _lanes_past(plan: Plan) -> int:
    """Lanes behind a group's last whose voxels it reaches."""
    return (plan.block[2] + plan.lags[2] - 2) // plan.stride[2]

"""Gates that need no clock: kernel launches, compilations, bytes and iterations of the benchmark's operations.

A budget is a count of what the code does today; it fails when a change launches, compiles or stores more. Lower it when
a change needs less.
"""

import tracemalloc
from collections import Counter

import numpy as np
import pytest
import warp as wp
from support import plain_steps
from support.ideal_rig import two_cameras

import lfpiv
from lfpiv.calibration.training import train
from lfpiv_kernels import runtime
from lfpiv_kernels.correlation import correlate, deform
from lfpiv_kernels.weights import footprint, ray_model

GRID = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(1.2, 1.0, 0.8), voxel_mm=0.1)
CAMERAS = 2
STORED_BYTES_PER_WEIGHT = {"pixels": 1.4, "profiles": 0.4}
"""By form: one byte per weight, and what dark corners and blocks' heads add to it, 1.27 on this rig; or two profiles
per block, 0.33."""
SMART_IMAGES, SMART_VOLUMES = 5, 12
"""Sensor images and volumes that SMART may allocate at once for both cameras; it holds 4 images here."""
EPOCHS = 10
"""Epochs that Levenberg-Marquardt may take to come within a tenth of the samples' noise; it takes 5."""


@pytest.fixture(scope="module")
def chunks():
    """Launches per operation: the CPU cuts them for its threads, CUDA does not."""
    return runtime.CHUNKS if runtime.device().form == "cpu" else 1


@pytest.fixture(scope="module")
def weights(device):
    return lfpiv.build_weights(two_cameras(), GRID)


@pytest.fixture
def launches(monkeypatch):
    """Names of the Warp kernels launched so far."""
    names, launch = [], wp.launch

    def counted(kernel, *arguments, **keywords):
        names.append(kernel.key)
        return launch(kernel, *arguments, **keywords)

    monkeypatch.setattr(wp, "launch", counted)
    return names


def compilations():
    return len(wp.get_module(footprint.__name__).execs)


def test_projection_launches_once_per_camera_and_chunk(weights, launches, chunks):
    volume = np.ones(GRID.shape, np.float32)
    images = weights(volume)
    assert len(launches) == 2 * CAMERAS * chunks  # voxels to rays, rays to pixels
    weights.T(images)
    assert len(launches) == 4 * CAMERAS * chunks


def test_smart_launches_and_allocates_the_same_in_every_iteration(weights, launches, chunks):
    images = weights(np.ones(GRID.shape, np.float32))
    first, counts, peaks = np.full(GRID.shape, 0.5, np.float32), [], []
    plain_steps.reconstruct(weights, images, 1, first=first)  # column sums and modules, once
    for iterations in (2, 5):
        launches.clear()
        tracemalloc.start()
        volume = plain_steps.reconstruct(weights, images, iterations, first=first, accelerate=False)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        counts.append(Counter(launches))
        assert volume.attrs["iterations"] == iterations
    forward, back = ("_project", "_back_project") if chunks > 1 else ("_scatter", "_gather")
    compare = counts[0]["_compare"] // (3 * CAMERAS)  # small images and volumes are cut into fewer chunks
    assert 0 < compare <= chunks
    # per iteration and camera one projection, comparison and back projection; then one mask of the exponent and one
    # update of the volume, which is small; before the first iteration a misfit
    for count, iterations in zip(counts, (2, 5), strict=True):
        compared = (iterations + 1) * CAMERAS
        sums = {"_sum": 4 * compared, "_add_up": 2 * compared}  # a GPU adds the two sums of the misfit itself
        assert count == {
            forward: (iterations + 1) * CAMERAS * chunks,
            "_compare": (iterations + 1) * CAMERAS * compare,
            back: iterations * CAMERAS * chunks,
            "_update": iterations,
            "_darken": iterations,
            "_multiply": 1,  # the caller's first guess, where a camera sees it
        } | ({} if chunks > 1 else sums)
    pixels = np.prod(next(iter(images.values())).shape)
    budget = 4 * (SMART_IMAGES * pixels + SMART_VOLUMES * GRID.size)
    assert max(peaks) < budget
    assert peaks[1] - peaks[0] < 4 * pixels  # nothing grows with the iterations


@pytest.mark.parametrize("form", STORED_BYTES_PER_WEIGHT)
def test_weights_are_stored_in_their_budget_and_compiled_once(form, device):
    weights = lfpiv.build_weights(two_cameras(), GRID, form=form)
    lit = int(weights.affected_pixels.sum())
    assert weights.memory_bytes < STORED_BYTES_PER_WEIGHT[form] * lit
    before = compilations()
    other = lfpiv.Grid.from_extent(centre_mm=(0.2, 0, 0.3), size_mm=(0.7, 0.9, 0.5), voxel_mm=0.05)
    lfpiv.build_weights(two_cameras(), other, form=form)  # another grid, another voxel: the same kernels
    assert compilations() == before


@pytest.mark.parametrize("form", STORED_BYTES_PER_WEIGHT)
def test_blocks_lie_gap_free_inside_the_rays_and_end_where_they_are_lit(form, device):
    weights = lfpiv.build_weights(two_cameras(), GRID, form=form)
    for name in weights.cameras:
        blocks = weights.projector(name).blocks
        height, width = blocks.height.astype(np.int64), blocks.width.astype(np.int64)
        assert height.min() > 0 and width.min() > 0 and width.max() <= ray_model.BLOCK_WIDTH
        size = width + height if form == "profiles" else width * height
        start = np.concatenate([[0], np.cumsum(size)])
        assert (start[blocks.first_block] == blocks.first_value).all()
        assert len(blocks.value) == start[-1] + ray_model.BLOCK_WIDTH
        assert blocks.ray.min() >= 0
        last_ray = blocks.ray + (height - 1) * blocks.microimages.edge + ray_model.BLOCK_WIDTH
        assert (last_ray <= blocks.microimages.size).all()
        for block in range(0, len(height), 7):
            value = blocks.value[start[block] : start[block + 1]]
            if form == "pixels":
                lit = value.reshape(height[block], width[block]) > 0
                assert lit[0].any() and lit[-1].any() and lit[:, 0].any() and lit[:, -1].any()
            else:
                across, down = np.split(value, [ray_model.BLOCK_WIDTH])
                assert (
                    across[0] and down[0] and down[-ray_model.ROW_GROUP :].any() and not len(down) % ray_model.ROW_GROUP
                )


def test_correlation_and_deformation_launch_once_per_slab(device, launches, chunks):
    rng = np.random.default_rng(0)
    first, second = rng.random((2, 40, 40, 40), np.float32)
    arguments = {"window": (16,) * 3, "step": (8,) * 3, "search": (4,) * 3}
    correlate.correlate_windows(first, second, **arguments)
    launched = Counter(launches)
    per_volume = {"_split", "_sum_planes", "_window_statistics", "_transform_planes"}
    assert set(launched) <= per_volume | {"_correlate_blocks", "_correlate_spectra", "_find_peaks"}
    for name, count in launched.items():  # all of it is one slab
        assert count <= chunks * (2 if name in per_volume else 1), name
    coefficients = [deform.spline_coefficients(volume) for volume in (first, second)]
    launches.clear()
    deform.deform_pair(*coefficients, np.zeros((11, 11, 11, 3), np.float32), (4.0, 4.0, 4.0))
    assert 0 < len(launches) <= chunks


def test_training_needs_few_epochs():
    rng = np.random.default_rng(0)
    inputs = rng.uniform(-1, 1, (3000, 5))
    truth = np.stack([inputs[:, 0] + 0.3 * inputs[:, 1] * inputs[:, 3], inputs[:, 1] - 0.2 * inputs[:, 4] ** 2], 1)
    noise = 0.01
    result = train(inputs, truth + rng.normal(0, noise, truth.shape))
    best = int(np.argmax(result.validation_rms < 1.1 * noise))
    assert 0 < best <= EPOCHS

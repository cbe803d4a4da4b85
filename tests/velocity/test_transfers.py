"""Budgets of what a pair of volumes moves between host and device: volumes once, then only what windows have.

The counts are those of a GPU: `pytest --emulate-gpu` takes its loops on the CPU, and copies as a GPU must.
"""

import numpy as np
import pytest
from support.particle_volumes import particle_pair, uniform

import lfpiv
from lfpiv.velocity.coverage import Voxels
from lfpiv.velocity.multi_pass import correlate_passes
from lfpiv.velocity.settings import REFINE_SEARCH, CorrelationSettings
from lfpiv.velocity.volume_pair import preprocess
from lfpiv_kernels import runtime
from lfpiv_kernels.correlation.memory import on_device
from lfpiv_kernels.correlation.plan import make_plan
from lfpiv_kernels.transfer import count_transfers

SHAPE = (40, 48, 56)
VOLUME = 4 * int(np.prod(SHAPE))
WINDOW, STEP = 16, 4
"""Of all passes but the last [voxel]: windows overlap by three quarters."""
UP_PER_VECTOR = 24 + 12 + 8
"""Field in float64 to the predictor; in float32 with flags and numbers of vectors to one round of medians [byte]. A
clean pair needs no further round."""
DOWN_PER_VECTOR = 24 + 6 * 12 + 4
"""Predicted means in float64; what the medians predict, and the number of neighbours [byte]."""
PEAKS = 8 * 4
"""Two displacements, coefficient and rival of a lane [byte]."""
SCALARS = 256
"""Means, powers and lag products of volumes [byte]."""
TABLES = 8192
"""Matrices of the predictor, taps of filters: they grow with an edge of the volume [byte]."""


@pytest.fixture
def pair(device):
    if runtime.device().form != "gpu":
        pytest.skip("nothing moves on the CPU; run with --emulate-gpu or --device cuda")
    return particle_pair(SHAPE, uniform(0.4, -0.3, 0.8), seed=3)


def moved(pair, passes, **options):
    """Transfers of a pair, and its vectors."""
    with count_transfers() as counted:
        vectors = lfpiv.correlate(*pair, windows=(WINDOW,) * passes, **options)
    return counted, vectors


def test_volumes_go_up_once_and_never_come_back(pair):
    for passes in (1, 2, 3):
        counted, _ = moved(pair, passes)
        assert sorted(counted.to_device)[-2:] == [VOLUME, VOLUME]
        assert sum(size >= VOLUME // 4 for size in counted.to_device) == 2
        assert max(counted.to_host) < VOLUME // 4


def test_a_mask_goes_up_once_as_flags(pair):
    solid = np.zeros(SHAPE, bool)
    solid[:, :12] = True
    counted, vectors = moved(pair, 3, mask=solid)
    assert vectors.masked.any() and vectors.valid.any()
    assert sorted(counted.to_device)[-3:] == [VOLUME // 4, VOLUME, VOLUME]
    assert sum(size >= VOLUME // 8 for size in counted.to_device) == 3
    assert max(counted.to_host) < VOLUME // 8


def test_a_further_pass_moves_what_its_windows_have(pair):
    moved(pair, 3)  # tables that are kept
    few, many = (moved(pair, passes)[0] for passes in (2, 3))
    plan = make_plan(SHAPE, (WINDOW,) * 3, (STEP,) * 3, (REFINE_SEARCH,) * 3)  # of the pass that is more
    vectors, lanes = int(np.prod(plan.count)), plan.count[0] * plan.lanes
    up, down = (sum(getattr(many, way)) - sum(getattr(few, way)) for way in ("to_device", "to_host"))
    assert UP_PER_VECTOR * vectors < up < UP_PER_VECTOR * vectors + TABLES
    assert down < DOWN_PER_VECTOR * vectors + PEAKS * lanes + SCALARS


def test_numbers_of_whole_volumes_are_single_numbers(pair):
    counted, vectors = moved(pair, 1)
    few = [size for size in counted.to_host if size <= 8 * 2 * 6]  # two volumes, six numbers of each
    assert sum(few) < SCALARS
    assert len(counted.to_host) - len(few) == 3  # peaks, medians, numbers of neighbours
    assert vectors.valid.values.mean() > 0.9


@pytest.mark.parametrize("options", ({}, {"smoothing_voxel": 1.0, "intensity_power": 1.0}))
def test_volumes_on_the_device_are_not_moved(pair, options):
    shared = {"smoothing_voxel": 0.5, "intensity_power": 0.5} | options
    settings = CorrelationSettings(windows=((WINDOW,) * 3,) * 2, overlap=0.5, max_displacement_voxel=None, **shared)
    volumes = [on_device(volume) for volume in pair]
    with count_transfers() as counted:
        correlate_passes(*(preprocess(one, *shared.values()) for one in volumes), settings, Voxels())
    assert max(counted.to_device + counted.to_host) < VOLUME // 4

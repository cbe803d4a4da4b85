"""SMART's data live on the device: what is moved per pass and per reconstruction, and what the CPU allocates."""

import tracemalloc
from collections import Counter

import numpy as np
import pytest
import warp as wp
from support.ideal_rig import optics, two_cameras
from support.noisy_blobs import noisy_blobs

import lfpiv
from lfpiv.reconstruction.settings import SmartSettings
from lfpiv.reconstruction.sieve import coefficients
from lfpiv.reconstruction.solver import SmartSolver
from lfpiv.weights.forms import shared_profiles
from lfpiv_kernels import runtime
from lfpiv_kernels.transfer import count_transfers

SCALARS = 16
"""Two float64 numbers [byte]."""
CASES = {
    "whole passes": {"subsets": 1},
    "subsets": {"subsets": 4},
    "subsets that may grow": {"subsets": "auto"},
    "without sieve": {"subsets": 1, "sieve_voxel": 0.0},
    "the paper's steps": {"subsets": 1, "sieve_voxel": 0.0, "accelerate": False, "normalisation": "paper"},
}
VOLUMES = {1: 10, 4: 10.5}
"""Volumes that a reconstruction may allocate at once, by the number of subsets; the constants of the rig are older.

Subsets: the coefficients before an epoch, to which it can be undone, and the sum of its exponents.
"""


@pytest.fixture(scope="module", params=["voxels", "planes"])
def recorded(request, device):
    """Return weights, those of voxels or profiles that planes of voxels share, and images."""
    with pytest.MonkeyPatch.context() as patch:
        if request.param == "planes":
            patch.setattr(shared_profiles, "FEWEST_VOXELS", 0)
        weights, _, images = noisy_blobs(40)
    assert (weights.rows > 1) == (request.param == "planes")
    return weights, images


@pytest.fixture
def moves(device):
    return runtime.device().form == "gpu"


def solver_of(recorded, iterations, settings):
    solver = SmartSolver(recorded[0], SmartSettings(**{"sieve_voxel": 0.6, "iterations": iterations, **settings}))
    solver.solve(recorded[1])  # constants of the rig, once
    return solver


@pytest.mark.parametrize("case", CASES)
def test_a_reconstruction_moves_its_images_its_volume_and_two_scalars_a_pass(recorded, moves, case):
    weights, images = recorded
    solver = solver_of(recorded, 9, CASES[case])
    with count_transfers() as counted:
        found = solver.solve(images)
    if not moves:
        assert counted.to_device == counted.to_host == []
        return
    pixels = [4 * len(weights.projector(name).map.pixel) for name in weights.cameras]
    assert counted.to_device == pixels
    sizes = Counter(counted.to_host)
    assert sizes.pop(4 * weights.grid.size) == 1
    assert set(sizes) == {SCALARS}
    grows = case == "subsets that may grow" or weights.rows > 1  # each epoch looks at the subsets' agreement
    passes = len(found.misfit)  # at least: SMART may compare several proposals of a step
    assert passes <= sizes[SCALARS] <= (2 if grows or "subsets" not in case else 1) * passes + 1


def test_each_comparison_of_whole_passes_reads_one_pair_of_scalars(recorded, moves):
    """Without momentum no proposal is taken back."""
    solver = solver_of(recorded, 6, CASES["the paper's steps"])
    with count_transfers() as counted:
        solver.solve(recorded[1])
    assert counted.to_host == ([SCALARS] * 7 + [4 * recorded[0].grid.size] if moves else [])


def test_a_first_guess_of_the_caller_is_moved_once(recorded, moves):
    weights, images = recorded
    solver = solver_of(recorded, 2, CASES["whole passes"])
    prepared = solver.prepare(images)
    with count_transfers() as counted:
        prepared.solve(first=np.ones(weights.grid.shape, np.float32))
    assert counted.to_device == ([4 * weights.grid.size] if moves else [])


def test_coefficients_of_a_volume_are_found_on_the_device(recorded, moves):
    volume = np.random.default_rng(1).random((9, 8, 7), np.float32)
    coefficients(volume, 0.6)
    with count_transfers() as counted:
        coefficients(volume, 0.7)
    constants = 6  # of the blur's three axes
    assert len(counted.to_device) == (constants + 1 if moves else 0)
    assert counted.to_host == ([volume.nbytes] if moves else [])


def test_a_step_over_a_subset_launches_few_sweeps_and_reuses_its_memory(recorded, monkeypatch):
    """One sweep scales the exponent, one takes the step with its momentum, and one masks the exponent."""
    if runtime.device().kind == "cuda":
        pytest.skip("a replay launches nothing from Python")
    launched, launch = Counter(), wp.launch

    def counted(kernel, *arguments, **keywords):
        launched[kernel.key] += 1
        return launch(kernel, *arguments, **keywords)

    solver = solver_of(recorded, 3, {**CASES["subsets"], "subsets": 4})
    prepared = solver.prepare(recorded[1])
    prepared.solve(iterations=0)
    monkeypatch.setattr(wp, "launch", counted)
    counts = []
    for epochs in (2, 6):
        launched.clear()
        prepared.solve(iterations=epochs, whole_passes=0)
        counts.append(Counter(launched))
    steps = 4 * (6 - 2)
    each = {name: (counts[1][name] - counts[0][name]) / steps for name in ("_multiply", "_sharpen", "_blur")}
    blurs = each.pop("_blur")
    assert each == {"_multiply": 1, "_sharpen": 1} and blurs <= 2 * runtime.CHUNKS
    assert counts[1]["_darken"] - counts[0]["_darken"] == steps
    assert "_update" not in counts[1]


@pytest.mark.parametrize("subsets", VOLUMES)
def test_passes_allocate_few_volumes_and_no_more_with_their_number(subsets, moves):
    if moves:
        pytest.skip("memory of a device is not traced")
    grid = lfpiv.Grid.from_extent(centre_mm=(0, 0, 0), size_mm=(2.4,) * 3, voxel_mm=0.08)
    weights = lfpiv.build_weights(two_cameras(optics=optics(rows=300, columns=300)), grid, form="profiles")
    images = weights(np.random.default_rng(0).random(grid.shape, np.float32))
    settings = {"subsets": subsets, "intensity_cap": 0.0}
    prepared = solver_of((weights, images), 4, settings).prepare(images)
    prepared.solve(iterations=0)
    peaks = []
    for iterations in (4, 8):
        tracemalloc.start()
        prepared.solve(iterations=iterations, whole_passes=0)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    volume = 4 * grid.size
    assert max(peaks) < VOLUMES[subsets] * volume
    assert peaks[1] - peaks[0] < volume / 2

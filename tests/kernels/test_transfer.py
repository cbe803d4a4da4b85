"""Arrays between host and device: views on the CPU, counted copies where the loops are those for a GPU."""

import numpy as np
import pytest
import warp as wp

from lfpiv_kernels import runtime
from lfpiv_kernels.transfer import bytes_on_device, count_transfers, to_device, to_host


@pytest.fixture
def moves(device):
    return runtime.device().form == "gpu"


def test_arrays_are_views_on_the_cpu_and_copies_elsewhere(moves):
    values = np.arange(6, dtype=np.float32)
    on_device = to_device(values, float)
    values[0] = 7
    assert to_host(on_device)[0] == (0 if moves else 7)
    assert np.shares_memory(to_host(on_device), values) is not moves


def test_moved_arrays_are_counted_once_while_the_context_is_open(moves):
    values = np.arange(6, dtype=np.float32)
    with count_transfers() as outer:
        on_device = to_device(values, float)
        with count_transfers() as inner:
            assert to_device(on_device) is on_device
            to_host(on_device)
    to_host(on_device)
    assert outer.to_device == ([values.nbytes] if moves else [])
    assert inner.to_device == []
    assert outer.to_host == inner.to_host == ([values.nbytes] if moves else [])


def test_work_of_the_host_moves_nothing(device):
    values = np.arange(6, dtype=np.float32)
    with count_transfers() as counted:
        to_device(values, float, device="cpu")
    assert counted.to_device == []


@pytest.mark.parametrize("size", [7, 1000, 1001, 1007, 4096])
@pytest.mark.parametrize("place", [None, "cpu"])
def test_more_bytes_than_warp_can_number_lie_at_the_address_of_their_array(monkeypatch, moves, size, place):
    monkeypatch.setattr("lfpiv_kernels.transfer.MOST_ELEMENTS", 1000)
    values = np.random.default_rng(3).integers(0, 256, size).astype(np.uint8)
    found = bytes_on_device(values, place)
    whole = wp.array(ptr=found.ptr, dtype=wp.uint8, shape=(size,), device=found.device)
    assert found.size == min(size, 1000) and (whole.numpy() == values).all()

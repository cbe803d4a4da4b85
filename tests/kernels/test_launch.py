"""Launches of Warp kernels in parts."""

import threading
import time
import weakref
from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from lfpiv_kernels import runtime
from lfpiv_kernels.launch import Call, launch, load
from lfpiv_kernels.transfer import to_device

TIMEOUT_S = 60.0


@wp.kernel
def _count_visits(
    # in
    weight: int,
    first: int,
    # out
    count_out: wp.array(dtype=int),
):
    index = first + wp.tid()
    count_out[index] = count_out[index] + weight


@wp.kernel
def _note_slot(
    # in
    slot: int,
    first: int,
    # out
    slot_out: wp.array(dtype=int),
):
    slot_out[first + wp.tid()] = slot


@pytest.mark.parametrize("parts", [None, 1, 7, 16])
@pytest.mark.parametrize("size", [0, 1, 5, 1000])
def test_parts_cover_every_thread_once(device, size, parts):
    counts = [np.zeros(size, np.int32) for _ in range(2)]
    arrays = [to_device(count) for count in counts]
    launch(*(Call(_count_visits, size, [n + 1], [array]) for n, array in enumerate(arrays)), parts=parts)
    for n, array in enumerate(arrays):
        assert (array.numpy() == n + 1).all()


def test_parts_that_run_side_by_side_have_scratch_memory_of_their_own(device):
    slots = to_device(np.full(1000, -2, np.int32))
    launch(Call(_note_slot, 1000, [], [slots], scratch=True))
    found = slots.numpy()
    assert (found == -1).all() if device.form == "gpu" else (found.min() >= 0 and found.max() < 8)


def test_work_of_the_host_beside_a_gpu_runs_on_the_threads(device, monkeypatch):
    on_gpu = replace(device, kind="cuda", form="gpu", threads=2)
    monkeypatch.setattr(runtime, "device", lambda: on_gpu)
    slots = to_device(np.full(1000, -2, np.int32), device="cpu")
    launch(Call(_note_slot, 1000, [], [slots], scratch=True), device="cpu")
    found = slots.numpy()
    assert found.min() >= 0 and found.max() < 8
    chunks = []
    runtime.run_chunks(10, lambda *chunk: chunks.append(chunk))
    assert chunks == [(0, 0, 10)]


def test_arrays_on_the_cpu_are_views():
    values = np.arange(4, dtype=np.float32)
    array = to_device(values, device="cpu")
    values[2] = 7.0
    assert array.numpy()[2] == 7.0


def test_an_error_of_a_part_reaches_the_caller_after_all_parts_have_ended(device, monkeypatch):
    monkeypatch.setattr(runtime, "device", lambda: replace(device, kind="cpu", form="cpu", threads=2))
    both, ended = threading.Barrier(2), []

    def job(part, first, last):
        if part < 2:
            both.wait(TIMEOUT_S)  # on the calling thread, and on another
        if threading.current_thread() is not threading.main_thread():
            time.sleep(0.05)
            ended.append(part)
            return
        raise ValueError(f"part {part}")

    with pytest.raises(ValueError, match="part"):
        runtime.run_chunks(4, job, chunks=4, warp_device="cpu")
    assert len(ended) == 3


def test_an_error_on_another_thread_reaches_the_caller(device, monkeypatch):
    monkeypatch.setattr(runtime, "device", lambda: replace(device, kind="cpu", form="cpu", threads=2))
    both = threading.Barrier(2)

    def job(part, first, last):
        both.wait(TIMEOUT_S)
        if threading.current_thread() is not threading.main_thread():
            raise ValueError(f"part {part}")

    with pytest.raises(ValueError, match="part"):
        runtime.run_chunks(2, job, chunks=2, warp_device="cpu")


def test_a_thread_that_is_late_keeps_no_array(device, monkeypatch):
    many = 64  # more than threads of the processor
    monkeypatch.setattr(runtime, "device", lambda: replace(device, kind="cpu", form="cpu", threads=many))
    begun, free = threading.Semaphore(0), threading.Event()

    def wait(part, first, last):
        begun.release()
        free.wait(TIMEOUT_S)

    blocker = threading.Thread(target=runtime.run_chunks, args=(many, wait), kwargs={"chunks": many})
    blocker.start()
    while begun.acquire(timeout=0.5):
        pass  # until all threads wait
    array = np.zeros(10)

    def job(part, first, last, own=array):
        own[first:last] += 1

    runtime.run_chunks(10, job, chunks=4)
    whole, known = (array == 1).all(), weakref.ref(array)
    del array, job
    kept = known() is not None
    free.set()
    blocker.join()
    assert whole and not kept


def test_two_functions_run_side_by_side_on_the_cpu(device, monkeypatch):
    monkeypatch.setattr(runtime, "device", lambda: replace(device, kind="cpu", form="cpu", threads=2))
    both = threading.Barrier(2)  # broken where one waits for the other to end
    first, second = runtime.side_by_side(lambda: both.wait(TIMEOUT_S), lambda: both.wait(TIMEOUT_S))
    assert {first, second} == {0, 1}


def test_two_functions_run_in_turn_on_a_gpu(device, monkeypatch):
    monkeypatch.setattr(runtime, "device", lambda: replace(device, kind="cuda", form="gpu"))
    order = []
    runtime.side_by_side(lambda: order.append("first"), lambda: order.append("second"))
    assert order == ["first", "second"]


def test_modules_are_loaded_by_one_thread_at_a_time(monkeypatch):
    """Warp's compilation is not thread-safe."""
    inside, most = [], []

    def record(module, device):
        inside.append(module)
        time.sleep(0.05)
        most.append(len(inside))
        inside.pop()

    monkeypatch.setattr(wp, "load_module", record)
    threads = [threading.Thread(target=load, args=(_count_visits, f"elsewhere:{number}")) for number in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == [1, 1, 1]

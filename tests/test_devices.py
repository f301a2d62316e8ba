"""Sending tensors and keeping them on a device; PyTorch's meta device stands for any other."""

import threading

import torch

from evsplat.devices import DeviceCache, constant, send, use_threads


def maker(log, key, count=100):
    def make():
        log.append((key, threading.current_thread()))
        return torch.full((count,), 1.0)

    return make


def test_on_the_cpu_nothing_is_kept_or_copied():
    log = []
    cache = DeviceCache("cpu", 10**9)
    cache.prefetch("a", maker(log, "a"))
    assert log == []
    value = torch.ones(3)
    assert cache.get("a", lambda: value) is value
    cache.get("a", maker(log, "a"))
    cache.get("a", maker(log, "a"))
    assert len(log) == 2


def test_a_value_is_made_once_in_the_background_and_stays():
    log = []
    cache = DeviceCache("meta", 10**9)
    cache.prefetch("a", maker(log, "a"))
    cache.prefetch("a", maker(log, "a"))
    values = [cache.get("a", maker(log, "a")) for _ in range(3)]
    assert values[0].device.type == "meta" and all(value is values[0] for value in values)
    assert [key for key, _ in log] == ["a"]
    assert log[0][1] is not threading.main_thread()
    assert cache.bytes == 400


def test_the_least_recently_used_leave_when_the_memory_is_full():
    log = []
    cache = DeviceCache("meta", 900)  # two of 400 bytes

    def use(key):
        cache.get(key, maker(log, key))
        return [made for made, _ in log]

    for key in ("a", "b", "a", "c"):
        use(key)
    assert use("a") == ["a", "b", "c"]
    assert use("b") == ["a", "b", "c", "b"]
    assert cache.bytes == 800
    none = DeviceCache("meta", 0)
    for _ in range(2):
        none.get("a", maker(log, "a"))  # the latest stays
        none.get("b", maker(log, "b"))
    assert none.bytes == 400


def test_what_fails_in_the_background_fails_where_it_is_wanted():
    def fail():
        raise OSError("the file is gone")

    cache = DeviceCache("meta", 100)
    cache.prefetch("a", fail)
    try:
        cache.get("a", fail)
    except OSError as error:
        assert str(error) == "the file is gone"
    else:
        raise AssertionError("no error")
    assert cache.get("a", lambda: torch.ones(2)).shape == (2,)


def test_send_keeps_values_and_gradients():
    tensor = torch.ones(3, requires_grad=True)
    assert send(tensor, "cpu") is tensor
    there = send(tensor * 2, "meta")
    assert there.device.type == "meta" and there.requires_grad


def test_threads_that_draw_take_the_number_that_was_set():
    before, seen = torch.get_num_threads(), []
    try:
        use_threads(before + 2)
        drawing = threading.Thread(target=lambda: seen.append(torch.get_num_threads()))
        drawing.start()
        drawing.join()
        use_threads(None)
        assert seen == [before + 2] and torch.get_num_threads() == before + 2
    finally:
        torch.set_num_threads(before)


def test_a_constant_is_made_once_for_each_kind_and_device():
    like = torch.zeros(1, dtype=torch.float64)
    matrix = constant([[1, 2.5], [3, 4]], like)
    assert torch.equal(matrix, torch.tensor([[1, 2.5], [3, 4]], dtype=torch.float64))
    assert constant(((1, 2.5), (3, 4)), like) is matrix
    assert constant([[1, 2.5], [3, 4]], like.float()).dtype == torch.float32
    assert constant([1.0], like.to("meta")).device.type == "meta"
    assert constant((True, False), torch.zeros(1, dtype=torch.bool)).tolist() == [True, False]

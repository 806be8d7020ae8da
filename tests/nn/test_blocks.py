"""Tasks submitted to the pool: on another thread, single-threaded there, without gradient."""

import threading

import pytest
import torch

from reli3d._bridge import WORKER
from reli3d.nn.blocks import submit

CPU = torch.device("cpu")


def facts():
    return threading.current_thread().name, torch.get_num_threads(), torch.is_grad_enabled()


def test_work_runs_on_a_thread_of_the_pool_that_computes_alone(threads):
    threads(2)
    name, count, grad = submit(facts, CPU)()
    assert name.startswith(WORKER) and count == 1 and not grad


def test_one_thread_does_it_at_once(threads):
    threads(1)
    done = []
    result = submit(lambda: done.append(facts()), CPU)
    assert done[0][0] == threading.current_thread().name and not done[0][2] and result() is None


def test_an_error_is_raised_when_the_value_is_read(threads):
    threads(2)

    def fail():
        raise ValueError("no surface")

    result = submit(fail, CPU)
    with pytest.raises(ValueError, match="no surface"):
        result()

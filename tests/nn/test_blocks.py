"""Tasks submitted to the pool: on another thread, single-threaded there, without gradient."""

import threading

import pytest
import torch

from reli3d._bridge import WORKER
from reli3d.nn.blocks import submit

CPU = torch.device("cpu")


@pytest.mark.parametrize("count", [1, 2])
def test_a_task_computes_alone_without_gradient_and_at_once_where_there_is_one_thread(threads, count):
    threads(count)
    done = []

    def task():
        done.append((threading.current_thread().name, torch.get_num_threads(), torch.is_grad_enabled()))
        raise ValueError("no surface")

    with pytest.raises(ValueError, match="no surface"):
        submit(task, CPU)()
    ((name, used, grad),) = done
    assert (name == threading.current_thread().name, name.startswith(WORKER)) == (count == 1, count == 2)
    assert used == 1 and not grad

"""Fixtures of all tests: device, threads, the folder of real data next to the checkout."""

from pathlib import Path

import pytest
import torch

from reli3d import _bridge
from tests.support.checkout import SHARED

DEVICES = ["cpu"] + (["cuda"] if torch.cuda.is_available() else [])


@pytest.fixture(params=DEVICES)
def device(request) -> torch.device:
    return torch.device(request.param)


@pytest.fixture
def threads():
    """Sets the number of torch threads and of threads of a launch; both are restored after the test."""
    before = torch.get_num_threads()

    def use(n):
        torch.set_num_threads(n)
        _bridge.pool.cache_clear()  # it is made once, for the number of its first call

    yield use
    use(before)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real meshes, maps and captures; a test that needs it skips visibly where it is absent."""
    if not (SHARED / "data").is_dir():
        pytest.skip("needs the data folder ../shared/data next to the checkout")
    return SHARED / "data"


@pytest.fixture(scope="session")
def goldens() -> Path:
    """Folder of reference inputs and outputs of the published model's modules."""
    if not (SHARED / "reference" / "goldens").is_dir():
        pytest.skip("needs the folder ../shared/reference/goldens next to the checkout")
    return SHARED / "reference" / "goldens"

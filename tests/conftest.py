"""Fixtures of all tests: device, threads, the folder of real data next to the checkout.  In CI few reasons may skip."""

import os
import re
from pathlib import Path

import pytest
import torch

from reli3d import _bridge
from tests.support.checkout import SHARED

DEVICES = ["cpu"] + (["cuda"] if torch.cuda.is_available() else [])


# Where CI is set, a test that skips for another reason fails: the machine lacks what .ci/run installs.
ALLOWED_SKIPS = re.compile(r"CUDA|Embree runs on|\.\./shared|next to the checkout")


def skip_is_failure(report) -> None:
    """Make a skip of ``report`` a failure unless its reason is CUDA or the data of ``../shared``."""
    if report.skipped and os.environ.get("CI") and not hasattr(report, "wasxfail"):
        path, line, reason = report.longrepr
        if not ALLOWED_SKIPS.search(reason):
            report.outcome = "failed"
            report.longrepr = f"{path}:{line}: {reason}; in CI nothing skips but for CUDA and ../shared"


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport():
    report = yield
    skip_is_failure(report)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report():
    report = yield
    skip_is_failure(report)
    return report


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

"""Fixtures of ``pytest bench/``: the device, and the table of results at the end."""

import pytest
import torch

DEVICES = ["cpu"] + (["cuda"] if torch.cuda.is_available() else [])
ROWS = pytest.StashKey[list]()


@pytest.fixture(params=DEVICES)
def device(request) -> torch.device:
    return torch.device(request.param)


@pytest.fixture
def rows(request) -> list:
    """Lines to print after the run."""
    return request.config.stash.setdefault(ROWS, [])


def pytest_terminal_summary(terminalreporter, config):
    if config.stash.get(ROWS, []):
        terminalreporter.section("times")
        for row in config.stash[ROWS]:
            terminalreporter.write_line(row)

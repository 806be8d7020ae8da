import pytest

from tests.support.samples import write_samples


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """The samples of ``tests/support/samples.py``; read-only."""
    out = tmp_path_factory.mktemp("samples")
    write_samples(out)
    return out

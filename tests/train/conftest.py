import pytest

from tests.support.stages import write_samples


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """Two samples of six views; read-only."""
    return write_samples(tmp_path_factory.mktemp("samples"), views=6, size=192)


@pytest.fixture(scope="session")
def small_samples(tmp_path_factory):
    """Folder of the same objects in four views of 48 pixels; read-only."""
    return write_samples(tmp_path_factory.mktemp("small"))

"""The garbage collector: relaxed in a program, left alone in a call."""

import atexit
import gc

import pytest

from reli3d.cli import collector
from reli3d.cli import main as reli3d
from reli3d.cli.exit_codes import command


@pytest.fixture
def thresholds():
    before = gc.get_threshold()
    yield before
    gc.set_threshold(*before)
    atexit.unregister(gc.freeze)


def test_a_program_collects_seldom_and_a_call_as_before(thresholds, monkeypatch):
    frozen = []
    monkeypatch.setattr(collector.atexit, "register", frozen.append)
    main = command("name")(lambda argv: gc.get_threshold())
    assert main([]) == thresholds and not frozen
    assert main() == (collector.OBJECTS, *thresholds[1:]) and frozen == [gc.freeze]


def test_the_command_of_all_commands_does_so_too(thresholds, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["reli3d"])
    assert reli3d.main() == 0 and "COMMAND" in capsys.readouterr().out
    assert gc.get_threshold()[0] == collector.OBJECTS


def test_a_program_imports_without_collections_and_a_call_as_before(thresholds):
    seen = []
    with collector.importing():
        seen.append(gc.isenabled())
    gc.set_threshold(collector.OBJECTS, *thresholds[1:])
    try:
        with pytest.raises(ImportError), collector.importing():
            seen.append(gc.isenabled())
            raise ImportError
        assert seen == [True, False] and gc.isenabled() and gc.get_freeze_count() > 0
    finally:
        gc.unfreeze()

"""``reli3d``: every command by its name."""

import pytest

from reli3d.cli import doctor, main


@pytest.mark.parametrize("name", [*main.COMMANDS, "data render", "data pack"])
def test_every_command_has_its_help_with_defaults(name, capsys):
    with pytest.raises(SystemExit) as stop:
        main.main([*name.split(), "--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert stop.value.code == 0 and "usage: reli3d" in text
    assert "(default None)" not in text and "(default False)" not in text
    assert "default" in text or name not in ("infer", "render", "data render", "data pack", "eval")


def test_options_reach_the_command_and_so_does_its_exit_code(monkeypatch, tmp_path, capsys):
    assert main.main([]) == 0
    text = capsys.readouterr().out
    assert all(f"\n  {name} " in text for name in main.COMMANDS)
    monkeypatch.setattr(doctor, "examine", lambda: ([("state", "ill")], False))
    assert main.main(["doctor"]) == 1 and capsys.readouterr().out.split() == ["state", "ill"]
    assert main.main(["check", str(tmp_path), "--output", str(tmp_path)]) == 2  # not an object folder
    assert capsys.readouterr().err.startswith("reli3d check: ")
    assert main.main(["infr"]) == 2
    assert "invalid choice: 'infr'" in capsys.readouterr().err

"""Text on a machine whose fonts cannot be listed."""

from pathlib import Path

import pytest

pytest.importorskip("pygame")
from pygame import sysfont

from sideslip.envs.rendering import canvas


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("script", [None, "#!/bin/sh\nexec sleep 9\n"], ids=["missing", "slow"])
def test_text_is_drawn_without_a_warning_where_no_font_is_listed(
    script: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if script is not None:
        (tmp_path / "fc-list").write_text(script)
        (tmp_path / "fc-list").chmod(0o755)
        (tmp_path / "sleep").symlink_to("/bin/sleep")
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(sysfont, "is_init", False)
    monkeypatch.setattr(sysfont, "Sysfonts", {})
    monkeypatch.setattr(sysfont, "Sysalias", {})
    canvas._load_font.cache_clear()
    canvas._render_words.cache_clear()
    assert canvas.Canvas((80, 40)).draw_text((5, 20), "12 m", "#000000", 19) > 10.0
    canvas._load_font.cache_clear()
    canvas._render_words.cache_clear()

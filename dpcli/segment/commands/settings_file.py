"""The file `settings.toml` beside trained weights."""

from __future__ import annotations

from dpcli.runtime.run_folder import RunFolder
from dpcli.runtime.whole_file import whole_file


def write_settings(folder: RunFolder, text: str) -> None:
    """Writes the resolved settings into the run's folder, as a file that --config reads back."""
    with whole_file(folder.file("settings.toml")) as part:
        part.write_text(text, encoding="utf-8")

"""The schema of summary.json, which belongs to the package, as a file of the site."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

SCHEMA = Path(__file__).parents[2] / "barpc/report/summary.schema.json"


def on_files(files: Files, config: Any) -> Files:
    """Add it where report.md links to it."""
    files.append(File.generated(config, SCHEMA.name, abs_src_path=str(SCHEMA)))
    return files

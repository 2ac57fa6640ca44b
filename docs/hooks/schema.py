"""The schema of summary.json, which the package makes, as a file of the site."""

from __future__ import annotations

import json
from typing import Any

from mkdocs.structure.files import File, Files

from barpc.report.summary import published_schema


def on_files(files: Files, config: Any) -> Files:
    """Add it where report.md links to it."""
    text = json.dumps(published_schema(), indent=1) + "\n"
    files.append(File.generated(config, "summary.schema.json", content=text))
    return files

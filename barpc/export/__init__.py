"""Finished runs in the words of other tools: neural renderers, COLMAP, stereo pipelines, catalogues.

`TARGETS` is the table: a row makes the files of an export, of a `Scene` that was read from the folder of a run.
"""

from __future__ import annotations

from barpc.export.targets import TARGETS, export_run

__all__ = ["TARGETS", "export_run"]

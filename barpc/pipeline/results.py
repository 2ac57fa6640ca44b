"""Results of runs, in memory and opened from folders: their common base, and `OpenedRun`."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from barpc.base.errors import BarpcWarning, InputError, plain
from barpc.base.frozen import load_npz
from barpc.base.safe_io import GEOJSON, read_json
from barpc.cameras import open_camera
from barpc.pipeline.remake import remake_report
from barpc.report import Summary
from barpc.report.compare import written_rpc
from barpc.report.finished import FinishedRun
from barpc.report.records import json_form
from barpc.report.runfiles import MATCHES, RunFiles
from barpc.scene import Tracks, View


class RunResult:
    """Base of the results of runs: `views`, `tracks` and `root` are its children's."""

    record: Summary

    @cached_property
    def summary(self) -> dict[str, Any]:
        """Content of summary.json."""
        found: dict[str, Any] = json_form(self.record)
        return found

    @property
    def passed(self) -> bool:
        """Whether every image was used and every quality gate met."""
        return self.record.passed

    @property
    def tables(self) -> RunFiles:
        """Tables of the run's folder as arrays: `observations` (K rows), `points` (P, 4) and their numbers `tracks`."""
        return FinishedRun.open(self._folder()).tables()

    def report(self) -> Path:
        """Make report.html of this run again from the files in its folder (extra `report`); return its path.

        A run that wrote no files (a check), or jinja2 that is not installed, is an InputError.
        """
        return remake_report(self._folder())

    def _folder(self) -> Path:
        if not self.record.out_dir:
            raise InputError("a check writes no files, so there are no tables, and nothing to make a report of")
        return Path(self.record.out_dir)

    def __repr__(self) -> str:
        tracks, place = self.record.tracks, self.record.out_dir or ""
        views = f"{len(self.record.views)} views, {tracks.num_tracks} tie points"
        counts = f"{views}, {tracks.num_observations} observations"
        written = f", in {place if len(place) <= 50 else '...' + place[-47:]}" if place else ""
        return f"{type(self).__name__}({self.record.kind}: {counts}, {self.record.status}{written})"


@dataclass(frozen=True, eq=False, repr=False)
class OpenedRun(RunResult):
    """A finished run, read from its folder; each part is read, and proved unchanged, when it is asked for.

    Parameters
    ----------
    record : Summary, content of summary.json as a typed record, with the folder
    root : str, the SHA-256 of SHA256SUMS
    finished : FinishedRun, the folder

    Examples
    --------
    >>> done = barpc.adjust("data_samples/view_0[01].tif", "again", points_per_image=300)
    >>> run = barpc.open_run("again")
    >>> run.views == done.views, run.tracks == done.tracks, run.passed == done.passed
    (True, True, True)
    """

    record: Summary
    root: str
    finished: FinishedRun

    @classmethod
    def of_folder(cls, folder: Path) -> OpenedRun:
        """Open a folder; InputError where it holds no finished run, or its summary was changed since."""
        run = FinishedRun.open(folder)
        return cls(replace(run.summary, out_dir=os.fspath(folder)), run.sealed.root, run)

    @cached_property
    def views(self) -> tuple[View, ...]:
        """The images whose cameras were written, in the order of their names, with these; then further bands.

        An image that is not where it was is a BarpcWarning: its camera is in the folder. InputError where the run wrote
        no cameras, or they were changed since.
        """
        if not (found := tuple(self._views())):
            raise InputError(f"{self.finished.folder}: a run of the kind {self.record.kind}, which wrote no cameras")
        return found

    def _views(self) -> Iterator[View]:
        for one in self.record.views:
            if one.outputs:
                if (rpc := written_rpc(self.finished, one.outputs)) is None:
                    raise InputError(f"{self.finished.folder}: no RPC file of {one.name} can be read: run it again")
                yield View(one.name, self._image(one.path), one.size, rpc, one.alt_range_m, one.date or "")
        for band in self.record.carried or ():
            camera = open_camera(self.finished.sealed.file(next(iter(band.outputs))))
            yield View(band.name, self._image(band.path), camera.extent, camera.model, camera.alt_range)

    def _image(self, path: str) -> str:
        """Return where an image is now."""
        try:
            return self.finished.input(path)
        except InputError as error:
            warnings.warn(str(error), BarpcWarning, stacklevel=4)
            return str(self.finished.sealed.located(path))

    @cached_property
    def tracks(self) -> Tracks:
        """All tie points; `Tracks.view` counts `record.views`."""
        path = self.finished.table(MATCHES)
        arrays = load_npz(path)
        try:
            found = Tracks(*(arrays[key] for key in ("view", "track", "xy", "sigma")))
            if [*arrays["names"]] != [view.name for view in self.record.views]:
                raise ValueError("its images are others")
        except (KeyError, ValueError, TypeError, IndexError) as error:
            raise InputError(f"{path}: damaged ({plain(error)}); run the adjustment again") from error
        return found

    def to_geojson(self) -> dict[str, Any]:
        """Return the outlines of the images with their figures, as GeoJSON."""
        found: dict[str, Any] = read_json(self.finished.table("footprints.geojson"), GEOJSON)
        return found

"""The one door to a finished run: its summary, its tables, its cameras, and its inputs, as they were."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from barpc.base.atomic import STATE
from barpc.base.errors import InputError
from barpc.base.identity import recorded
from barpc.base.keywords import PathLike
from barpc.base.manifest import LAST, SUMS
from barpc.base.remote import PathOrUrl, is_url
from barpc.base.sealed import Sealed
from barpc.report.runfiles import (
    FOLDER,
    PAGE_TABLES,
    PRIOR_FILE,
    TIE_TABLES,
    RunFiles,
    read_summary,
    read_tables,
    table_path,
)
from barpc.report.summary import InputEntry, Summary


@dataclass(frozen=True, eq=False)
class FinishedRun:
    """The folder of a run, as `barpc.base.sealed` finds it, and its summary."""

    sealed: Sealed
    summary: Summary

    @classmethod
    def open(cls, folder: PathLike) -> FinishedRun:
        """Open a run folder.

        InputError where it is none, or its summary was changed since.
        """
        folder = Path(folder)
        with recorded({}):  # no inputs of the command: `barpc report` and others add to them
            if not os.path.lexists(folder / SUMS):
                read_summary(folder)  # says what is missing, or of another release
            sealed = Sealed.open(folder)
            sealed.file(LAST)
            return cls(sealed, read_summary(folder))

    @classmethod
    def refuse_edited(cls, folder: Path, files: Iterable[Path], of_images: bool) -> None:
        """Raise InputError where files of a folder, if it is one of a run, are not as the run wrote them.

        `of_images`: its images are to be read, and all of them, with the pixels that their VRTs show.
        """
        if not (os.path.lexists(folder / LAST) and any(os.path.lexists(folder / name) for name in (SUMS, STATE))):
            return
        from barpc.rasters.raster import sources_of  # with GDAL: to read no image, none is asked for

        run, names = cls.open(folder), {file.name for file in files}
        if of_images:
            outputs = [view.outputs for view in run.summary.views] + [one.outputs for one in run.summary.carried or ()]
            names |= {name for files in outputs for name in files if name.endswith((".vrt", ".tif"))}
        for name in sorted(names & run.sealed.listed.keys()):  # others may lie there, too
            path = run.sealed.file(name)
            for source in sources_of(path) if of_images else ():
                run.ask(source)

    @property
    def folder(self) -> Path:
        """The folder, as given."""
        return self.sealed.folder

    @cached_property
    def inputs(self) -> Mapping[str, InputEntry]:
        """Inputs by their paths in the files of the run."""
        return {one.path: one for one in self.summary.inputs or ()}

    @cached_property
    def lineage(self) -> tuple[FinishedRun, ...]:
        """The run itself, the run that it added images to (`--add-to`), the one behind that, and so on.

        InputError where one of them is gone or has another block than images were added to.
        """
        added = (self.summary.options or {}).get("add_to")
        names = f"{added}/{FOLDER}/{PRIOR_FILE}", f"{added}/{PRIOR_FILE}"
        block = next((path for path in self.inputs if path in names), None)
        if block is None:
            return (self,)
        try:
            found = self.input(block)
        except InputError as error:
            raise InputError(
                f"{self.folder} adds images to {self.sealed.located(str(added))}, whose cameras it held: {error}"
            ) from error
        folder = Path(found).parent
        return (self, *FinishedRun.open(folder.parent if folder.name == FOLDER else folder).lineage)

    def table(self, name: str) -> Path:
        """Return the path of a table; InputError where it was changed since."""
        return self.sealed.file(table_path(self.folder, name).relative_to(self.folder).as_posix())

    def tables(self, of_page: bool = False) -> RunFiles:
        """Read the tie points, `of_page`: also the outlines and pictures; InputError where they were changed since."""
        for name in PAGE_TABLES if of_page else TIE_TABLES:
            self.table(name)
        return read_tables(self.summary, self.folder, of_page)

    def input(self, path: str, more: Iterable[Path] = ()) -> str:
        """Return where an input is, by the path in the run's files, a VRT with the images that it shows.

        A URL, or none, as it is. `more`: places to look for it by name. InputError where no file has its content.
        """
        if (entry := self.inputs.get(path)) is None:
            return self.sealed.input(path, "")
        from barpc.rasters.raster import sources_of

        found = self.sealed.input(path, entry.sha256, entry.bytes, more)
        for source in () if is_url(found) else sources_of(found):
            self.ask(source)
        return found

    def ask(self, path: PathOrUrl) -> None:
        """Raise InputError where a file has not the content of the run's input at this place, or else of its name."""
        if is_url(os.fspath(path)):
            return
        named = [one for one in self.inputs.values() if Path(one.path).name == Path(path).name]
        here = [one for one in named if Path(os.path.abspath(path)) in self.sealed.seen(one.path)]  # noqa: PTH100
        if not any(self.sealed.holds(Path(path), one.path, one.sha256, one.bytes) for one in here or named):
            raise InputError(f"{path}: is not the file that {self.folder} was made of; put it back, or run the "
                             "adjustment again")  # fmt: skip

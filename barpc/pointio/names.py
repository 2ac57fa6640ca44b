"""Which view a file means by a name: its own name, its file's name, or that without the ending."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import PurePath

from barpc.errors import InputError


class ViewNames:
    """Views found by any of the names that files use for them.

    Parameters
    ----------
    names : sequence of str
        The views, in order.
    source : str
        The file that is read, for messages.
    """

    def __init__(self, names: Sequence[str], source: str) -> None:
        self.names, self.source = tuple(names), source
        self._index: dict[str, int] = {}
        ambiguous: set[str] = set()
        for i, name in enumerate(names):
            for key in {PurePath(name).name, PurePath(name).stem}:
                if key in self._index:
                    ambiguous.add(key)
                self._index[key] = i
        for key in ambiguous:
            del self._index[key]
        self._index.update({name: i for i, name in enumerate(names)})

    def find(self, name: str) -> int | None:
        """Index of the view that `name` means; None where it means none."""
        path = PurePath(name.strip().strip('"'))
        for key in (str(path), path.name, path.stem):
            if key in self._index:
                return self._index[key]
        return None

    def index(self, name: str) -> int:
        """Index of the view that `name` means.

        Raises
        ------
        InputError
            There is none.
        """
        found = self.find(name)
        if found is None:
            listed = ", ".join(self.names[:10])
            raise InputError(f"{self.source}: no view is named {name!r}; there are {listed}")
        return found

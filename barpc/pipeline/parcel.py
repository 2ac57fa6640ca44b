"""Large arrays on their way to a worker: written once into the run folder, and sent as paths.

The keypoints of a view go to all its pairs. Over a network of workers they would pass through the scheduler
each time; so they are put on a shelf in the run folder, which all workers see as they see the images.
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from barpc.errors import InputError
from barpc.record import Record, from_record, to_record
from barpc.workspace import Workspace

LARGE = 1 << 20
"""Arrays of so many bytes are sent as paths."""


@dataclass(frozen=True)
class Parcel:
    """The arguments of a task.

    Parameters
    ----------
    small : dict of str to ndarray
        What `to_record` made of them, without the large arrays.
    large : mapping of str to str
        Name of each large array -> its file.
    """

    small: Record
    large: Mapping[str, str]

    def unpacked(self) -> tuple[Any, ...]:
        """The arguments.

        Raises
        ------
        InputError
            The worker does not see the run folder.
        """
        try:
            arrays = {name: np.load(path, allow_pickle=False) for name, path in self.large.items()}
        except OSError as error:
            raise InputError(
                f"{error.filename}: a worker cannot read it; images and run folder must be on a disk that all "
                "workers see under the same path"
            ) from error
        arguments: tuple[Any, ...] = from_record({**self.small, **arrays})
        return arguments


class Shelf:
    """Where large arrays lie while a run is at work: a folder among its caches."""

    def __init__(self, workspace: Workspace) -> None:
        self._workspace, self._folder = workspace, workspace.cache / "arrays"

    def packed(
        self, args: tuple[Any, ...], digest: Callable[[np.ndarray[Any, Any]], str]
    ) -> tuple[Any, ...] | Parcel:
        """The arguments as they are, or as a parcel where a large array is among them."""
        try:
            record = to_record(args)
        except TypeError:  # something that is not kept as a record, such as a user's own sensor
            return args
        large = {name: array for name, array in record.items() if array.nbytes >= LARGE}
        if not large:
            return args
        paths = {name: self._put(array, digest(array)) for name, array in large.items()}
        return Parcel({name: array for name, array in record.items() if name not in large}, paths)

    def _put(self, array: np.ndarray[Any, Any], digest: str) -> str:
        path = self._folder / f"{hashlib.sha256(digest.encode()).hexdigest()[:32]}.npy"
        if not path.exists():
            with self._workspace.keeping(path) as partial, partial.open("wb") as file:
                np.save(file, array, allow_pickle=False)
        return str(path)

    def clear(self) -> None:
        """Take the arrays away."""
        shutil.rmtree(self._folder, ignore_errors=True)

"""Values that never change: what frozen records with arrays share."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
import numpy.typing as npt

from barpc.errors import BarpcError, InputError


class Frozen:
    """Base of frozen dataclasses (declared with ``eq=False``) that hold arrays and plain values.

    Arrays are copies of their own and read-only, after unpickling too; equality and hash go by the content of the
    fields that are given to the constructor.
    """

    def __post_init__(self) -> None:
        for name in self._given():
            value = getattr(self, name)
            if isinstance(value, np.ndarray):
                self._keep(name, value.copy())

    def _keep(self, name: str, value: Any) -> None:
        """Set a field; an array becomes read-only."""
        if isinstance(value, np.ndarray):
            value.setflags(write=False)
        object.__setattr__(self, name, value)

    def _array(
        self,
        name: str,
        shape: tuple[int | None, ...],
        error: type[BarpcError] = InputError,
        dtype: npt.DTypeLike = np.float64,
        finite: bool = True,
    ) -> Any:
        """Make a field a read-only array of the given shape (None: any length), its numbers `finite` if so asked."""
        value: npt.NDArray[Any] = np.array(getattr(self, name), dtype=dtype)
        what = f"{type(self).__name__} {name}"
        if value.ndim != len(shape) or any(
            n not in (None, m) for n, m in zip(shape, value.shape, strict=True)
        ):
            raise error(f"{what}: shape {value.shape}, expected {shape}")
        if finite and not np.isfinite(value).all():
            raise error(f"{what}: not finite ({value[~np.isfinite(value)][0]})")
        self._keep(name, value)
        return value

    def _given(self) -> list[str]:
        """Names of the fields that the constructor takes."""
        return [field.name for field in fields(self) if field.init]  # type: ignore[arg-type]  # children are dataclasses

    def _content(self) -> tuple[object, ...]:
        return tuple(_plain(getattr(self, name)) for name in self._given())

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and isinstance(other, Frozen) and self._content() == other._content()

    def __hash__(self) -> int:
        return hash(self._content())

    def __setstate__(self, state: dict[str, Any]) -> None:
        for name, value in state.items():
            self._keep(name, value)


def _plain(value: object) -> object:
    """What stands for a value when it is compared; -0.0 is 0.0."""
    if not isinstance(value, np.ndarray):
        return value
    return value.shape, (value + 0.0 if value.dtype.kind == "f" else value).tobytes()

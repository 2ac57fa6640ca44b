"""How a file of points is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from barpc.base.errors import InputError


def refused(read: Callable[[Path], object], path: Path, said: str) -> str:
    """What a reader says of a file that it refuses: one line that begins with its name and holds a pattern."""
    with pytest.raises(InputError, match=said) as told:
        read(path)
    assert str(told.value).startswith(str(path))
    assert "\n" not in str(told.value)
    return str(told.value)

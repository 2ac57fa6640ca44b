"""Foundations: errors, files opened and written safely, frozen values, options, the ellipsoid."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module

TYPE_CHECKING = False  # as in barpc itself
if TYPE_CHECKING:
    from typing import Any


def used_later(package: str, modules: Mapping[str, str]) -> Callable[[str], Any]:
    """Return the `__getattr__` of a package whose names (name -> its module) are imported when first used."""

    def of_package(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(modules[name]), name)

    return of_package

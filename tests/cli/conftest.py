"""A camera file, crops that overlap and a run on them, and what every verb does set by hand."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from barpc.cli import cli
from barpc.rpcio import write_rpc_copy
from tests.reliability.conftest import crops, pristine, ran  # noqa: F401
from tests.rpcio.conftest import make_rpc, write_image


@pytest.fixture
def image(tmp_path: Path) -> Path:
    """An image of 600 x 400 px with an RPC in its tag, alone in its folder."""
    raw = write_image(tmp_path / "raw.tif", shape=(1, 400, 600))
    write_rpc_copy(make_rpc().crop(900, 900), raw, tmp_path / "in" / "scene.tif")
    return tmp_path / "in" / "scene.tif"


@pytest.fixture
def verb(monkeypatch: pytest.MonkeyPatch) -> Callable[[object], None]:
    """Sets what every call of the group does: it returns a value or raises an error."""

    def does(what: object) -> None:
        def called(**_: object) -> object:
            if isinstance(what, BaseException):
                raise what
            return what() if callable(what) else what

        monkeypatch.setattr(cli, "main", called)

    return does

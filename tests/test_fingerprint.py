"""What is no file is refused where it would be hashed, not waited for."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest

from barpc.base.errors import ImageError, InputError
from barpc.rasters.raster import hashed


def refused(path: Path) -> str:
    """What is said of a path; a thread of its own, as a pipe that is opened may never answer."""
    said: list[str] = []

    def ask() -> None:
        with pytest.raises((ImageError, InputError)) as caught:
            hashed(path)
        said.append(str(caught.value))

    thread = threading.Thread(target=ask, daemon=True)
    thread.start()
    thread.join(60.0)
    assert said, "it waits"
    return said[0]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names on this system")
def test_a_pipe_or_a_device_has_no_hash(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(tmp_path / "pipe")
    for name in ("pipe", "link"):
        assert refused(tmp_path / name) == f"{tmp_path / name}: a pipe, not a file; an image is needed"
    (tmp_path / "zeros").symlink_to("/dev/zero")
    assert "a device, not a file" in refused(tmp_path / "zeros")
    assert "no such file" in refused(tmp_path / "missing")

"""A valid file of every format, to start mutations from."""

from __future__ import annotations

import tempfile
from pathlib import Path

from barpc.rpcio import FORMATS, write_rpc_copy
from tests.rpcio.conftest import dimap_v1, dimap_v2, dimap_v3, enmap, envi, make_rpc, write_image, yaml


def _tiff() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        image = write_image(Path(folder) / "a.tif", shape=(1, 2, 2))
        write_rpc_copy(make_rpc(), image, Path(folder) / "b.tif")
        return (Path(folder) / "b.tif").read_bytes()


def _alos() -> bytes:
    offsets = ["006500", "03550", " 35.6812", " 139.7671", " 0500"]
    cells = [f"{f'{1 + i / 100:+.5f}E-{i % 8}':>12}" for i in range(80)]
    return "".join([*offsets, *offsets, *cells]).encode()


SAMPLES: dict[str, bytes] = {
    row.name: row.write(make_rpc()).encode() for row in FORMATS.values() if row.write is not None
} | {
    "dimap": dimap_v2(make_rpc()).encode(),
    "dimap v1": dimap_v1(make_rpc()).encode(),
    "dimap v3": dimap_v3(make_rpc()).encode(),
    "enmap": enmap(make_rpc()).encode(),
    "yaml": yaml(make_rpc()).encode(),
    "envi": envi(make_rpc()).encode(),
    "alos": _alos(),
    "tiff": _tiff(),
}


def seed(name: str) -> bytes:
    """A sample with the byte in front by which `targets.check_all` chooses its reader."""
    names = list(FORMATS)
    kind = name.split(" ", maxsplit=1)[0]
    return bytes([len(names) if kind == "tiff" else names.index(kind)]) + SAMPLES[name]

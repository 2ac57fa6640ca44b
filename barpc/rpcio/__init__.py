"""RPC files: read any vendor's, write those that other tools read, and say where an RPC came from.

`FORMATS` is the table of syntaxes; `read_rpc` goes by content and, for images, by GDAL's order of
precedence. See ``docs/formats.md``.
"""

from __future__ import annotations

from barpc.rpcio.formats import CARRIERS, FORMATS, WRITABLE, Carrier, find_rpc, format_for, write_camera, write_rpc
from barpc.rpcio.images import local_image, write_crop, write_rpc_copy, write_rpc_vrt
from barpc.rpcio.sources import hidden_by, read_rpc, read_rpc_source, shadows, sidecars

__all__ = [
    "CARRIERS",
    "FORMATS",
    "WRITABLE",
    "Carrier",
    "find_rpc",
    "format_for",
    "hidden_by",
    "local_image",
    "read_rpc",
    "read_rpc_source",
    "shadows",
    "sidecars",
    "write_camera",
    "write_crop",
    "write_rpc",
    "write_rpc_copy",
    "write_rpc_vrt",
]

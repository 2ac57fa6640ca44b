"""The day an image was taken, where its metadata say so."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from datetime import date

from barpc.errors import BarpcError
from barpc.remote import Place, Remote
from barpc.rpcio.formats import files_of
from barpc.sidefile import RPC_FILE, read_head

_TAGS = ("ACQUISITIONDATETIME", "NITF_IDATIM", "TIFFTAG_DATETIME")  # the last is often that of the file
_DAY = re.compile(r"(\d{4})[-:/]?(\d\d)[-:/]?(\d\d)")
_STATED = re.compile(
    rb"(?:first_?line_?time|earliest_?acq_?time|imaging_date|acquisition_?date(?:_?time)?)\"?\s{0,9}[>=:]\s{0,9}\"?"
    rb"(\d{4}-\d\d-\d\d)",
    re.IGNORECASE,
)
_HEAD = 1 << 20  # bytes of a file beside the image that are looked at


def date_taken(image: Place, camera: Place, tags: Mapping[str, str]) -> str:
    """The day (ISO 8601) that the files of an image state, its own `tags` last; empty where none does.

    Looked at are the file of its camera, Maxar's IMD and XML, and Airbus' DIM file.
    """
    for file in _beside(image, camera):
        try:
            stated = _STATED.search(read_head(file, RPC_FILE, _HEAD))
        except BarpcError:
            continue
        if stated and (day := _day(stated[1].decode())):
            return day
    return next((day for tag in _TAGS if (day := _day(tags.get(tag, "")))), "")


def _beside(image: Place, camera: Place) -> Iterator[Place]:
    if isinstance(image, Remote) or isinstance(camera, Remote):
        return
    if camera != image and camera.is_file():
        yield camera
    product = image.stem[4:]
    wanted = [f"{image.stem}.imd", f"{image.stem}.xml"]
    wanted += [f"dim_{part}.xml" for part in (product, product.rpartition("_")[0]) if part]
    present = files_of(image.parent)
    yield from (image.parent / present[name.lower()] for name in wanted if name.lower() in present)


def _day(text: str) -> str:
    """The day that a time begins with; empty for none, or one before there were satellites."""
    found = _DAY.match(text.strip())
    try:
        day = date(*map(int, found.groups())) if found else date.min
    except ValueError:
        return ""
    return day.isoformat() if day.year > 1956 else ""

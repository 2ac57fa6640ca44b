"""When an image was taken and where the sun stood, where the files beside it say so."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import date
from pathlib import Path

import numpy as np

from barpc.errors import BarpcError
from barpc.remote import Place, is_url
from barpc.rpcio.formats import files_of
from barpc.sidefile import RPC_FILE, read_head

_TAGS = ("ACQUISITIONDATETIME", "NITF_IDATIM", "TIFFTAG_DATETIME")  # the last is often that of the file
_TAG = re.compile(r"(\d{4})[-:/]?(\d\d)[-:/]?(\d\d)")
_FIRST = 1957  # no satellite took an image before
_HEAD = 4 << 20  # bytes of a file that are looked at
_NUMBER = rb"([+-]?\d{1,3}(?:\.\d{1,20})?(?:e[+-]?\d{1,2})?)"
_SUN = {
    name: re.compile(
        rb"(?<![a-z])(?:mean_?)?sun_?" + word + rb"\"?(?:\s?unit=\"\w{1,9}\")?\s{0,9}[>=:]\s{0,9}" + _NUMBER,
        re.IGNORECASE,
    )
    for name, word in (("elevation", rb"el(?:ev(?:ation)?)?"), ("azimuth", rb"az(?:im(?:uth)?)?"))
}
_DAY = rb"(\d{4}-\d\d-\d\d)"
_CLOCK = rb"(\d\d:\d\d:\d\d(?:\.\d{1,9})?)"
_WHEN = re.compile(
    rb"(?:first_?line_?time|earliest_?acq_?time|tlc_?time|imaging_date|acquisition_?date(?:_?time)?|\"acquired)\"?"
    rb"\s{0,9}[>=:]\s{0,9}\"?" + _DAY + rb"(?:T" + _CLOCK + rb")?",
    re.IGNORECASE,
)
_TIME = re.compile(rb"<IMAGING_TIME>" + _CLOCK)


@dataclass(frozen=True)
class Sunlight:
    """The sun's elevation and azimuth [deg], and the time (UTC, ISO 8601; the day alone where no more is known)."""

    elevation: float | None = None
    azimuth: float | None = None
    time: str | None = None


def light_of(image: str, camera: str | None = None) -> Sunlight:
    """Read sun angles and time from the file of an image's camera and the metadata beside the image: Maxar's
    IMD and XML, Airbus' DIM file.

    Of several values over the image (Airbus) the median is taken.
    """
    found: dict[str, float] = {}
    time = None
    if not image or any(name and (is_url(name) or "\0" in name) for name in (image, camera)):
        return Sunlight()
    for text in _texts(Path(image), Path(camera or image)):
        for name, pattern in _SUN.items():
            values = [float(value) for value in pattern.findall(text)]
            if values and abs(values[0]) <= 360 and name not in found:
                found[name] = float(np.median(values))
        time = time or _time(text)
    return Sunlight(found.get("elevation"), found.get("azimuth"), time or None)


def date_taken(image: Place, camera: Place, tags: Mapping[str, str]) -> str:
    """Return the day (ISO 8601) that the files of `light_of` state, an image's own `tags` last; empty where
    none does.
    """
    stated = next((time[:10] for text in _texts(image, camera) if (time := _time(text))), "")
    found = (_TAG.match(tags.get(tag, "").strip()) for tag in _TAGS)
    return stated or next((day for tag in found if tag and (day := _day("-".join(tag.groups())))), "")


def _day(text: str) -> str:
    """Return a day, if it is one of a time with satellites; else empty."""
    try:
        return text if date.fromisoformat(text).year >= _FIRST else ""
    except ValueError:
        return ""


def _time(text: bytes) -> str:
    stated = _WHEN.search(text)
    day = _day(stated[1].decode()) if stated else ""
    if not (stated and day):
        return ""
    clock = stated[2]
    if clock is None and (later := _TIME.search(text, stated.end(), stated.end() + 500)):
        clock = later[1]
    return f"{day}T{clock.decode()}Z" if clock else day


def _texts(image: Place, camera: Place) -> Iterator[bytes]:
    """Yield how the file of the camera and the metadata beside an image begin; nothing of images elsewhere."""
    if not (isinstance(image, Path) and isinstance(camera, Path)):
        return
    product = image.stem[4:]
    wanted = [f"{image.stem}.imd", f"{image.stem}.xml", f"{image.stem}_metadata.json"]
    wanted += [f"dim_{part}.xml" for part in (product, product.rpartition("_")[0]) if part]
    present = files_of(image.parent)
    files = [camera] if camera != image and camera.is_file() else []
    for file in [
        *files,
        *(image.parent / present[name.lower()] for name in wanted if name.lower() in present),
    ]:
        try:
            yield read_head(file, RPC_FILE, _HEAD)
        except BarpcError:
            continue

"""When an image was taken and where the sun stood, where the files beside it say so."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from barpc.errors import BarpcError
from barpc.remote import is_url
from barpc.rpcio.formats import files_of
from barpc.sidefile import RPC_FILE, read_head

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
class Light:
    """The sun's elevation and azimuth [deg], and the time (UTC, ISO 8601; the day alone where no more is known)."""

    elevation: float | None = None
    azimuth: float | None = None
    time: str | None = None


def light_of(image: str, camera: str | None = None) -> Light:
    """What the file of an image's camera and the metadata beside the image say: Maxar's IMD and XML, Airbus' DIM file.

    Of several values over the image (Airbus) the median is taken.
    """
    found: dict[str, float] = {}
    time = None
    for file in _beside(image, camera):
        try:
            text = read_head(file, RPC_FILE, _HEAD)
        except BarpcError:
            continue
        for name, pattern in _SUN.items():
            values = [float(value) for value in pattern.findall(text)]
            if values and abs(values[0]) <= 360 and name not in found:
                found[name] = float(np.median(values))
        time = time or _time(text)
    return Light(found.get("elevation"), found.get("azimuth"), time)


def _time(text: bytes) -> str | None:
    stated = _WHEN.search(text)
    if stated is None:
        return None
    day, clock = stated[1].decode(), stated[2]
    if clock is None and (later := _TIME.search(text, stated.end(), stated.end() + 500)):
        clock = later[1]
    try:
        datetime.fromisoformat(day).replace(tzinfo=UTC)
        return f"{day}T{clock.decode()}Z" if clock else day
    except ValueError:
        return None


def _beside(image: str, camera: str | None) -> Iterator[Path]:
    if is_url(image) or not image or "\0" in image:
        return
    path, product = Path(image), Path(image).stem[4:]
    if camera and camera != image and not is_url(camera) and "\0" not in camera and Path(camera).is_file():
        yield Path(camera)
    wanted = [f"{path.stem}.imd", f"{path.stem}.xml", f"{path.stem}_metadata.json"]
    wanted += [f"dim_{part}.xml" for part in (product, product.rpartition("_")[0]) if part]
    present = files_of(path.parent)
    yield from (path.parent / present[name.lower()] for name in wanted if name.lower() in present)

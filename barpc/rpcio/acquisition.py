"""The sensor, time and sun angles of an image, read from its metadata.

Metadata are the file of the camera, Maxar's IMD and XML, Airbus' DIM and Planet's JSON beside the image, and its tags;
never pixels.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import date
from heapq import merge
from pathlib import Path

import numpy as np

from barpc.base.errors import BarpcError
from barpc.base.remote import PathOrUrl, is_url
from barpc.base.safe_io import RPC_FILE, read_head
from barpc.rasters.raster import MOSAICS, driver_at
from barpc.rpcio.formats import files_of
from barpc.rpcio.images import SCANNED

FIRST_YEAR = 1957
"""No satellite took an image before."""
_BEFORE, _LENGTH = 8, 250  # bytes of a match before its word ("mean_sun"), and from there on at most


@dataclass(frozen=True)
class Acquisition:
    """Sensor, time and sun angles of an image as its metadata state them; None or empty where they do not."""

    elevation: float | None = None  # of the sun [deg]
    azimuth: float | None = None  # of the sun [deg], clockwise from north
    time: str | None = None  # UTC, ISO 8601; the day alone where no more is known
    sensor: str = ""  # and band: WV02_P, PHR1B_PAN

    def day(self, tags: Mapping[str, str]) -> str:
        """Return the day (ISO 8601), or that of an image's `tags`; empty if neither states one."""
        if self.time:
            return self.time[:10]
        found = (_DAY_TAG.match(tags.get(tag, "").strip()) for tag in _DAY_TAGS)
        return next((day for tag in found if tag and (day := _day("-".join(tag.groups())))), "")


def read_acquisition(
    image: PathOrUrl | str, camera: PathOrUrl | str | None = None, tags: Mapping[str, str] | None = None
) -> Acquisition:
    """Read the sensor, time and sun angles of an image from its camera's file, the metadata beside it, and its `tags`.

    The first that states a thing counts; of several values in it (Airbus' sun angles) the median is taken.
    """
    sun, words, time = dict[str, float](), dict[str, str](), ""
    of_tags = "".join(f"{key}={value}\n" for key, value in (tags or {}).items()).encode()[:SCANNED]
    for text in map(_Text, (*_metadata(image, camera), of_tags)):
        angles = dict[str, list[float]]()
        for found in _SUN.matches(text):
            angles.setdefault("azimuth" if found[1] is None else "elevation", []).append(float(found[2]))
        sun = {name: float(np.median(values)) for name, values in angles.items() if abs(values[0]) <= 360} | sun
        for name, keyed in _SENSOR.items():
            if name not in words and (stated := next(keyed.matches(text), None)):
                words[name] = stated[1].decode()
        time = time or _time(text)
        if not (words and time) and (strip := next(_STRIP_NAME.matches(text), None)):
            words.setdefault("satellite", strip[1].decode())
            time = time or _of_digits(strip[2].decode(), strip[3].decode())
    name, number, band = (words.get(word, "") for word in _SENSOR)
    band = "" if name.startswith(band) else f"_{band}"  # OTB's keyword lists call an instrument PHR
    sensor = re.sub(r"[^\w-]+", "-", name + number + band) if name else ""
    return Acquisition(sun.get("elevation"), sun.get("azimuth"), time or None, sensor)


def _metadata(image: PathOrUrl | str, camera: PathOrUrl | str | None) -> Iterator[bytes]:
    """Yield how the file of the camera and the metadata beside an image begin; nothing of images elsewhere."""
    names = [os.fspath(name) for name in (image, camera) if name]
    if not image or any(is_url(name) or "\0" in name for name in names):
        return
    place, holder = Path(names[0]), Path(names[-1])
    product, present = place.stem[4:], files_of(place.parent)
    wanted = [f"{place.stem}.imd", f"{place.stem}.xml", f"{place.stem}_metadata.json"]
    wanted += [f"dim_{part}.xml" for part in (product, product.rpartition("_")[0]) if part]
    beside = (place.parent / present[name.lower()] for name in wanted if name.lower() in present)
    seen = set[tuple[int, int]]()
    for file in (holder, *beside):
        with suppress(BarpcError, OSError):
            status = file.stat()
            of_pixels = driver_at(file) not in (None, *MOSAICS)
            if not of_pixels and (status.st_dev, status.st_ino) not in seen:
                seen.add((status.st_dev, status.st_ino))
                yield read_head(file, RPC_FILE, SCANNED)


class _Text:
    """A text and the places of words (lower case) in it.

    All but some lines of the metadata of an image, 1 MB, are orbit and attitude, in digits: words are first looked for
    in the text without digits, once among its parts that differ. To search 1 MB takes 1 ms so, and 100 ms by patterns.
    """

    def __init__(self, whole: bytes) -> None:
        self.whole, self._lower = whole, whole.lower()
        self._letters = self._lower.translate(None, b"0123456789.+- \t\r\n")
        self._parts = b">".join(set(self._letters.split(b">")))

    def places(self, word: bytes) -> Iterator[int]:
        """Yield where a word begins."""
        place = -len(word)
        count = self._letters.count(word) if word in self._parts else 0
        for _ in range(count):  # behind the last one nothing is searched
            if (place := self._lower.find(word, place + len(word))) < 0:
                return
            yield place


@dataclass(frozen=True)
class _Keyed:
    """A pattern, and words (lower case) one of which each of its matches holds."""

    words: tuple[bytes, ...]
    pattern: re.Pattern[bytes]

    def matches(self, text: _Text) -> Iterator[re.Match[bytes]]:
        """Yield the matches in a text in their order."""
        end = 0
        for place in merge(*map(text.places, self.words)):
            found = self.pattern.search(text.whole, max(end, place - _BEFORE), place + _LENGTH)
            if found is not None and found.start() <= place:
                end = found.end()
                yield found


_NUMBER_TEXT = rb"([+-]?\d{1,3}(?:\.\d{1,20})?(?:e[+-]?\d{1,2})?)"
_SUN = _Keyed(
    (b"sun",),
    re.compile(
        rb"(?<![a-z])(?:mean_?)?sun_?(?:(el(?:ev(?:ation)?)?)|az(?:im(?:uth)?)?)\"?(?:\s?unit=\"\w{1,9}\")?\s{0,9}[>=:]"
        rb"\s{0,9}" + _NUMBER_TEXT,
        re.IGNORECASE,
    ),
)
_SENSOR = {
    name: _Keyed(
        words,
        re.compile(
            rb"(?<![a-z_])(?:" + b"|".join(words) + rb")\"?\s{0,9}[>=:]\s{0,9}\"?"
            rb"([A-Za-z0-9][\w .-]{0,39}?)\"?\s{0,9}[;<,\n\r}]",
            re.IGNORECASE,
        ),
    )
    for name, words in {
        "satellite": (b"satid", b"mission", b"satellite_id"),
        "number": (b"mission_index",),
        "band": (b"bandid", b"band_id", b"spectral_processing", b"instrument"),
    }.items()
}
_CLOCK = rb"([01]\d|2[0-3]):?([0-5]\d):?([0-5]\d(?:\.\d{1,9})?)"
_WHEN = _Keyed(
    (b"first", b"earliest", b"tlc_time", b"tlctime", b"image_date", b"imaging_date", b"acquisition", b'"acquired',
     b"idatim"),
    re.compile(
        rb"(?:first_?line_?time|earliest_?acq_?time|tlc_?time|imag(?:e|ing)_date|acquisition_?date(?:_?time)?|idatim"
        rb"|\"acquired)\"?\s{0,9}[>=:]\s{0,9}\"?(\d{4})-?(\d\d)-?(\d\d)(?:[T ]?" + _CLOCK + rb")?",
        re.IGNORECASE,
    ),
)  # fmt: skip
_STRIP_NAME = _Keyed(
    (b"ds_",), re.compile(rb"(?<![A-Za-z0-9])DS_(PHR1[AB]|SPOT[67]|PNEO[3-6])_(\d{8})(\d{6})\d?_")
)  # the acquisition by which Airbus names what it delivers: sensor, day, time
_IMAGING_TIME = re.compile(rb"<IMAGING_TIME>" + _CLOCK)
_DAY_TAGS = ("ACQUISITIONDATETIME", "NITF_IDATIM", "TIFFTAG_DATETIME")  # the last is often that of the file
_DAY_TAG = re.compile(r"(\d{4})[-:/]?(\d\d)[-:/]?(\d\d)")


def _time(text: _Text) -> str:
    stated = next(_WHEN.matches(text), None)
    day = _day(b"-".join(stated.groups()[:3]).decode()) if stated else ""
    if not (stated and day):
        return ""
    clock = stated.groups()[3:]
    if clock[0] is None and (later := _IMAGING_TIME.search(text.whole, stated.end(), stated.end() + 500)):
        clock = later.groups()
    return f"{day}T{b':'.join(clock).decode()}Z" if clock[0] else day


def _of_digits(day: str, clock: str) -> str:
    """Return a time of YYYYMMDD and HHMMSS; empty if it is none."""
    found = _day(f"{day[:4]}-{day[4:6]}-{day[6:]}")
    return f"{found}T{clock[:2]}:{clock[2:4]}:{clock[4:]}Z" if found and clock[:2] < "24" else found


def _day(text: str) -> str:
    """Return a day, if it is one of a time with satellites; else empty."""
    try:
        return text if date.fromisoformat(text).year >= FIRST_YEAR else ""
    except ValueError:
        return ""

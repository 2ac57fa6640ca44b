"""Reading a VRT: a closed grammar of tags, attributes and text; what is not in it is refused.

GDAL's own reader takes attributes for elements, tags in any case, and half-closed documents. So GDAL is never
shown a VRT of somebody else: what this module reads is all there is, and of that it writes a new one.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from barpc.base.errors import ImageError, RpcFormatError
from barpc.base.safe_io import MB, XML, parse_xml, read_bytes

_INTEGERS = {f"{u}int{n}": f"{u.upper()}Int{n}" for n in (16, 32, 64) for u in ("u", "")}
_COMPLEX = {"complex_int16": "CInt16", "complex64": "CFloat32", "complex128": "CFloat64"}
_FLOATS = {"float32": "Float32", "float64": "Float64"}
GDAL_TYPES = {"uint8": "Byte", "int8": "Int8"} | _INTEGERS | _FLOATS | _COMPLEX
"""rasterio's names of pixel types -> GDAL's."""
MAGIC = b"<VRTDataset"
Rect = tuple[int, int, int, int]  # col, row of the first pixel, width, height [px]

_ANY = r"(?s:.*)"
_INTEGER_PATTERN = r"\d{1,9}"
_REAL_PATTERN = r"[+-]?(?:\d{1,400}\.?\d{0,400}|\.\d{1,400})(?:[eE][+-]?\d{1,4})?"
_NODATA = rf"{_REAL_PATTERN}|[+-]?nan|[+-]?inf(?:inity)?"
_SWITCH = "0|1"
_TYPE = "|".join(GDAL_TYPES.values())
_RESAMPLING = "nearest|near|bilinear|cubic|cubicspline|lanczos|average|rms|mode|gauss"
_SRS = r"(?s:[A-Z_]{4,20}\[.*\])|EPSG:\d{1,6}"
INDIRECT = re.compile(r"/vsi|[A-Za-z][A-Za-z0-9+._-]+:")
BLOCK_SIZE = 512  # px a side, read and written at a time
_SHIFT = 1e-3  # px; a rectangle that lies less beside whole pixels is meant to lie on them


class _Tag(NamedTuple):
    """Allowed content of an element: a pattern of its text, of its attributes, and its children."""

    text: str | None = None
    attributes: Mapping[str, str] = {}
    children: str = ""


_RECT = ("xOff", "yOff", "xSize", "ySize")
PROPERTIES = ("RasterXSize", "RasterYSize", "BlockXSize", "BlockYSize", "DataType")
"""Of a source."""
_SOURCE_ELEMENTS = "SourceFilename SourceBand SourceProperties SrcRect DstRect"
_BAND = "ColorInterp NoDataValue HideNoDataValue SimpleSource ComplexSource"
_FORGOTTEN = "Description UnitType Offset Scale Metadata CategoryNames ColorTable Histograms"
_INTEGER_ELEMENTS = ("BlockXSize", "BlockYSize", "BucketCount", "IncludeOutOfRange", "Approximate")
_AXIS_MAPPING = r"-?\d(,-?\d){0,3}"
_GRAMMAR: dict[str, _Tag] = {
    "VRTDataset": _Tag(
        None,
        {"rasterXSize": _INTEGER_PATTERN, "rasterYSize": _INTEGER_PATTERN},
        "SRS GeoTransform GCPList Metadata BlockXSize BlockYSize OverviewList VRTRasterBand MaskBand",
    ),
    "SRS": _Tag(_SRS, {"dataAxisToSRSAxisMapping": _AXIS_MAPPING, "coordinateEpoch": _REAL_PATTERN}),
    "GeoTransform": _Tag(rf"{_REAL_PATTERN}(\s*,\s*{_REAL_PATTERN}){{5}}"),
    "GCPList": _Tag(None, {"Projection": f"{_SRS}|", "dataAxisToSRSAxisMapping": _AXIS_MAPPING}, "GCP"),
    "GCP": _Tag(None, {"Id": _ANY, "Info": _ANY, **dict.fromkeys(("Pixel", "Line", "X", "Y", "Z"), _REAL_PATTERN)}),
    "Metadata": _Tag(None, {"domain": _ANY}, "MDI"),
    "MDI": _Tag(_ANY, {"key": _ANY}),
    "OverviewList": _Tag(r"[\d\s]*", {"resampling": r"\w+"}),
    "VRTRasterBand": _Tag(
        None,
        {"dataType": _TYPE, **dict.fromkeys(("band", "blockXSize", "blockYSize"), _INTEGER_PATTERN)},
        f"{_BAND} {_FORGOTTEN}",
    ),
    "MaskBand": _Tag(None, {}, "VRTRasterBand"),
    "ColorInterp": _Tag(r"[\w ]+"),
    "HideNoDataValue": _Tag(_SWITCH),
    "CategoryNames": _Tag(None, {}, "Category"),
    "ColorTable": _Tag(None, {}, "Entry"),
    "Entry": _Tag(None, dict.fromkeys(("c1", "c2", "c3", "c4"), _INTEGER_PATTERN)),
    "Histograms": _Tag(None, {}, "HistItem"),
    "HistItem": _Tag(None, {}, "HistMin HistMax BucketCount IncludeOutOfRange Approximate HistCounts"),
    "HistCounts": _Tag(r"[\d|]*"),
    "SimpleSource": _Tag(None, {"resampling": _RESAMPLING}, _SOURCE_ELEMENTS),
    "ComplexSource": _Tag(None, {"resampling": _RESAMPLING}, f"{_SOURCE_ELEMENTS} NODATA ScaleOffset ScaleRatio"),
    "SourceFilename": _Tag(_ANY, {"relativeToVRT": _SWITCH, "shared": _SWITCH}),
    "SourceBand": _Tag(rf"{_INTEGER_PATTERN}|mask,{_INTEGER_PATTERN}"),
    "SourceProperties": _Tag(None, {**dict.fromkeys(PROPERTIES, _INTEGER_PATTERN), "DataType": r"\w+"}),
    **dict.fromkeys(("SrcRect", "DstRect"), _Tag(None, dict.fromkeys(_RECT, _REAL_PATTERN))),
    **dict.fromkeys(_INTEGER_ELEMENTS, _Tag(_INTEGER_PATTERN)),
    **dict.fromkeys(("Description", "UnitType", "Category"), _Tag(_ANY)),
    **dict.fromkeys(("Offset", "Scale", "ScaleOffset", "ScaleRatio"), _Tag(_REAL_PATTERN)),
    **dict.fromkeys(("NoDataValue", "NODATA", "HistMin", "HistMax"), _Tag(_NODATA)),
}
_REPEATED = "Metadata MDI GCP Entry Category HistItem VRTRasterBand SimpleSource ComplexSource"


@dataclass(frozen=True)
class Source:
    """A rectangle of a band (from 1) of a raster, or of the band's mask, and where it goes."""

    file: Path
    band: int
    mask: bool = False
    src: Rect | None = None  # in the raster, and in the VRT, of one size; None for the whole
    dst: Rect | None = None
    nodata: float | None = None  # not handed on
    scale: tuple[float, float] = (1.0, 0.0)  # ratio and offset applied to the values

    @property
    def plain(self) -> bool:
        """Whether values are handed on as they are."""
        return self.nodata is None and self.scale == (1.0, 0.0)


@dataclass(frozen=True)
class Band:
    """A band of a VRT: `dtype` by rasterio's name, `fill` where no source reaches."""

    dtype: str
    nodata: float | None
    fill: float
    color: str
    unit: str | None  # of its values, and what makes these of the numbers: scale and offset
    linear: tuple[float, float]
    sources: tuple[Source, ...]


@dataclass(frozen=True)
class Vrt:
    """Content of a VRT."""

    size: tuple[int, int]  # width, height [px]
    bands: tuple[Band, ...]
    mask: Band | None  # of the whole raster
    srs: str  # WKT or EPSG code; empty where there is none
    transform: tuple[float, ...] | None  # GDAL's six numbers
    metadata: dict[str, dict[str, str]]  # domain -> key -> value
    gcp_srs: str
    gcps: tuple[dict[str, str], ...]  # their attributes, as they stand

    @property
    def all(self) -> list[Band]:
        """The bands and, where there is one, the mask."""
        return [*self.bands, *filter(None, [self.mask])]

    @property
    def sources(self) -> list[Source]:
        """Sources of all bands and of the mask."""
        return [source for band in self.all for source in band.sources]


def read_vrt(path: Path, *, name: str | None = None) -> Vrt:
    """Read a VRT; its sources are not looked at, and are relative to what `path` links to, as in GDAL.

    ImageError where it does not parse, holds anything outside the grammar, or a source that is no plain path.
    """
    name = name or str(path)
    try:
        return _parsed_vrt(read_bytes(path, replace(XML, most=MB)), path.resolve().parent, name)
    except RpcFormatError as error:
        raise ImageError(str(error)) from error


@lru_cache(maxsize=1)  # a file that was written is read twice in a row
def _parsed_vrt(data: bytes, folder: Path, name: str) -> Vrt:
    return vrt_from_xml(parse_xml(data, name=name, max_bytes=MB), folder, name)


def vrt_from_xml(root: Element, folder: Path, name: str) -> Vrt:
    """Read a VRT as `read_vrt`, from the parsed document and the folder to which its sources are relative."""
    if root.tag != "VRTDataset":
        raise ImageError(f"{name}: <{root.tag}> where <VRTDataset> was expected")
    _require_grammar(root, name)
    return _ElementReader(folder, name).dataset(root)


def _require_grammar(element: Element, name: str) -> None:
    """Raise unless the element and all in it are of the grammar."""
    tag = _GRAMMAR[element.tag]
    for key, value in element.attrib.items():
        if key not in tag.attributes:
            raise _refused(name, f"<{element.tag} {key}=...>")
        if not re.fullmatch(tag.attributes[key], value.strip()):
            raise _refused(name, f"{key}={value[:60]!r} in <{element.tag}>")
    text = [element.text or "", *(child.tail or "" for child in element)]
    if not re.fullmatch(tag.text or "", "".join(text).strip()):
        raise _refused(name, f"{''.join(text).strip()[:60]!r} in <{element.tag}>")
    seen: set[str] = set()
    for child in element:
        if child.tag not in tag.children.split():
            raise _refused(name, f"<{child.tag}> in <{element.tag}>")
        if child.tag in seen and child.tag not in _REPEATED.split():
            raise _refused(name, f"two <{child.tag}> in <{element.tag}>")
        seen.add(child.tag)
        _require_grammar(child, name)


def _refused(name: str, what: str) -> ImageError:
    return ImageError(f"{name}: a VRT with {what} is not read; give the images it is made of")


@dataclass(frozen=True)
class _ElementReader:
    """Values of elements that passed `_require_grammar`."""

    folder: Path
    name: str

    def dataset(self, root: Element) -> Vrt:
        gcps = root.find("GCPList")
        numbers = root.findtext("GeoTransform")
        mask = root.find("MaskBand/VRTRasterBand")
        width, height = (int(root.get(key, "0")) for key in ("rasterXSize", "rasterYSize"))
        if not width or not height:
            raise ImageError(f"{self.name}: a VRT without rasterXSize and rasterYSize")
        bands = [self.band(e, i) for i, e in enumerate(root.iterfind("VRTRasterBand"), 1)]
        if not bands:
            raise ImageError(f"{self.name}: a VRT without bands")
        return Vrt(
            size=(width, height),
            bands=tuple(bands),
            mask=None if mask is None else self.band(mask, 1),
            srs=root.findtext("SRS", "").strip(),
            transform=tuple(map(float, numbers.split(","))) if numbers else None,
            metadata=self.metadata(root),
            gcp_srs="" if gcps is None else gcps.get("Projection", "").strip(),
            gcps=() if gcps is None else tuple(dict(gcp.attrib) for gcp in gcps),
        )

    def metadata(self, root: Element) -> dict[str, dict[str, str]]:
        found: dict[str, dict[str, str]] = {}
        for element in root.iterfind("Metadata"):
            domain = found.setdefault(element.get("domain", ""), {})
            for item in element:
                key = item.get("key", "")
                if domain.setdefault(key, item.text or "") != (item.text or ""):
                    raise ImageError(f"{self.name}: two values of {key!r} in the VRT")
        return found

    def band(self, element: Element, index: int) -> Band:
        if int(element.get("band", index)) != index:
            found = element.get("band")
            raise ImageError(f"{self.name}: a VRT whose band {index} says that it is band {found}")
        nodata = element.findtext("NoDataValue")
        value = None if nodata is None else float(nodata)
        hidden = element.findtext("HideNoDataValue", "0").strip() == "1"
        kind = element.get("dataType", "Byte")
        colour = "Undefined" if element.find("ColorTable") is None else "Palette"
        return Band(
            dtype=next(key for key, name in GDAL_TYPES.items() if name == kind),
            nodata=None if hidden else value,
            fill=0.0 if value is None else value,
            color=element.findtext("ColorInterp", colour).strip().lower(),
            unit=element.findtext("UnitType"),
            linear=(float(element.findtext("Scale", "1")), float(element.findtext("Offset", "0"))),
            sources=tuple(self.source(e) for e in element if e.tag in ("SimpleSource", "ComplexSource")),
        )

    def source(self, element: Element) -> Source:
        kind, _, number = element.findtext("SourceBand", "1").strip().rpartition(",")
        nodata = element.findtext("NODATA")
        src, dst = (self.rect(element.find(tag)) for tag in ("SrcRect", "DstRect"))
        if src and dst and src[2:] != dst[2:]:
            raise self.resampled()
        return Source(
            file=self.file(element.find("SourceFilename")),
            band=int(number),
            mask=bool(kind),
            src=src,
            dst=dst,
            nodata=None if nodata is None else float(nodata),
            scale=(float(element.findtext("ScaleRatio", "1")), float(element.findtext("ScaleOffset", "0"))),
        )

    def rect(self, element: Element | None) -> Rect | None:
        if element is None:
            return None
        values = [float(element.get(key, "nan")) for key in _RECT]
        if not all(abs(v) < 2**31 and abs(v - round(v)) <= _SHIFT for v in values):
            raise self.resampled()
        x, y, width, height = (round(v) for v in values)
        return x, y, width, height

    def resampled(self) -> ImageError:
        return ImageError(
            f"{self.name}: a VRT that resamples (SrcRect and DstRect are not the same whole pixels) is not read; "
            "write it out as a GeoTIFF"
        )

    def file(self, element: Element | None) -> Path:
        text = "" if element is None else element.text or ""
        relative = element is not None and element.get("relativeToVRT", "0") == "1"
        if not text or INDIRECT.match(text) or not (relative or Path(text).is_absolute()):
            raise ImageError(f"{self.name}: the VRT points at {text[:200]!r}, which is no plain local file")
        return self.folder / text


# --- writing ----------------------------------------------------------------------------------------------


class Named(NamedTuple):
    """How a VRT names a file, and the file's size, block and type by GDAL's names, where they are known."""

    text: str
    relative: bool = False
    properties: Mapping[str, str] = {}


def vrt_text(vrt: Vrt, named: Callable[[Source], Named]) -> str:
    """Return the text of a VRT, in which files have the names that `named` gives them."""
    root = Element("VRTDataset", rasterXSize=str(vrt.size[0]), rasterYSize=str(vrt.size[1]))
    if vrt.srs:
        SubElement(root, "SRS").text = vrt.srs
    if vrt.transform:
        SubElement(root, "GeoTransform").text = ", ".join(map(repr, vrt.transform))
    for domain, items in vrt.metadata.items():
        element = SubElement(root, "Metadata", domain=domain)
        for key, value in items.items():
            SubElement(element, "MDI", key=key).text = value
    if vrt.gcps:
        element = SubElement(root, "GCPList", Projection=vrt.gcp_srs)
        for gcp in vrt.gcps:
            SubElement(element, "GCP", gcp)
    block = {f"block{axis}Size": str(min(BLOCK_SIZE, n)) for axis, n in zip("XY", vrt.size, strict=True)}
    for number, band in enumerate(vrt.bands, 1):
        _add_band(root, band, named, {"band": str(number), **block})
    if vrt.mask is not None:
        _add_band(SubElement(root, "MaskBand"), vrt.mask, named, block)
    indent(root)
    return tostring(root, encoding="unicode") + "\n"


def _add_band(parent: Element, band: Band, named: Callable[[Source], Named], attributes: Mapping[str, str]) -> None:
    element = SubElement(parent, "VRTRasterBand", {"dataType": GDAL_TYPES[band.dtype], **attributes})
    hidden = band.nodata is None
    texts = {
        "NoDataValue": _shortest(band.fill) if band.fill or not hidden else "",
        "HideNoDataValue": "1" if band.fill and hidden else "",
        "ColorInterp": band.color.capitalize(),
        "UnitType": band.unit or "",
        "Scale": repr(band.linear[0]) if band.linear[0] != 1.0 else "",
        "Offset": repr(band.linear[1]) if band.linear[1] else "",
    }
    for tag, text in texts.items():
        if text:
            SubElement(element, tag).text = text
    for source in band.sources:
        _add_source(element, source, named(source))


def _add_source(parent: Element, source: Source, file: Named) -> None:
    element = SubElement(parent, "SimpleSource" if source.plain else "ComplexSource")
    # not shared: another VRT may have the file open as it was before it was written again
    SubElement(element, "SourceFilename", shared="0", relativeToVRT=str(int(file.relative))).text = file.text
    SubElement(element, "SourceBand").text = f"{'mask,' * source.mask}{source.band}"
    if file.properties:
        SubElement(element, "SourceProperties", dict(file.properties))
    if source.dst:
        for tag, rect in (("SrcRect", source.src or (0, 0, *source.dst[2:])), ("DstRect", source.dst)):
            SubElement(element, tag, dict(zip(_RECT, map(str, rect), strict=True)))
    if source.nodata is not None:
        SubElement(element, "NODATA").text = _shortest(source.nodata)
    if not source.plain:
        SubElement(element, "ScaleOffset").text = repr(source.scale[1])
        SubElement(element, "ScaleRatio").text = repr(source.scale[0])


def _shortest(value: float) -> str:
    return str(int(value)) if value.is_integer() else repr(value)  # GDAL reads 1e+17 of a whole type as 1

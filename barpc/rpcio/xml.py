"""RPC files in XML: Maxar (ISD), Airbus DIMAP v1 to v3, EnMAP, and the RPC domain of GDAL's VRT and PAM."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from barpc.base.errors import ImageError, RpcFormatError
from barpc.base.safe_io import parse_xml
from barpc.rasters.vrt import vrt_from_xml
from barpc.rpcio.text import (
    COEFFICIENTS,
    ERROR_FIELDS,
    KEYS,
    MAXAR,
    OFFSETS,
    SCALES,
    Fields,
    ReadOptions,
    Size,
    fields_from_rpc,
    format_number,
    in_order_b,
    listed_numbers,
    number,
    rpc_from_fields,
)
from barpc.sensor.rpc import RPC

_HEIGHT_DEFAULT = "HEIGHT_DEFAULT"  # of GDAL's RPC domain: the altitude of the scene's ground [m]


def _xml_root(text: str, name: str, *, strip_namespaces: bool = True, only: tuple[str, ...] = ()) -> Element:
    body = re.sub(r"\A\s*+<\?xml[^<>]*\?>", "", text, count=1)  # the encoding it declares is no longer its own
    return parse_xml(body.encode(), name=name, strip_namespaces=strip_namespaces, only=only)


def _element_numbers(parent: Element, path: str, name: str) -> list[float]:
    """Return the numbers in an element."""
    text = parent.findtext(path, "").strip()
    if not text:
        raise RpcFormatError(f"{name}: <{path}> is missing or empty")
    return listed_numbers(text, name, path)


def _element(parent: Element, paths: Iterable[str], name: str) -> Element:
    """Return the first of several elements that exists, at any depth."""
    for path in paths:
        found = parent.find(f".//{path}")
        if found is not None:
            return found
    raise RpcFormatError(f"{name}: none of the elements {', '.join(paths)} is there")


def read_maxar(text: str, name: str, options: ReadOptions) -> RPC:
    """Read Maxar's image support data: `<RPB><IMAGE>`, twenty numbers in one element a list."""
    root = _xml_root(text, name, only=("RPB",))
    rpb = root if root.tag == "RPB" else _element(root, ("RPB",), name)
    spec = rpb.findtext("SPECID", "RPC00B").strip()
    image = _element(rpb, ("IMAGE",), name)
    fields: Fields = {}
    for key, word in MAXAR.items():
        tag = word.upper()
        path = f"{tag}List/{tag}" if key in COEFFICIENTS else tag
        if key not in ERROR_FIELDS or image.find(path) is not None:
            fields[key] = _element_numbers(image, path, name)
    return rpc_from_fields(in_order_b(fields, spec, name), name, options)


def write_maxar(rpc: RPC, size: Size | None = None) -> str:
    """Write the `<RPB>` part of Maxar's image support data; of its `<IMD>` the width and height [px], where known."""
    counts = [f"\t\t<{tag}>{n}</{tag}>" for tag, n in zip(("NUMCOLUMNS", "NUMROWS"), size or (), strict=False)]
    lines = []
    for key, values in fields_from_rpc(rpc).items():
        tag = MAXAR[key].upper()
        element = f"<{tag}>{' '.join(map(format_number, values))}</{tag}>"
        if key in COEFFICIENTS:
            lines += [f"\t\t\t<{tag}List>", f"\t\t\t\t{element}", f"\t\t\t</{tag}List>"]
        else:
            lines.append(f"\t\t\t{element}")
    xml = '<?xml version="1.0" encoding="UTF-8"?>'
    imd = ["\t<IMD>", *reversed(counts), "\t</IMD>"] if counts else []
    head = [xml, "<isd>", *imd, "\t<RPB>", "\t\t<SPECID>RPC00B</SPECID>", "\t\t<IMAGE>"]
    return "\n".join([*head, *lines, "\t\t</IMAGE>", "\t</RPB>", "</isd>"]) + "\n"


def read_dimap(text: str, name: str, options: ReadOptions) -> RPC:
    """Read Airbus' DIMAP: Pleiades, SPOT 6/7, PeruSat (v1, v2), Pleiades Neo (v3); not its direct model.

    The first pixel's centre is (1, 1) in v1 and v2 and (0, 0) in v3. ERR_BIAS_ROW and _COL are the error of the
    vendor's own fit [px], no geolocation accuracy: they are left out.
    """
    model = _element(_xml_root(text, name, only=("Global_RFM",)), ("Global_RFM",), name)
    if model.find(".//F_COL") is not None:
        return _read_dimap_v1(model, name, options)
    inverse = _element(model, ("Inverse_Model", "GroundtoImage_Values"), name)
    validity = _element(model, ("RFM_Validity",), name)
    fields: Fields = {key: _element_numbers(validity, key, name) for key in OFFSETS + SCALES}
    for key in COEFFICIENTS:
        fields[key] = [value for i in range(1, 21) for value in _element_numbers(inverse, f"{key}_{i}", name)]
    return rpc_from_fields(fields, name, options, 0.0 if inverse.tag == "GroundtoImage_Values" else 1.0)


def _read_dimap_v1(model: Element, name: str, options: ReadOptions) -> RPC:
    """Read DIMAP v1: forty numbers an element, scales A and offsets B by axis."""
    fields: Fields = {}
    for axis, field in (("ROW", "LINE"), ("COL", "SAMP")):
        values = _element_numbers(model, f".//F_{axis}", name)
        if len(values) != 40:
            raise RpcFormatError(f"{name}: F_{axis} has {len(values)} coefficients, expected 40")
        fields[f"{field}_NUM_COEFF"], fields[f"{field}_DEN_COEFF"] = values[:20], values[20:]
    axes = {"Lon": "LONG", "Lat": "LAT", "Alt": "HEIGHT", "Col": "SAMP", "Row": "LINE"}
    validity = _element(model, ("RFM_Validity",), name)
    for axis, field in axes.items():
        element = _element(validity, (axis,), name)
        fields[f"{field}_SCALE"], fields[f"{field}_OFF"] = (_element_numbers(element, part, name) for part in "AB")
    return rpc_from_fields(fields, name, options, first_pixel=1.0)


_ENMAP_AXES = {"LINE": "ROW", "SAMP": "COL"}


def read_enmap(text: str, name: str, options: ReadOptions) -> RPC:
    """Read EnMAP's metadata: `options.band` chooses among the bands' RPCs."""
    root = _xml_root(text, name)
    bands = [b for rpc in root.iter("RPC") for b in rpc.iter("bandID") if b.get("number") == str(options.band)]
    if not bands:
        raise RpcFormatError(f"{name}: no RPC of band {options.band}")
    values = {e.tag.upper(): number(e.text or "", name, e.tag) for e in bands[0]}
    fields: Fields = {}
    for key in OFFSETS + SCALES:
        axis, _, kind = key.partition("_")
        fields[key] = [values[k] for k in (f"{_ENMAP_AXES.get(axis, axis)}_{kind}",) if k in values]
    for key in COEFFICIENTS:
        axis, part, _ = key.split("_")
        stem = f"{_ENMAP_AXES[axis]}_{part}_"
        fields[key] = [values[k] for i in range(1, 21) for k in (f"{stem}{i}", f"{stem}{i:02d}") if k in values][:20]
    return rpc_from_fields(fields, name, options)


_RADARSAT_WORDS = (
    "biasError randomError lineOffset pixelOffset latitudeOffset longitudeOffset heightOffset lineScale pixelScale "
    "latitudeScale longitudeScale heightScale lineNumeratorCoefficients lineDenominatorCoefficients "
    "pixelNumeratorCoefficients pixelDenominatorCoefficients"
)
_RADARSAT = dict(zip(KEYS, _RADARSAT_WORDS.split(), strict=True))


def read_radarsat(text: str, name: str, options: ReadOptions) -> RPC:
    """Read `<rationalFunctions>` of RADARSAT-2's and RCM's product.xml."""
    functions = _element(_xml_root(text, name, only=("rationalFunctions",)), ("rationalFunctions",), name)
    fields = {
        key: _element_numbers(functions, word, name)
        for key, word in _RADARSAT.items()
        if key not in ERROR_FIELDS or functions.find(word) is not None
    }
    return rpc_from_fields(fields, name, options)


def read_gdal(text: str, name: str, options: ReadOptions) -> RPC:
    """Read GDAL's RPC metadata domain; a VRT is read by the grammar by which it is opened (`barpc.rasters.vrt`)."""
    root = _xml_root(text, name, strip_namespaces=False)
    found = root.find("Metadata[@domain='RPC']")
    if root.tag == "VRTDataset":
        try:
            items = vrt_from_xml(root, Path(), name).metadata.get("RPC")
        except ImageError as error:
            raise RpcFormatError(str(error)) from error
    else:
        items = None if found is None else {e.get("key", ""): e.text or "" for e in found.iter("MDI")}
    if items is None:
        raise RpcFormatError(f'{name}: no <Metadata domain="RPC">')
    return rpc_from_domain(items, name, options)


def rpc_from_domain(items: Mapping[str, str], name: str, options: ReadOptions) -> RPC:
    """Return the RPC in GDAL's metadata domain; other keys are passed over."""
    fields = {key: listed_numbers(value, name, key) for key, value in items.items() if key in KEYS}
    rpc = rpc_from_fields(fields, name, options)
    if _HEIGHT_DEFAULT not in items:
        return rpc
    level = next(iter(listed_numbers(items[_HEIGHT_DEFAULT], name, _HEIGHT_DEFAULT)), np.nan)
    return replace(rpc, height_default=level) if np.isfinite(level) else rpc


def rpc_items(rpc: RPC) -> dict[str, str]:
    """Return GDAL's metadata domain of an RPC, numbers that read back to the bit."""
    fields = fields_from_rpc(rpc)
    fields |= {} if rpc.height_default is None else {_HEIGHT_DEFAULT: [rpc.height_default]}
    return {key: " ".join(map(format_number, values)) for key, values in sorted(fields.items())}

"""A server that must hear nothing, and files made to be fetched, opened or followed elsewhere."""

from __future__ import annotations

import struct
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np
import rasterio

from tests.geotiffs import write_image

SIDE = 160  # px; of the crops


@dataclass
class Trap:
    """A server that must hear nothing, and files that nobody may open."""

    url: str
    canary: Path
    raster: Path
    requests: list[str] = field(default_factory=list)
    events: Callable[[], int] = lambda: 0

    def wms(self) -> str:
        """A web map service as GDAL reads it."""
        return (
            f'<GDAL_WMS><Service name="TMS"><ServerUrl>{self.url}/${{z}}/${{x}}/${{y}}.png</ServerUrl></Service>'
            "<DataWindow><UpperLeftX>0</UpperLeftX><UpperLeftY>0</UpperLeftY><LowerRightX>160</LowerRightX>"
            "<LowerRightY>160</LowerRightY><TileLevel>0</TileLevel><SizeX>160</SizeX><SizeY>160</SizeY>"
            "</DataWindow><BandsCount>1</BandsCount></GDAL_WMS>"
        )

    def vrt(self, source: object, more: str = "", kind: str = "SimpleSource") -> str:
        """A VRT of the crops' size over any source."""
        named = f'<SourceFilename relativeToVRT="0">{source}</SourceFilename><SourceBand>1</SourceBand>'
        return self.band(f"<{kind}>{named}</{kind}>", more)

    def band(self, body: str, more: str = "", attributes: str = "", root: str = "") -> str:
        """A VRT of one band."""
        return (
            f'<VRTDataset rasterXSize="{SIDE}" rasterYSize="{SIDE}"{root}>{more}'
            f'<VRTRasterBand dataType="UInt16" band="1"{attributes}>{body}</VRTRasterBand></VRTDataset>'
        )

    @property
    def remote(self) -> str:
        """The server's raster by GDAL's file system."""
        return f"/vsicurl/{self.url}.tif"


@contextmanager
def served(canary: Path, raster: Path) -> Iterator[Trap]:
    """A trap whose server hands out a good image to whoever asks."""
    content = raster.read_bytes()
    heard: list[str] = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            heard.append(f"{self.command} {self.path}")
            self.send_response(200)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            if self.command == "GET":
                self.wfile.write(content)

        do_HEAD = do_POST = do_GET

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.handle_error = lambda *_: None  # type: ignore[method-assign]  (a reader that hangs up half-way)
    threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
    try:
        yield Trap(f"http://127.0.0.1:{server.server_port}/x", canary, raster, heard)
    finally:
        server.shutdown()
        server.server_close()


def attribute(trap: Trap, name: str) -> str:
    return trap.band(f'<SimpleSource SourceFilename="{escape(name)}" SourceBand="1"/>')


def indirect(text: str) -> Callable[[Trap], str]:
    """A VRT over a name that is a syntax."""
    return lambda t: t.vrt(
        escape(text.replace("REMOTE", t.remote).replace("URL", t.url).replace("RASTER", str(t.raster)))
    )


def mask(trap: Trap, inner: str, attributes: str = "") -> str:
    good = f"<SourceFilename>{trap.raster.with_name('good.tif')}</SourceFilename><SourceBand>1</SourceBand>"
    return trap.band(
        f"<SimpleSource>{good}</SimpleSource>",
        f'<MaskBand{attributes}><VRTRasterBand dataType="Byte">{inner}</VRTRasterBand></MaskBand>',
    )


def group(trap: Trap, inner: str) -> str:
    return (
        '<VRTDataset><Group name="/"><Dimension name="Y" size="160"/><Dimension name="X" size="160"/>'
        '<Array name="a"><DataType>UInt16</DataType><DimensionRef ref="Y"/><DimensionRef ref="X"/>'
        f"{inner}</Array></Group></VRTDataset>"
    )


def overviews_in_a_tiff(trap: Trap) -> bytes:
    """A sound TIFF whose own metadata name overviews elsewhere."""
    path = trap.canary.with_name("tagged.tif")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with rasterio.open(path, "w", driver="GTiff", width=SIDE, height=SIDE, count=1, dtype="uint16") as out:
            out.write(np.arange(SIDE * SIDE, dtype=np.uint16).reshape(1, SIDE, SIDE))
            out.update_tags(ns="OVERVIEWS", OVERVIEW_FILE=trap.remote)
            out.update_tags(ns="MASK", MASK_FILE=trap.remote)
    data = path.read_bytes()
    path.unlink()
    assert trap.remote.encode() in data
    return data


def boxes_of_a_jp2(trap: Trap) -> bytes:
    """A JPEG 2000 image whose GML box takes its coordinate system from the server."""
    path = trap.canary.with_name("boxed.jp2")
    write_image(path, np.zeros((64, 64), np.uint8), driver="JP2OpenJPEG")
    data = path.read_bytes()
    path.unlink()
    gml = (
        f'<gml:FeatureCollection xmlns:gml="http://www.opengis.net/gml" xmlns:xlink="http://www.w3.org/1999/xlink">'
        f'<gml:featureMember><gml:FeatureCollection><gml:featureMember><gml:RectifiedGridCoverage dimension="2">'
        f'<gml:rectifiedGridDomain><gml:RectifiedGrid dimension="2" srsName="{trap.url}"><gml:origin>'
        f'<gml:Point srsName="{trap.url}"><gml:pos>1 2</gml:pos></gml:Point></gml:origin>'
        f'<gml:offsetVector srsName="{trap.url}">1 0</gml:offsetVector><gml:offsetVector srsName="{trap.url}">0 -1'
        "</gml:offsetVector></gml:RectifiedGrid></gml:rectifiedGridDomain></gml:RectifiedGridCoverage>"
        "</gml:featureMember></gml:FeatureCollection></gml:featureMember></gml:FeatureCollection>"
    )

    def box(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", 8 + len(body)) + kind + body

    inner = box(b"asoc", box(b"lbl ", b"gml.root-instance") + box(b"xml ", gml.encode()))
    outer = box(b"asoc", box(b"lbl ", b"gml.data") + inner)
    at = data.index(b"jp2c") - 4
    return data[:at] + outer + data[at:]


WARPED = (
    '<VRTDataset rasterXSize="160" rasterYSize="160" subClass="VRTWarpedDataset"><VRTRasterBand dataType="UInt16" '
    'band="1" subClass="VRTWarpedRasterBand"/><BlockXSize>128</BlockXSize><BlockYSize>128</BlockYSize>'
    "<GDALWarpOptions><ResampleAlg>NearestNeighbour</ResampleAlg><WorkingDataType>UInt16</WorkingDataType>"
    '<SourceDataset relativeToVRT="0">{}</SourceDataset><BandList><BandMapping src="1" dst="1"/></BandList>'
    "</GDALWarpOptions></VRTDataset>"
)
PROCESSED = (
    '<VRTDataset rasterXSize="160" rasterYSize="160" subClass="VRTProcessedDataset"><Input><SourceFilename>{}'
    '</SourceFilename></Input><ProcessingSteps><Step name="a"><Algorithm>LocalScaleOffset</Algorithm></Step>'
    "</ProcessingSteps></VRTDataset>"
)
PANSHARPENED = (
    '<VRTDataset subClass="VRTPansharpenedDataset"><PansharpeningOptions><PanchroBand><SourceFilename>{0}'
    "</SourceFilename><SourceBand>1</SourceBand></PanchroBand><SpectralBand dstBand='1'><SourceFilename>{0}"
    "</SourceFilename><SourceBand>1</SourceBand></SpectralBand></PansharpeningOptions></VRTDataset>"
)
TILES = "<GDALTileIndexDataset><IndexDataset>{}</IndexDataset><IndexLayer>a</IndexLayer></GDALTileIndexDataset>"
GRID = "ncols 3\nnrows 3\nxllcorner 5\nyllcorner 44\ncellsize 0.1\n1 2 3\n4 5 6\n7 8 9\n"

CONTENTS: dict[str, Callable[[Trap], str | bytes]] = {
    "source, element": lambda t: t.vrt(t.remote),
    "source, element, without vsicurl": lambda t: t.vrt(t.url),
    "source, attribute": lambda t: attribute(t, t.remote),
    "source, attribute, without vsicurl": lambda t: attribute(t, t.url),
    "source, tags in lower case": lambda t: t.vrt(t.url).replace("SourceFilename", "sourcefilename"),
    "source, raw data": lambda t: t.vrt(f"<![CDATA[{t.url}]]>"),
    "source, characters by number": lambda t: t.vrt("".join(f"&#{ord(c)};" for c in t.url)),
    "source, an entity": lambda t: f'<!DOCTYPE V [<!ENTITY x "{t.remote}">]>' + t.vrt("&x;"),
    "source, split by a comment": lambda t: t.vrt(t.url[:5] + "<!-- - -->" + t.url[5:]),
    "source, behind a comment that one parser ends": lambda t: attribute(t, t.url).replace(
        "<Simple", "<!--> --><Simple"
    ),
    "source, behind an instruction": lambda t: attribute(t, t.url).replace("<Simple", "<?x y='>'?><Simple"),
    "source, unquoted and unclosed": lambda t: attribute(t, t.url).replace('"160"', "160").replace("</VRTDataset>", ""),
    "source, a namespace": lambda t: (
        attribute(t, t.url).replace("SimpleSource", "v:SimpleSource").replace("<VRTDataset", '<VRTDataset xmlns:v="v"')
    ),
    "source, twice": lambda t: t.vrt(f"{t.raster.with_name('good.tif')}</SourceFilename><SourceFilename>{t.url}"),
    "source, with options": lambda t: t.band(
        f"<SimpleSource><SourceFilename>{t.remote}</SourceFilename><OpenOptions><OOI key='a'>b</OOI></OpenOptions>"
        "</SimpleSource>"
    ),
    "UTF-16": lambda t: ('<?xml version="1.0" encoding="UTF-16"?>' + t.vrt(t.remote)).encode("utf-16"),
    "a mark in front": lambda t: b"\xef\xbb\xbf" + attribute(t, t.url).encode(),
    "lines in front": lambda t: "\n \n" + attribute(t, t.url),
    "a declaration in front": lambda t: '<?xml version="1.0"?>' + attribute(t, t.url),
    "source, complex": lambda t: t.vrt(t.url, kind="ComplexSource"),
    "source, averaged": lambda t: t.vrt(t.url, kind="AveragedSource"),
    "source, filtered": lambda t: t.vrt(t.url, kind="KernelFilteredSource").replace(
        "</KernelF", "<Kernel normalized='1'><Size>3</Size><Coefs>1 1 1 1 1 1 1 1 1</Coefs></Kernel></KernelF"
    ),
    "source, nodata from data": lambda t: t.vrt(t.remote, kind="NoDataFromMaskSource"),
    "source, a VRT": indirect("vrt://REMOTE"),
    "source, a directory of a TIFF": indirect("GTIFF_DIR:1:REMOTE"),
    "source, in an archive": indirect("/vsizip/REMOTE/x.tif"),
    "source, part of a file": indirect("/vsisubfile/0_900,REMOTE"),
    "source, streaming": lambda t: t.vrt(t.remote.replace("vsicurl", "vsicurl_streaming")),
    "source, a service": lambda t: t.vrt(escape(t.wms())),
    "source, a service by name": indirect("WMS:URL?SERVICE=WMS&LAYERS=a&SRS=EPSG:4326&BBOX=0,0,1,1"),
    "source, a service of tiles": indirect("WMTS:URL"),
    "source, a service of coverages": indirect("WCS:URL"),
    "source, Zarr": indirect('ZARR:"REMOTE"'),
    "a mask, element": lambda t: mask(t, f"<SimpleSource><SourceFilename>{t.url}</SourceFilename></SimpleSource>"),
    "a mask, attribute": lambda t: mask(t, f'<SimpleSource SourceFilename="{t.url}" SourceBand="1"/>'),
    "an overview, element": lambda t: t.vrt(t.raster.with_name("good.tif")).replace(
        "</VRTRasterBand>",
        f"<Overview><SourceFilename>{t.url}</SourceFilename></Overview></VRTRasterBand>",
    ),
    "an overview, attribute": lambda t: t.vrt(t.raster.with_name("good.tif")).replace(
        "</VRTRasterBand>", f'<Overview SourceFilename="{t.url}" SourceBand="1"/></VRTRasterBand>'
    ),
    "an overview, metadata": lambda t: t.vrt(
        t.raster.with_name("good.tif"),
        f'<Metadata domain="OVERVIEWS"><MDI key="OVERVIEW_FILE">{t.url}</MDI></Metadata>',
    ),
    "a coordinate system": lambda t: t.vrt(t.raster.with_name("good.tif"), f"<SRS>{t.url}</SRS>"),
    "a coordinate system of GCPs": lambda t: t.vrt(
        t.raster.with_name("good.tif"),
        f'<GCPList Projection="{t.url}"><GCP Pixel="0" Line="0" X="0" Y="0"/></GCPList>',
    ),
    "a derived band": lambda t: t.band(
        f'<PixelFunctionType>sum</PixelFunctionType><SimpleSource SourceFilename="{t.url}" SourceBand="1"/>',
        attributes=' subClass="VRTDerivedRasterBand"',
    ),
    "a derived band in Python": lambda t: t.band(
        "<PixelFunctionLanguage>Python</PixelFunctionLanguage><PixelFunctionType>os.system</PixelFunctionType>"
        f'<SimpleSource SourceFilename="{t.url}" SourceBand="1"/>',
        attributes=' subClass="VRTDerivedRasterBand"',
    ),
    "a raw band": lambda t: t.band(
        f"<SourceFilename relativeToVRT='0'>{t.remote}</SourceFilename><ImageOffset>0</ImageOffset>",
        attributes=' subClass="VRTRawRasterBand"',
    ),
    "a raw band of a secret": lambda t: t.band(
        f"<SourceFilename relativeToVRT='0'>{t.canary}</SourceFilename>",
        attributes=' subClass="VRTRawRasterBand"',
    ),
    "a warped raster": lambda t: WARPED.format(t.url),
    "a processed raster": lambda t: PROCESSED.format(t.url),
    "a sharpened raster": lambda t: PANSHARPENED.format(t.url),
    "arrays": lambda t: group(
        t, f"<Source><SourceFilename>{t.url}</SourceFilename><SourceBand>1</SourceBand></Source>"
    ),
    "a template of groups": lambda t: t.band(
        "", f"<GroupTemplate><SourceFilename>{t.url}</SourceFilename></GroupTemplate>"
    ),
    "itself": lambda t: t.vrt("ITSELF"),
    "a web service": Trap.wms,
    "a web service with a VRT in it": lambda t: t.wms().replace("<DataWindow>", "<VRTDataset/><DataWindow>"),
    "a service of tiles": lambda t: f"<GDAL_WMTS><GetCapabilitiesUrl>{t.url}</GetCapabilitiesUrl></GDAL_WMTS>",
    "a service of coverages": lambda t: (
        f"<WCS_GDAL><ServiceURL>{t.url}?</ServiceURL><CoverageName>a</CoverageName></WCS_GDAL>"
    ),
    "an index of tiles": lambda t: TILES.format(t.url),
    "a STAC item": lambda t: f'{{"type":"Feature","stac_version":"1.0.0","assets":{{"a":{{"href":"{t.url}"}}}}}}',
    "a grid of text": lambda t: GRID,
    "a VRT in a NITF": lambda t: "NITF02.10 " + t.vrt(t.url),
    "a TIFF with overviews elsewhere": overviews_in_a_tiff,
    "a JPEG 2000 image with a coordinate system elsewhere": boxes_of_a_jp2,
}
"""What a file may hold that makes GDAL, left alone, look elsewhere."""


def write(trap: Trap, name: str, path: Path) -> Path:
    """Write one of `CONTENTS` to a file."""
    content = CONTENTS[name](trap)
    if isinstance(content, str):
        content = content.replace("ITSELF", str(path)).encode()
    path.write_bytes(content)
    return path

"""SICD documents of made-up images: every way of forming an image, from one satellite pass."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.polynomial import polynomial

from barpc.base.geodesy import ecef_from_ground, ground_from_ecef, up

KINDS = ("PFA", "RGAZCOMP", "INCA", "XRGYCR", "XCTYAT", "PLANE")
DURATION, SPEED, TURN = 6.0, 7550.0, 1.08e-3  # s, m/s, rad/s
SIZE = (900, 700)  # columns, rows


def pass_over(scp: np.ndarray, incidence: float, side: str, squint: float) -> np.ndarray:
    """ARPPoly (6, 3): a circle about the Earth's centre, the centre point seen `squint` s after the middle."""
    vertical = up(np.array(ground_of(scp))[None])[:, 0]
    east = np.cross([0, 0, 1.0], vertical)
    east /= np.linalg.norm(east)
    flight = np.cross(vertical, east) + 0.2 * east  # to the north, as all go up or down
    flight -= vertical * (flight @ vertical)
    flight /= np.linalg.norm(flight)
    right = np.cross(flight, vertical)
    away = -right if side == "R" else right  # where the satellite is
    angle = np.radians(incidence)
    at = scp + 8e5 * (np.cos(angle) * vertical + np.sin(angle) * away)
    radial, radius = at / np.linalg.norm(at), np.linalg.norm(at)
    flight -= radial * (flight @ radial)
    flight /= np.linalg.norm(flight)
    times = np.linspace(-1.0, DURATION + 1.0, 60)
    phase = TURN * (times - DURATION / 2 - squint)
    track = radius * (np.cos(phase)[:, None] * radial + np.sin(phase)[:, None] * flight)
    return polynomial.polyfit(times, track, 5)


def ground_of(ecef: np.ndarray) -> tuple[float, float, float]:
    lon, lat, alt = ground_from_ecef(ecef)
    return float(lon), float(lat), float(alt)


def _poly(tag: str, coeffs: np.ndarray) -> str:
    coeffs = np.asarray(coeffs, dtype=float)
    terms = "".join(
        "<Coef " + " ".join(f'exponent{k + 1}="{p}"' for k, p in enumerate(power)) + f">{float(value)!r}</Coef>"
        for power, value in np.ndenumerate(coeffs)
    )
    orders = " ".join(f'order{k + 1}="{n - 1}"' for k, n in enumerate(coeffs.shape))
    return f"<{tag} {orders}>{terms}</{tag}>"


def _xyz(tag: str, vector: np.ndarray) -> str:
    return f"<{tag}>" + "".join(f"<{a}>{float(v)!r}</{a}>" for a, v in zip("XYZ", vector, strict=True)) + f"</{tag}>"


def document(kind: str, *, ground=(5.4, 43.3, 120.0), incidence=35.0, side="R", squint=0.4, first=(0, 0)) -> str:
    """A SICD document; `first` is the first row and column of a part of the full image."""
    scp = ecef_from_ground(np.array(ground))
    arp = pass_over(scp, incidence, side, squint)
    velocity = polynomial.polyder(arp)
    middle = DURATION / 2
    position, speed = polynomial.polyval(middle, arp), polynomial.polyval(middle, velocity)
    sight = (scp - position) / np.linalg.norm(scp - position)
    normal = np.cross(speed, sight)
    normal /= np.linalg.norm(normal)
    turn = 1.0 if side == "R" else -1.0  # columns go on so that rows, columns and up are right-handed
    along = turn * np.cross(sight, normal)
    time, algorithm, grid, more = np.array([[middle]]), "RMA", kind, ""
    if kind == "PFA":
        algorithm, grid = "PFA", "RGAZIM"
        angle = -turn * 0.009 * polynomial.polyfromroots([middle])
        more = _poly("PolarAngPoly", angle) + _poly("SpatialFreqSFPoly", [0.99999, 2e-5, 0.05, 0.004, -0.02])
        more = f"<PFA>{_xyz('FPN', normal)}{_xyz('IPN', normal)}<PolarAngRefTime>{middle}</PolarAngRefTime>{more}</PFA>"
    elif kind == "RGAZCOMP":
        algorithm, grid = "RGAZCOMP", "RGAZIM"
        cone = float(np.linalg.norm(np.cross(speed, sight)) / np.linalg.norm(speed))
        more = f"<RgAzComp><AzSF>{turn * cone / 8e5!r}</AzSF>{_poly('KazPoly', [0.0])}</RgAzComp>"
    elif kind == "INCA":
        grid = "RGZERO"
        times = np.linspace(0.0, DURATION, 40001)
        ranges = np.linalg.norm(polynomial.polyval(times, arp).T - scp, axis=1)
        closest = times[np.argmin(ranges)]
        here, late = np.linalg.norm(position - scp), middle - closest
        pace = np.linalg.norm(polynomial.polyval(closest, velocity))
        nearest = np.linalg.norm(polynomial.polyval(closest, arp) - scp)
        bend = (here**2 - nearest**2) / (pace * late) ** 2
        time = np.array([[middle, 1.44e-4 * turn, 1e-12], [2e-7, 1e-13, 0.0]])
        more = (
            f"<RMA><RMAlgoType>OMEGA_K</RMAlgoType><ImageType>INCA</ImageType><INCA>"
            f"{_poly('TimeCAPoly', [closest, 1.45e-4 * turn, 3e-13])}<R_CA_SCP>{float(nearest)!r}</R_CA_SCP>"
            f"<FreqZero>9.6e9</FreqZero>{_poly('DRateSFPoly', [[bend, 1e-9], [-1e-7, 0.0]])}</INCA></RMA>"
        )
    elif kind == "XCTYAT":
        time = np.array([[middle, 1.2e-4 * turn], [1e-7, 0.0]])
    elif kind == "PLANE":  # the ground plane
        vertical = up(np.array(ground)[None])[:, 0]
        along = np.cross(vertical, sight)
        along *= turn * np.sign(along @ speed) / np.linalg.norm(along)
        sight = np.cross(along, vertical) * np.sign(np.cross(along, vertical) @ sight)
        sight /= np.linalg.norm(sight)
    lon, lat, alt = ground
    return f"""<?xml version="1.0"?>
<SICD xmlns="urn:SICD:1.2.1"><CollectionInfo><CollectorName>Made up</CollectorName><CoreName>{kind}</CoreName>
<CollectType>MONOSTATIC</CollectType><RadarMode><ModeType>SPOTLIGHT</ModeType></RadarMode></CollectionInfo>
<ImageData><PixelType>RE32F_IM32F</PixelType><NumRows>{SIZE[1]}</NumRows><NumCols>{SIZE[0]}</NumCols>
<FirstRow>{first[0]}</FirstRow><FirstCol>{first[1]}</FirstCol>
<FullImage><NumRows>2000</NumRows><NumCols>2000</NumCols></FullImage>
<SCPPixel><Row>{340 + first[0]}</Row><Col>{460 + first[1]}</Col></SCPPixel></ImageData>
<GeoData><EarthModel>WGS_84</EarthModel><SCP>{_xyz("ECF", scp)}
<LLH><Lat>{lat}</Lat><Lon>{lon}</Lon><HAE>{alt}</HAE></LLH></SCP></GeoData>
<Grid><ImagePlane>SLANT</ImagePlane><Type>{grid}</Type>{_poly("TimeCOAPoly", time)}
<Row>{_xyz("UVectECF", sight)}<SS>0.8</SS><KCtr>66.7</KCtr></Row>
<Col>{_xyz("UVectECF", along)}<SS>0.9</SS><KCtr>0</KCtr></Col></Grid>
<Timeline><CollectStart>2026-01-05T18:41:24.051402Z</CollectStart><CollectDuration>{DURATION}</CollectDuration></Timeline>
<Position><ARPPoly>{"".join(_poly(a, arp[:, k]) for k, a in enumerate("XYZ"))}</ARPPoly></Position>
<ImageFormation><ImageFormAlgo>{algorithm}</ImageFormAlgo></ImageFormation>
<SCPCOA><SCPTime>{middle}</SCPTime>{_xyz("ARPPos", position)}{_xyz("ARPVel", speed)}
<SideOfTrack>{side}</SideOfTrack></SCPCOA>
{more}</SICD>
"""


def nitf(text: str, path: Path, images: int = 1, graphics: int = 0, texts: int = 0) -> Path:
    """A NITF 2.1 with the document in a data extension behind images of 4 bytes and more, by its lengths alone."""
    data = text.encode()
    kinds = (
        [(b"IM".ljust(439, b"\0"), bytes(4 + k), b"%06d%010d") for k in range(images)],
        [(b"SY".ljust(258, b"\0"), bytes(7 + k), b"%04d%06d") for k in range(graphics)],
        [],  # reserved
        [(b"TE".ljust(282, b"\0"), bytes(11 + k), b"%04d%05d") for k in range(texts)],
        [
            (b"DEother".ljust(200), b"no sicd !", b"%04d%09d"),
            (b"DEXML_DATA_CONTENT".ljust(230), data, b"%04d%09d"),
        ],
        [],
    )
    counts = b"".join(
        b"%03d" % len(kind) + b"".join(form % (len(head), len(body)) for head, body, form in kind) for kind in kinds
    )
    header = b"NITF02.10".ljust(342) + b"%012d%06d" % (0, 360 + len(counts)) + counts
    segments = b"".join(head + body for kind in kinds for head, body, _ in kind)
    path.write_bytes(header + segments)
    return path

"""Files of ground points: every syntax gives the same points, and what cannot be meant is said before any work."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace

import numpy as np
import pyproj
import pytest

from barpc.ba import adjust_tracks
from barpc.base.errors import InputError
from barpc.base.geodesy import ground_from_ecef
from barpc.base.options import RunOptions, TieOptions
from barpc.pipeline import control
from barpc.pipeline.control import load_gcps
from barpc.pointio.tables import GROUND_SIGMA, IMAGE_SIGMA
from barpc.scene import GroundPoints, View
from barpc.sensor.corrected import Corrected, Correction
from barpc.simulate import simulate_block

BLOCK = simulate_block(3, 4, num_gcps=6, seed=3, lon=-58.4, lat=34.6)
VIEWS = BLOCK.views
POINTS = replace(BLOCK.gcps, sigma=np.tile([0.1, 0.2, 0.3], (6, 1)), xy_sigma=np.full(len(BLOCK.gcps.view), 0.4))


def rows(points: GroundPoints):
    """Name, place, sigma, image and position of each observation."""
    for g, v, xy in zip(points.point, points.view, points.xy.tolist(), strict=True):
        yield points.names[g], points.lonlatalt[g].tolist(), points.sigma[g].tolist(), VIEWS[v].name, xy


def table(points: GroundPoints, head: str, sign: str = ",") -> str:
    """A CSV with named columns."""
    lines = [head.replace(",", sign)]
    for name, (lon, lat, alt), sigma, image, (col, row) in rows(points):
        known = {"id": name, "lon": lon, "lat": lat, "alt": alt, "image": image + ".tif", "col": col, "row": row}
        known |= {"e": sigma[0], "n": sigma[1], "u": sigma[2], "px": 0.4, "": "remark"}
        order = [MEANING.get(word.strip().lower(), "") for word in head.split(",")]
        lines.append(sign.join(str(known[key]) for key in order))
    return "\n".join(lines) + "\n"


MEANING = {
    **dict.fromkeys(("id", "gcp_id", "name"), "id"), **dict.fromkeys(("lon", "longitude [deg]"), "lon"),
    **dict.fromkeys(("lat", "latitude [deg]"), "lat"), **dict.fromkeys(("h", "z", "elevation"), "alt"),
    **dict.fromkeys(("image", "filename"), "image"), **dict.fromkeys(("col", "sample", "px"), "col"),
    **dict.fromkeys(("row", "line", "py"), "row"), **dict.fromkeys(("sigma_e", "sigma_x", "sigma east"), "e"),
    **dict.fromkeys(("sigma_n", "sigma_y", "sigma north"), "n"), "sigma_px": "px", "sigma_col": "px",
    **dict.fromkeys(("sigma_u", "sigma_z", "sigma up"), "u"), "x": "lon", "y": "lat",
}  # fmt: skip


def asp(points: GroundPoints) -> str:
    """A `.gcp` file as bundle_adjust's manual has it: id lat lon height, sigmas, then every image."""
    lines = {}
    for name, (lon, lat, alt), (e, n, u), image, (col, row) in rows(points):
        lines.setdefault(name, f"{name} {lat!r} {lon!r} {alt!r} {e} {n} {u}")
        lines[name] += f" /some/where/{image}.tif {col!r} {row!r} 0.4 0.4"
    return "# WKT: GEOGCS[...]\n" + "\n".join(lines.values()) + "\n"


def geojson(points: GroundPoints, **more) -> str:
    """As orthority's manual has it: a feature an observation, file name with or without its ending."""
    features = [
        {
            "type": "Feature",
            "properties": {"filename": image, "ji": xy, "id": name, "info": None, **more},
            "geometry": {"type": "Point", "coordinates": place},
        }
        for name, place, _, image, xy in rows(points)
    ]
    return json.dumps({"type": "FeatureCollection", "features": features})


FULL = "id,lon,lat,h,image,col,row,sigma_e,sigma_n,sigma_u,sigma_px"
SURVEY = "Filename,PX,PY,gcp_id,X,Y,Z,remark,sigma_x,sigma_y,sigma_z,sigma_col"
WORDS = "name,Latitude [deg],Longitude [deg],Elevation,image,sample,line,sigma east,sigma north,sigma up,sigma_px"
TEXTS = {
    "a.gcp": asp(POINTS),
    "a.geojson": geojson(POINTS, sigma_m=[0.1, 0.2, 0.3], sigma_px=0.4),
    "a.csv": table(POINTS, FULL),
    "b.csv": "# surveyed\n" + table(POINTS, SURVEY),
    "c.txt": table(POINTS, WORDS, "\t"),
    "d.csv": table(POINTS, FULL, ";").replace(".", ",").replace(",tif", ".tif"),
}


def load(path, text: str, views=VIEWS, dem=None, **options) -> GroundPoints:
    path.write_text(text)
    return load_all([path], views, dem, **options)


def load_all(paths, views=VIEWS, dem=None, **options) -> GroundPoints:
    found = load_gcps(list(map(str, paths)), views, RunOptions(**options), dem)
    assert found is not None
    return found


@pytest.mark.parametrize("name", TEXTS)
def test_every_syntax_gives_the_same_points(tmp_path, name):
    found = load(tmp_path / name, TEXTS[name])
    assert found.names == POINTS.names
    assert found.left_out == ()
    order = np.lexsort((found.view, found.point))
    for field in ("lonlatalt", "sigma"):
        np.testing.assert_array_equal(getattr(found, field), getattr(POINTS, field))
    for field in ("point", "view", "xy", "xy_sigma"):
        np.testing.assert_array_equal(getattr(found, field)[order], getattr(POINTS, field))


def test_without_names_points_are_told_apart_by_their_places(tmp_path):
    found = load(tmp_path / "a.csv", table(POINTS, "lon,lat,h,image,col,row"))
    assert found.names == tuple(f"gcp_{n}" for n in range(1, 7))
    assert len(found.view) == len(POINTS.view)


@pytest.mark.parametrize(
    ("columns", "cells", "ground", "image"),
    [
        ("sigma_xy,sigma_z", "0.3,0.9", (0.3, 0.3, 0.9), IMAGE_SIGMA),
        ("sigma,sigma_z", "0.3,0.9", (0.3, 0.3, 0.9), IMAGE_SIGMA),
        ("accuracy,sigma_row,scol", "0.3,0.2,0.7", (0.3, 0.3, 0.3), 0.7),
        ("sigma_east,sigma_px", "0.3,", (0.3, GROUND_SIGMA, GROUND_SIGMA), IMAGE_SIGMA),
    ],
)
def test_sigmas_may_be_stated_together(tmp_path, columns, cells, ground, image):
    lines = table(POINTS, "id,lon,lat,h,image,col,row").splitlines()
    text = "\n".join([f"{lines[0]},{columns}", *(f"{line},{cells}" for line in lines[1:])])
    found = load(tmp_path / "a.csv", text)
    np.testing.assert_array_equal(found.sigma, np.tile(ground, (6, 1)))
    np.testing.assert_array_equal(found.xy_sigma, np.full(len(POINTS.view), image))


@pytest.mark.parametrize(
    ("head", "says"),
    [
        ("id,lon,lat,h,col,row", "no column image"),
        ("id,x,y,z,image", "no column"),
        ("id,lon,lat,h,image,col,row,sigma_elephant", "'sigma_elephant' is none that is read"),
    ],
)
def test_a_table_that_lacks_a_column_says_which(tmp_path, head, says):
    with pytest.raises(InputError, match=says):
        load(tmp_path / "a.csv", table(POINTS, head))


def moved(which: list[int], change) -> GroundPoints:
    place = POINTS.lonlatalt.copy()
    place[which] = [change(*row) for row in place[which]]
    return replace(POINTS, lonlatalt=place)


def exchanged(lon, lat, alt):
    return lat, lon, alt


FAULTS = {
    "all exchanged": (list(range(6)), exchanged, "6 of 6 points .*longitude and latitude are exchanged"),
    "most exchanged": ([0, 1, 3, 5], exchanged, "4 of 6 points .gcp_000, gcp_001, gcp_003, gcp_005.: longitude and"),
    "one exchanged": ([2], exchanged, "point gcp_002: longitude and latitude are exchanged"),
    "a sign": ([4], lambda lon, lat, alt: (-lon, lat, alt), "point gcp_004: the sign of a longitude"),
    "another place": ([1], lambda lon, lat, alt: (lon, lat + 0.02, alt), "point gcp_001: as far as 2 km"),
    "too high": ([3], lambda lon, lat, alt: (lon, lat, alt + 3000.0), "point gcp_003: altitudes far outside"),
    "in space": ([3], lambda lon, lat, alt: (lon, lat, alt + 3e6), "point gcp_003: altitudes far outside"),
    "too low": ([5], lambda lon, lat, alt: (lon, lat, alt - 3000.0), "point gcp_005: altitudes far outside"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("write", [asp, geojson], ids=["gcp", "geojson"])
def test_what_cannot_be_meant_is_named_and_refused_or_left_out(tmp_path, fault, write):
    which, change, says = FAULTS[fault]
    text = write(moved(which, change))
    with pytest.raises(InputError, match=says) as error:
        load(tmp_path / "p.txt", text)
    assert "p.txt" in str(error.value)
    assert "\n" not in str(error.value)
    found = load(tmp_path / "p.txt", text, keep_going=True)
    assert found.names == tuple(name for g, name in enumerate(POINTS.names) if g not in which)
    assert set(found.point.tolist()) == set(range(6 - len(which)))
    (line,) = found.left_out
    assert POINTS.names[which[0]] in line


@pytest.mark.parametrize("value", ["nan", "inf", "-1e300"])
def test_a_position_in_the_image_that_is_none_is_refused(tmp_path, value):
    lines = asp(POINTS).splitlines()
    words = lines[3].split()
    words[8] = value
    lines[3] = " ".join(words)
    with pytest.raises(InputError, match="point gcp_002: no ground is seen"):
        load(tmp_path / "p.gcp", "\n".join(lines))


def test_latitudes_beyond_the_pole_are_recognised_as_longitudes(tmp_path):
    block = simulate_block(2, 4, num_gcps=5, seed=3, lon=139.7, lat=35.7)
    lines = ["lon,lat,alt,image,col,row"]
    for g, v, (col, row) in zip(block.gcps.point, block.gcps.view, block.gcps.xy, strict=True):
        lon, lat, alt = block.gcps.lonlatalt[g]
        lines.append(f"{lat},{lon},{alt},{block.views[v].name},{col},{row}")
    with pytest.raises(InputError, match=r"5 of 5 points .*exchanged"):
        load(tmp_path / "p.csv", "\n".join(lines), block.views)


def test_cameras_that_are_hundreds_of_metres_off_and_heights_above_the_geoid_are_no_fault(tmp_path):
    move = Correction(np.zeros(3), np.array([300.0, -250.0, 200.0]), np.array([7e6, 0.0, 0.0]))
    off = [View(v.name, v.path, v.size, Corrected(v.sensor, move), v.alt_range) for v in VIEWS]
    above_geoid = asp(moved(list(range(6)), lambda lon, lat, alt: (lon, lat, alt - 100.0)))
    assert load(tmp_path / "p.gcp", above_geoid, off).names == POINTS.names


@pytest.mark.parametrize("only", [False, True])
def test_images_that_are_not_in_the_run_are_refused_or_left_out(tmp_path, only):
    text = asp(POINTS)
    if only:
        for view in VIEWS:
            text = text.replace(f"/{view.name}.tif", f"/else_{view.name}.tif")
    else:
        text = text.replace(f"/{VIEWS[1].name}.tif", "/else.tif")
    with pytest.raises(InputError, match="else"):
        load(tmp_path / "p.gcp", text)
    found = load(tmp_path / "p.gcp", text, keep_going=True)
    assert len(found.left_out) == 1
    assert "else" in found.left_out[0]
    assert len(found.view) == (0 if only else (POINTS.view != 1).sum())


def test_of_a_file_of_one_image_no_image_is_asked(tmp_path):
    one = POINTS.select(np.bincount(POINTS.point[POINTS.view == 0], minlength=6) > 0)
    one = replace(one, **{name: getattr(one, name)[one.view == 0] for name in ("point", "view", "xy", "xy_sigma")})
    found = load(tmp_path / "p.csv", table(one, "id,lon,lat,h,col,row"), VIEWS[:1])
    np.testing.assert_array_equal(found.xy, one.xy)


@pytest.mark.parametrize(("beyond", "passes"), [(400.0, True), (600.0, False)])
@pytest.mark.parametrize("end", [0, 1])
def test_altitudes_may_leave_those_of_the_camera_by_half_a_kilometre(tmp_path, end, beyond, passes):
    alt = VIEWS[0].alt_range[end] + (beyond if end else -beyond)
    text = asp(moved([0], lambda lon, lat, _: (lon, lat, alt)))
    if passes:
        assert load(tmp_path / "p.gcp", text).names == POINTS.names
    else:
        with pytest.raises(InputError, match="point gcp_000: altitudes far outside"):
            load(tmp_path / "p.gcp", text)


@pytest.mark.parametrize(
    ("metres", "search", "passes"),
    [(700.0, 700.0, True), (1500.0, 700.0, False), (1500.0, 6e3, True), (2500.0, 4e3, False)],
)
def test_how_far_a_camera_may_be_wrong_is_a_kilometre_or_what_is_searched(tmp_path, metres, search, passes):
    text = asp(moved([2], lambda lon, lat, alt: (lon, lat + metres / 111e3, alt)))
    if passes:
        assert load(tmp_path / "p.gcp", text, tie=TieOptions(search=search)).left_out == ()
    else:
        with pytest.raises(InputError, match="point gcp_002: as far as"):
            load(tmp_path / "p.gcp", text, tie=TieOptions(search=search))


def test_several_files_are_one_and_each_is_left_out_alone(tmp_path):
    for name, text in (("a.gcp", asp(POINTS)), ("b.csv", "nothing\n"), ("c.csv", TEXTS["a.csv"])):
        (tmp_path / name).write_text(text)
    paths = [tmp_path / name for name in ("a.gcp", "b.csv", "c.csv")]
    with pytest.raises(InputError, match=r"b\.csv"):
        load_all(paths)
    found = load_all(paths, keep_going=True)
    assert found.names == POINTS.names * 2
    assert len(found.left_out) == 1
    assert "b.csv" in found.left_out[0]
    np.testing.assert_array_equal(found.lonlatalt[found.point], np.tile(POINTS.lonlatalt, (2, 1))[found.point])


# --- its parts ---------------------------------------------------------------------------------------------


def test_without_files_there_are_no_points() -> None:
    assert load_gcps([], VIEWS, RunOptions()) is None


def test_ten_names_are_listed_and_the_others_counted() -> None:
    names = [f"g{n}" for n in range(13)]
    ten = ", ".join(names[:10])
    assert [control.listed(names[:count]) for count in (1, 2, 10)] == ["g0", "g0, g1", ten]
    assert [control.listed(names[:count]) for count in (11, 13)] == [f"{ten} and {n} more" for n in (1, 3)]


@dataclass(frozen=True)
class Plain:
    """A camera that looks straight down: column and row are hundredths of a degree, or another part of it."""

    degrees: float = 0.01
    size: float = 1.0  # NaN: what a pixel measures is not known

    def localize(self, image, alt):
        return np.column_stack([np.asarray(image) * self.degrees, alt])

    def project_jacobian(self, ground):
        return None, np.broadcast_to(self.size * np.eye(2, 3) / self.degrees, (len(ground), 2, 3))


def made(*rows: tuple[int, int, float, float], lonlatalt) -> GroundPoints:
    """Points with observations: point, view, column, row."""
    place = np.array(lonlatalt, dtype=float).reshape(-1, 3)
    point, view, xy = [row[0] for row in rows], [row[1] for row in rows], [row[2:] for row in rows]
    names = tuple(f"g{n}" for n in range(len(place)))
    return GroundPoints(names, place, np.ones((len(place), 3)), point, view, xy, np.ones(len(rows)))


def flat(count: int = 2) -> tuple[View, ...]:
    ends = [(0.0, 300.0), (1000.0, 2000.0)]
    return tuple(View(f"v{n}", f"v{n}.tif", (9000, 9000), Plain(), ends[n]) for n in range(count))  # type: ignore[arg-type]


def told(points: GroundPoints, search: float = 0.5, views=None) -> list[tuple[list[int], str]]:
    """Which points cannot be meant, and how the reason begins; reasons of none are left out."""
    found = control._implausible(points, views or flat(), search)
    return [(np.flatnonzero(wrong).tolist(), what) for wrong, what in found if wrong.any()]


@pytest.mark.parametrize(
    ("lon", "lat", "says"),
    [
        (30.0, 40.0, ""), (40.0, 30.0, "longitude and latitude are exchanged"),
        (-40.0, 30.0, "as far as"), (-30.0, 40.0, "the sign"), (30.0, -40.0, "the sign"), (-30.0, -40.0, "the sign"),
        (40.0, -30.0, "as far as"), (31.0, 40.0, "as far as"),
    ],
)  # fmt: skip
def test_each_mistake_is_recognised_by_itself(lon, lat, says) -> None:
    """The image shows 30 east, 40 north."""
    found = told(made((0, 0, 3000.0, 4000.0), lonlatalt=[lon, lat, 10.0]))
    assert [which for which, _ in found] == ([[0]] if says else [])
    assert not says or found[0][1].startswith(says)


def test_a_point_is_told_by_any_of_its_images_and_how_far_is_the_farthest_of_them() -> None:
    """A degree of longitude is 109.6 km at ten degrees north, of latitude 110.6."""
    points = made(
        (0, 0, 30e2, 10e2), (0, 1, 32e2, 10e2), (1, 0, 33e2, 10e2), (1, 1, 33e2, 10e2), (2, 1, 30e2, 11e2),
        lonlatalt=[[30, 10, 100], [33, 10, 100], [30, 10, 1500]],
    )  # fmt: skip
    ((which, what),) = [row for row in told(points) if row[1].startswith("as far as")]
    assert which == [0, 2]
    assert what == "as far as 219 km from where the images show it, by their cameras"
    sky = made((0, 0, np.nan, 10e2), (0, 1, 30e2, 10e2), (1, 1, 33e2, 10e2), lonlatalt=[[33, 10, 100], [31, 10, 100]])
    ((_, what),) = [row for row in told(sky) if row[1].startswith("as far as")]
    assert what.startswith("as far as 329 km")  # one of the observations sees no ground


def test_beyond_a_pole_there_is_no_ground_however_near_it_would_be() -> None:
    """90.001 north is 111 m from the pole, nearer than a camera is wrong by."""
    for lat, wrong in ((90.0, False), (90.001, True)):
        found = told(made((0, 0, 0.0, 9000.0), lonlatalt=[0.0, lat, 10.0]))
        assert bool(found) == wrong


@pytest.mark.parametrize(
    ("view", "alt", "fine"),
    [
        (0, -500.0, True), (0, -501.0, False), (0, 800.0, True), (0, 801.0, False),
        (1, 500.0, True), (1, 499.0, False), (1, 2500.0, True), (1, 2501.0, False),
    ],
)  # fmt: skip
def test_altitudes_belong_to_the_image_that_shows_the_point(view, alt, fine) -> None:
    points = made((0, 0, 0.0, 0.0), (1, view, 100.0, 100.0), lonlatalt=[[0, 0, 100.0], [1, 1, alt]])
    ends = "0 to 300 m" if view == 0 else "0 to 2000 m"
    says = f"altitudes far outside {ends}, where the cameras are used: metres above the ellipsoid are needed"
    assert told(points) == ([] if fine else [([1], says)])


def test_points_are_sought_at_the_altitude_of_the_camera_that_is_nearest_theirs() -> None:
    """At an altitude beyond the camera's, height makes no distance."""
    points = made((0, 0, 0.0, 0.0), (1, 1, 0.0, 0.0), lonlatalt=[[0, 0, 790.0], [0, 0, 510.0]])
    assert told(points) == []
    seen: list[float] = []

    class Asked(Plain):
        def localize(self, image, alt):
            seen.extend(alt.tolist())
            return super().localize(image, alt)

    told(points, views=[replace(view, sensor=Asked()) for view in flat()])
    assert seen == [300.0, 1000.0]


@pytest.mark.parametrize(("search", "reach"), [(0.5, 1000.0), (0.9, 1000.0), (6.0, 6657.0)])
def test_the_reach_is_that_of_pixels_on_the_ground_or_a_kilometre(search, reach) -> None:
    """A pixel is 1109.5 m: at the equator a degree of longitude is 111.3 km, of latitude 110.6."""
    for share, fine in ((0.99, True), (1.01, False)):
        points = made((0, 0, 0.0, 0.0), lonlatalt=[0.0, share * reach / 110574.0, 10.0])
        assert (told(points, search) == []) == fine


@pytest.mark.parametrize(("view", "far"), [(0, True), (1, False)])
def test_each_image_is_asked_for_its_own_observations(view, far) -> None:
    """Of two points one lies nine hundredths of a degree off: six pixels of the coarser camera, not of the other."""
    degrees = (0.01, 0.02)
    views = [replace(flat()[0], sensor=Plain(step)) for step in degrees]  # type: ignore[arg-type]
    points = made(
        (0, 1, 3.0 / 0.02, 1.0 / 0.02), (1, view, 2.0 / degrees[view], 1.0 / degrees[view]), (0, 0, 300.0, 100.0),
        lonlatalt=[[3.0, 1.0, 10.0], [2.0, 1.09, 10.0]],
    )  # fmt: skip
    assert [which for which, _ in told(points, 6.0, views)] == [[1]] * far


def test_where_a_pixel_has_no_size_the_reach_is_a_kilometre() -> None:
    views = [replace(flat()[0], sensor=Plain(0.01, size=np.nan))]  # type: ignore[arg-type]
    assert told(made((0, 0, 0.0, 0.0), lonlatalt=[0.0, 0.008, 10.0]), 6.0, views) == []
    assert told(made((0, 0, 0.0, 0.0), lonlatalt=[0.0, 0.010, 10.0]), 6.0, views) != []


def test_several_faults_are_several_lines_and_a_point_has_the_first_that_fits(tmp_path) -> None:
    """Of the file: exchanged (0, 1), too high (2), and an image that is none; of a run that goes on all are told."""
    place = POINTS.lonlatalt.copy()
    place[[0, 1]] = place[[0, 1]][:, [1, 0, 2]]
    place[1, 2] = place[2, 2] = 9000.0
    text = asp(replace(POINTS, lonlatalt=place)).replace(f"/{VIEWS[2].name}.tif", "/else.tif")
    path = tmp_path / "p.gcp"
    found = load(path, text, keep_going=True)
    assert found.names == POINTS.names[3:]
    first, second, third = found.left_out
    assert first.startswith(f"{path}: 2 of 6 points (gcp_000, gcp_001): longitude and latitude are exchanged")
    assert second.startswith(f"{path}: point gcp_002: altitudes far outside")
    assert third == f"{path}: it names images that are not in this run: /some/where/else.tif; left out"
    assert first.endswith("; left out")
    with pytest.raises(InputError, match=r"exchanged.*; correct it, or leave it out with --keep-going$"):
        load(path, text)


def test_of_several_files_each_observation_keeps_its_point_and_strangers_are_named_once(tmp_path) -> None:
    paths = [tmp_path / name for name in ("a.gcp", "b.gcp", "c.gcp")]
    for n, path in enumerate(paths):
        some = POINTS.select(np.arange(6) % 3 == n)
        path.write_text(asp(some).replace(f"/{VIEWS[2].name}.tif", "/else.tif"))
    found = load_all(paths, keep_going=True)
    order = [0, 3, 1, 4, 2, 5]
    assert found.names == tuple(POINTS.names[g] for g in order)
    np.testing.assert_array_equal(found.lonlatalt, POINTS.lonlatalt[order])
    np.testing.assert_array_equal(found.sigma, POINTS.sigma[order])
    seen = {(POINTS.names[g], v, *xy) for g, v, xy in zip(POINTS.point, POINTS.view, POINTS.xy.tolist(), strict=True)}
    kept = {(found.names[g], v, *xy) for g, v, xy in zip(found.point, found.view, found.xy.tolist(), strict=True)}
    assert kept == {row for row in seen if row[1] != 2}
    assert found.strangers == ("/some/where/else.tif",)
    assert [line.split(":")[0] for line in found.left_out] == list(map(str, paths))


# --- altitudes that nobody knows ---------------------------------------------------------------------------


class Plane:
    """A DEM that knows heights west of a longitude."""

    known = True

    def __init__(self, east: float = np.inf) -> None:
        self.east = east

    def __call__(self, lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
        return np.where(lon < self.east, 321.0, np.nan)


def at_zero(points: GroundPoints, some: np.ndarray) -> GroundPoints:
    """Points of which some have the altitude that GDAL and QGIS write for none."""
    return replace(points, lonlatalt=np.where(some[:, None], points.lonlatalt * [1.0, 1.0, 0.0], points.lonlatalt))


@pytest.mark.parametrize("some", [np.ones(6, dtype=bool), np.arange(6) == 2, np.arange(6) > 1])
def test_an_altitude_of_zero_is_none_and_holds_an_image_sideways_alone(tmp_path, some) -> None:
    path = tmp_path / "p.gcp"
    found = load(path, asp(at_zero(POINTS, some)))
    low, high = min(view.alt_range[0] for view in VIEWS), max(view.alt_range[1] for view in VIEWS)
    count = int(some.sum())
    np.testing.assert_array_equal(found.lonlatalt[some, 2], 0.5 * (low + high))
    np.testing.assert_allclose(found.sigma[some, 2], (high - low) * count**0.5)  # together no better than the range
    np.testing.assert_array_equal(found.sigma[:, :2], POINTS.sigma[:, :2])
    for name in ("lonlatalt", "sigma"):
        np.testing.assert_array_equal(getattr(found, name)[~some], getattr(POINTS, name)[~some])
    assert found.left_out == (
        f"{path}: {count} of 6 points have no altitude, or a default (0, or one for all) and constrain the images "
        "horizontally only: give their altitudes, or --dem",
    )


def test_a_dem_knows_the_altitudes_that_are_zero_where_it_reaches(tmp_path) -> None:
    text = asp(at_zero(POINTS, np.arange(6) != 1))
    found = load(tmp_path / "p.gcp", text, dem=Plane())
    assert found.lonlatalt[:, 2].tolist() == [321.0, POINTS.lonlatalt[1, 2], *[321.0] * 4]
    np.testing.assert_allclose(found.sigma[[0, 2], 2], np.hypot(RunOptions().adjust.dem_sigma, 5.0 * 5**0.5))
    assert found.sigma[1, 2] == 0.3
    assert found.left_out == ()
    assert "5 of 6 points have no altitude, or a default (0, or one for all): the DEM's are" in " ".join(found.said)
    east = float(np.median(POINTS.lonlatalt[:, 0]))
    found = load(tmp_path / "p.gcp", text, dem=Plane(east))
    beyond = (POINTS.lonlatalt[:, 0] >= east) & (np.arange(6) != 1)
    np.testing.assert_array_equal(found.lonlatalt[:, 2] == 321.0, ~beyond & (np.arange(6) != 1))
    assert f"; {beyond.sum()} of them constrain the images horizontally only" in found.left_out[0]


@pytest.mark.parametrize("seed", range(3))
def test_control_without_altitudes_says_no_more_of_the_height_than_it_knows(tmp_path, seed) -> None:
    """Its truth 200 m from the middle of the range: within what is said; taken as 0 it was 40 m off, known to 0.45."""
    block = simulate_block(3, 200, num_gcps=8, seed=seed)
    gcps, lines = block.gcps, {}
    for g, v, (col, row) in zip(gcps.point, gcps.view, gcps.xy.tolist(), strict=True):
        lon, lat, _ = gcps.lonlatalt[g].tolist()
        lines[g] = f"g{g} {lat} {lon} 0 1 1 1 {block.views[v].name} {col} {row} 1 1\n"
    gcps = load(tmp_path / "p.gcp", "".join(lines.values()), block.views)
    found = adjust_tracks(block.views, block.tracks, gcps=gcps)
    off = ground_from_ecef(found.points) - block.truth.ground
    metres = np.nanmean(off, axis=0) * [111e3 * np.cos(np.radians(43.3)), 111e3, 1.0]
    assert (np.abs(metres) < 3.0 * found.gauge.sigma).all()
    assert found.gauge.sigma[2] > 5.0


def test_points_without_a_column_of_altitudes_are_as_those_of_zero(tmp_path) -> None:
    path, text = tmp_path / "p.csv", table(POINTS, "id,lon,lat,image,col,row")
    found = load(path, text)
    assert found.said == (f"{path}: CSV; no altitudes",)
    assert found.left_out[0].endswith("and constrain the images horizontally only: give their altitudes, or --dem")
    found = load(path, text, dem=Plane())
    assert found.lonlatalt[:, 2].tolist() == [321.0] * 6
    assert found.left_out == ()


def test_a_map_and_degrees_are_the_same_points_ground_and_image_apart_too(tmp_path) -> None:
    """The files of one --gcp go together: MicMac's ground points with the image points of another file, once."""
    to_map = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32631", always_xy=True).transform
    ground = "".join(
        f"<OneAppuisDAF><Pt>{x!r} {y!r} {z!r}</Pt><NamePt>{name}</NamePt></OneAppuisDAF>"
        for name, (lon, lat, z) in zip(POINTS.names, POINTS.lonlatalt.tolist(), strict=True)
        for x, y in [to_map(lon, lat)]
    )
    seen = "".join(
        f"<MesureAppuiFlottant1Im><NameIm>{VIEWS[v].name}</NameIm><OneMesureAF1I><NamePt>{POINTS.names[g]}</NamePt>"
        f"<PtIm>{col!r} {row!r}</PtIm></OneMesureAF1I></MesureAppuiFlottant1Im>"
        for g, v, (col, row) in zip(POINTS.point, POINTS.view, POINTS.xy.tolist(), strict=True)
    )
    (first := tmp_path / "ground.xml").write_text(f"<Global>{ground}</Global>")
    (second := tmp_path / "seen.xml").write_text(f"<SetOfMesureAppuisFlottants>{seen}</SetOfMesureAppuisFlottants>")
    for paths in ([first], [first, second], [second, first]):
        found = load_all(paths, gcp_crs="EPSG:32631")
        assert sorted(found.names) == sorted(POINTS.names)
        assert len(found.view) == len(POINTS.view)
        order = [found.names.index(name) for name in POINTS.names]
        np.testing.assert_allclose(found.lonlatalt[order], POINTS.lonlatalt, rtol=0, atol=1e-8)

"""Tables of points and of names: every column, default and limit that decides what a file means."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.control import GroundControlPoint

from barpc.base.errors import InputError
from barpc.pointio.correspondences import correspondence_kind, read_correspondences, read_grid
from barpc.pointio.gcps import read_gcps
from barpc.pointio.matches import Links, asp_text, read_links, tracks_of
from barpc.pointio.names import (
    MAX_NAME,
    ViewNames,
    cell,
    from_cell,
    pair_name,
    require_pair_names,
    unique_names,
)
from barpc.pointio.third_party_matches import index_pairs, pair_files, pair_of
from tests.geotiffs import write_blank, write_image
from tests.pointio.stages import read_matches

NAMES = ["left", "right"]

# --- ground control points -------------------------------------------------------------------------------------


def gcps(folder: Path, text: str, names: list[str] = NAMES):
    path = folder / "points.csv"
    path.write_text(text, encoding="utf-8")
    return read_gcps(path, names)


@pytest.mark.parametrize(
    ("columns", "cells", "ground", "pixels"),
    [
        ("other", "3", (1, 1, 1), 0.5),
        ("sigma", "3", (3, 3, 3), 0.5),
        ("sigma_xy", "3", (3, 3, 1), 0.5),
        ("sigma,sigma_xy", "2,3", (3, 3, 2), 0.5),
        ("sigma_x,sigma_xy,sigma_z", "4,3,5", (4, 3, 5), 0.5),
        ("sx,sy,sz", "4,6,5", (4, 6, 5), 0.5),
        ("sigma_px", "0.2", (1, 1, 1), 0.2),
        ("sigma_col,sigma_row", "0.2,0.7", (1, 1, 1), 0.7),
        ("sigma,sigma_px", ",", (1, 1, 1), 0.5),
    ],
)
def test_accuracies_are_those_that_are_stated_the_nearest_word_first(tmp_path, columns, cells, ground, pixels) -> None:
    found = gcps(tmp_path, f"image,lon,lat,alt,col,row,{columns}\nleft,5,43,100,1,2,{cells}\n")
    assert found.sigma.tolist() == [list(ground)]
    assert found.xy_sigma.tolist() == [pixels]


@pytest.mark.parametrize("column", ["sigma", "sigma_z", "sigma_px"])
@pytest.mark.parametrize("stated", ["nan", "inf", "0", "-1"])
def test_an_accuracy_that_is_none_is_not_taken_for_a_blank(tmp_path, column, stated) -> None:
    with pytest.raises(InputError, match="sigmas positive"):
        gcps(tmp_path, f"image,lon,lat,alt,col,row,{column}\nleft,5,43,100,1,2,{stated}\n")


def test_of_one_image_a_table_need_not_name_it(tmp_path) -> None:
    text = "lon,lat,alt,col,row\n5,43,100,1,2\n6,43,100,3,4\n"
    found = gcps(tmp_path, text, ["left"])
    assert found.names == ("gcp_1", "gcp_2")
    assert found.view.tolist() == [0, 0]
    assert gcps(tmp_path, text.replace("alt", "other"), ["left"]).lonlatalt[:, 2].tolist() == [0.0, 0.0]


@pytest.mark.parametrize("word", ["sigma_up_ft", "stdev_z", "std", "accuracy [ft]", "error", "err_x"])
def test_an_accuracy_by_a_word_that_is_not_read_is_refused(tmp_path, word) -> None:
    with pytest.raises(
        InputError, match=f"column '{re.escape(word)}' is none that is read; accuracies are called sigma,"
    ):
        gcps(tmp_path, f"image,lon,lat,alt,col,row,{word}\nleft,5,43,100,1,2,1\n")
    assert len(gcps(tmp_path, f"image,lon,lat,alt,col,row,my_{word}\nleft,5,43,100,1,2,1\n").names) == 1


def test_a_line_that_lacks_a_number_is_named(tmp_path) -> None:
    head = "image,lon,lat,alt,col,row\nleft,5,43,100,1,2\n"
    for line in ("left,5,43,100,1\n", "left,5,43,high,1,2\n", "left,,43,4,1,2\n"):
        with pytest.raises(InputError, match=r"points\.csv, line 3: expected"):
            gcps(tmp_path, head + line)


def test_points_of_one_name_and_place_are_one(tmp_path) -> None:
    text = (
        "id,image,lon,lat,alt,col,row\np,left,5,43,100,1,2\nq,left,5,43,100,3,4\np,right,5,43,100,5,6\n"
        "p,right,5,43,101,7,8\nq,far,5,43,100,7,8\n"
    )
    found = gcps(tmp_path, text)
    assert found.names == ("p", "q", "p")
    assert found.point.tolist() == [0, 1, 0, 2]
    assert found.view.tolist() == [0, 0, 1, 1]
    assert found.strangers == ("far",)


@pytest.mark.parametrize(
    ("lon", "lat", "alt", "ok"),
    [
        ("540", "43", "100", True), ("541", "43", "100", False), ("5", "90", "100", True),
        # exchanged with the longitude: whoever knows the images says so
        ("35.1", "-139.2", "100", True), ("5", "541", "100", False),
        ("5", "43", "1e9", True), ("5", "43", "1.1e9", False), ("nan", "43", "100", False),
    ],
)  # fmt: skip
def test_a_place_is_one_in_degrees(tmp_path, lon, lat, alt, ok) -> None:
    text = f"image,lon,lat,alt,col,row\nleft,{lon},{lat},{alt},1,2\n"
    if ok:
        assert gcps(tmp_path, text).lonlatalt.shape == (1, 3)
    else:
        with pytest.raises(InputError, match=r"points\.csv: "):
            gcps(tmp_path, text)


def test_a_point_of_geojson_is_one_in_all_its_images_and_states_sigmas_and_strangers(tmp_path) -> None:
    def feature(**properties: object) -> dict[str, object]:
        place = {"type": "Point", "coordinates": [5.4, 43.2, 100.0]}
        return {"properties": {"ji": [1, 2], "filename": "left", "id": "a", **properties}, "geometry": place}

    path = tmp_path / "a.geojson"
    features = [feature(sigma_m=[1, 2, 3], sigma_px=0.25), feature(filename="right.tif", ji=[10.5, 20.5])]
    path.write_text(json.dumps({"features": [*features, feature(id="b"), feature(filename="far")]}))
    found = read_gcps(path, NAMES)
    assert found.names == ("a", "b")
    assert (found.point.tolist(), found.view.tolist()) == ([0, 0, 1], [0, 1, 0])
    assert found.xy.tolist() == [[1, 2], [10.5, 20.5], [1, 2]]
    assert found.sigma.tolist() == [[1, 2, 3], [1, 1, 1]]
    assert found.xy_sigma.tolist() == [0.25, 0.5, 0.5]
    assert found.strangers == ("far",)
    for wrong, says in (
        ({"sigma_m": 1.0}, r"sigma_m is \[east, north, up\]"),
        ({"sigma_m": [1, 2]}, r"sigma_m is \[east, north, up\], sigma_px a number"),
        ({"sigma_px": "much"}, "'sigma_px' of a point: 'much' is no number"),
    ):
        path.write_text(json.dumps({"features": [feature(**wrong)]}))
        with pytest.raises(InputError, match=says):
            read_gcps(path, NAMES)


def test_tags_without_an_altitude_or_a_name(tmp_path) -> None:
    points = [GroundControlPoint(row=k, col=1, x=5.4, y=43.2, z=100.0, id=name) for k, name in enumerate("ab")]
    path = write_image(tmp_path / "left.tif", np.zeros((4, 4), np.uint8), gcps=points, crs="EPSG:4326")
    found = read_gcps(path, NAMES)
    assert found.view.tolist() == [0, 0]
    assert found.lonlatalt.tolist() == [[5.4, 43.2, 100.0]] * 2
    assert found.xy.tolist() == [[1.0, 0.0], [1.0, 1.0]]
    assert (found.sigma == 1.0).all()
    assert (found.xy_sigma == 0.5).all()
    with pytest.raises(InputError, match=r"left\.tif: image with GCP tags, no GCP of a, b; it names .*left\.tif"):
        read_gcps(path, ["a", "b"])


# --- correspondences -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("head", "kind"),
    [
        (b"1 2 3 4 5\n", "csv"), (b"1 2 3 4\n", None), (b"1 2 3 4 5 6\n", "csv"), (b"lon,lat\n", "csv"),
        (b"lon,height\n", None), (b"x,y,col,row\n", "csv"), (b"lon lat x y z\n", "csv"), (b"# 1\n\n1;2;3;4;5\n", "csv"),
        (b"PK\3\4", "npz"), (b' {"type": "FeatureCollection"}', "geojson"), (b'{"rpc": {}}', None),
        (b"\xff\xfe1", None),
    ],
)  # fmt: skip
def test_a_file_is_known_by_its_beginning(tmp_path, head, kind) -> None:
    (tmp_path / "a").write_bytes(head)
    assert correspondence_kind(tmp_path / "a") == kind


def test_a_table_may_state_sigmas_and_call_its_ground_x_and_y(tmp_path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("x y z col row sigma_px\n5.4 43.2 100 10 20 0.3\n")
    found = read_correspondences(path)
    assert found.ground.tolist() == [[5.4, 43.2, 100.0]]
    assert found.image.tolist() == [[10.0, 20.0]]
    assert found.sigma.tolist() == [0.3]
    path.write_text("lon lat z x y\n5.4 43.2 100 10 20\n")
    found = read_correspondences(path)
    assert found.image.tolist() == [[10.0, 20.0]]
    assert found.sigma is None


def test_arrays_of_an_npz_have_one_length(tmp_path) -> None:
    ground, image, path = np.ones((4, 3)), np.ones((4, 2)), tmp_path / "a.npz"
    np.savez(path, ground=ground, image=image, sigma=np.full(4, 0.2))
    assert read_correspondences(path).sigma.tolist() == [0.2] * 4
    for wrong in (
        {"ground": ground[:3], "image": image},
        {"ground": ground[:, :2], "image": image},
        {"ground": ground, "image": ground},
        {"ground": ground, "image": image, "sigma": np.ones(3)},
        {"ground": np.array(1.0), "image": np.array(1.0)},
    ):
        np.savez(path, **wrong)
        with pytest.raises(InputError, match="arrays of shapes"):
            read_correspondences(path)
    np.savez(path, **{k: np.ones(3) for k in ("lon", "lat", "alt", "col")}, row=np.ones(4))
    with pytest.raises(InputError, match="columns of different lengths"):
        read_correspondences(path)
    np.savez(path, **{k: np.ones(3) for k in ("lon", "lat", "alt", "col")})
    with pytest.raises(InputError, match="neither ground and image nor row; has lon, lat, alt, col"):
        read_correspondences(path)
    np.savez(path, ground=np.array(["a"]), image=image)
    with pytest.raises(InputError, match="not an npz of numbers"):
        read_correspondences(path)


def layered(path: Path, bands: np.ndarray, transform: rasterio.Affine, tags: dict[str, str]) -> Path:
    with rasterio.open(write_image(path, bands, transform=transform), "r+") as out:
        out.update_tags(**tags)
    return path


def test_a_grid_states_its_altitudes_and_lies_where_its_geotransform_puts_it(tmp_path) -> None:
    bands = np.random.default_rng(0).uniform(10, 11, (4, 3, 5))
    bands[2, 1, 3] = np.nan  # no ground there at the upper altitude
    transform = rasterio.Affine(10.0, 2.0, 5.0, -1.0, 20.0, 7.0)
    tags = {"ALTITUDE_B0": "100", "ALTITUDE_B1": "100", "ALTITUDE_B2": "250.5"}
    path = layered(tmp_path / "a.tif", bands, transform, tags)
    assert correspondence_kind(path) == "grid"
    found = read_grid(path)
    assert len(found.ground) == 2 * 15 - 1
    at = 1 * 5 + 4  # row 1, col 4 of the first layer
    assert found.image[at].tolist() == [10.0 * 4 + 2.0 * 1 + 5.0 - 0.5, -1.0 * 4 + 20.0 * 1 + 7.0 - 0.5]
    assert found.ground[at].tolist() == [bands[0, 1, 4], bands[1, 1, 4], 100.0]
    assert found.ground[-1].tolist() == [bands[2, 2, 4], bands[3, 2, 4], 250.5]
    assert read_grid(path, [1.0, 2.0]).ground[-1, 2] == 2.0
    assert read_correspondences(path, altitudes=[1.0, 2.0]).ground[-1, 2] == 2.0
    np.testing.assert_array_equal(read_correspondences(path).ground, found.ground)
    assert correspondence_kind(layered(tmp_path / "b.tif", bands, transform, {})) is None
    for altitudes in ([1.0], [1.0, 2.0, 3.0], [1.0, np.nan]):
        with pytest.raises(InputError, match="give one altitude a layer"):
            read_grid(path, altitudes)
    for wrong in ({"ALTITUDE_B0": "100"}, {**tags, "ALTITUDE_B2": "high"}):
        with pytest.raises(InputError, match="but 2 altitudes are known"):
            read_grid(layered(tmp_path / "b.tif", bands, transform, wrong))
    with pytest.raises(InputError, match="3 bands are 1 layers"):
        read_grid(layered(tmp_path / "b.tif", bands[:3], transform, tags))


def test_a_grid_of_gigabytes_is_refused_before_it_is_read(tmp_path) -> None:
    profile = {"count": 4, "dtype": "float32", "transform": rasterio.Affine.scale(2.0)}
    path = write_blank(tmp_path / "a.tif", (7000, 7000), **profile)  # 1.6 GB of doubles
    with rasterio.open(path, "r+") as out:
        out.update_tags(ALTITUDE_B0="1")
    with pytest.raises(InputError, match="a localisation grid"):
        read_grid(path)


@pytest.mark.parametrize(
    ("band", "value", "ok"),
    [(0, 540.0, True), (0, -541.0, False), (1, -90.0, True), (1, 90.1, False), (0, np.inf, True)],
)
def test_a_node_of_a_grid_is_on_earth_or_none(tmp_path, band, value, ok) -> None:
    bands = np.full((2, 2, 2), 10.0)
    bands[band, 0, 1] = value
    path = layered(tmp_path / "a.tif", bands, rasterio.Affine(10, 0, 0, 0, 10, 0), {"ALTITUDE_B0": "1"})
    if ok:
        assert len(read_grid(path).ground) == 4 - np.isinf(value)
    else:
        with pytest.raises(InputError, match="a node of it is no longitude, latitude"):
            read_grid(path)


# --- names -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("files", "names"),
    [
        (["a/x.tif", "b/x.tif", "b/y.tif"], ["a_x", "b_x", "y"]),
        (["a/x.tif", "a/x.jp2"], ["x.tif", "x.jp2"]),
        (["a/b/x.tif", "c/b/x.tif", "c/d/x.tif"], ["a_b_x", "c_b_x", "d_x"]),
        (["a/X.tif", "b/x.tif"], ["a_X", "b_x"]),
        (["a/x.tif", "a/x.tif", "b/y.tif"], ["x", "x", "y"]),
        (["/x.tif", "/a/x.tif"], ["x", "a_x"]),
        (["a/e\u0301.tif", "b/\u00e9.tif"], ["a_e\u0301", "b_\u00e9"]),
    ],
)
def test_a_name_has_as_many_folders_as_tell_it_apart(files, names) -> None:
    assert unique_names([Path(file) for file in files]) == names


def test_names_that_cannot_be_told_apart_or_are_too_long_are_refused() -> None:
    with pytest.raises(InputError, match=r"a/X\.tif and a/x\.tif: their names cannot be told apart"):
        unique_names([Path("a/b.tif"), Path("a/X.tif"), Path("a/x.tif")])
    assert len(unique_names([Path("n" * MAX_NAME + ".tif")])[0]) == MAX_NAME == 120
    with pytest.raises(InputError, match="more than 120 bytes"):
        unique_names([Path("n" * 121 + ".tif")])
    with pytest.raises(InputError, match="more than 120 bytes"):
        unique_names([Path("é" * 61 + ".tif")])


@pytest.mark.parametrize(
    ("names", "ok"),
    [
        (["a", "b", "c"], True),
        (["a", "a__b", "c", "b__c"], False),  # a__b__c: a and b__c, or a__b and c
        (["a", "a__b", "c"], True),
        (["a", "a__b", "b"], True),
        (["a", "a_", "b", "_b"], False),  # a___b
        (["a", "a_", "b"], True),
    ],
)
def test_the_name_of_a_pair_means_one_pair(names, ok) -> None:
    assert pair_name("a", "b") == "a__b"
    if ok:
        require_pair_names(names)
    else:
        with pytest.raises(InputError, match="would mean two pairs; rename an image"):
            require_pair_names(names)


@pytest.mark.parametrize(
    ("text", "written"),
    [
        ("view", "view"), ("a b", '"a b"'), ('a"b', '"a""b"'), ("=1", '"\'=1"'), ("+1", '"\'+1"'), ("-1", "'-1"),
        ("@x", '"\'@x"'), (" =1", '"\' =1"'), ("'=1", '"\'\'=1"'), ("1-2", "1-2"), ("", '""'), ("#1", '"#1"'),
        ("it's", "it's"),
    ],
)  # fmt: skip
def test_a_cell_is_never_a_formula_and_comes_back(text, written) -> None:
    import csv

    assert cell(text) == written
    assert from_cell(next(csv.reader([f"{written},x"]))[0]) == text
    assert from_cell("'quoted") == "'quoted"


def test_a_view_is_found_by_its_name_its_file_or_its_stem() -> None:
    views = ViewNames(["a/x.tif", "y", "b/z.1", "c/z.2"], "m.csv")
    for text in ("a/x.tif", "x.tif", "x", "/other/x.jp2", ' "x" ', " x "):
        assert views.find(text) == 0, text
    assert views.find("y.tif") == 1
    assert views.find("z") is None  # two have this stem
    assert (views.find("z.1"), views.find("z.2")) == (2, 3)
    for _ in range(2):
        assert views.find("q") is None
    assert views.strangers == {"z": 1, "q": 2}
    assert (views.exact("y"), views.exact("x")) == (1, None)
    assert views.index("x") == 0
    with pytest.raises(InputError, match=r"m\.csv: no view is named 'q'; there are a/x\.tif, y"):
        views.index("q")


# --- matches -----------------------------------------------------------------------------------------------------


def test_a_table_of_matches_may_state_a_sigma_and_name_others(tmp_path) -> None:
    path = tmp_path / "m.csv"
    path.write_text("Image,Col,Row,Track,Sigma\na,1,2,t,0.25\nb,3,4,t,0.5\nother,5,6,t,1\na,7,8,s,1\nb,9,9,s,1\n")
    links = read_links(path, ["a", "b"])
    assert links.sigma.tolist() == [0.25, 0.5, 1.0, 1.0]
    found = read_matches(path, ["b", "a"])
    assert found.view.tolist() == [0, 1, 0, 1]
    assert found.xy.tolist() == [[3, 4], [1, 2], [9, 9], [7, 8]]
    for text, words in (
        ("image,col,row,track,sigma\na,1,2,t,0\nb,1,2,t,1\n", "a sigma not positive"),
        ("image,col,row,track\na,inf,2,t\nb,1,2,t\n", "a coordinate is not finite"),
        (
            "image,col,row,track\nx,1,2,t\ny,1,2,t\n",
            "seen in two of the views; it names x, y, and the images are a, b",
        ),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=words):
            read_matches(path, ["a", "b"])


def test_an_npz_of_matches_has_arrays_of_one_length_and_views_with_names(tmp_path) -> None:
    path = tmp_path / "m.npz"
    names, xy = np.array(["a", "b"]), np.arange(6.0).reshape(3, 2)
    good = {"names": names, "view": [0, 1, 1], "track": [5, 5, 6], "xy": xy}
    np.savez(path, **good)
    assert read_matches(path, ["a", "b"]).xy.tolist() == [[0, 1], [2, 3]]
    assert (read_links(path, ["a", "b"]).sigma == 0.5).all()
    np.savez(path, **good, sigma=[1.0, 2.0, 3.0])
    assert read_links(path, ["a", "b"]).sigma.tolist() == [1.0, 2.0, 3.0]
    assert read_links(path, ["b", "a"]).view.tolist() == [1, 0, 0]
    for wrong in (
        {"view": [0, 1]}, {"track": [5, 5]}, {"xy": np.zeros((3, 3))}, {"sigma": [1.0]}, {"view": [0, 1, 2]},
        {"view": [0, -1, 1]}, {"track": ["x", "y", "z"]},
    ):  # fmt: skip
        np.savez(path, **{**good, **wrong})
        with pytest.raises(InputError, match="not an npz of names, view, track"):
            read_links(path, ["a", "b"])


def test_points_of_a_view_at_one_place_are_one_the_most_certain() -> None:
    view = np.array([0, 0, 1, 1, 0])
    xy = np.array([[1.0, 2.0], [1.0, 2.0], [1.0, 2.0], [3.0, 4.0], [1.0, 2.5]])
    links = Links(view, xy, np.array([0.5, 0.2, 0.3, 0.4, 0.1]), np.array([[0, 2], [1, 3], [4, 2]])).merged()
    table = sorted(zip(links.view.tolist(), links.xy.tolist(), links.sigma.tolist(), strict=True))
    assert table == [(0, [1.0, 2.0], 0.2), (0, [1.0, 2.5], 0.1), (1, [1.0, 2.0], 0.3), (1, [3.0, 4.0], 0.4)]
    ends = [[(int(links.view[k]), *links.xy[k].tolist()) for k in pair] for pair in links.ends]
    assert ends == [
        [(0, 1.0, 2.0), (1, 1.0, 2.0)],
        [(0, 1.0, 2.0), (1, 3.0, 4.0)],
        [(0, 1.0, 2.5), (1, 1.0, 2.0)],
    ]


def test_the_matches_of_several_files_are_joined_by_their_places() -> None:
    one = Links.of_pairs([(0, 1, np.array([[1.0, 1.0], [2.0, 2.0]]), np.array([[5.0, 5.0], [6.0, 6.0]]))])
    two = Links.of_pairs([(1, 2, np.array([[6.0, 6.0]]), np.array([[8.0, 8.0]]))])
    whole = Links.joined([one, two])
    assert len(whole.view) == 5
    tracks = tracks_of(whole, "a")
    assert np.bincount(tracks.point).tolist() == [2, 3]
    assert Links.joined([one]) is one
    none = Links.of_pairs([])
    assert (none.view.shape, none.xy.shape, none.ends.shape) == ((0,), (0, 2), (0, 2))


@pytest.mark.parametrize("count", [2, 3, 16, 17, 40])
def test_an_observation_is_linked_to_the_next_sixteen_of_its_track(count) -> None:
    rng = np.random.default_rng(0)
    order = rng.permutation(2 * count)
    view, track = np.tile(np.arange(count), 2)[order], np.repeat([3, 9], count)[order]
    links = Links.of_tracks(view, track, rng.normal(size=(2 * count, 2)), np.ones(2 * count))
    assert (track[links.ends[:, 0]] == track[links.ends[:, 1]]).all()
    apart = view[links.ends[:, 1]] - view[links.ends[:, 0]]
    assert np.bincount(apart).tolist() == [0, *(2 * (count - k) for k in range(1, min(16, count - 1) + 1))]
    assert len(np.unique(links.tracks())) == 2


def test_a_track_that_is_seen_once_or_twice_in_one_view_is_left_out() -> None:
    view = np.array([0, 1, 0, 1, 1, 2, 0, 1])
    track = np.array([0, 0, 1, 1, 1, 2, 3, 3])
    links = Links.of_tracks(view, track, np.arange(16.0).reshape(8, 2), np.arange(1.0, 9.0))
    found = tracks_of(links, "m")
    assert found.point.tolist() == [0, 0, 1, 1]
    assert found.view.tolist() == [0, 1, 0, 1]
    assert found.sigma.tolist() == [1, 2, 7, 8]
    with pytest.raises(InputError, match=r"^m: no track is seen in two"):
        tracks_of(Links.of_tracks(view[2:6], track[2:6], np.zeros((4, 2)), np.ones(4)), "m")


@pytest.mark.parametrize(
    ("matches", "counts", "found"),
    [
        (np.array([[0, 1], [2, 0]]), (3, 2), [[0, 1], [2, 0]]),
        (np.array([1, -1, 0]), (3, 2), [[0, 1], [2, 0]]),
        (np.array([-1, -1]), (2, 5), []),
        (np.zeros((0, 2), int), (3, 2), []),
        (np.array([[3, 0]]), (3, 2), None),
        (np.array([[0, 2]]), (3, 2), None),
        (np.array([[0, -1]]), (3, 2), None),
        (np.array([1, 0]), (3, 2), None),
        (np.array([[1, 0, 2]]), (3, 2), None),
        (np.array([[1.0, 0.0]]), (3, 2), None),
    ],
)
def test_matches_are_numbers_of_keypoints_that_there_are(matches, counts, found) -> None:
    if found is None:
        with pytest.raises(ValueError, match="match"):
            index_pairs(matches, counts)
    else:
        assert index_pairs(matches, counts).tolist() == found


@pytest.mark.parametrize(
    ("name", "pair"),
    [
        ("a__b.txt", (0, 1)), ("b__a.txt", (1, 0)), ("a__b-clean.match", (0, 1)), ("run-a__b.txt", (0, 1)),
        ("a_b_matches.npz", (0, 1)), ("a_b.npz", (0, 1)), ("x__y_z.txt", None), ("a__a.txt", None),
        ("a__x__y_z.txt", (0, 2)), ("q__b.txt", None), ("ab.txt", None), ("r-s-a__b.txt", (0, 1)),
    ],
)  # fmt: skip
def test_a_file_is_named_after_its_two_images(name, pair) -> None:
    views = ViewNames(["a", "b", "x__y_z"], "m")
    assert pair_of(Path(name), views) == pair


def test_of_two_files_of_a_pair_the_clean_one_is_taken(tmp_path) -> None:
    for name in ("a__b.match", "a__b-clean.match", "a__b.txt", "b_c.npz", "note.txt", "a__c.csv"):
        (tmp_path / name).touch()
    assert [path.name for path in pair_files(tmp_path)] == ["a__b-clean.match", "a__b.txt", "b_c.npz"]


def test_what_is_written_for_asp_reads_back(tmp_path) -> None:
    rng = np.random.default_rng(0)
    first, second = rng.uniform(0, 1e4, (2, 5, 2))
    text = asp_text(first, second)
    assert text.splitlines()[0] == "5 5"
    assert text.splitlines()[1].split()[2:] == [*(str(round(v)) for v in first[0]), *"0110000"]
    (tmp_path / "a__b.txt").write_text(text)
    links = read_links(tmp_path / "a__b.txt", ["a", "b"])
    np.testing.assert_array_equal(links.xy[links.ends[:, 0]], first)
    np.testing.assert_array_equal(links.xy[links.ends[:, 1]], second)
    for wrong in ("5 4\n", "6 6\n", "4 4\n"):
        (tmp_path / "a__b.txt").write_text(text.replace("5 5\n", wrong))
        with pytest.raises(InputError, match="keypoints but holds 10"):
            read_links(tmp_path / "a__b.txt", ["a", "b"])

"""When images were taken and where the sun stood, against tables and programs of others."""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from barpc.base.errors import InputError, UsageError
from barpc.export.light import dated, lit, moment, sun_angles
from barpc.rpcio.acquisition import read_acquisition
from tests.export.conftest import ended

PUBLISHED = [
    # Reda and Andreas 2004 (NREL/TP-560-34302), table A5.1: elevation without refraction, azimuth
    (datetime(2003, 10, 17, 19, 30, 30, tzinfo=UTC), -105.1786, 39.742476, 39.872046, 194.340241),
]


def apart(one: tuple[float, float], other: tuple[float, float]) -> float:
    """Angle [deg] between two directions, given as elevation and azimuth."""
    ways = []
    for elevation, azimuth in np.radians([one, other]):
        ways.append([np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation)])
    return float(np.degrees(np.linalg.norm(np.cross(*ways))))


@pytest.mark.parametrize(("time", "lon", "lat", "elevation", "azimuth"), PUBLISHED)
def test_the_sun_stands_where_a_published_example_has_it(time, lon, lat, elevation, azimuth):
    assert apart(sun_angles(time, lon, lat), (elevation, azimuth)) < 0.01


@pytest.mark.parametrize(
    ("name", "lon", "lat"),
    [
        ("rpc_formats/rpc_WV2.xml", -0.3247, 45.6544),
        ("rpc_formats/WV02_10300100D0772D00.r100.xml", -156.618, 71.343),
        ("physical_maxar/10200100A1865800.r100.xml", 50.205, -76.5),
        ("physical_maxar/1040010074793300.xml", -156.625, 71.3317),
    ],
)
def test_the_sun_stands_where_the_maker_of_a_real_image_states_it(shared_data, name, lon, lat):
    """To 0.1 degrees, as stated, once the horizon is that of the geocentric latitude, 0.2 degrees off the true one."""
    stated = read_acquisition(str(shared_data / name), str(shared_data / name))
    geocentric = np.degrees(np.arctan(0.99330562 * np.tan(np.radians(lat))))
    found = sun_angles(moment(stated.time), lon, geocentric)
    assert found == pytest.approx((stated.elevation, stated.azimuth), abs=0.1)


@pytest.mark.slow
def test_the_sun_stands_where_the_algorithm_of_nrel_has_it():
    pvlib, pandas = pytest.importorskip("pvlib"), pytest.importorskip("pandas")
    rng = np.random.default_rng(3)
    for _ in range(300):
        time = datetime(1990, 1, 1, tzinfo=UTC) + timedelta(days=rng.uniform(0, 60 * 365.25))
        lon, lat = rng.uniform(-180, 180), np.degrees(np.arcsin(rng.uniform(-1, 1)))
        truth = pvlib.solarposition.spa_python(pandas.DatetimeIndex([time]), lat, lon)
        found = sun_angles(time, lon, lat)
        assert apart(found, (float(truth.elevation.iloc[0]), float(truth.azimuth.iloc[0]))) < 0.01


def test_the_user_s_time_is_of_images_that_state_none_and_of_those_he_names(south):
    def times(*given, dates=()):
        return [shot.light.time for shot in dated(south, given, dates).shots]

    own, names = "2013-04-17T10:32:15.5Z", [shot.name for shot in south.shots]
    assert times() == [own, None, None]
    assert times("2014-01-01T09:00:00", dates=["2015-01-01"]) == [own, *["2014-01-01T09:00:00Z"] * 2]
    assert times(dates=["2015-01-01"]) == [own, *["2015-01-01"] * 2]
    assert times(f"{names[0]}=2014-01-01T09:00:00+02:00", dates=[f"{names[2]}=2015-01-01"]) == [
        "2014-01-01T07:00:00Z",
        None,
        "2015-01-01",
    ]


@pytest.mark.parametrize(
    ("times", "dates", "said"),
    [
        (["10:36"], [], "--time 10:36: is no UTC time as 2013-04-17T10:36:44"),
        (["2013-04-17"], [], "--time 2013-04-17: is no UTC time"),
        ([], ["2013-04-17T10:36:44"], "--date 2013-04-17T10:36:44: is no day as 2013-04-17"),
        ([], ["1913-04-17"], "is no day"),
        ([], ["2013-02-30"], "is no day"),
        ([], ["B=2013-02-03"], "--date B=2013-02-03: no image B; there are view_0000, "),
    ],
)
def test_a_time_that_is_none_is_refused(south, times, dates, said):
    with pytest.raises(UsageError, match=re.escape(said)):
        dated(south, times, dates)


def test_where_nothing_tells_the_time_nothing_is_written_and_the_exit_code_is_3(southern, tmp_path, capsys):
    for target, flag in (("satnerf", "--time"), ("stac", "--date")):
        assert ended(southern, tmp_path / "out", "--to", target) == 3
        said = capsys.readouterr()
        assert said.out == ""
        assert re.fullmatch(
            rf"barpc: needs review \(exit code 3\): nothing is written: view_0001, view_0002: .*give {flag} .*\n",
            said.err,
        )
        assert not (tmp_path / "out").exists()


def test_a_time_at_night_is_refused(south):
    with pytest.raises(InputError, match=r"view_0001: .*T03:00:00Z, \d\d degrees of sun below the horizon"):
        lit(dated(south, ["2013-04-17T03:00:00"], []))


@pytest.mark.parametrize(
    ("tags", "expected"),
    [
        ({"NITF_IDATIM": "20130417103602"}, (None, None, "2013-04-17T10:36:02Z")),
        ({"NITF_STDIDC_ACQUISITION_DATE": "20141005160138", "NITF_USE00A_SUN_EL": "+50.8",
          "NITF_USE00A_SUN_AZ": "150.3"}, (50.8, 150.3, "2014-10-05T16:01:38Z")),
        ({"ACQUISITIONDATETIME": "2013-04-17 10:36:02"}, (None, None, "2013-04-17T10:36:02Z")),
        ({"ACQUISITIONDATETIME": "2013-04-17 25:36:02"}, (None, None, "2013-04-17")),
        ({"TIFFTAG_DATETIME": "2013:04:17 10:36:02"}, (None, None, None)),
        ({"NAME": "DS_PHR1A_201304171036448_FR1_PX_E005N43_0707_01658"}, (None, None, "2013-04-17T10:36:44Z")),
    ],
)  # fmt: skip
def test_tags_state_the_time_and_the_sun(tags, expected):
    light = read_acquisition("a.tif", None, tags)
    assert (light.elevation, light.azimuth, light.time) == expected


def test_a_keyword_list_states_the_time(shared_data):
    camera = shared_data / "optical/phr_ventoux/left_image.geom"
    assert read_acquisition(camera.with_suffix(".tif"), camera).time == "2013-08-05T10:42:19.4Z"

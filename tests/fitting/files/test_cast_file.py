"""Casts from files of several makes, and files that are damaged or leave something open."""

import numpy as np
import pytest
import xarray as xr

from fitting import fit_profile
from fitting.files.cast_file import Reading, profile_of, raw_casts, read_cast, read_casts
from fitting.files.cast_netcdf import casts_of
from fitting.files.irradiance_units import irradiance_factor, irradiance_units_in
from fitting.files.seabass import read_seabass, seabass_text
from fitting.observations.profile import Profile
from tests.fitting.synthetic_casts import ED_BELOW, LU_BELOW, write_turbid_cast
from tests.paths import REFERENCE

DEPTH = np.linspace(0.5, 30.0, 60)
KD = {412: 0.12, 490: 0.06}


def ed(depth=DEPTH, wavelength=490):
    return 1.2 * np.exp(-KD[wavelength] * depth)


@pytest.mark.parametrize(
    ("text", "factor"),
    [
        ("W m-2 nm-1", 1.0),
        ("W/m^2/nm", 1.0),
        ("W m^-2 nm^-1", 1.0),
        ("uW/cm^2/nm", 0.01),
        ("µW cm-2 nm-1", 0.01),
        ("microW/(sq_cm*nm)", 0.01),
        ("mW/cm^2/um", 0.01),
        ("uW/cm^2/nm/sr", 0.01),
        ("W m-2 um-1", 0.001),
        ("W m-2", None),
        ("umol m-2 s-1", None),
        ("counts", None),
    ],
)
def test_units_in_many_spellings(text, factor):
    assert irradiance_factor(text) == (None if factor is None else pytest.approx(factor))


def test_units_in_a_comment():
    text = "downcast; Ed uW cm-2 nm-1, PAR umol photons m-2 s-1, depth in m"
    assert irradiance_units_in(text) == ["uW cm-2 nm-1"]


def seabass(folder, missing=(), units="m,uW/cm^2/nm,uW/cm^2/nm,degrees"):
    rows = np.stack([DEPTH, 100 * ed(wavelength=412), 100 * ed(), np.full(60, 3.0)], axis=1)
    rows[list(missing), 1] = np.nan
    path = folder / "cast.sb"
    header = {"station": "A1", "north_latitude": "40.5[DEG]", "south_latitude": "40.5[DEG]"}
    fields = ["depth", "Ed412", "Ed490", "tilt"]
    path.write_text(seabass_text(fields, units.split(","), rows, header))
    return path


def test_seabass_units_and_missing_values_are_honoured(tmp_path):
    cast = read_cast(seabass(tmp_path, missing=(3, 4)))
    np.testing.assert_allclose(cast.Ed[:, 1], ed(), rtol=1e-7)
    assert np.isnan(cast.Ed[3, 0])
    assert cast.counts["missing"] == 2
    fit = fit_profile(cast)
    np.testing.assert_allclose(fit.quantities["Kd"].value, list(KD.values()), rtol=1e-4)
    assert fit.metadata["left_out"]["missing"] == 2
    assert fit.metadata["largest_tilt_degrees"] == 3.0
    with pytest.raises(ValueError, match=r"ed412 is in 'volts'"):
        read_cast(seabass(tmp_path, units="m,volts,volts,degrees"))


def test_seabass_codes_beyond_detection(tmp_path):
    path = seabass(tmp_path)
    text = path.read_text().replace(
        "/missing=-9999", "/missing=-9999\n/below_detection_limit=-8888"
    )
    lines = text.splitlines()
    lines[-1] = f"{DEPTH[-1]},-8888,{100 * ed()[-1]},3"
    path.write_text("\n".join(lines))
    assert read_cast(path).counts == {"below detection limit": 1}


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (("/end_header", ""), "header never ends"),
        (("/units=m,", "/units="), "unit of column 'depth' is not stated"),
        (("/delimiter=comma", ""), "lacks /delimiter="),
        (("/delimiter=comma", "/delimiter=semicolon"), "comma, space or tab"),
        (("depth,Ed412", "deep,Ed412"), "column 'depth' is missing"),
        ((",3\n", "\n"), "values for 4 fields"),
    ],
)
def test_bad_seabass_gets_a_sentence(tmp_path, change, sentence):
    path = seabass(tmp_path)
    path.write_text(path.read_text().replace(*change))
    with pytest.raises(ValueError, match=sentence) as caught:
        read_cast(path)
    assert "cast.sb" in str(caught.value)


def test_a_flow_through_file_is_no_profile(tmp_path):
    """Spaces between values, dates and times as text, comments in the header, missing values."""
    path = tmp_path / "underway.sb"
    path.write_text(
        "/begin_header\n/investigators=A_Person,Another_Person\n/!/affiliations=Some_Lab\n"
        "/data_type=flow_thru\n/north_latitude=6.036[DEG]\n/south_latitude=6.016[DEG]\n"
        "/start_time=01:08:00[GMT]\n/water_depth=NA\n/measurement_depth=1.5\n/missing=-9999\n"
        '/! "_sd" columns contain standard deviations\n/delimiter=space\n'
        "/fields=date,time,lat,lon,Wt,sal,ap436.4,ap440.7,ap440.7_sd\n"
        "/units=yyyymmdd,hh:mm:ss,degrees,degrees,degreesC,PSU,1/m,1/m,1/m\n/end_header\n"
        "20200102 01:08:00 6.0356 -91.5757 25.8794 33.0004 0.0227 0.0235 0.0003\n"
        "20200102 01:09:00 6.0353 -91.5734 25.8803 32.9980 0.0230 -9999 0.0004\n"
        "20200102 01:10:00 6.0350 -91.5710 25.8875 32.9956 -0.0001 0.0236 0.0003\n"
    )
    file = read_seabass(path)
    assert file.degrees("north_latitude") == pytest.approx(6.036)
    assert file.degrees("north_latitude", "south_latitude") == pytest.approx(6.026)
    np.testing.assert_array_equal(file.columns["ap440.7"], [0.0235, np.nan, 0.0236])
    np.testing.assert_array_equal(file.columns["ap436.4"], [0.0227, 0.0230, -0.0001])
    np.testing.assert_array_equal(file.columns["wt"], [25.8794, 25.8803, 25.8875])
    assert file.units["ap440.7"] == "1/m"
    with pytest.raises(ValueError, match="this is not a profile"):
        read_cast(path)


JULD = "days since 1950-01-01 00:00:00 UTC"


def argo(folder, engine="h5netcdf", casts=2, **changes):
    pressure = np.tile(DEPTH * 1.01, (casts, 1))
    adjusted = np.full(pressure.shape, np.nan)
    adjusted[0] = ed(wavelength=412)
    flags = np.full(pressure.shape, b"1")
    flags[0, 5], flags[0, 6] = b"4", b"9"
    dims = ("N_PROF", "N_LEVELS")
    unit = {"units": "W/m^2/nm"} | changes
    data = xr.Dataset(
        {
            "PRES": (dims, pressure, {"units": "decibar"}),
            "LATITUDE": ("N_PROF", np.full(casts, 35.0)),
            "LONGITUDE": ("N_PROF", np.full(casts, 20.5)),
            "JULD": ("N_PROF", np.arange(casts) + 25567.25, {"units": JULD}),
            "PLATFORM_NUMBER": ("N_PROF", np.full(casts, b"6903247 ")),
            "CYCLE_NUMBER": ("N_PROF", np.arange(casts, dtype=np.int32) + 112),
            "DOWN_IRRADIANCE412": (dims, 2 * np.tile(ed(wavelength=412), (casts, 1)), unit),
            "DOWN_IRRADIANCE412_QC": (dims, np.full(pressure.shape, b"3")),
            "DOWN_IRRADIANCE412_ADJUSTED": (dims, adjusted, unit),
            "DOWN_IRRADIANCE412_ADJUSTED_QC": (dims, flags),
            "DOWNWELLING_PAR": (dims, pressure, {"units": "microMoleQuanta/m^2/sec"}),
        }
    )
    path = folder / "BD6903247_001.nc"
    data.to_netcdf(path, engine=engine)
    return path


@pytest.mark.parametrize("engine", ["h5netcdf", "scipy"])
def test_argo_prefers_adjusted_values_and_obeys_their_flags(tmp_path, engine):
    cast = read_cast(argo(tmp_path, engine, casts=1))
    assert cast.counts["bad quality flag"] == 2
    keep = np.isfinite(cast.Ed[:, 0])
    assert keep.sum() == 58
    np.testing.assert_allclose(cast.Ed[keep, 0], ed(wavelength=412)[keep], rtol=1e-6)
    # 1.01 dbar per metre at the surface, less below: TEOS-10 within a centimetre.
    np.testing.assert_allclose(cast.depth, DEPTH * 1.0034, rtol=2e-3)
    # All flags of the second profile are bad where nothing is adjusted.
    with pytest.raises(ValueError, match=r"BD6903247_001\.nc:1: the band at 412 nm keeps 0 of 60"):
        read_casts(argo(tmp_path, engine))


def test_netcdf_without_a_unit_or_cut_short_is_refused(tmp_path):
    with pytest.raises(ValueError, match="unit of DOWN_IRRADIANCE412 is not stated"):
        read_cast(argo(tmp_path, casts=1, units=""))
    path = argo(tmp_path, casts=1)
    path.write_bytes(path.read_bytes()[:4000])
    with pytest.raises(ValueError, match="half-written or damaged"):
        read_cast(path)


def test_a_plain_dataset_with_a_column_map(tmp_path):
    path = tmp_path / "cast.nc"
    xr.Dataset(
        {"irradiance": (("wavelength", "z"), [ed(wavelength=412), ed()], {"units": "W m-2 nm-1"})},
        {"wavelength": [412.0, 490.0], "z": ("z", DEPTH, {"units": "m"})},
    ).to_netcdf(path, engine="h5netcdf")
    cast = read_cast(path, Reading(columns={"Ed": "irradiance", "depth": "z"}))
    np.testing.assert_allclose(cast.Ed[:, 1], ed())
    with pytest.raises(ValueError, match=r"neither BGC-Argo .* nor a variable Ed"):
        read_cast(path)


def csv(folder, header, names, columns):
    path = folder / "cast.csv"
    rows = [",".join(f"{v:.9g}" for v in row) for row in np.stack(columns, axis=1)]
    path.write_text("\n".join([header, ",".join(names), *rows]) + "\n")
    return path


def test_csv_styles(tmp_path):
    quiet = np.full(60, 2.0)
    quiet[7] = 30.0
    names = ["depth_m", "EdZ_tilt_deg", "Ed0_490", "EdZ_490", "LuZ_490"]
    columns = [DEPTH, quiet, np.full(60, 130.0), 100 * ed(), ed()]
    path = csv(tmp_path, "# a cast; irradiance in uW cm-2 nm-1", names, columns)
    cast = read_cast(path, Reading(tilt_limit=10.0, depth_offset=0.25))
    assert cast.counts == {"tilt above 10 degrees": 1}
    assert cast.depth[0] == 0.75
    keep = np.delete(np.arange(60), 7)
    np.testing.assert_allclose(cast.Ed[:, 0], ed()[keep], rtol=1e-7)
    assert cast.Lu is not None
    np.testing.assert_allclose(cast.Lu[:, 0], 0.01 * ed()[keep], rtol=1e-7)
    path = csv(tmp_path, "#", ["depth (m)", "Ed490 (uW/cm2/nm)"], [DEPTH, 100 * ed()])
    np.testing.assert_allclose(read_cast(path).Ed[:, 0], ed(), rtol=1e-7)
    path = csv(tmp_path, "#", ["z", "irr"], [DEPTH, ed()])
    reading = Reading(
        columns={"depth": "z", "Ed_490": "irr"}, units={"depth": "m", "Ed": "W/m2/nm"}
    )
    np.testing.assert_allclose(read_cast(path, reading).Ed[:, 0], ed(), rtol=1e-7)


def test_little_light_is_not_taken_for_darkness():
    # The last tenth of a cast down to e^-21 still falls: nothing is subtracted there.
    depth = np.linspace(0.5, 52.5, 100)
    clean = np.exp(-0.4 * depth)[:, None]
    noise = 1 + 0.05 * np.random.default_rng(1).standard_normal(clean.shape)
    cast = Profile(depth, [412.0], clean * noise, sigma=0.05 * clean)
    assert cast.dark_sd[0] == 0.0
    offset = Profile(depth, [412.0], clean + 1e-4 * (1 + 0.01 * (noise - 1)))
    assert offset.dark[0] == pytest.approx(1e-4, rel=1e-2)


def test_contradictory_or_absent_units_are_refused(tmp_path):
    names, columns = ["depth_m", "Ed_490"], [DEPTH, ed()]
    for comment in ("# Ed W m-2 nm-1, later uW cm-2 nm-1", "# a cast"):
        with pytest.raises(ValueError, match="unit of column 'Ed_490' is not stated"):
            read_cast(csv(tmp_path, comment, names, columns))
    with pytest.raises(ValueError, match="unit of column 'depth' is not stated"):
        read_cast(csv(tmp_path, "# W m-2 nm-1", ["depth", "Ed_490"], columns))


def test_a_sheet_of_casts(tmp_path):
    names, twice = ["cast", "depth_m", "Ed_490"], np.tile(DEPTH, 2)
    columns = [np.repeat([1, 2], 60), twice, np.concatenate([ed(), 2 * ed()])]
    path = csv(tmp_path, "# Ed in W/m2/nm", names, columns)
    casts = read_casts(path)
    assert [cast.source.split(":")[-1] for cast in casts] == ["1", "2"]
    np.testing.assert_allclose(casts[1].Ed, 2 * casts[0].Ed, rtol=1e-8)
    with pytest.raises(ValueError, match="holds 2 casts"):
        read_cast(path)


def test_up_and_downcast_mixed_and_a_million_rows(tmp_path):
    there_and_back = np.concatenate([DEPTH, DEPTH[::-1]])
    cast = Profile(there_and_back, [490.0], ed(there_and_back)[:, None])
    np.testing.assert_allclose(fit_profile(cast).quantities["Kd"].value, 0.06, rtol=1e-4)
    deep = np.linspace(0.0, 60.0, 1_000_000)
    noise = 1 + 0.3 * np.random.default_rng(0).standard_normal(deep.shape)
    cast = Profile(deep, [490.0], (ed(deep) * noise)[:, None])
    assert len(cast.depth) <= 2048
    assert cast.counts["samples in medians over depth"] == 1_000_000 - 2048
    # Medians of 489: 1.8 % each, a few hundred of them.
    np.testing.assert_allclose(fit_profile(cast).quantities["Kd"].value, 0.06, rtol=0.01)


def test_a_turbid_cast_with_shadows_on_its_reference(tmp_path):
    truth = write_turbid_cast(tmp_path)
    assert 0.4 < truth.nonpositive.max() < 0.5
    with pytest.raises(ValueError, match=r"unit of column .* is not stated"):
        read_cast(truth.path)
    units = {"Ed": "uW cm-2 nm-1", "Lu": "uW cm-2 nm-1 sr-1"}
    reading = Reading(units=units, depth_offset=ED_BELOW, upward_offset=LU_BELOW, tilt_limit=20.0)
    cast = read_cast(truth.path, reading)
    np.testing.assert_array_equal(cast.wavelength, truth.wavelength)
    assert cast.counts == {"tilt above 20 degrees": int(np.sum(truth.tilt > 20))}
    assert cast.upward_below == pytest.approx(LU_BELOW - ED_BELOW)
    # Negative noise about darkness stays: it is data.
    assert np.mean(cast.Ed[cast.mask] < 0) > 0.2
    # The arm of the shadow band takes five sixths of the light from the reference and nothing from
    # the water: what is left of the light above is its true rise of 4 %.
    assert cast.reference is not None
    np.testing.assert_allclose(np.ptp(cast.reference, axis=0), 0.04, atol=0.005)
    fit = fit_profile(cast, depth_range=(1.0, 8.0))
    error = fit.quantities["Kd"].value / truth.Kd - 1
    # Measured: 0.43 % where light reaches 8 m above the noise, 0.82 % where it ends before.
    lit = (truth.wavelength >= 412) & (truth.wavelength <= 710)
    assert np.max(np.abs(error[lit])) < 0.005
    assert np.max(np.abs(error)) < 0.009
    pull = error * truth.Kd / fit.quantities["Kd"].sd
    assert np.max(np.abs(pull[lit])) < 4.2


def test_ten_casts_of_a_float_by_the_simplest_model_that_suffices():
    casts = read_casts(REFERENCE / "argo_6903247_casts.csv")
    assert len(casts) == 10
    for cast in casts:
        fit = fit_profile(cast, layers=None)
        assert 0.030 < fit.quantities["Kd"].value[2] < 0.070
        assert min(fit.metadata["runs_test_p"]) > 0.01
        assert len(fit.metadata["interfaces_m"]) <= 3
        assert fit.dof is not None
        assert np.min(fit.dof) > 3


def test_absorption_and_attenuation_beside_the_light(tmp_path):
    path = tmp_path / "cast.sb"
    rows = "\n".join(f"{z:.3f},{e:.6g},0.1,0.4" for z, e in zip(DEPTH, ed(), strict=True))
    head = (
        "/begin_header\n/missing=-9999\n/delimiter=comma\n/fields=depth,Ed490,agp440,cgp555\n"
        "/units=m,W/m^2/nm,{},1/m\n/end_header\n"
    )
    path.write_text(head.format("1/m") + rows + "\n")
    profile = read_cast(path)
    assert profile.beam_wavelength.tolist() == [440.0, 555.0]
    np.testing.assert_allclose(profile.a[:, 0], 0.1)
    np.testing.assert_allclose(profile.c[:, 1], 0.4)
    assert np.all(np.isnan(profile.a[:, 1]))
    path.write_text(head.format("none") + rows + "\n")
    with pytest.raises(ValueError, match="unit of agp440 is 'none'; it must be 1/m"):
        read_cast(path)
    with pytest.raises(ValueError, match="need beam_wavelength"):
        Profile(DEPTH, [490.0], ed()[:, None], a=ed()[:, None])
    with pytest.raises(ValueError, match=r"a must have shape \(depth, beam\) = \(60, 2\)"):
        Profile(DEPTH, [490.0], ed()[:, None], beam_wavelength=[440, 555], a=ed()[:, None])


@pytest.mark.parametrize("engine", ["h5netcdf", "scipy"])
def test_place_time_and_float_are_kept(tmp_path, engine):
    path = argo(tmp_path, engine)
    known = {"latitude": 35.0, "longitude": 20.5, "platform": "6903247"}
    for number, raw in enumerate(raw_casts(path)):
        time = f"2020-01-0{1 + number}T06:00:00Z"
        assert raw.station == {**known, "time": time, "cycle": 112 + number}
    assert profile_of(raw_casts(path)[0]).station == raw_casts(path)[0].station
    with xr.open_dataset(path, engine=engine) as data:  # times decoded
        assert casts_of(data, "memory")[1].station["time"] == "2020-01-02T06:00:00Z"
        bare = data.drop_vars(["JULD", "PLATFORM_NUMBER", "CYCLE_NUMBER"])
        bare["LONGITUDE"] = bare.LONGITUDE * np.nan
        assert casts_of(bare, "memory")[0].station == {"latitude": 35.0}


def test_seabass_headers_say_where_and_when(tmp_path):
    path = seabass(tmp_path)
    assert read_cast(path).station == {"latitude": 40.5}
    more = "/west_longitude=-70.5[DEG]\n/east_longitude=-70.7[DEG]\n/start_date=20200131\n"
    text = path.read_text()
    for clock, time in (("", ""), ("/start_time=09:08:07[GMT]\n", "T09:08:07Z")):
        path.write_text(text.replace("/begin_header\n", f"/begin_header\n{more}{clock}"))
        station = read_cast(path).station
        assert station.pop("longitude") == pytest.approx(-70.6)
        assert station == {"latitude": 40.5, "time": f"2020-01-31{time}"}

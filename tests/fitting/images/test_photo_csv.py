import numpy as np
import pytest

from fitting.files.csv_sheet import read_sheet
from fitting.images.photo_csv import read_photo, read_profile
from tests.paths import SCENES

HEADER = "# units: depth=m, Ed_*=W m-2 nm-1\n"


def write(folder, text, name="cast.csv"):
    path = folder / name
    path.write_text(text)
    return path


def rows(count=8, bands=2):
    return "".join(
        f"{z},{','.join(str(np.exp(-0.1 * z)) for _ in range(bands))}\n" for z in range(count)
    )


def test_the_shipped_cast_reads():
    profile = read_profile(SCENES / "argo_6903247.csv")
    assert profile.wavelength.tolist() == [380.0, 412.0, 490.0]
    assert profile.masked == 0
    assert profile.depth[0] == pytest.approx(0.02)
    assert profile.Ed[0].tolist() == [0.155716, 0.27644, 0.307863]


def test_the_shipped_chart_readings_read():
    photo, clipped = read_photo(SCENES / "red_sea_charts.csv", 5.0)
    assert [chart.name for chart in photo.charts] == ["A", "B", "C", "D"]
    assert [chart.distance for chart in photo.charts] == [4.65, 6.19, 7.40, 9.78]
    assert clipped == 5
    assert photo.azimuth == 180.0
    assert sum(len(chart.values) for chart in photo.charts) == 19
    assert photo.backgrounds[0].values.shape == (4, 3)


def test_units_are_told_apart_by_the_header_and_never_guessed(tmp_path):
    body = "depth,Ed_412,Ed_490\n" + rows()
    watts = read_profile(write(tmp_path, HEADER + body))
    micro = read_profile(write(tmp_path, HEADER.replace("W m-2", "uW cm-2") + body))
    np.testing.assert_allclose(micro.Ed, 0.01 * watts.Ed, rtol=1e-15)
    with pytest.raises(ValueError, match=r"unit of column 'Ed_412' is not stated"):
        read_profile(write(tmp_path, "# units: depth=m\n" + body))
    with pytest.raises(ValueError, match=r"Ed_412 is in 'W m-2'; known are"):
        read_profile(write(tmp_path, "# units: depth=m, Ed_*=W m-2\n" + body))
    with pytest.raises(ValueError, match=r"depth must be in m, not 'dbar'"):
        read_profile(write(tmp_path, "# units: depth=dbar, Ed_*=W m-2 nm-1\n" + body))


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (HEADER + "depht,Ed_412\n" + rows(bands=1), r"column 'depth' is missing.*Near it: depht"),
        (HEADER + "depth,L_412\n" + rows(bands=1), r"no irradiance column; name them Ed_<nm>"),
        (HEADER + "depth,Ed_490,Ed_412\n" + rows(), r"strictly increasing.*412 nm follows 490"),
        (HEADER + "depth,Ed_412,Ed_412\n" + rows(), r"strictly increasing.*412 nm follows 412"),
        (HEADER + "depth,Ed_412\n" + rows(3, 1), r"keeps 3 of 3 depths.*at least 5"),
        (HEADER + "depth,Ed_412\n0,1,2\n", r"data row 1 has 3 values for 2 columns"),
        (HEADER + "depth,Ed_412\n0,bright\n", r"data row 1: 'bright' is not a number"),
        (HEADER + "depth,Ed_412\n", r"holds no data"),
        ("", r"holds no data"),
        (HEADER + "depth,Ed_412\n0,\x001\n", r"NUL bytes"),
        (HEADER + "# solar_zenith: noon\ndepth,Ed_412\n" + rows(bands=1), r"'noon', not a number"),
    ],
)
def test_bad_casts_get_a_sentence_that_names_the_file(tmp_path, text, sentence):
    with pytest.raises(ValueError, match=sentence) as caught:
        read_profile(write(tmp_path, text))
    assert "cast.csv" in str(caught.value)


def test_missing_and_non_positive_values_are_masked_and_counted(tmp_path):
    body = "depth,Ed_412\n" + rows(8, 1) + "8,\n9,-0.1\n10,0\n-0.2,1.1\n"
    profile = read_profile(write(tmp_path, HEADER + body))
    assert profile.masked == 4
    assert int(profile.mask.sum()) == 8


def test_a_binary_file_is_refused(tmp_path):
    path = tmp_path / "cast.csv"
    path.write_bytes(b"\xff\xfe\xfa")
    with pytest.raises(ValueError, match="is not text"):
        read_sheet(path)


PHOTO = (
    "# units: range=m\n# camera: Nikon D850\n"
    "kind,chart,reflectance,range,zenith,R,G,B,R_sd,G_sd,B_sd,clipped\n"
    "chart,A,0.5,2,90,0.2,0.4,0.5,0.01,0.01,0.01,0\n"
    "chart,A,0.1,2,90,0.1,0.2,0.3,0.01,0.01,0.01,0\n"
    "background,,,,90,0.05,0.2,0.4,0.01,0.01,0.01,0\n"
)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (("Nikon D850", "Nikon D85"), r"'Nikon D85' is unknown. Near it:.*Nikon D850"),
        (("background,,", "water,,"), r"data row 3: kind is 'water'"),
        (("range=m", "range=ft"), r"range must be in m, not 'ft'"),
        (("reflectance,range", "albedo,range"), r"column 'reflectance' is missing"),
        (("chart,A,0.5,2", "chart,A,0.5,-2"), r"distance of chart 'A' must be positive"),
        (("chart,A,0.5,2,90", "chart,A,7,2,90"), r"reflectance of chart 'A' must lie between"),
        (("# camera", "# flash: fired\n# camera"), r"charts.csv: a flash fired"),
        (("# camera", "# relative_exposure: long\n# camera"), r"'relative_exposure' is 'long'"),
    ],
)
def test_bad_chart_readings_get_a_sentence(tmp_path, change, sentence):
    path = write(tmp_path, PHOTO.replace(*change), "charts.csv")
    if "distance" in sentence:
        path.write_text(PHOTO.replace(",2,90", ",-2,90"))
    with pytest.raises(ValueError, match=sentence):
        read_photo(path, 5.0)


def test_field_noise_adds_to_the_stated_noise(tmp_path):
    path = write(tmp_path, PHOTO, "charts.csv")
    photo, clipped = read_photo(path, 5.0, field_noise=0.1)
    assert clipped == 0
    np.testing.assert_allclose(photo.charts[0].sigma[0], np.hypot(0.01, [0.02, 0.04, 0.05]))


def test_the_exposure_of_a_file_is_passed_on(tmp_path):
    assert read_photo(write(tmp_path, PHOTO), 5.0)[0].exposure is None
    text = PHOTO.replace("# camera", "# flash: not fired\n# relative_exposure: 1e-4\n# camera")
    assert read_photo(write(tmp_path, text), 5.0)[0].exposure == 1e-4

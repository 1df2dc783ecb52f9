"""Casts of one station merged, and spectra as csv and SeaBASS."""

import numpy as np
import pytest

from fitting import Profile, fit_profile
from fitting.commands import main as cli
from fitting.files.csv_sheet import read_sheet
from fitting.files.seabass import read_seabass
from fitting.profile.merge_casts import merged
from fitting.report.spectra_table import write_spectra

BANDS, KD = np.array([443.0, 490.0, 555.0]), np.array([0.2, 0.1, 0.15])
SUN = np.array([1.0, 1.2, 1.1])


def cast(seed, sun=1.0, surface=False, noise=0.03, offset=0.0):
    rng = np.random.default_rng(seed)
    depth = np.sort(rng.uniform(0.3, 15.0, 40))
    seen = sun * SUN * np.exp(-KD * depth[:, None])
    seen = seen * (1 + noise * rng.standard_normal(seen.shape)) + offset
    above = np.tile(sun * SUN / 0.96, (40, 1)) if surface else None
    return Profile(depth, BANDS, seen, surface=above, source=f"cast {seed}")


@pytest.mark.parametrize("surface", [True, False])
def test_a_station_of_three_casts_is_known_better(surface):
    casts = [cast(seed, sun, surface) for seed, sun in enumerate((1.0, 0.6, 1.4))]
    one, all_three = fit_profile(casts[0]), fit_profile(merged(casts))
    kd, alone = all_three.quantities["Kd"], one.quantities["Kd"]
    assert np.all(np.abs(np.log(kd.value / KD)) < 4 * kd.sd)
    # Three times the samples: sqrt(3), the waves' possible correlation apart.
    assert np.all(kd.sd < 0.75 * alone.sd)
    assert all_three.metadata["left_out"]["casts merged"] == 3
    low, high = all_three.interval("Ed0_490")
    assert low * 0.97 < 1.2 < high * 1.03


def test_casts_that_do_not_belong_together():
    other = Profile(np.arange(1.0, 9.0), [412.0], np.exp(-np.arange(1.0, 9.0))[:, None])
    with pytest.raises(ValueError, match="have different bands"):
        merged([cast(0), other])
    with pytest.raises(ValueError, match="no cast to merge"):
        merged([])


def test_spectra_come_back_from_csv_and_seabass(tmp_path):
    fit = fit_profile(cast(0))
    write_spectra(tmp_path / "fit.csv", fit)
    sheet = read_sheet(tmp_path / "fit.csv")
    np.testing.assert_allclose(sheet.numbers("Kd"), fit.quantities["Kd"].value, rtol=1e-7)
    assert sheet.stated_unit("Kd") == "1/m"
    write_spectra(tmp_path / "fit.sb", fit)
    file = read_seabass(tmp_path / "fit.sb")
    np.testing.assert_allclose(file.columns["wavelength"], BANDS)
    np.testing.assert_allclose(
        file.columns["kd_high"], fit.quantities["Kd"].interval()[1], rtol=1e-7
    )
    assert file.units["ed_0"] == "W/m^2/nm"
    with pytest.raises(ValueError, match=r"written as \.csv or \.sb"):
        write_spectra(tmp_path / "fit.txt", fit)


def test_the_command_merges_and_writes_a_table(tmp_path, capsys):
    paths = []
    for seed in range(2):
        one = cast(seed)
        paths.append(tmp_path / f"{seed}.csv")
        rows = [
            ",".join(f"{v:.8g}" for v in (z, *row))
            for z, row in zip(one.depth, one.Ed, strict=True)
        ]
        head = "depth_m," + ",".join(f"Ed_{wl:g}" for wl in BANDS)
        paths[-1].write_text("\n".join(["# Ed in W m-2 nm-1", head, *rows]) + "\n")
    out = tmp_path / "out"
    options = ["--merge", "--kd-only", "-o", str(out), "--table", str(tmp_path / "t.sb")]
    assert cli.run(["fit-profile", *map(str, paths), *options]) == 0
    assert "casts merged: 2" in capsys.readouterr().out
    found = read_seabass(tmp_path / "t.sb").columns["kd"]
    np.testing.assert_allclose(found, KD, rtol=0.03)
    assert out.with_suffix(".nc").exists()
    archive = ["fit-profile", *map(str, paths), "--know", "cdom=0.1+-0.01"]
    assert cli.run(archive) == 3
    assert "add --constituents" in capsys.readouterr().err

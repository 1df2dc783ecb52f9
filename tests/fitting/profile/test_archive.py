"""Many casts: one program, results that do not depend on company, archives that go on."""

import os

import numpy as np
import pytest
import xarray as xr

from fitting import Profile, fit_profile, fit_profiles
from fitting.commands import main as cli
from fitting.files.cast_file import Reading
from fitting.profile.archive import Task, fit_archive

BANDS = np.array([412.0, 490.0, 555.0])


def casts(count=12, seed=0):
    """Casts of two lengths, a fifth of them with one band less."""
    rng = np.random.default_rng(seed)
    made = []
    for i in range(count):
        depth = np.sort(rng.uniform(0.2, 20.0, 30 if i % 3 else 22))
        bands = BANDS[: 2 if i % 5 == 4 else 3]
        kd = np.exp(rng.uniform(np.log(0.05), np.log(0.3), len(bands)))
        noise = 1 + 0.05 * rng.standard_normal((len(depth), len(bands)))
        made.append(Profile(depth, bands, np.exp(-kd * depth[:, None]) * noise, source=f"cast {i}"))
    return made


def test_a_cast_gives_the_same_alone_and_in_any_company():
    many = casts()
    together = fit_profiles(many)
    apart = [*fit_profiles(many[:5]), *fit_profiles(many[:4:-1])]
    alone = [fit_profile(cast) for cast in many[:3]]
    order = [*range(5), *range(11, 4, -1)]
    for fit, i in zip(apart, order, strict=True):
        np.testing.assert_allclose(fit.x, together[i].x, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(fit.covariance, together[i].covariance, rtol=1e-9, atol=1e-18)
    for fit, i in zip(alone, range(3), strict=True):
        np.testing.assert_allclose(fit.x, together[i].x, rtol=1e-12, atol=1e-12)
    assert len(together) == 12
    assert together[-1].metadata["source"] == "cast 11"


def test_casts_that_cannot_be_used_do_not_stop_the_others():
    many = casts(3)
    fits = fit_profiles(many, depth_range=(0.0, 1.5))
    usable = [cast.mask[cast.depth <= 1.5].sum(axis=0).min() >= 5 for cast in many]
    assert len(fits.failures) == usable.count(False) > 0
    data = fits.to_xarray()
    assert bool(np.all(np.isnan(data.Kd[min(fits.failures)])))
    with pytest.raises(ValueError, match=r"cast \d: depth_range 0-1.5 m leaves"):
        fits[min(fits.failures)]


def test_the_table_of_casts_agrees_with_each_fit():
    many = casts(6)
    fits = fit_profiles(many)
    data = fits.to_xarray()
    assert data.Kd.shape == (6, 3)
    assert bool(np.isnan(data.Kd[4, 2]))
    kd = fits[1].quantities["Kd"]
    np.testing.assert_allclose(data.Kd[1], kd.value)
    np.testing.assert_allclose(data.Kd_high[1], kd.interval(0.95)[1])


def write(folder, cast, name):
    path = folder / name
    rows = [
        f"{z:.9g}," + ",".join(f"{v:.9g}" for v in row)
        for z, row in zip(cast.depth, cast.Ed, strict=True)
    ]
    head = "depth_m," + ",".join(f"Ed_{wl:g}" for wl in cast.wavelength)
    path.write_text("\n".join(["# Ed in W m-2 nm-1", head, *rows]) + "\n")
    return path


HOSTILE = {
    "empty.csv": b"",
    "nul.csv": b"depth_m,Ed_490\n0,\x001\n",
    "unitless.csv": b"depth_m,Ed_490\n" + b"".join(b"%d,%d\n" % (i, 99 - i) for i in range(20)),
    "one.csv": b"# W m-2 nm-1\ndepth_m,Ed_490\n1,1\n",
    "missing.csv": b"# W m-2 nm-1\ndepth_m,Ed_490\n" + b"1,\n" * 20,
    "half.nc": b"\x89HDF\r\n\x1a\n" + b"\x00" * 100,
    "classic.nc": b"CDF\x01" + b"\x00\x01" * 30,
    "text.sb": b"/begin_header\n/fields=depth,ed490\n",
}


def test_an_archive_goes_on_past_hostile_files_and_resumes(tmp_path, capsys):
    many = casts(3)
    good = [write(tmp_path, cast, f"cast{i}.csv") for i, cast in enumerate(many)]
    bad = []
    for name, content in HOSTILE.items():
        bad.append(tmp_path / name)
        bad[-1].write_bytes(content)
    folder = tmp_path / "out"
    files = [*bad[:4], *good, *bad[4:], tmp_path / "absent.csv"]
    code = cli.run(["fit-profile", *map(str, files), "-o", str(folder)])
    printed = capsys.readouterr()
    assert code == 3
    assert "9 of 12 files could not be used in full; the rest is done" in printed.err
    assert "Traceback" not in printed.err
    for name in HOSTILE:
        assert name in printed.err
    assert sorted(p.name for p in folder.iterdir()) == [f"cast{i}.csv.kd.nc" for i in range(3)]
    with xr.open_dataset(folder / "cast1.csv.kd.nc") as data:
        np.testing.assert_allclose(
            data.Kd[0], fit_profile(many[1]).quantities["Kd"].value, rtol=1e-6
        )
    stamp = (folder / "cast1.csv.kd.nc").stat().st_mtime_ns
    os.utime(good[0], (stamp / 1e9 + 10, stamp / 1e9 + 10))
    outcomes = {o.path: o for o in fit_archive(good, Task(folder))}
    assert [outcomes[path].resumed for path in good] == [False, True, True]
    assert (folder / "cast1.csv.kd.nc").stat().st_mtime_ns == stamp


def test_one_hostile_file_is_a_sentence_and_code_3(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name, content in HOSTILE.items():
        (tmp_path / name).write_bytes(content)
        assert cli.run(["fit-profile", name]) == 3
        printed = capsys.readouterr().err
        assert name in printed
        assert "Traceback" not in printed
    assert {p.name for p in tmp_path.iterdir()} == set(HOSTILE)


@pytest.mark.parametrize(
    ("option", "sentence"),
    [
        (["--know", "cdom=0.12"], "write name=value+-sd"),
        (["--know", "cdon=0.1+-0.1"], "'cdon' is unknown"),
        (["--transport", "six-stream"], "'six-stream'; it must be one of two-stream"),
        (["--columns", "depth"], "write ours=theirs"),
        (["--layers", "many"], "write a number or auto"),
    ],
)
def test_bad_options_are_sentences(option, sentence, tmp_path, capsys):
    path = write(tmp_path, casts(1)[0], "cast.csv")
    assert cli.run(["fit-profile", str(path), *option]) == 3
    assert sentence in capsys.readouterr().err


@pytest.mark.slow
def test_a_cluster_writes_the_same_bytes_as_one_process(tmp_path, monkeypatch):
    from distributed import LocalCluster

    monkeypatch.setenv("SOURCE_DATE_EPOCH", "0")  # results name the second they were written in
    many = casts(6)
    files = [write(tmp_path, cast, f"cast{i}.csv") for i, cast in enumerate(many)]
    (tmp_path / "broken.csv").write_bytes(HOSTILE["nul.csv"])
    files.append(tmp_path / "broken.csv")
    task = Task(tmp_path / "one", Reading())
    list(fit_archive(files, task))
    with LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as cluster:
        other = Task(tmp_path / "many", Reading())
        outcomes = list(fit_archive(files, other, cluster.scheduler_address, group=2))
    assert sum(o.casts for o in outcomes) == 6
    assert [len(o.problems) for o in outcomes if o.path.name == "broken.csv"] == [1]
    for path in files[:-1]:
        name = f"{path.name}.kd.nc"
        one, two = (tmp_path / folder / name for folder in ("one", "many"))
        assert one.read_bytes() == two.read_bytes()

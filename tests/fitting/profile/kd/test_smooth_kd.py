"""A smooth Kd(z): its integrals, its intervals, and its evidence against layers."""

import numpy as np
import pytest
import xarray as xr

from fitting import Profile, smooth_kd
from fitting.commands import main as cli
from fitting.profile.kd.smooth_kd import _paths

DEPTH = np.linspace(0.3, 45.0, 120)
FINE = np.linspace(0.0, 45.0, 4501)
SURFACE = np.array([0.06, 0.09])


def bump(z):
    return SURFACE + 0.05 * np.exp(-(((z[:, None] - 22.0) / 7.0) ** 2))


def step(z):
    return np.where(z[:, None] < 20.0, SURFACE, 2.0 * SURFACE)


def even(z):
    return np.broadcast_to(SURFACE, (len(z), 2))


def fits(kd, count, seed=0):
    """Fits of casts with 5 % waves."""
    rng = np.random.default_rng(seed)
    middle = 0.5 * (FINE[1:] + FINE[:-1])
    path = np.concatenate([np.zeros((1, 2)), np.cumsum(kd(middle) * 0.01, axis=0)])
    clean = np.exp(-np.stack([np.interp(DEPTH, FINE, column) for column in path.T], axis=1))
    for _ in range(count):
        seen = clean * (1 + 0.05 * rng.standard_normal(clean.shape))
        yield smooth_kd(Profile(DEPTH, [490.0, 555.0], seen), (0.0, 45.0))


def test_paths_are_integrals_of_hats():
    knots = np.linspace(0.0, 10.0, 6)
    hats = np.stack([np.interp(FINE, knots, row) for row in np.eye(6)], axis=1)
    sums = np.cumsum(0.5 * (hats[1:] + hats[:-1]) * 0.01, axis=0)
    inside = FINE[1:] <= 10.0
    np.testing.assert_allclose(_paths(FINE[1:], knots)[inside], sums[inside], atol=2e-5)


def test_a_smooth_kd_is_covered():
    inside, error, sd = [], [], []
    for fit in fits(bump, 6):
        low, high = fit.Kd.interval(0.95)
        truth = bump(fit.depth)
        inside.append((low < truth) & (truth < high))
        error.append(np.log(fit.Kd.value / truth))
        sd.append(fit.Kd.sd)
        # Three layers follow these casts nearly as well, and know of fewer numbers.
        assert abs(fit.evidence) < 10.0
    # Measured over 40: 0.98, for errors are a tenth smaller than their deviations.
    assert 0.92 < np.mean(inside) <= 1.0
    assert 0.6 < np.sqrt(np.mean(np.square(error)) / np.mean(np.square(sd))) < 1.1
    assert np.median(sd) < 0.08


def test_the_command_writes_a_smooth_kd(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    seen = np.exp(-0.1 * DEPTH)[:, None] * np.array([1.0, 2.0])
    seen *= 1 + 0.05 * np.random.default_rng(0).standard_normal(seen.shape)
    rows = [f"{z:.9g},{a:.9g},{b:.9g}" for z, (a, b) in zip(DEPTH, seen, strict=True)]
    head = ["# Ed in W m-2 nm-1", "depth_m,Ed_490,Ed_555"]
    (tmp_path / "cast.csv").write_text("\n".join([*head, *rows]) + "\n")
    assert cli.run(["fit-profile", "cast.csv", "--kd-only", "--smooth"]) == 0
    assert "times as likely as 1 layer(s)" in capsys.readouterr().out
    with xr.open_dataset(tmp_path / "cast_fit.nc", group="smooth") as data:
        assert data.Kd.dims == ("depth", "wavelength")
        assert bool(np.all((data.Kd_low < 0.1) & (data.Kd_high > 0.1)))
        assert data.attrs["evidence_against_layers"] < 0
    assert cli.run(["fit-profile", "cast.csv", "cast.csv", "--smooth"]) == 3
    assert "--sample and --smooth are for one cast" in capsys.readouterr().err


@pytest.mark.parametrize(("kd", "interfaces", "least"), [(step, 1, 10.0), (even, 0, 3.0)])
def test_evidence_tells_layers(kd, interfaces, least):
    for fit in fits(kd, 2):
        assert len(fit.interfaces) == interfaces
        assert fit.evidence < -least

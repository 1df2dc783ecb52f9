"""The measured trade-off: rows, tables, and a whole run of the candidate models."""

import csv

import numpy as np
import pytest

import oceaninv as oi
from fitting.commands import fit_trade_off
from fitting.commands import main as cli
from oceaninv.fidelity import trade_off
from oceaninv.fidelity.candidate_models import (
    CandidateModel,
    answer_of_transport,
    candidate_models,
    references,
)
from tests.fitting.commands.test_main import CAST

SCENE = """
title = "Small sea"
[bands]
count = 4
[water]
chlorophyll_mg_m3 = 1.0
cdom_440_per_m = 0.1
detritus_400_per_m = 0.05
[light]
sun_zenith_deg = 40
[surface]
[camera]
position_m = [0.0, 0.0, 2.0]
direction = [0.0, 1.0, 0.1]
fov_deg = 60
width = 6
height = 4
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "small.toml"
    path.write_text(SCENE)
    return path


def test_the_front_is_what_nothing_beats(tmp_path):
    rows = [trade_off.Row(name, s, 0.0, e) for name, s, e in (
        ("slow, worse", 3.0, 0.5), ("fast", 1.0, 0.4), ("slow, better", 2.0, 0.1)
    )]  # fmt: skip
    front = trade_off._pareto_front(rows)
    assert [row.model for row in front] == ["fast", "slow, better", "slow, worse"]
    assert [row.best for row in front] == [True, True, False]
    found = trade_off.Trade("sea", "photograph", "exact", 0.001, front)
    table = trade_off.how_to_choose([found], (0.45, 0.2, 0.01))
    assert "| sea | photograph | fast, 1e+03 ms | slow, better, 2e+03 ms | none | 0.1 % |" in table
    trade_off.save_rows(tmp_path / "sea.csv", found)
    assert trade_off.load_rows(tmp_path / "sea.csv") == found


def test_errors_of_photographs_are_of_channels(file):
    """A model of some bands is judged by the channels that it makes of them."""
    found = oi.load_scene(file)
    benchmark = trade_off._Benchmark(found.scene, found.camera, "photograph")
    even = np.ones((len(benchmark.origin), 4))
    assert benchmark.error(1.1 * even, even) == pytest.approx(0.1)
    assert benchmark.error(even[:, :3], even, (0, 1, 3)) < 0.01
    benchmark = trade_off._Benchmark(found.scene, found.camera, "irradiance")
    light = np.exp(-np.arange(10.0))[:, None] * np.ones(4)
    wrong = light.copy()
    wrong[2], wrong[9] = 1.2 * wrong[2], 9.0  # the last is below the 1 % level
    assert benchmark.error(wrong, light) == pytest.approx(0.2)


def test_every_dial_has_its_models(file):
    import dataclasses

    scene = oi.load_scene(file).scene
    names = [model.name for model in candidate_models(scene, "photograph")]
    for part in ("printed closure", "KdTransport", "FourStream, float32", "MonteCarlo(1024, 32)",
                 "MonteCarlo(64, 4)", "PlaneParallel(16, 8)", "TwoStream, 3 bands"):  # fmt: skip
        assert part in names
    assert not any("bands" in model.name for model in candidate_models(scene, "irradiance"))
    glowing = dataclasses.replace(scene, inelastic=oi.Inelastic(oi.Raman()))
    names = [model.name for model in candidate_models(glowing, "photograph")]
    assert "PlaneParallel(8, 6, inelastic_orders=2)" in names
    assert "TwoStream, elastic" in names
    assert "inelastic_orders=3" in references(glowing, "photograph")[0].name


@pytest.mark.slow
def test_trade_writes_rows_and_a_picture(file, tmp_path, monkeypatch):
    """A few of the models, beside a reference that is not the real one."""
    few = {"printed closure", "TwoStream", "TwoStream, float32", "MonteCarlo(64, 4)"}
    monkeypatch.setattr(
        trade_off,
        "candidate_models",
        lambda *given: [model for model in candidate_models(*given) if model.name in few],
    )
    monkeypatch.setattr(
        trade_off,
        "references",
        lambda _, quantity: [
            CandidateModel(f"exact {n}", answer_of_transport(oi.PlaneParallel(n), quantity))
            for n in (6, 4)
        ],
    )
    stem = tmp_path / "out"
    assert cli.run(["trade", str(file), "-o", str(stem), "--repeats", "2"]) == 0
    lines = stem.with_suffix(".csv").read_text().splitlines()
    error = {row["model"]: float(row["error"]) for row in csv.DictReader(lines[1:])}
    assert set(error) == few
    # Measured: 0.045 and 4.2.
    assert error["TwoStream"] < 0.1
    assert error["printed closure"] > 1.0
    assert abs(error["TwoStream, float32"] / error["TwoStream"] - 1) < 1e-2
    assert stem.with_suffix(".png").stat().st_size > 1000


@pytest.mark.slow
def test_the_trade_of_a_fit_names_shifts_and_savings(tmp_path, monkeypatch):
    """Of one model only: it is the reference."""
    monkeypatch.setattr(fit_trade_off, "TRANSPORTS", (oi.TwoStream(),))
    monkeypatch.setattr(fit_trade_off, "TOLERANCES", ())
    stem = tmp_path / "fit"
    assert cli.run(["trade", "--fit", CAST, "-o", str(stem), "--repeats", "1"]) == 0
    (row,) = csv.DictReader(stem.with_suffix(".csv").read_text().splitlines())
    assert row["model"] == "TwoStream()"
    assert float(row["share_of_reference"]) == 1.0
    assert float(row["cdom_shift_sd"]) == 0.0
    assert float(row["cdom_low"]) < float(row["cdom"]) < float(row["cdom_high"])
    assert stem.with_suffix(".png").stat().st_size > 1000


def test_fits_take_one_file(capsys):
    assert cli.run(["trade", "--fit", CAST, CAST]) == 3
    assert "--fit takes one file" in capsys.readouterr().err

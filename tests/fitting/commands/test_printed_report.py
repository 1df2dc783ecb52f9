"""What is said first: whether the model describes the data at all."""

import jax
import numpy as np

import oceaninv as oi
from fitting import fit_profile
from fitting.commands import main as cli
from fitting.report.web_page import write_html
from tests.fitting.core.test_result import light

DOUBT = "The model does not describe these data: reduced chi-square "


def cast(folder, kd):
    profile = light(kd)
    rows = np.column_stack([profile.depth, profile.Ed])
    lines = ["# units: depth=m, Ed_*=W m-2 nm-1", "depth,Ed_490,Ed_555,Ed_750"]
    lines += [",".join(f"{value:.8g}" for value in row) for row in rows]
    path = folder / "cast.csv"
    path.write_text("\n".join(lines) + "\n")
    return str(path)


def test_a_doubtful_model_is_the_first_line_of_what_is_printed(tmp_path, capsys):
    for kd, doubtful in (([0.06, 0.09, 0.12], True), ([0.06, 0.09, 2.6], False)):
        with jax.enable_x64(True):
            command = ["fit-profile", cast(tmp_path, kd), "-o", str(tmp_path / "fit")]
            assert cli.run(command) == 0
        first, *others = capsys.readouterr().out.splitlines()
        assert first.startswith(DOUBT) == doubtful
        assert not any(line.startswith(DOUBT) for line in others)


def test_a_doubtful_model_is_the_first_line_of_the_page(tmp_path):
    for kd, doubtful in (([0.06, 0.09, 0.12], True), ([0.06, 0.09, 2.6], False)):
        with jax.enable_x64(True):
            fit = fit_profile(light(kd), transport=oi.TwoStream())
        write_html(fit, tmp_path / "fit.html")
        body = (tmp_path / "fit.html").read_text().split("</style>")[1]
        assert body.startswith("<p class='no'>" + DOUBT) == doubtful
        assert body.startswith("<h1>") != doubtful

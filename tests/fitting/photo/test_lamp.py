"""Charts lit by a lamp at the camera: the closed form against quadrature, a fit that sees c."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

import oceaninv as oi
from fitting import Background, Chart, Photo, fit_photo, read_photograph
from fitting.images.chart_reading import table_of
from fitting.images.photo_csv import read_photo
from fitting.photo._lamp import lamplit
from fitting.photo.forward_model import predict
from fitting.photo.problem import prepare
from tests.fitting.images.test_photo_csv import PHOTO
from tests.fitting.images.test_photograph_file import IMAGE, write
from tests.fitting.photo.test_fit_photo import CAMERA, GREY, TRUTH, water

RANGES = (0.6, 1.2, 2.5, 4.0)
BANDS = np.array([450.0, 650.0])


def test_single_scattering_is_its_integral():
    exact, lamp = water(BANDS), jnp.array([1.0, 0.5])
    distance = jnp.array([0.1, 0.5, 3.0, 1e6])
    white, veil = lamplit(exact, lamp, distance, jnp.asarray(0.2))
    back = np.asarray(exact.volume_scattering(jnp.array([-1.0])))[0]
    c = np.asarray(exact.c)
    for i in range(2):
        for k, far in enumerate((0.1, 0.5, 3.0, 60.0)):
            arriving = np.exp(-2 * c[i] * float(distance[k])) / np.pi / float(distance[k]) ** 2
            assert white[k, i] == pytest.approx(float(lamp[i]) * arriving, rel=1e-12)
            path = quad(lambda r, c=c[i]: np.exp(-2 * c * r) / r**2, 0.2, max(far, 0.2))[0]
            assert veil[k, i] == pytest.approx(float(lamp[i]) * back[i] * path, rel=1e-7, abs=1e-12)


def test_lamplight_has_derivatives():
    def total(x):
        model = oi.BioOpticalModel().iops(oi.Constituents(x[0], 0.1, 0.1), BANDS)
        white, veil = lamplit(model, jnp.ones(2), jnp.array([0.5, 2.0, 1e6]), x[1])
        return jnp.sum(jnp.log(white[:2])) + jnp.sum(jnp.log(veil))

    total = jax.jit(total)
    x = jnp.array([1.5, 0.2])
    slope = jax.jacfwd(total)(x)
    for i, step in enumerate(1e-4 * np.eye(2)):
        difference = (total(x + step) - total(x - step)) / 2e-4
        assert float(slope[i]) == pytest.approx(float(difference), rel=1e-5)
    np.testing.assert_allclose(jax.jacrev(total)(x), slope, rtol=1e-10)


def test_lamplit_readings_say_so_and_nothing_else_takes_them(tmp_path):
    path = tmp_path / "charts.csv"
    path.write_text(PHOTO.replace("# camera", "# flash: fired\n# light: lamp\n# camera"))
    photo, _ = read_photo(path, 5.0)
    assert photo.lamp
    with pytest.raises(ValueError, match="lamplight has one model"):
        fit_photo(photo, tolerance=0.05)
    frame = read_photograph(write(tmp_path / "a.exr", IMAGE, "float"))
    assert "# light: lamp" in table_of(frame, [], [], 90.0, None, lamp=True)


@pytest.mark.slow
def test_lamplit_charts_measure_attenuation():
    """Noise-free greys at four ranges: converged, c close and inside, detritus is not claimed."""

    def photo(values):
        parts = [values[4 * k : 4 * k + 4] for k in range(4)]
        charts = [Chart(part, GREY, r, 0.01 * part) for part, r in zip(parts, RANGES, strict=True)]
        behind = Background(values[16:], sigma=0.01 * values[16:])
        camera = oi.spectrum.camera_response(CAMERA)
        return Photo(charts, [behind], depth=5.0, response=camera, lamp=True)

    parameters, (readings,), light = prepare([photo(np.ones((17, 3)))], oi.TwoStream())
    values = {p.name: jnp.asarray(p.centre) for p in parameters}
    values |= {name: jnp.asarray(v) for name, v in TRUTH.items()}
    values |= {"overlap_distance": jnp.asarray(0.3), "chart_0_1": jnp.asarray(1.1)}
    clean = np.asarray(predict(values, readings, oi.TwoStream(), light))
    fit = fit_photo(photo(clean))
    assert fit.converged
    exact = water(np.array([550.0]))
    found = fit.quantities["c_550"]
    low, high = found.interval()
    assert low < float(exact.c[0]) < high
    assert found.sd < 0.2
    assert not fit.identifiable["detritus"]

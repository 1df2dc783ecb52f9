"""Bands and responses against fine quadrature, exact cases, colorimetric identities."""

import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from oceaninv.foundation import spectrum, tables
from tests.paths import ROOT

GRIDS = {
    "equal": spectrum.bands(12),
    "uneven": np.array([395.0, 412.5, 443.0, 490.0, 555.0, 670.0, 765.0]),
    "two": np.array([450.0, 600.0]),
}
D850 = spectrum.camera_response("Nikon D850")


def response_at(response, wavelength):
    """Piecewise linear response, 0 beyond its samples, (channel, wl)."""
    return np.stack(
        [np.interp(wavelength, response.samples, row, 0, 0) for row in np.asarray(response.values)]
    )


def fine(response, wavelength, radiance):
    """Midpoint rule on a fine grid over the bands, split at nothing in particular."""
    edges = spectrum.band_edges(wavelength)
    step = 0.001
    at = np.arange(edges[0] + step / 2, edges[-1], step)
    return step * response_at(response, at) @ np.interp(at, wavelength, radiance)


def test_bands_fill_the_interval():
    centres = spectrum.bands(15)
    np.testing.assert_allclose(centres, np.arange(410.0, 700.0, 20.0), rtol=1e-15)
    edges = spectrum.band_edges(centres)
    np.testing.assert_allclose(edges, np.arange(400.0, 701.0, 20.0), rtol=1e-15)
    np.testing.assert_allclose(spectrum.bands(2, 380, 780), [480.0, 680.0])


@pytest.mark.parametrize("grid", GRIDS)
def test_weights_against_fine_quadrature(grid):
    wavelength = GRIDS[grid]
    radiance = np.random.default_rng(1).uniform(0.1, 1.0, wavelength.size)
    got = np.asarray(D850.weights(wavelength)) @ radiance
    np.testing.assert_allclose(got, fine(D850, wavelength, radiance), rtol=1e-9)


def test_exact_for_a_constant_response_and_a_linear_spectrum():
    # Integral of 2 L over 400-700 nm with L linear between centres and flat in the outer halves.
    box = spectrum.Response(jnp.full((1, 2), 2.0), [300.0, 800.0], ("all",))
    centres = spectrum.bands(6)
    line = 0.25 + 0.001 * centres
    ends = 25.0 * (line[0] + line[-1])
    inner = 250.0 * (line[0] + line[-1]) / 2
    got = np.asarray(box.weights(centres)) @ line
    np.testing.assert_allclose(got, [2 * (ends + inner)], rtol=1e-14)
    np.testing.assert_allclose(np.sum(box.weights(centres)), 600.0, rtol=1e-14)


def test_a_spectrum_linear_between_bands_gives_the_same_on_any_finer_grid():
    coarse = spectrum.bands(10)
    edges = spectrum.band_edges(coarse)
    radiance = np.random.default_rng(2).uniform(0.1, 1.0, coarse.size)
    # A finer grid that holds the coarse centres, and whose ends reach the same outer edges.
    fine_grid = np.unique(np.concatenate([coarse, np.linspace(edges[0], edges[-1], 601)[1:-1]]))
    again = np.interp(fine_grid, coarse, radiance)
    coarse_channels = np.asarray(D850.weights(coarse)) @ radiance
    fine_channels = np.asarray(D850.weights(fine_grid)) @ again
    # What the fine grid leaves out at its ends is a quarter of a nanometre.
    missing = fine(D850, coarse, radiance) - fine(D850, fine_grid, again)
    np.testing.assert_allclose(fine_channels + missing, coarse_channels, rtol=1e-9)


def test_smooth_weights():
    """Exact for a straight line in units of the light; nearer to 1 nm than linear ones are."""
    response = spectrum.camera_response("Nikon D850")
    light = spectrum.daylight_table()
    fine = np.arange(400.5, 700, 1.0)
    for n in (8, 16):
        bands = spectrum.bands(n)
        line = spectrum.daylight(bands) * (2.0 - bands / 500.0)
        exact = np.asarray(response.weights(fine)) @ (spectrum.daylight(fine) * (2 - fine / 500))
        found = np.asarray(response.smooth_weights(bands, light)) @ line
        np.testing.assert_allclose(found, exact, rtol=2e-4, atol=1e-4 * exact.max())
        curve = lambda x: spectrum.daylight(x) * np.exp(-(((x - 480) / 60) ** 2))  # noqa: E731
        exact = np.asarray(response.weights(fine)) @ curve(fine)
        errors = [
            np.max(np.abs(np.asarray(weights) @ curve(bands) - exact))
            for weights in (response.smooth_weights(bands, light), response.weights(bands))
        ]
        assert errors[0] < 0.5 * errors[1]
    flat = response.smooth_weights(fine)
    np.testing.assert_allclose(flat, response.weights(fine), atol=2e-3)
    with pytest.raises(ValueError, match="light must be positive"):
        response.smooth_weights([450.0, 550.0], ([400.0, 700.0], [0.0, 0.0]))


def test_share_outside_the_bands():
    at = np.arange(380.0005, 780.0, 0.001)
    whole = 0.001 * response_at(D850, at).sum(axis=1)
    for start, stop in ((400.0, 700.0), (500.0, 600.0)):
        inside = 0.001 * response_at(D850, at[(at > start) & (at < stop)]).sum(axis=1)
        got = D850.outside(spectrum.bands(7, start, stop))
        np.testing.assert_allclose(got, 1 - inside / whole, atol=1e-8)
    np.testing.assert_allclose(D850.outside(spectrum.bands(5, 300.0, 900.0)), 0.0, atol=1e-14)
    np.testing.assert_allclose(D850.outside(spectrum.bands(5, 800.0, 900.0)), 1.0, atol=0)


def test_a_blind_channel_has_nothing_outside_and_a_finite_gradient():
    def total(values):
        return jnp.sum(spectrum.Response(values, [400.0, 700.0], ("blind",)).outside([500.0, 600]))

    value, slope = jax.value_and_grad(total)(jnp.zeros((1, 2)))
    assert value == 0
    assert np.all(np.isfinite(slope))


def test_weights_are_linear_in_the_response_and_keep_its_dtype():
    centres = spectrum.bands(8)
    twice = eqx.tree_at(lambda r: r.values, D850, 2 * D850.values)
    np.testing.assert_allclose(twice.weights(centres), 2 * D850.weights(centres), rtol=1e-15)
    single = eqx.tree_at(lambda r: r.values, D850, D850.values.astype(jnp.float32))
    assert single.weights(centres).dtype == jnp.float32
    assert single.outside(centres).dtype == jnp.float32
    np.testing.assert_allclose(single.weights(centres), D850.weights(centres), rtol=1e-5)
    assert spectrum.generic_camera(jnp.zeros(3, jnp.float32)).values.dtype == jnp.float32


def test_gradient_with_respect_to_camera_coefficients():
    centres = spectrum.bands(8)
    radiance = jnp.asarray(np.exp(-(((centres - 480) / 60) ** 2)))

    @jax.jit
    def channels(coefficients):
        return spectrum.generic_camera(coefficients).weights(centres) @ radiance

    at = jnp.array([0.3, -1.0, 2.0])
    forward, reverse = jax.jacfwd(channels)(at), jax.jacrev(channels)(at)
    np.testing.assert_allclose(forward, reverse, rtol=1e-13)
    # Linear: the difference quotient is the derivative but for rounding.
    steps = 0.5 * jnp.eye(3)
    quotient = jnp.stack([channels(at + step) - channels(at - step) for step in steps], axis=1)
    np.testing.assert_allclose(forward, quotient, rtol=1e-12)
    assert np.linalg.matrix_rank(np.asarray(forward), tol=1e-3 * np.abs(forward).max()) == 3


# Of these the balance between channels was published.
BALANCED = [n for n in spectrum.camera_names() if n not in ("ARRI D21", "Nikon D5100")]


def test_generic_camera_is_the_mean_and_its_components_are_orthogonal():
    mean = spectrum.generic_camera()
    np.testing.assert_array_equal(spectrum.generic_camera(jnp.zeros(3)).values, mean.values)
    steps = [spectrum.generic_camera(row).values - mean.values for row in jnp.eye(3)]
    gram = np.array([[np.sum(a * b) for a in steps] for b in steps])
    # The lengths are the standard deviations that the header of the table states.
    note = tables.load("generic_camera").note
    stated = [float(word.strip(",;")) for word in note.split("scores, ")[1].split()[:3]]
    np.testing.assert_allclose(np.sqrt(np.diag(gram)), stated, rtol=2e-5)
    np.testing.assert_allclose(gram - np.diag(np.diag(gram)), 0.0, atol=1e-6)
    # They describe the measured cameras: largest score, largest distance that they leave.
    for name in BALANCED:
        away = spectrum.camera_response(name).values - mean.values
        scores = np.array([float(np.sum(away * step)) for step in steps]) / np.diag(gram)
        rest = away - sum(score * step for score, step in zip(scores, steps, strict=True))
        assert np.max(np.abs(scores)) < 3.32
        assert np.sqrt(np.mean(rest**2)) < 0.0472


def test_generic_camera_is_that_of_the_measured_cameras():
    """Mean, standard deviations and directions anew from the 50 cameras of known balance."""
    values = np.stack([np.asarray(spectrum.camera_response(name).values) for name in BALANCED])
    rows = values.reshape(50, -1)
    mean = spectrum.generic_camera()
    np.testing.assert_allclose(mean.values.ravel(), rows.mean(axis=0), atol=6e-7)
    _, size, directions = np.linalg.svd(rows - rows.mean(axis=0), full_matrices=False)
    for k, row in enumerate(jnp.eye(3)):
        step = np.asarray(spectrum.generic_camera(row).values - mean.values).ravel()
        expected = directions[k] * size[k] / 7.0  # of 50 - 1 degrees of freedom
        expected *= np.sign(expected @ step)
        np.testing.assert_allclose(step, expected, atol=4e-7)
    assert np.sum(size[:3] ** 2) / np.sum(size**2) == pytest.approx(0.730, abs=5e-4)


def test_camera_names_and_errors():
    assert {"Nikon D850", "Canon PowerShot S90"} <= set(spectrum.camera_names())
    for name in spectrum.camera_names():
        response = spectrum.camera_response(name)
        assert response.channels == ("R", "G", "B")
        assert float(response.values[1].max()) == 1.0
    with pytest.raises(ValueError, match=r"Camera 'd850' is unknown. Near it: Nikon D850"):
        spectrum.camera_response("d850")


def test_d65_white_is_srgb_white():
    fine_bands = spectrum.bands(420, 360, 780)
    xyz = np.asarray(spectrum.cie_1931().weights(fine_bands)) @ spectrum.daylight(fine_bands)
    white = xyz / xyz[1]
    np.testing.assert_allclose(spectrum.to_srgb(white), [1.0, 1.0, 1.0], atol=1e-3)
    # The white point of CIE 15.
    np.testing.assert_allclose(white, [0.95047, 1.0, 1.08883], atol=2.3e-5)


def test_srgb_is_encoded_and_bounded():
    white = np.array([0.95047, 1.0, 1.08883])
    image = np.array([[0.0 * white, 0.18 * white], [4.0 * white, [0.0, 0.5, 0.0]]])
    got = spectrum.to_srgb(image)
    assert got.shape == (2, 2, 3)
    # 18 % grey is 0.4613 after the sRGB curve: 1.055 * 0.18^(1/2.4) - 0.055.
    np.testing.assert_allclose(got[0, 1], 1.055 * 0.18 ** (1 / 2.4) - 0.055, atol=1e-4)
    np.testing.assert_allclose(got[1, 0], 1.0, atol=5e-4)
    assert 0.0 <= got.min() < 1e-3


# Ottosson 2020, from XYZ: written out again to judge the mapping by.
_LMS = np.array(
    [
        [0.8189330101, 0.3618667424, -0.1288597137],
        [0.0329845436, 0.9293118715, 0.0361456387],
        [0.0482003018, 0.2643662691, 0.6338517070],
    ]
)
_LAB = np.array(
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
)
_XYZ_OF_SRGB = np.array(
    [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
)


def _decoded(srgb):
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _lightness_chroma_hue(linear):
    lightness, a, b = (np.cbrt(linear @ _XYZ_OF_SRGB.T @ _LMS.T) @ _LAB.T).T
    return lightness, np.hypot(a, b), np.arctan2(b, a)


def _xyz_of(lightness, chroma, hue):
    lab = np.stack([lightness, chroma * np.cos(hue), chroma * np.sin(hue)], axis=-1)
    return (lab @ np.linalg.inv(_LAB).T) ** 3 @ np.linalg.inv(_LMS).T


def test_colours_within_the_gamut_are_left_alone():
    linear = np.random.default_rng(1).uniform(0, 1, (500, 3)) ** 3
    xyz = linear @ _XYZ_OF_SRGB.T
    # The standard's matrix and its rounded inverse differ by 3e-4.
    inner = 0.01 + 0.98 * linear
    assert not spectrum.outside_srgb(inner @ _XYZ_OF_SRGB.T).any()
    np.testing.assert_allclose(_decoded(spectrum.to_srgb(xyz)), linear, atol=4e-4)
    np.testing.assert_allclose(
        spectrum.to_srgb(xyz),
        np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055),
        atol=0.6 / 255,
    )


def test_colours_beyond_the_gamut_keep_lightness_and_hue():
    """They come to lie on its edge; all hues and lightnesses."""
    generator = np.random.default_rng(2)
    lightness, hue = generator.uniform(0.1, 0.95, 400), generator.uniform(-np.pi, np.pi, 400)
    xyz = _xyz_of(lightness, 0.7 * lightness**0.5, hue)
    assert spectrum.outside_srgb(xyz).all()
    linear = _decoded(spectrum.to_srgb(xyz))
    light, chroma, angle = _lightness_chroma_hue(linear)
    np.testing.assert_allclose(light, lightness, atol=1e-3)
    turned = np.abs((angle - hue + np.pi) % (2 * np.pi) - np.pi)
    assert np.max(turned * chroma) < 1e-3
    edge = np.minimum(linear.min(axis=1), 1 - linear.max(axis=1))
    assert np.all(edge < 3e-4)
    more = _xyz_of(light, chroma + 0.01, angle)
    assert spectrum.outside_srgb(more).all()


def test_the_mapping_never_lowers_the_larger_chroma():
    """Along one hue, what is shown rises with the chroma up to the edge and then stays."""
    chroma = np.linspace(0.0, 0.5, 101)
    for hue in np.radians([20.0, 110.0, 145.0, 200.0, 230.0, 265.0, 330.0]):
        xyz = _xyz_of(np.full_like(chroma, 0.6), chroma, np.full_like(chroma, hue))
        shown = _lightness_chroma_hue(_decoded(spectrum.to_srgb(xyz)))[1]
        assert np.all(np.diff(shown) > -3e-4)
        beyond = spectrum.outside_srgb(xyz)
        np.testing.assert_allclose(shown[~beyond], chroma[~beyond], atol=1e-3)
        assert np.ptp(shown[beyond]) < 1e-3


def test_lighter_than_white_and_darker_than_black():
    white = np.array([0.95047, 1.0, 1.08883])
    xyz = np.array([5.0 * white + [0.0, 0.0, 3.0], -0.1 * white])
    np.testing.assert_allclose(spectrum.to_srgb(xyz), [[1, 1, 1], [0, 0, 0]], atol=1e-3)


def test_observer_integrates_to_the_sums_of_the_published_functions():
    whole = np.asarray(spectrum.cie_1931().weights(spectrum.bands(471, 359.5, 830.5))).sum(axis=1)
    # Sums over 360-830 nm by 1 nm; half of the first and last values lies beyond the integral.
    np.testing.assert_allclose(whole, [106.86547, 106.85692, 106.89225], rtol=3.5e-6)


def water_colours():
    """Daylight after 0 to 20 m of clear to green water at 1 nm: (spectrum, wl)."""
    wavelength = np.arange(400.5, 700.0)
    table = tables.load("MorelMaritorena2001")
    kw, chi, e = (table.at(wavelength, name) for name in ("Kw", "chi", "e"))
    spectra = [
        np.exp(-depth * (kw + chi * chlorophyll**e))
        for depth in (0.0, 5.0, 20.0)
        for chlorophyll in (0.03, 0.3, 3.0)
    ]
    return wavelength, spectrum.daylight(wavelength) * np.array(spectra)


# Worst error of green and blue against themselves, and of any channel against the brightest.
@pytest.mark.parametrize(
    ("n", "relative", "absolute"),
    [(8, 0.0431, 0.0253), (16, 0.00713, 0.00974), (32, 0.00136, 0.00175)],
)
def test_error_of_few_bands_against_one_nanometre(n, relative, absolute):
    wavelength, spectra = water_colours()
    exact = spectra @ np.asarray(D850.weights(wavelength)).T
    centres = spectrum.bands(n)
    sampled = np.array([np.interp(centres, wavelength, row) for row in spectra])
    error = np.abs(sampled @ np.asarray(D850.weights(centres)).T - exact)
    assert (error[:, 1:] / exact[:, 1:]).max() < relative
    assert (error / exact.max(axis=1)[:, None]).max() < absolute


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: spectrum.bands(1), "n must be at least 2 bands, but is 1"),
        (lambda: spectrum.bands(4, 700.0, 400.0), "0 < start < stop in nm, but came 700 and 400"),
        (lambda: spectrum.band_edges([500.0]), "one alone has no width"),
        (lambda: D850.weights([500.0]), "one alone has no width"),
        (lambda: spectrum.daylight([299.0]), "300-780 nm"),
        (lambda: spectrum.to_srgb(np.zeros((4, 2))), "must end in an axis of 3"),
        (
            lambda: spectrum.Response(jnp.ones((3, 2)), [400.0, 500.0, 600.0], ("R", "G", "B")),
            r"shape \(channel, sample\) = \(3, 3\), .* came with \(3, 2\)",
        ),
        (
            lambda: spectrum.Response(jnp.ones((1, 2), int), [400.0, 500.0], ("R",)),
            "real floating numbers, but came as int",
        ),
    ],
)
def test_errors(call, sentence):
    with pytest.raises(ValueError, match=sentence):
        call()


def test_colour_is_loaded_only_when_used_and_leaves_printing_alone():
    code = """
import sys
import numpy as np
from oceaninv import spectrum
assert "colour" not in sys.modules
before = np.get_printoptions()
spectrum.daylight([500.0])
assert "colour" in sys.modules
assert np.get_printoptions() == before
"""
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


@pytest.mark.parametrize(("count", "stop"), [(8, 650), (12, 650), (8, 700), (12, 700)])
def test_camera_bands(count, stop):
    """They fill their range, and integrate cameras of the project's better than equal bands do, on
    a light under water that they were not fitted to."""
    from oceaninv import water

    nodes, equal = spectrum.camera_bands(count, 400, stop), spectrum.bands(count, 400, stop)
    assert nodes.size == count
    np.testing.assert_allclose(spectrum.band_edges(nodes)[[0, -1]], [400, stop], atol=0.2)
    fine = spectrum.bands(stop - 400, 400, stop)

    def light(at):
        return np.exp(-np.outer(np.asarray(water.absorption(at)), [2.0, 4.0, 6.0, 8.0]))

    errors = []
    for name in ("Nikon D850", "Canon EOS 5D Mark II"):
        response = spectrum.camera_response(name)
        exact = np.asarray(response.smooth_weights(fine)) @ light(fine)
        for at in (nodes, equal):
            found = np.asarray(response.smooth_weights(at)) @ light(at)
            errors.append(np.max(np.abs(found - exact) / exact.max(axis=0)))
    ours, even = np.reshape(errors, (2, 2)).mean(axis=0)
    assert ours < 0.92 * even
    with pytest.raises(ValueError, match="take equal bands"):
        spectrum.camera_bands(9)

"""Boards: what surrounds a patch, how a fit sees it, and what is refused."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import oceaninv as oi
from fitting import Background, Board, Chart, Photo
from fitting.images.chart_targets import NAMES, target
from fitting.images.photo_csv import read_photo
from fitting.observations.photo import WAVELENGTH
from fitting.photo._band_derivatives import downward
from fitting.photo.forward_model import (
    _light_from_the_side,
    _light_on_charts,
    _with_one_peak,
    light_up,
    predict,
)
from fitting.photo.problem import prepare
from fitting.photo.surroundings import RINGS, surroundings_of
from oceaninv.transport.closed_form._two_moment_field import DeltaScaledWater
from oceaninv.transport.objects._surface_irradiance import facet_irradiance

ONES = np.ones((24, 3))


def checker(distance=1.0, **changes) -> Chart:
    known = target("ColorChecker24")
    return Chart(ONES, known.reflectance, distance, **({"board": known.board} | changes))


def _around(scene):
    """Diffuse scalar irradiance at 5 m, without the delta-scaled beam of the sun."""
    mu0, beam = scene.beam()
    lost = DeltaScaledWater(scene.water).attenuation.c_star
    scalar = oi.irradiance(scene, jnp.asarray([5.0])).E0.value[0]
    return np.asarray(scalar - beam * jnp.exp(-lost * 5.0 / mu0))


def test_rings_hold_the_board_and_no_more():
    around = surroundings_of(checker())
    board = checker().board
    assert board is not None
    assert around.reflectance.shape == (24, RINGS, 16)
    np.testing.assert_allclose(around.reflectance[:, 0], target("ColorChecker24").reflectance)
    assert np.all(around.cover[:, 0] == 1.0)
    # Rings are filled evenly in radius: the mean width of what is covered, over all azimuths, is
    # the mean distance of the edge from the patch's centre.
    azimuth = 2 * np.pi * (np.arange(20000) + 0.5) / 20000
    way = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    half = np.array([board.width, board.height]) / 2
    for place in (0, 8, 23):
        room = np.where(way > 0, half - board.patches[place, :2], half + board.patches[place, :2])
        edge = np.min(room / np.abs(way), axis=1).mean()
        width = np.diff(around.radius, prepend=0.0)
        assert around.cover[place] @ width == pytest.approx(edge, rel=0.01)
    # A board of one grey is that grey wherever it is.
    plain = dataclasses.replace(target("ColorChecker24"), reflectance=np.full((24, 16), 0.3)).board
    assert plain is not None
    grey = Board(plain.width, plain.height, 0.0, plain.patches, np.full(24, 0.3), ground=0.3)
    even = surroundings_of(Chart(ONES, np.full(24, 0.3), 1.0, board=grey))
    np.testing.assert_allclose(even.reflectance, 0.3 * even.cover[:, :, None].repeat(16, axis=2))


def test_a_board_that_fills_the_view_and_one_that_is_a_point():
    """The limits: exp(-(c - b_forward) r) and no water behind; exp(-c r) and all of it."""
    grey = np.array([0.3, 0.3])

    def seen(board):
        frame = Photo([Chart(np.ones((2, 3)), grey, 1.5, board=board)],
                      [Background(np.ones((1, 3)))], depth=5.0,
                      response=oi.spectrum.camera_response("Nikon D850"))  # fmt: skip
        parameters, (readings,), sun = prepare([frame], oi.TwoStream())
        values = {p.name: jnp.asarray(p.centre) for p in parameters}
        values |= {f"gain_0_{c}": jnp.asarray(1.0) for c in "RGB"}
        values["side_light_0"] = jnp.asarray(0.0)
        lit = light_up(values, readings, sun, 0)
        return np.asarray(predict(values, readings, oi.TwoStream(), sun)), lit

    # An upright face across the sun: 1.35 / 4 of the diffuse scalar irradiance.
    point, lit = seen(Board(1e-7, 1e-7, 0.0))
    whole = seen(Board(3.0, 3.0, 0.0))[0]
    scene, water = lit.scene, lit.water
    light = 1.35 / 4 * _around(scene) / np.pi
    endless = oi.Rays(jnp.asarray([0.0, 0.0, 5.0]), jnp.asarray([[0.0, 1.0, -6e-17]]))
    open_water = np.asarray(oi.radiance(scene, endless).value)[0]
    response = np.asarray(lit.response)
    for got, lost, exact in ((point, water.c, 1e-5), (whole, water.a + water.bb, 0.03)):
        through = np.exp(-np.asarray(lost) * 1.5)
        expected = (through * 0.3 * light + (1 - through) * open_water) @ response.T
        np.testing.assert_allclose(got[0], expected, rtol=exact)


def test_patches_are_seen_before_the_water_in_their_own_direction():
    """A black board hides open water, which is brighter above and towards the sun, and deeper down
    behind its lower edge."""
    places = [[u, v, 0.01, 0.01] for u in (-0.1, 0.0, 0.1) for v in (-0.1, 0.0, 0.1)]
    board = Board(0.3, 0.3, 0.0, places, np.zeros(9), ground=0.0)
    chart = Chart(np.ones((9, 3)), np.zeros(9), 0.6, board=board)
    response = oi.spectrum.camera_response("Nikon D850")

    def seen(**sun):
        frame = Photo([chart], depth=5.0, response=response, **sun)
        parameters, (readings,), light = prepare([frame], oi.TwoStream())
        values = {p.name: jnp.asarray(p.centre) for p in parameters}
        values |= {f"gain_0_{c}": jnp.asarray(1.0) for c in "RGB"}
        values |= {f"gradient_{way}_0": jnp.asarray(1.0) for way in ("down", "across")}
        lit = light_up(values, readings, light, 0)
        return np.asarray(predict(values, readings, oi.TwoStream(), light)), lit, readings

    found, lit, readings = seen(azimuth=90.0)
    # Looking along y, with the sun at +x, which is to the left: right is -x, down is +z.
    way = np.array([[-u, 0.6, v] for u, v, *_ in places])
    way = jnp.asarray(way / np.linalg.norm(way, axis=1)[:, None])
    ahead = oi.radiance(lit.scene, oi.Rays(jnp.asarray([0.0, 0.0, 5.0]), way)).value
    down = oi.irradiance(lit.scene, jnp.asarray([5.0, 5.5])).Ed.value
    fading = np.log(np.asarray(down[0] / down[1])) / 0.5
    water = _with_one_peak(lit.water)
    rings = np.diff(
        np.asarray(oi.disc_transmission(water, jnp.asarray([0.6]), readings.radius, 1.5))[0],
        axis=0, prepend=0.0,
    )  # fmt: skip
    hidden = np.asarray(readings.cover) @ rings
    hidden *= 1 - np.array([v for _, v, *_ in places])[:, None] * fading
    expected = np.asarray(ahead) * (1 - hidden) @ np.asarray(lit.response).T
    # Parabolas between three lines of sight each way.
    np.testing.assert_allclose(found, expected, rtol=6e-3)
    # The upper left patch is the brightest, by much more than that.
    assert np.all(found[0] > 1.1 * found[8])
    # Where nobody says on which side the sun stands, both sides are alike.
    even = seen()[0]
    np.testing.assert_allclose(even[:3], even[6:], rtol=1e-9)


def test_a_board_does_not_tell_of_scattering_backwards():
    """The peak is that of bb/b 0.014 whatever the water's: same b, share, and none lost."""
    model = oi.BioOpticalModel()
    water = model.iops(oi.Constituents(chlorophyll=1.0, cdom=0.1, detritus=0.1), WAVELENGTH)
    one = _with_one_peak(water)
    np.testing.assert_allclose(one.b, water.b, rtol=1e-6)
    low, high = (i for i, p in enumerate(water.phases) if isinstance(p, oi.phase.FournierForand))
    particles = one.b_components[low] + one.b_components[high]
    ratio = (0.004 * one.b_components[low] + 0.05 * one.b_components[high]) / particles
    np.testing.assert_allclose(ratio, 0.014, rtol=2e-3)


def test_readings_that_are_left_out_stay_on_the_board():
    chart = checker()
    some = chart.only(np.arange(24) >= 18)
    assert some.place is not None
    np.testing.assert_array_equal(some.place, np.arange(18, 24))
    np.testing.assert_allclose(
        surroundings_of(some).reflectance[:, 1:], surroundings_of(chart).reflectance[18:, 1:],
        rtol=0.2, atol=0.02,
    )  # fmt: skip
    assert some.board is chart.board


@pytest.mark.parametrize(
    ("name", "width", "height"),
    [("ColorChecker24", 0.289, 0.204), ("ColorCheckerPassport", 0.125, 0.09),
     ("DGK18", 0.216, 0.140)],
)  # fmt: skip
def test_charts_known_by_name_know_their_boards(name, width, height):
    assert name in NAMES
    chart = target(name)
    assert chart.board is not None
    assert (chart.board.width, chart.board.height) == (width, height)
    assert len(chart.board.patches) == len(chart.reflectance)
    double = chart.of_size(2 * width, 0.0).board
    assert double is not None
    assert double.height == pytest.approx(2 * height)
    np.testing.assert_allclose(double.patches, 2 * chart.board.patches)
    assert double.size_sd == 0.0


def test_sizes_from_files(tmp_path):
    head = (
        "# units: kind=text, chart=text, reflectance=1, range=m, zenith=degree, R*=1, G*=1, B*=1\n"
    )
    rows = "kind,chart,reflectance,range,zenith,R,G,B,R_sd,G_sd,B_sd\n"
    rows += "".join(f"chart,A,{v},2,90,{v},{v},{v},.01,.01,.01\n" for v in (0.1, 0.5, 0.9))

    def read(header="", **options):
        path = tmp_path / "dive.csv"
        path.write_text(head + header + rows)
        return read_photo(path, 5.0, **options)[0].charts[0].board

    assert read() is None
    board = read("# board_width: 0.3\n# board_height: 0.2\n")
    assert (board.width, board.height) == (0.3, 0.2)
    assert read(size=0.4).width == 0.4
    with pytest.raises(ValueError, match=r"dive\.csv: give both '# board_width' and"):
        read("# board_width: 0.3\n")
    with pytest.raises(
        ValueError, match=r"dive\.csv: width of a board is 280 m; between 0 and 20 m"
    ):
        read("# board_width: 280\n# board_height: 200\n")


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda: Board(0.0, 0.1), "width of a board is 0 m; between 0 and 20 m"),
        (lambda: Board(280.0, 204.0), "a length in mm"),
        (lambda: Board(0.2, np.nan), "height of a board is nan"),
        (lambda: Board(0.2, 0.2, -0.1), r"size_sd of a board must lie in \[0, 2\)"),
        (lambda: Board(0.2, 0.2, patches=[[0.1, 0.0, 0.05, 0.05]], reflectance=[0.5]),
         "1 of 1 patches have no size or lie outside"),
        (lambda: Board(0.2, 0.2, patches=[[0.0, 0.0, 0.05, 0.05]]), "one reflectance per patch: 0"),
        (lambda: checker(0.1), "nearer than its half-size"),
        (lambda: checker(place=np.arange(1, 25)), "must name one of the board's 24 patches"),
        (lambda: target("DGK18").of_size(216.0), "a length in mm"),
    ],
)  # fmt: skip
def test_boards_that_cannot_be_are_refused(made, said):
    with pytest.raises(ValueError, match=said):
        made()


def test_a_board_without_a_known_size_is_one_more_unknown():
    def names(**changes):
        frame = Photo([checker(**changes)], depth=5.0)
        return prepare([frame], oi.TwoStream())[0]

    known = target("ColorChecker24").of_size(0.289, 0.0).board
    assert "board_size" not in names(board=known).names
    for board, spread in ((checker().board, 0.05), (None, 0.5)):
        by_name = {p.name: p for p in names(board=board)}
        assert by_name["board_size"].centre == 1.0
        assert by_name["board_size"].spread == spread
    assert len(WAVELENGTH) == 16


def lit_by(zenith, azimuth):
    """(irradiance on a chart, Ed, around, sun, cosine of the sun), each at (wl,)."""
    frame = Photo([checker(zenith=zenith)], depth=5.0, azimuth=azimuth)
    parameters, (readings,), sun = prepare([frame], oi.TwoStream())
    values = {p.name: jnp.asarray(p.centre) for p in parameters}
    values |= {f"gain_0_{c}": jnp.asarray(1.0) for c in "RGB"}
    lit = light_up(values, readings, sun, 0)
    light = downward(lit.scene, jnp.asarray([5.0]), oi.TwoStream())
    found = _light_on_charts(readings, lit, light, jnp.asarray(0.0))
    return (*(np.asarray(v)[0] for v in (found, *light)), float(lit.scene.beam()[0]))


@pytest.mark.parametrize("azimuth", [0.0, 60.0, 180.0])
def test_a_level_chart_is_lit_by_ed(azimuth):
    found, down, *_ = lit_by(180.0, azimuth)
    np.testing.assert_allclose(found, down, rtol=1e-12)
    found, down, *_ = lit_by(0.0, azimuth)
    np.testing.assert_allclose(found, 0.03 * down, rtol=1e-12)


@pytest.mark.parametrize(
    ("azimuth", "side"), [(0.0, 0.63), (45.0, 0.99), (-90.0, 1.35), (135.0, 1.375), (180.0, 1.4)]
)
def test_an_upright_chart_sees_the_light_of_its_side(azimuth, side):
    found, _, around, sun, mu0 = lit_by(90.0, azimuth)
    direct = np.sqrt(1 - mu0**2) * max(-np.cos(np.radians(azimuth)), 0.0)
    np.testing.assert_allclose(found, side / 4 * around + direct * sun, rtol=1e-9)


@pytest.mark.slow
def test_light_from_the_side_is_that_of_the_exact_field():
    """At 550 nm and 5 m, of waters of the default model: within a factor of 1.3."""
    for amounts in ((0.2, 0.03, 0.01), (1.5, 0.15, 0.08), (5.0, 0.5, 0.4)):
        names = ("chlorophyll", "cdom", "detritus")
        water = oi.BioOpticalModel().iops(
            oi.Constituents(**dict(zip(names, amounts, strict=True))), np.array([550.0])
        )
        scene = oi.Scene(water, oi.Light(40.0, jnp.ones(1)), oi.FlatSurface())
        normals = jnp.asarray([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
        exact = facet_irradiance(scene, oi.PlaneParallel(16), jnp.full(3, 5.0), normals)
        _, around, sun = (np.asarray(v)[0, 0] for v in downward(
            scene, jnp.asarray([5.0]), oi.TwoStream()))  # fmt: skip
        mu0 = float(scene.beam()[0])
        diffuse = np.asarray(exact)[:, 0] - np.array([np.sqrt(1 - mu0**2) * sun, 0.0, 0.0])
        # A face towards the sun belongs to a camera that looks away from it.
        for azimuth, light in zip((180.0, 90.0, 0.0), diffuse, strict=True):
            ratio = 4 * light / around / _light_from_the_side(azimuth)
            assert 1 / 1.45 < ratio < 1.3, (amounts, azimuth, ratio)


def test_priors_of_light_on_boards():
    def centre_and_spread(name, azimuth):
        frame = Photo([checker()], depth=5.0, azimuth=azimuth)
        one = {p.name: p for p in prepare([frame], oi.TwoStream())[0]}[name]
        return one.centre, one.spread

    for azimuth, exponent in ((0.0, 0.2), (45.0, -0.025), (90.0, -0.25), (180.0, -0.25)):
        assert centre_and_spread("side_light_0", azimuth) == pytest.approx((exponent, 0.3))
    for name, expected in (
        ("gradient_down_0", (1.1, 0.15)),
        ("gradient_across_0", (1.6, 0.6)),
        ("light_down_0", (0.0, 0.05)),
        ("light_across_0", (0.0, 0.05)),
        ("peak_width", (1.5, 0.5)),
    ):
        assert centre_and_spread(name, 90.0) == pytest.approx(expected)


@pytest.mark.parametrize("zenith", [90.0, 120.0])
def test_opaque_water_leaves_values_and_derivatives_finite(zenith):
    frame = Photo([checker(zenith=zenith)], [Background(np.ones((1, 3)))], depth=30.0)
    parameters, (readings,), sun = prepare([frame], oi.TwoStream())
    x = np.asarray(parameters.prior().centre).copy()
    x[[parameters.names.index(n) for n in ("cdom", "detritus")]] += np.log(1e5)

    @jax.jit
    def with_slope(x):
        def seen(x):
            return predict(parameters.layout().values(x), readings, oi.TwoStream(), sun)

        return seen(x), jax.jacfwd(seen)(x)

    for part in with_slope(jnp.asarray(x)):
        assert np.all(np.isfinite(part))

"""`oceaninv pick`: clicks become the corners that `read-charts` takes."""

import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.backend_bases import MouseEvent

from fitting.commands import main as cli
from fitting.commands import pick
from fitting.commands.read_charts import _chart
from fitting.images.photograph_file import read_photograph
from tests.fitting.images.test_photograph_file import IMAGE, write


def click(figure, x, y, button=1):
    """A click on a point of the picture, by way of the screen."""
    column, row = figure.axes[0].transData.transform((x, y))
    figure.canvas.callbacks.process(
        "button_press_event", MouseEvent("button_press_event", figure.canvas, column, row, button)
    )


def test_four_clicks_are_the_corners_of_a_chart(tmp_path, monkeypatch, capsys):
    """With one taken back, and clicks beside the picture and while the window zooms left out."""
    path = write(tmp_path / "a b.png", IMAGE, "uint16")
    given = [(1.0, 2.0), (14.3, 1.5), (13.9, 10.1), (1.2, 9.6)]
    figure = pyplot.figure()

    def clicks():
        click(figure, *given[0])
        click(figure, 8.0, 8.0)
        click(figure, 8.0, 8.0, button=3)
        click(figure, -0.6, 5.0)
        figure.canvas.widgetlock(figure)
        click(figure, 5.0, 5.0)
        figure.canvas.widgetlock.release(figure)
        assert figure.axes[0].get_title().startswith("top right corner")
        for point in given[1:]:
            click(figure, *point)

    monkeypatch.setattr(pick, "_window", lambda path: figure)
    monkeypatch.setattr(pyplot, "show", clicks)
    assert cli.run(["pick", str(path)]) == 0
    said = capsys.readouterr().out.strip()
    assert said.startswith('--chart "NAME KIND RANGE ')
    text = said.removeprefix("--chart ").strip('"').replace("RANGE", "2")
    name, kind, distance, corners = _chart(text)
    assert (name, kind, distance) == ("NAME", "KIND", 2.0)
    np.testing.assert_allclose(corners, given, atol=0.051)
    assert not pyplot.fignum_exists(figure.number)


def test_a_window_closed_too_early_is_a_sentence(tmp_path, monkeypatch, capsys):
    path = write(tmp_path / "a.png", IMAGE, "uint16")
    figure = pyplot.figure()
    monkeypatch.setattr(pick, "_window", lambda path: figure)
    monkeypatch.setattr(pyplot, "show", lambda: click(figure, 3.0, 3.0))
    assert cli.run(["pick", str(path)]) == 3
    assert "closed after 1 of 4 corners" in capsys.readouterr().err
    pyplot.close(figure)


def test_without_a_display_the_other_ways_are_named(tmp_path, capsys):
    path = write(tmp_path / "a.png", IMAGE, "uint16")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pyplot, "show", lambda: pytest.fail("no window can be shown"))
        previous = pyplot.get_backend()
        pyplot.switch_backend("agg")
        try:
            assert cli.run(["pick", str(path)]) == 3
        finally:
            pyplot.switch_backend(previous)
    assert "there is no display for a window" in capsys.readouterr().err
    assert pyplot.get_fignums() == []


def test_the_picture_shows_the_photograph_where_its_pixels_are(tmp_path):
    path = write(tmp_path / "a.png", IMAGE, "uint16")
    figure = pyplot.figure()
    shown = np.clip(read_photograph(path).values, 0.0, 1.0)
    pick.Clicks(figure, shown)
    (image,) = figure.axes[0].images
    assert tuple(image.get_extent()) == (-0.5, 15.5, 11.5, -0.5)
    np.testing.assert_allclose(image.get_array() / 255.0, shown, atol=0.0021)
    pyplot.close(figure)

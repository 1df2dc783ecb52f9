"""`oceaninv pick`."""

from pathlib import Path
from typing import Annotated, Any

import typer

_CORNERS = ("top left", "top right", "bottom right", "bottom left")


def pick_command(
    path: Annotated[Path, typer.Argument(help="Photograph: raw, EXR, PNG or TIFF.")],
    encoding: Annotated[
        str | None, typer.Option(help="linear or sRGB, for files that do not say.")
    ] = None,
) -> None:
    """Click the corners of a chart in a window; prints them as `read-charts --chart` takes them."""
    from fitting.images.chart_reading import display
    from fitting.images.photograph_file import read_photograph

    photograph = read_photograph(path, encoding)
    figure = _window(path)
    clicks = Clicks(figure, display(photograph.values))
    from matplotlib import pyplot

    pyplot.show()
    if len(clicks.points) < len(_CORNERS):
        raise ValueError(
            f"the window was closed after {len(clicks.points)} of {len(_CORNERS)} corners."
        )
    print(f'--chart "NAME KIND RANGE {clicks.text()}"')


def _window(path: Path) -> Any:
    """A figure in a window; ValueError where there is no display."""
    from matplotlib import pyplot

    try:
        figure = pyplot.figure(str(path))
    except (ImportError, RuntimeError):  # of a backend that cannot start
        figure = None
    if figure is None or figure.canvas.required_interactive_framework is None:
        pyplot.close("all")
        raise ValueError(
            "there is no display for a window: read the corners in any picture viewer, or write "
            "find in their place."
        )
    return figure


class Clicks:
    """The corners of a chart, clicked in a figure.

    `picture`: (row, column, 3) between 0 and 1.  A click beside it, or while the window zooms or
    moves, does not count; the right button takes the last corner back.  The figure is closed at
    the fourth.  `points`: (column, row) of each corner, the first pixel's centre at (0, 0).
    """

    def __init__(self, figure: Any, picture: Any):
        self.figure, self.points = figure, []
        self._rows, self._columns = picture.shape[:2]
        self._axes = figure.add_subplot()
        self._axes.imshow((255.0 * picture + 0.5).astype("uint8"), interpolation="nearest")
        (self._line,) = self._axes.plot([], [], "o-", color="tab:red", markersize=4)
        self._axes.autoscale(False)
        self._ask()
        figure.canvas.mpl_connect("button_press_event", self._clicked)

    def text(self) -> str:
        """The corners as x,y x,y x,y x,y, to a tenth of a pixel."""
        return " ".join(f"{x:.1f},{y:.1f}" for x, y in self.points)

    def _ask(self) -> None:
        self._axes.set_title(f"{_CORNERS[len(self.points)]} corner of the patches, as printed")
        self._line.set_data([x for x, _ in self.points], [y for _, y in self.points])
        self.figure.canvas.draw_idle()

    def _clicked(self, event: Any) -> None:
        if event.inaxes is not self._axes or self.figure.canvas.widgetlock.locked():
            return
        x, y = event.xdata, event.ydata
        inside = -0.5 <= x <= self._columns - 0.5 and -0.5 <= y <= self._rows - 0.5
        if event.button == 3 and self.points:
            self.points.pop()
        elif event.button == 1 and inside:
            self.points.append((float(x), float(y)))
        if len(self.points) < len(_CORNERS):
            self._ask()
            return
        from matplotlib import pyplot

        pyplot.close(self.figure)

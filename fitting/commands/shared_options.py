"""What the commands share: options, tables and the writing of results."""

import contextlib
import math
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    import numpy as np

    from fitting.core.result import Fit
    from fitting.images.photograph_file import Photograph


def _stem(path: Path | None) -> Path | None:
    """STEM.nc means STEM, so that no STEM.nc.nc is written."""
    return path.with_suffix("") if path is not None and path.suffix == ".nc" else path


Output = Annotated[
    Path | None,
    typer.Option(
        "--output",
        "-o",
        callback=_stem,
        help="Stem of the files to write, STEM.nc and STEM.png; by default INPUT_fit.",
        rich_help_panel="Output",
    ),
]
Overwrite = Annotated[
    bool,
    typer.Option(
        "--overwrite",
        help="Replace files of the results' names that oceaninv did not write.",
        rich_help_panel="Output",
    ),
]
SolarZenith = Annotated[
    float | None,
    typer.Option(
        help="Sun zenith angle in air, degrees; unknown if not given.",
        rich_help_panel="Sun and camera",
    ),
]
Tolerance = Annotated[
    float | None,
    typer.Option(
        help="Largest acceptable model error (relative); the cheapest transport that meets it is "
        "chosen.",
        rich_help_panel="Model",
    ),
]
RangeKind = Annotated[
    str | None,
    typer.Option(
        help="What the range map holds: z, depth along the optical axis, or line, distance along "
        "the line of sight; by default z of COLMAP maps (.bin) and line of others.",
        rich_help_panel="Range map",
    ),
]
RangeScale = Annotated[
    float | None,
    typer.Option(
        help="Metres per unit of the range map's numbers; a COLMAP map needs this or "
        "--known-length.",
        rich_help_panel="Range map",
    ),
]
KnownLength = Annotated[
    str | None,
    typer.Option(
        help='Two pixels and the distance between what they show, as "x1,y1,x2,y2,METRES".',
        rich_help_panel="Range map",
    ),
]
IntrinsicsFile = Annotated[
    Path | None,
    typer.Option(
        help="cameras.bin or cameras.txt of a COLMAP model, or its folder, for depths along the "
        "axis and for --known-length.",
        rich_help_panel="Range map",
    ),
]
FieldOfView = Annotated[
    float | None,
    typer.Option(
        "--fov",
        help="Full horizontal field of view in degrees, in place of --intrinsics.",
        rich_help_panel="Range map",
    ),
]


def read_ranges(
    path: Path,
    photograph: "Photograph",
    kind: str | None,
    scale: float | None,
    known_length: str | None,
    intrinsics: Path | None,
    field_of_view: float | None,
) -> "np.ndarray":
    """The ranges of a photograph by the options above; prints how they were taken."""
    from fitting.images.range_file import read_range_and_say

    length = None
    if known_length is not None:
        try:
            length = [float(number) for number in known_length.split(",")]
        except ValueError:
            length = []
        if len(length) != 5:
            raise ValueError(f'--known-length is {known_length!r}; write "x1,y1,x2,y2,METRES".')
    if intrinsics is not None and field_of_view is not None:
        raise ValueError("--intrinsics and --fov contradict each other: give one of them.")
    ranges, said = read_range_and_say(
        path,
        photograph,
        kind=kind,
        scale=scale,
        known_length=length,
        intrinsics=field_of_view if intrinsics is None else intrinsics,
    )
    print(said)
    return ranges


def range_inputs(path: Path | None, intrinsics: Path | None) -> list[Path]:
    """The files that a range map and the options above name."""
    from fitting.images.intrinsics import model_file

    named = [] if path is None else [path]
    return named if intrinsics is None else [*named, model_file(intrinsics)]


def check_range_options(path: Path | None, *options: object) -> None:
    """ValueError where options of a range map are given without one."""
    if path is None and any(option is not None for option in options):
        raise ValueError(
            "--range-kind, --range-scale, --known-length, --intrinsics and --fov belong to a "
            "--range-map: give it, too."
        )


# What the commands call the transports; `render` draws with all, fits with some.
TRANSPORTS = {
    "two-stream": "TwoStream",
    "four-stream": "FourStream",
    "kd": "KdTransport",
    "plane-parallel": "PlaneParallel",
    "monte-carlo": "MonteCarlo",
}
_WITH_SD = re.compile(
    r"\s*(?P<value>[-+.,\deE]+?)\s*(?:(?:\+-|\+/-|±)\s*(?P<sd>[-+.,\deE]+)\s*)?", re.ASCII
)


def transport_class(name: str, allowed: Collection[str] = tuple(TRANSPORTS)):
    """The class of a transport by its name; ValueError where it is not among `allowed`."""
    import oceaninv as oi

    if name not in allowed:
        raise ValueError(f"--transport is {name!r}; it must be one of {', '.join(allowed)}.")
    return getattr(oi, TRANSPORTS[name])


def number_with_sd(text: str) -> tuple[float, float | None] | None:
    """(value, standard deviation or None) from 5, 5+-1, 5±1 or, with decimal commas, 5,5±0,1.

    None where that is not what the text says, or where a number is not positive.
    """
    found = _WITH_SD.fullmatch(text)
    if found is None:
        return None
    try:
        numbers = [float(n.replace(",", ".")) for n in found.groups() if n is not None]
    except ValueError:
        return None
    if not all(0.0 < number < math.inf for number in numbers):
        return None
    return numbers[0], numbers[1] if len(numbers) == 2 else None


def known_values(texts: Iterable[str]) -> dict[str, tuple[float, float]]:
    """Value and standard deviation by name, from texts such as "cdom=0.12+-0.01"."""
    known = {}
    for text in texts:
        name, _, numbers = text.partition("=")
        value, sd = number_with_sd(numbers) or (0.0, None)
        if sd is None or not name.strip():
            raise ValueError(
                f"--know is {text!r}; write name=value+-sd, both positive, as cdom=0.12+-0.01."
            )
        known[name.strip()] = (value, sd)
    return known


@contextlib.contextmanager
def noting(failures: list[str], what: str) -> Iterator[None]:
    """Keep the sentence of a step that fails, so that what was fitted before is still written."""
    try:
        yield
    except ValueError as error:
        failures.append(f"{what} could not be found: {error}")


def status(text: str):
    """A spinner on stderr while something runs."""
    from rich.console import Console

    return Console(stderr=True).status(text)


def print_doubt(*fits: "Fit | None") -> None:
    """The sentence of each fit whose model does not describe its data; before all numbers."""
    for fit in fits:
        if fit is not None and fit.doubt:
            print(fit.doubt)


def print_water(fit: "Fit") -> None:
    """Constituents and quantities with intervals, and their sensitivity to assumptions."""
    from rich.console import Console
    from rich.table import Table

    from fitting.core.result import sensitivity_text
    from fitting.water_model.unknowns import phytoplankton_range

    table = Table(title=f"Water by {fit.metadata['transport']}", title_justify="left")
    for name in ("quantity", "unit", "value", "95 % interval"):
        table.add_column(name, justify="left" if name in ("quantity", "unit") else "right")
    shifts = Table(title="Shift of the value per sd of an assumption", title_justify="left")
    shifts.add_column("quantity")
    shifts.add_column("most sensitive to", overflow="fold")
    for number in fit.numbers():
        table.add_row(number.name, number.unit, number.value_text, number.interval_text)
        shifts.add_row(number.name, sensitivity_text(fit.sensitivity[number.name], 2))
    Console().print(table, shifts)
    if fit.plan is not None:
        error, asked = (f"{100 * e:.2g} %" for e in (fit.plan.predicted_error, fit.plan.tolerance))
        print(f"chosen: {fit.plan.transport}, predicted error {error}, asked {asked}")
    if fit.bias is not None:
        print("values of constituents are corrected for the curvature of the model (Box 1971)")
    if "bands_not_modelled_nm" in fit.metadata:
        low, high = phytoplankton_range()
        named = ", ".join(f"{band:g}" for band in fit.metadata["bands_not_modelled_nm"])
        print(
            f"constituents were fitted without {named} nm: absorption by phytoplankton is "
            f"tabulated from {low:g} to {high:g} nm"
        )
    if "nearest_jerlov_type" in fit.metadata:
        print(jerlov_text(fit.metadata, fit.quantities["Kd"].sd))
    print(f"search: {fit.result}")


def jerlov_text(metadata: Mapping[str, Any], sd_kd: "np.ndarray") -> str:
    """The nearest Jerlov type: how far it is, and how far the fit itself may be off, both as the
    root mean square of ln Kd over the bands.

    >>> import numpy as np
    >>> found = {"nearest_jerlov_type": "IB", "nearest_jerlov_rms_ln_kd": 0.14}
    >>> jerlov_text(found, np.array([0.3, 0.4]))
    'nearest Jerlov type: IB (14 % off; Kd itself is known to 35 %)'
    """
    off, own = metadata["nearest_jerlov_rms_ln_kd"], math.sqrt(float((sd_kd**2).mean()))
    return (
        f"nearest Jerlov type: {metadata['nearest_jerlov_type']} ({100 * off:.0f} % off; Kd itself "
        f"is known to {100 * own:.0f} %)"
    )


def with_endings(stem: Path, *endings: str) -> list[Path]:
    """STEM with each ending."""
    return [stem.with_name(stem.name + ending) for ending in endings]


def check_outputs(outputs: Iterable[Path], inputs: Iterable[Path], overwrite: bool) -> None:
    """ValueError, before the work, where a result could not or must not be written.

    A result must not replace what the command reads, whatever links or letters its name is spelt
    with, nor a file that oceaninv did not write, unless `overwrite`.
    """
    from oceaninv.foundation.atomic_write import check_writable

    inputs = list(inputs)
    for output in outputs:
        if output.exists() and not overwrite:
            same = next((path for path in inputs if path.exists() and path.samefile(output)), None)
            if same is not None:
                raise ValueError(
                    f"the result {output} would replace the input {same}: name another output "
                    "with -o, or use --overwrite."
                )
        check_writable(output, overwrite=overwrite)


def preload() -> None:
    """Import what the results are written with while the compiler keeps the other core busy."""
    import threading

    def load():
        import h5netcdf  # noqa: F401
        import matplotlib.backends.backend_agg
        import matplotlib.figure  # noqa: F401

    threading.Thread(target=load, daemon=True).start()

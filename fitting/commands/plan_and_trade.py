"""`oceaninv plan` and `oceaninv trade`."""

import html
from pathlib import Path
from typing import Annotated

import typer

from fitting.commands.shared_options import Overwrite, check_outputs, status, with_endings
from oceaninv.foundation.provenance import record_inputs

SceneFile = Annotated[Path, typer.Argument(help="Scene file (toml).")]
Quantity = Annotated[str, typer.Option(help="irradiance, radiance or photograph.")]


def plan_command(
    path: SceneFile,
    tolerance: Annotated[float, typer.Option(help="Relative error to stay below.")] = 0.03,
    quantity: Quantity = "photograph",
) -> None:
    """Say which model of a scene is the cheapest that is good enough, and why."""
    import oceaninv as oi

    file = oi.load_scene(path)
    camera = file.camera if quantity == "photograph" else None
    depth = float(file.camera.position[2]) if quantity == "radiance" else None
    chosen = oi.plan(file.scene, tolerance, quantity, depth=depth, camera=camera)
    print(f"{chosen.transport!r}")
    print(f"predicted error {100 * chosen.predicted_error:.2g} %, asked {100 * tolerance:.2g} %")
    dropped = [name for name, term in chosen.terms.items() if not term.kept]
    print(f"left out: {', '.join(dropped) or 'nothing'}; bands: {len(chosen.bands)}")
    for reason in chosen.why.rstrip(".").split("; "):
        print(f"  {reason}")


def trade_command(
    paths: Annotated[
        list[Path], typer.Argument(help="Scene files (toml); with --fit one cast or chart file.")
    ],
    quantity: Quantity = "photograph",
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="Stem of the files to write; of many scenes, their folder."
        ),
    ] = None,
    repeats: Annotated[
        int, typer.Option(help="Runs, of which the median counts; fewer of slow models.", min=1)
    ] = 7,
    inelastic: Annotated[
        bool, typer.Option(help="Add Raman scattering and the fluorescence of chlorophyll.")
    ] = False,
    fit: Annotated[
        bool, typer.Option("--fit", help="Run the fit of a profile through every transport.")
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    """Run every model of a scene: error against time as STEM.csv and STEM.png.

    Of many scenes also a table, choose_QUANTITY.md: the fastest model within 30, 10, 3 and 1 %, of
    all scenes whose rows lie in the folder.  With --fit, how the constituents of a depth profile
    move when its model of the light is cheapened.
    """
    if fit:
        if len(paths) != 1:
            raise ValueError(f"--fit takes one file; {len(paths)} were given.")
        _trade_of_fit(paths[0], output, repeats, overwrite)
        return
    if len(paths) == 1:
        stem = Path(f"{paths[0].stem}_trade") if output is None else output
        _trade_of_scene(paths[0], stem, quantity, repeats, inelastic, overwrite)
        return
    from oceaninv.fidelity.trade_off import how_to_choose, load_rows
    from oceaninv.foundation import provenance
    from oceaninv.foundation.atomic_write import atomic_write, checksum_line, with_checksum

    folder = output or Path("trade")
    folder.mkdir(parents=True, exist_ok=True)
    ending = "_inelastic" if inelastic else ""
    stems = [folder / f"{path.stem}{ending}_{quantity}" for path in paths]
    table = folder / f"choose_{quantity}.md"
    outputs = [file for stem in stems for file in with_endings(stem, ".csv", ".png")]
    check_outputs([*outputs, table], paths, overwrite)
    record_inputs(paths)
    for path, stem in zip(paths, stems, strict=True):
        _trade_of_scene(path, stem, quantity, repeats, inelastic, overwrite)
    found = sorted(folder.glob(f"*_{quantity}.csv"))
    made_by = html.escape("\n".join(provenance.current().lines))
    rows = how_to_choose([load_rows(path) for path in found])
    text = f"<!-- {checksum_line()}\n{made_by} -->\n{rows}"
    with atomic_write(table, overwrite=overwrite) as temporary:
        temporary.write_text(with_checksum(text))
    print(f"wrote {table}")


def _trade_of_scene(
    path: Path, stem: Path, quantity: str, repeats: int, inelastic: bool, overwrite: bool
) -> None:
    import dataclasses

    import oceaninv as oi
    from oceaninv.fidelity.trade_off import draw_rows, measure, save_rows

    file = oi.load_scene(path)
    scene, title = file.scene, file.title
    stem.parent.mkdir(parents=True, exist_ok=True)
    data, image = with_endings(stem, ".csv", ".png")
    check_outputs([data, image], file.files, overwrite)
    record_inputs(file.files)
    if inelastic:
        glow = oi.Inelastic(oi.Raman(), oi.ChlorophyllFluorescence())
        scene, title = dataclasses.replace(scene, inelastic=glow), f"{title}, inelastic"
    with status(f"running the candidate models on {path.name}"):
        trade = measure(scene, file.camera, quantity, repeats, title)
    _print_trade(trade)
    if scene.objects or scene.lamps:
        print("left out: objects and lamps")
    save_rows(data, trade, overwrite=overwrite)
    draw_rows(image, trade, overwrite=overwrite)
    print(f"wrote {data} and {image}")


def _print_trade(trade) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"{trade.title}: {trade.quantity}", title_justify="left")
    for name in ("model", "ms", "compile s", "error %", "best"):
        table.add_column(name, justify="left" if name == "model" else "right")
    for row in trade.rows:
        numbers = (
            f"{1e3 * row.seconds:.3g}",
            f"{row.compile_seconds:.2g}",
            f"{100 * row.error:.2g}",
        )
        table.add_row(row.model, *numbers, "*" if row.best else "")
    Console().print(table)
    print(f"the reference's own error: {100 * trade.reference_error:.2g} %")


def _trade_of_fit(path: Path, output: Path | None, repeats: int, overwrite: bool) -> None:
    from rich.console import Console
    from rich.table import Table

    from fitting.commands.fit_trade_off import draw_fits, measure_fits, save_fits
    from fitting.files.cast_file import read_cast

    data, image = with_endings(output or Path(f"{path.stem}_trade"), ".csv", ".png")
    check_outputs([data, image], [path], overwrite)
    record_inputs([path])
    profile = read_cast(path)
    with status("fitting through every transport"):
        rows = measure_fits(profile, repeats)
    names = list(rows[0].value)
    table = Table(title=f"{path.name}: fits", title_justify="left")
    for name in ("model", "s", *names, "largest shift (sd)"):
        table.add_column(name, justify="left" if name == "model" else "right")
    for row in rows:
        cells = [f"{row.value[n]:.3g} ({row.low[n]:.2g} - {row.high[n]:.2g})" for n in names]
        table.add_row(row.model, f"{row.seconds:.2g}", *cells, f"{max(row.shift.values()):.2f}")
    Console().print(table)
    save_fits(data, rows, overwrite=overwrite)
    draw_fits(image, rows, path.name, overwrite=overwrite)
    print(f"wrote {data} and {image}")

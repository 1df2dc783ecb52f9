"""`oceaninv plan` and `oceaninv trade`."""

from pathlib import Path
from typing import Annotated

import typer

from fitting.commands.common import Output, status

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
    path: SceneFile,
    quantity: Quantity = "photograph",
    output: Output = None,
    repeats: Annotated[int, typer.Option(help="Runs, of which the median counts.", min=1)] = 7,
) -> None:
    """Run every model of a scene: error against time as STEM.csv and STEM.png."""
    from rich.console import Console
    from rich.table import Table

    import oceaninv as oi
    from fitting.trade import draw_rows, measure, save_rows

    file = oi.load_scene(path)
    with status("running the ladder"):
        rows, doubt = measure(file.scene, file.camera, quantity, repeats)
    table = Table(title=f"{file.title}: {quantity}", title_justify="left")
    for name in ("model", "ms", "compile s", "error %", "best"):
        table.add_column(name, justify="left" if name == "model" else "right")
    for row in rows:
        numbers = (
            f"{1e3 * row.seconds:.3g}",
            f"{row.compile_seconds:.2g}",
            f"{100 * row.error:.2g}",
        )
        table.add_row(row.model, *numbers, "*" if row.best else "")
    Console().print(table)
    print(f"the reference's own error: {100 * doubt:.2g} %")
    if file.scene.objects or file.scene.lamps or file.scene.inelastic is not None:
        print("left out: objects, lamps and inelastic light")
    stem = output or Path(f"{path.stem}_trade")
    data, image = stem.with_name(stem.name + ".csv"), stem.with_name(stem.name + ".png")
    save_rows(data, rows, doubt, quantity)
    draw_rows(image, rows, doubt, f"{file.title}: {quantity}")
    print(f"wrote {data} and {image}")

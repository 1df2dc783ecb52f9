"""`oceaninv render`."""

from pathlib import Path
from typing import Annotated, Any

import typer

from fitting.commands.shared_options import TRANSPORTS, Overwrite, check_outputs, transport_class
from oceaninv.foundation.provenance import record_inputs


def render_command(
    path: Annotated[Path, typer.Argument(help="Scene file (toml).")],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            help=".exr (float, layers), .tif (16 bit, linear) or .png (sRGB).",
            rich_help_panel="Output",
        ),
    ],
    transport: Annotated[
        str | None,
        typer.Option(
            help="One of " + ", ".join(TRANSPORTS) + "; without it two-stream, and plane-parallel "
            "for layers and inelastic light.",
            rich_help_panel="Model",
        ),
    ] = None,
    seed: Annotated[
        int, typer.Option(help="Of the sensor's noise and of monte-carlo.", rich_help_panel="Model")
    ] = 0,
    bands: Annotated[
        int | None, typer.Option(help="Bands instead of the file's.", rich_help_panel="Model")
    ] = None,
    width: Annotated[
        int | None,
        typer.Option(help="Pixels across instead of the file's.", rich_help_panel="Output"),
    ] = None,
    steps: Annotated[
        int, typer.Option(help="Steps along a line of sight for shadows.", rich_help_panel="Model")
    ] = 48,
    paths: Annotated[
        int, typer.Option(help="monte-carlo: paths per pixel.", rich_help_panel="Model")
    ] = 256,
    spectral: Annotated[
        bool, typer.Option("--spectral", help="EXR of every band.", rich_help_panel="Output")
    ] = False,
    linear: Annotated[
        bool, typer.Option("--linear", help="PNG of 16 bits, linear.", rich_help_panel="Output")
    ] = False,
    white_balance: Annotated[
        str | None,
        typer.Option(
            metavar="surface|depth|none|COLUMN,ROW",
            help="Of an sRGB .png: what looks grey, a card in the light above the surface, in that "
            "which comes down at the camera's depth (the default, surface where lamps shine), or "
            "as seen at a pixel (from 0, top left).",
            rich_help_panel="Output",
        ),
    ] = None,
    animate: Annotated[
        int | None,
        typer.Option(
            help="Draw this many frames of --rise or --seconds.", rich_help_panel="Animation"
        ),
    ] = None,
    rise: Annotated[
        float | None,
        typer.Option(
            help="Metres that --animate lifts the camera (1; with --seconds 0).",
            rich_help_panel="Animation",
        ),
    ] = None,
    seconds: Annotated[
        float,
        typer.Option(
            help="For which --animate lets the waves of the surface travel.",
            rich_help_panel="Animation",
        ),
    ] = 0.0,
    overwrite: Overwrite = False,
) -> None:
    """Draw a scene."""
    import dataclasses

    from rich.console import Console
    from rich.progress import Progress

    from oceaninv import load_scene
    from oceaninv.rendering import render

    if output.suffix.lower() not in (".exr", ".tif", ".tiff", ".png"):
        raise ValueError(f"--output is {output}; it must end in .exr, .tif or .png.")
    if bands is not None and bands < 2:
        raise ValueError(f"--bands is {bands}; at least 2 are needed.")
    if steps < 1 or paths < 1:
        raise ValueError(f"--steps {steps} and --paths {paths} must be at least 1.")
    balance = _white_balance(white_balance)
    if animate is not None and animate < 2:
        raise ValueError(f"--animate is {animate}; it must be at least 2 frames.")
    found = load_scene(path, bands=bands)
    if width is not None:
        found = dataclasses.replace(found, camera=_resized(found.camera, width))
    if transport is None:
        transport = _default_transport(found.scene)
    model = _transport(transport, found, steps, paths)
    rise = (0.0 if seconds else 1.0) if rise is None else rise
    frames = [(output, found)]
    if animate is not None:
        frames = _frames(found, output, animate, rise, seconds)
    check_outputs([target for target, _ in frames], found.files, overwrite)
    record_inputs(found.files)
    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(found.title, total=len(frames))
        for i, (target, frame) in enumerate(frames):
            picture = render.draw(
                frame,
                model,
                seed=seed + i,
                veil=output.suffix.lower() == ".exr",
                progress=lambda share, i=i: bar.update(task, completed=i + share),
            )
            note = render.metadata(path, frame, model, seed + i, picture)
            render.save(
                target,
                frame,
                picture,
                note,
                linear=linear,
                spectral=spectral,
                seed=seed + i,
                white_balance=balance,
                overwrite=overwrite,
            )
    names = str(output) if animate is None else f"{frames[0][0]} ... {frames[-1][0].name}"
    print(f"wrote {names}: {found.camera.width} x {found.camera.height}, {transport}")


def _default_transport(scene) -> str:
    """The fastest that solves the scene."""
    from oceaninv import Layers

    exact = isinstance(scene.water, Layers) or scene.inelastic is not None
    return "plane-parallel" if exact else "two-stream"


def _transport(name: str, found, steps: int, paths: int):
    import oceaninv as oi

    model = transport_class(name)
    if name == "monte-carlo":
        return model(paths=paths)
    arguments = {"kd": {"kd": found.kd}, "plane-parallel": {"knots": 48}}.get(name, {})
    base = model(**arguments)
    scene = found.scene
    waves = scene.surface is not None and scene.surface.waves is not None
    return oi.WithObjects(base, steps) if scene.objects or scene.lamps or waves else base


def _white_balance(text: str | None) -> str | tuple[int, int] | None:
    from oceaninv.rendering.display import WHITE_BALANCES

    if text is None or text in WHITE_BALANCES:
        return text
    parts = text.split(",")
    if len(parts) != 2 or not all(part.strip().isdecimal() for part in parts):
        raise ValueError(
            f"--white-balance is {text!r}; it must be {', '.join(WHITE_BALANCES)} or the column "
            "and row of a pixel, such as 120,80."
        )
    return int(parts[0]), int(parts[1])


def _resized(camera, width: int):
    import dataclasses

    if width < 1:
        raise ValueError(f"--width is {width}; it must be at least 1.")
    height = max(round(camera.height * width / camera.width), 1)
    return dataclasses.replace(camera, width=width, height=height)


def _frames(found, output: Path, count: int, rise: float, seconds: float):
    """Names and scenes of an animation: the camera moves straight up by `rise` metres while waves
    travel for some seconds."""
    import dataclasses

    surface: Any = found.scene.surface
    waves: Any = None if surface is None else surface.waves
    if seconds and waves is None:
        raise ValueError(f"--seconds is {seconds:g}, but the scene has no [surface.waves].")

    start = found.camera.position
    depth = float(start[2])
    limit = None if found.scene.floor is None else float(found.scene.floor.depth)
    if depth - rise < 0 or (limit is not None and depth - rise >= limit):
        raise ValueError(
            f"--rise is {rise:g}, which takes the camera from {depth:g} m out of the water."
        )
    frames = []
    for i in range(count):
        up = rise * i / (count - 1)
        camera = dataclasses.replace(found.camera, position=start.at[2].add(-up))
        name = output.with_name(f"{output.stem}_{i + 1:04d}{output.suffix}")
        frame = dataclasses.replace(found, camera=camera)
        if surface is not None and waves is not None:
            moved = dataclasses.replace(waves, time=waves.time + seconds * i / (count - 1))
            scene = dataclasses.replace(
                found.scene, surface=dataclasses.replace(surface, waves=moved)
            )
            frame = dataclasses.replace(frame, scene=scene)
        frames.append((name, frame))
    return frames

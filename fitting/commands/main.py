"""The command `oceaninv`."""

import os
import sys
import warnings
from typing import Annotated

import typer

from fitting.commands import (
    check,
    fit_photo,
    fit_profile,
    pick,
    plan_and_trade,
    read_charts,
    render,
    rerun,
    template,
)
from oceaninv.foundation.provenance import Provenance, recording, version

INPUT_ERROR = 3

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Water constituents from underwater light, with honest intervals.",
    epilog="Exit status: 0 done, 1 check found problems, 2 wrong options, 3 bad input.",
)


# The commands, each with an example.
for _command, _example in (
    (fit_profile.fit_profile_command, "fit-profile cast.csv --layers auto -o cast_fit"),
    (fit_photo.fit_photo_command, 'fit-photo dive.csv --depth 5+-1 --camera "Nikon D810" --report'),
    (pick.pick_command, "pick dive.dng"),
    (
        read_charts.read_charts_command,
        'read-charts dive.dng --chart "A ColorChecker24 2.5 find" -o dive',
    ),
    (rerun.rerun_command, "rerun cast_fit.nc -o cast_again.nc"),
    (check.check_command, "check dive.dng dive.csv"),
    (render.render_command, "render scene.toml --width 640 -o scene.png"),
    (plan_and_trade.plan_command, "plan scene.toml --tolerance 0.03"),
    (plan_and_trade.trade_command, "trade scene.toml --quantity irradiance -o scene_trade"),
    (template.cameras_command, "cameras"),
    (template.template_command, "template photo -o dive.csv"),
):
    _name = _command.__name__.removesuffix("_command").replace("_", "-")
    app.command(_name, epilog=f"Example: oceaninv {_example}")(_command)


def _print_version(asked: bool | None) -> None:
    if asked:
        print(f"oceaninv {version()}")
        raise typer.Exit


@app.callback()
def _commands(
    asked: Annotated[
        bool | None,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version and exit."
        ),
    ] = None,
) -> None:
    """Water constituents from underwater light, with honest intervals."""


def quick_compilation(drawing: bool = False) -> None:
    """Halve compile times on a CPU; must come before JAX starts its backend.

    The flags are those of stored programs (`fitting.core.program_cache.QUICK`).  A picture is worth
    optimising (`drawing`); there the older generator of code is eight times faster, too.
    """
    from fitting.core.program_cache import QUICK, knows_quick_options

    if knows_quick_options():
        flags = [f"--{name}={str(value).lower()}" for name, value in QUICK.items()]
        if drawing:
            flags = [flag for flag in flags if "optimization_level" not in flag]
        os.environ["XLA_FLAGS"] = " ".join([os.environ.get("XLA_FLAGS", ""), *flags]).strip()


def _set_up(drawing: bool = False, fitting: bool = False) -> None:
    """float64 and a cache of compiled programs; must come before the first array.

    Fits keep their programs themselves (`fitting.core.program_cache`), JAX those of other commands.
    """
    quick_compilation(drawing)
    import jax

    from fitting.core.program_cache import program_folder

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_compilation_cache_dir", str(program_folder()))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
    jax.config.update("jax_enable_compilation_cache", not fitting)


def _show_warning(message, category, filename, lineno, file=None, line=None) -> None:
    if issubclass(category, UserWarning):
        print(f"oceaninv: {message}", file=sys.stderr)


def run(arguments: list[str]) -> int:
    """Run one command; returns the exit code, 3 after a sentence about bad input.

    A UserWarning is printed as its sentence; other warnings, which name lines of code, are not.
    """
    try:
        made_by = Provenance(tuple(arguments))
        with recording(made_by), warnings.catch_warnings():
            warnings.simplefilter("always", UserWarning)
            warnings.showwarning = _show_warning
            app(arguments, standalone_mode=True)
    except (ValueError, OSError) as error:
        print(f"oceaninv: {error}", file=sys.stderr)
        return INPUT_ERROR
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def main() -> None:
    """The console script."""
    # `trade` times its programs: they are optimised as those of a picture are.
    command = "".join(sys.argv[1:2])
    _set_up(
        command in ("render", "trade"), fitting=command.startswith("fit-") or command == "rerun"
    )
    if command == "trade":  # a program that was stored would not count as compiled
        import jax

        jax.config.update("jax_compilation_cache_dir", None)
        jax.config.update("jax_enable_compilation_cache", False)
    sys.exit(run(sys.argv[1:]))


if __name__ == "__main__":
    main()

"""Pictures of fits."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fitting.core.result import LEVEL, Fit, Quantity
from fitting.report._bulk_picture import draw_coefficients
from oceaninv.foundation.figure_file import save_figure
from oceaninv.foundation.provenance import without_folders

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def picture(
    fit: Fit, path: str | Path, constituents: Fit | None = None, *, overwrite: bool = False
) -> None:
    """Write the figure of a fit as PNG."""
    save_figure(figure_of(fit, constituents), path, dpi=130, overwrite=overwrite)


def figure_of(fit: Fit, constituents: Fit | None = None) -> "Figure":
    """Draw a fit: observations against the model, spectra with 95 % bands, unknowns."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    reflectance = "Rrs" in fit.quantities or "R" in fit.quantities
    numbers = sum(not p.nuisance for p in (constituents or fit).parameters)
    numbers += (
        sum(q.value.ndim == 0 for q in constituents.quantities.values()) if constituents else 0
    )
    height = max(4.6, 0.38 * numbers if constituents is not None else 0.0)
    figure = Figure(figsize=(16.0 if reflectance else 12.5, height))
    FigureCanvasAgg(figure)
    # Fixed margins: a computed layout would draw everything twice.
    margins = {"left": 0.06, "right": 0.985, "bottom": 0.12, "top": 0.87, "wspace": 0.25}
    widths = (1.15, 1, *([1] if reflectance else []), 1)
    places = figure.subplots(1, len(widths), width_ratios=widths, gridspec_kw=margins)
    data, spectra, unknowns = places[0], places[1], places[-1]
    if reflectance:
        _draw_reflectance(places[2], fit)
    if "coefficient" in fit.posterior_predictive.axes:
        draw_coefficients(data, spectra, fit)
    else:
        draw = _draw_profile if "depth" in fit.posterior_predictive.axes else _draw_readings
        draw(data, fit)
        _draw_spectra(spectra, fit, constituents)
    _draw_unknowns(unknowns, constituents or fit, fit)
    # Do not print absolute local paths in a picture: pictures are shared.
    title = without_folders(str(fit.metadata.get("source", "")))
    figure.suptitle(title, fontsize=9, color="0.35")
    return figure


def _draw_profile(axes, fit: Fit) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    predictive = fit.posterior_predictive
    depth = predictive.coords["depth"]
    used = np.isfinite(predictive.observed).any(axis=1)
    for i, wavelength in enumerate(fit.wavelength):
        colour = wavelength_colour(wavelength)
        observed, predicted = predictive.observed[:, i], predictive.predicted[:, i]
        kept = np.isfinite(observed)
        axes.plot(observed[kept], depth[kept], ".", ms=4, color=colour, alpha=0.55)
        label = f"{wavelength:g} nm" if len(fit.wavelength) <= 8 else None
        axes.plot(predicted[kept], depth[kept], "-", lw=1.4, color=colour, label=label)
        if len(fit.wavelength) <= 8:
            half = 1.96 * predictive.sd[:, i][kept]
            # The axis is logarithmic: what the noise floor takes below zero ends at a hundredth.
            low = np.maximum(predicted[kept] - half, 0.01 * predicted[kept])
            high = predicted[kept] + half
            axes.fill_betweenx(depth[kept], low, high, color=colour, alpha=0.12, lw=0)
    axes.set(xscale="log", xlabel="Ed (W m⁻² nm⁻¹)", ylabel="depth (m)")
    axes.set_ylim(depth[used].max() * 1.03, 0)
    light = predictive.observed[predictive.observed > 0]
    wide = light.max() > 300.0 * light.min()
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0,) if wide else (1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    bands = ", 95 % of samples (bands)" if len(fit.wavelength) <= 8 else ""
    axes.set_title(f"measured (dots), fitted (lines){bands}", fontsize=10)
    if len(fit.wavelength) <= 8:
        axes.legend(frameon=False, fontsize=9)


def _draw_readings(axes, fit: Fit) -> None:
    predictive = fit.posterior_predictive
    for i, (name, colour) in enumerate(
        zip("RGB", ("tab:red", "tab:green", "tab:blue"), strict=True)
    ):
        axes.errorbar(
            predictive.predicted[:, i],
            predictive.observed[:, i],
            predictive.sd[:, i],
            fmt="o",
            ms=4,
            lw=0.8,
            color=colour,
            label=name,
        )
    low = np.nanmin(predictive.observed) * 0.9
    high = np.nanmax(predictive.observed) * 1.1
    axes.plot([low, high], [low, high], "-", lw=0.8, color="0.5")
    axes.set(xlabel="fitted linear camera value", ylabel="read from the photograph")
    axes.set_title("readings", fontsize=10)
    axes.legend(frameon=False, fontsize=9)


def _draw_spectra(axes, fit: Fit, constituents: Fit | None) -> None:
    named = [("Kd", "tab:blue"), ("Ku", "tab:green"), ("KLu", "tab:purple"), ("c", "tab:orange")]
    shown = [("Kd, model", constituents, "Kd", "0.45")] if constituents is not None else []
    shown += [(name, fit, name, colour) for name, colour in named if name in fit.quantities]
    for label, source, name, colour in shown:
        _draw_spectrum(axes, source.wavelength, source.quantities[name], label, colour, source.dof)
    axes.set(xlabel="wavelength (nm)", ylabel="coefficient (m⁻¹)")
    # Bands that are hardly known would hide the others.
    known = [
        np.nanmax(np.where(q.sd < 0.5, q.value * np.exp(2.0 * q.sd), np.nan))
        for _, source, name, _ in shown
        if np.any((q := source.quantities[name]).sd < 0.5)
    ]
    axes.set_ylim(0, 1.15 * max(known) if known else None)
    axes.set_title("attenuation with 95 % intervals", fontsize=10)
    axes.legend(frameon=False, fontsize=9)


def _draw_spectrum(axes, wavelength, quantity: Quantity, label: str, colour: str, dof=None) -> None:
    low, high = quantity.interval(LEVEL, dof)
    if len(wavelength) > 8:
        axes.fill_between(wavelength, low, high, color=colour, alpha=0.25, lw=0)
        axes.plot(wavelength, quantity.value, color=colour, label=label)
        return
    # Where a model does not describe its data, a coefficient can come out negative, and the ends of
    # its interval, which are multiples of it, the wrong way round.
    low, high = np.minimum(low, high), np.maximum(low, high)
    error = np.stack([quantity.value - low, high - quantity.value])
    form = {"fmt": "o", "ms": 5, "capsize": 3, "color": colour, "label": label}
    axes.errorbar(wavelength, quantity.value, error, **form)


def _draw_reflectance(axes, fit: Fit) -> None:
    for name, label, colour in (("Rrs", "Rrs (sr⁻¹)", "tab:purple"), ("R", "R", "tab:green")):
        if name in fit.quantities:
            _draw_spectrum(axes, fit.wavelength, fit.quantities[name], label, colour)
    axes.set(xlabel="wavelength (nm)", ylabel="reflectance")
    axes.set_ylim(0, None)
    axes.set_title("reflectance with 95 % intervals", fontsize=10)
    axes.legend(frameon=False, fontsize=9)


def _draw_unknowns(axes, fit: Fit, plain: Fit) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    # Many bands are drawn among the spectra already, and those of `plain` always.
    others = plain.numbers() if plain is not fit else []
    rows = [n for n in [*fit.numbers(), *others] if n.wavelength is None and n.name != "PAR_0"]
    if len(fit.wavelength) <= 8 or not rows:
        rows = [n for n in fit.numbers() if n.wavelength is not None] + rows
    # Between many rows there is no room for a second line.
    gap = ", " if len(rows) > 10 else "\n"
    for y, number in enumerate(reversed(rows)):
        colour, ends = "tab:blue" if number.identifiable else "0.6", [number.low, number.high]
        axes.plot(ends, [y, y], "-", lw=5, color=colour, alpha=0.5, solid_capstyle="butt")
        text = f"{number.name} ({number.unit})"
        if number.identifiable:
            axes.plot(number.value, y, "o", ms=5, color=colour)
        else:
            text += f"{gap}{number.value_text}"
        axes.text(0.02, y + 0.16, text, fontsize=8, transform=axes.get_yaxis_transform())
    axes.set(xscale="log", yticks=[], ylim=(-0.5, len(rows)), xlabel="value (95 % interval)")
    ends = np.array([(number.low, number.high) for number in rows])
    if ends.size and np.nanmax(ends) < 30.0 * np.nanmin(ends):
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    else:
        axes.xaxis.set_major_locator(LogLocator(numticks=6))
    # Plain numbers: setting powers of ten as mathematics takes longer than the whole drawing.
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_title("water", fontsize=10)


def wavelength_colour(wavelength: float) -> tuple[float, float, float]:
    """A legible screen colour for a band (nm): violet to red, darkened for paper."""
    import matplotlib

    spectrum = matplotlib.colormaps["turbo"]
    red, green, blue, _ = spectrum(float(np.clip((wavelength - 370.0) / 340.0, 0.02, 0.98)))
    return 0.85 * red, 0.85 * green, 0.85 * blue


# `Fit` lies in a package below this one and must not import it.
Fit.draw = staticmethod(figure_of)

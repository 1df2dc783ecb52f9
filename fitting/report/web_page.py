"""A fit as one web page that needs nothing else: tables, flags, pictures."""

import base64
import html
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from fitting.core.result import LEVEL, Fit, Number, sensitivity_text
from fitting.report.picture import picture
from oceaninv.foundation import provenance
from oceaninv.foundation.atomic_write import atomic_write, checksum_line, with_checksum

_STYLE = (
    "body{font:15px/1.45 sans-serif;max-width:62em;margin:2em auto;padding:0 1em;color:#222}"
    "table{border-collapse:collapse;margin:.6em 0}td,th{padding:.2em .8em;border-bottom:1px solid "
    "#ddd;text-align:right}td:first-child,th:first-child{text-align:left}img{max-width:100%}"
    ".no{color:#a40}caption{text-align:left;color:#666;padding-bottom:.3em}"
)


def write_html(
    fit: Fit,
    path: str | Path,
    pictures: Sequence[tuple[str, str | Path]] = (),
    *,
    overwrite: bool = False,
) -> None:
    """Write a fit as a self-contained page.

    `pictures`: (caption, PNG file), shown after the picture of the fit and stored inside the page.
    """
    water = "".join(map(_row, fit.numbers()))
    named = [p for p in fit.parameters if not p.nuisance]
    names = [p.name for p in named]
    index = [fit.parameters.names.index(n) for n in names]
    correlation = "".join(
        f"<tr><td>{a}</td>" + "".join(f"<td>{fit.correlation[i, j]:+.2f}</td>" for j in index)
        + "</tr>"
        for a, i in zip(names, index, strict=True)
    )  # fmt: skip
    sensitivity = _shifts(fit.sensitivity)
    facts = "".join(
        f"<tr><td>{html.escape(k.replace('_', ' '))}</td><td style='text-align:left'>"
        f"{html.escape(f'{v:.3g}' if isinstance(v, float) else str(v))}</td></tr>"
        for k, v in {**fit.facts, **provenance.current().facts}.items()
    )
    with tempfile.TemporaryDirectory() as folder:
        drawn = Path(folder) / "fit.png"
        picture(fit, drawn)
        images = "".join(
            f"<h2>{html.escape(title)}</h2><img alt='{html.escape(title)}' src='data:image/png;"
            f"base64,{base64.b64encode(Path(file).read_bytes()).decode()}'>"
            for title, file in [("Readings, attenuation, water", drawn), *pictures]
        )
    page = (
        f"<!doctype html><!-- {checksum_line()} --><html lang='en'><meta charset='utf-8'>"
        "<title>Water from photographs</title>"
        f"<style>{_STYLE}</style>{_doubt(fit)}<h1>Water from photographs</h1>"
        f"<p>Search: {html.escape(fit.result)}.</p><table><caption>{_caption(fit)}</caption><tr>"
        f"<th>quantity</th><th>unit</th><th>value</th><th>{LEVEL:.0%} interval</th></tr>{water}"
        f"</table>{images}<h2>Correlations</h2><table><tr><th></th>"
        + "".join(f"<th>{n}</th>" for n in names)
        + f"</tr>{correlation}</table><h2>What each answer is sensitive to</h2><table>"
        "<caption>relative change if the assumption moved by one standard deviation</caption>"
        f"{sensitivity}</table>{_fixed(fit)}<h2>Data and model</h2><table>{facts}</table></html>\n"
    )
    with atomic_write(path, overwrite=overwrite) as temporary:
        temporary.write_text(with_checksum(page), encoding="utf-8")


def _doubt(fit: Fit) -> str:
    return f"<p class='no'>{html.escape(fit.doubt)}</p>" if fit.doubt else ""


def _fixed(fit: Fit) -> str:
    """The sensitivity of fits of photographs to what their model fixes."""
    from fitting.photo.assumptions import assumptions
    from fitting.photo.problem import PhotoProblem
    from fitting.water_model.alternatives import ALTERNATIVES

    if not isinstance(fit.problem, PhotoProblem):
        return ""
    rows = _shifts(assumptions(fit))
    meant = "; ".join(f"{name}: {words}" for name, words in ALTERNATIVES.items())
    return (
        "<table><caption>relative change if the model took something else for granted</caption>"
        f"{rows}</table><p>{html.escape(meant)}.</p>"
    )


def _caption(fit: Fit) -> str:
    text = "Where the data do not determine a number, only its interval is given."
    if fit.bias is not None:
        text += " Constituents are corrected for the curvature of the model (Box 1971)."
    return text


def _row(number: Number) -> str:
    best = html.escape(number.value_text)
    best = best if number.identifiable else f"<span class='no'>{best}</span>"
    return (
        f"<tr><td>{html.escape(number.name)}</td><td>{html.escape(number.unit)}</td>"
        f"<td>{best}</td><td>{number.interval_text}</td></tr>"
    )


def _shifts(by_answer: Mapping[str, Mapping[str, float]]) -> str:
    """Rows of a table: each answer, and what it is most sensitive to."""
    return "".join(
        f"<tr><td>{name}</td><td style='text-align:left'>"
        f"{html.escape(sensitivity_text(shifts, 3))}</td></tr>"
        for name, shifts in by_answer.items()
    )

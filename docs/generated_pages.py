"""MkDocs hook: pages that are made from files of the repository whenever the site is built.

Notebooks with their outputs, acceptance tables, benchmarks, errata, keys of scene files, the change
log and the guide for contributors are taken as they stand in the repository, help texts from the
command itself, so that the site cannot differ from them.
"""

import base64
import io
import json
import os
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files, InclusionLevel

ROOT = Path(__file__).parents[1]
TABLES = {"acceptance": "Acceptance", "benchmarks": "Benchmarks"}
COPIES = {
    "physics/errata.md": "ERRATA.md",
    "files/scenes.md": "scenes/README.md",
    "develop/contributing.md": "CONTRIBUTING.md",
    "develop/conduct.md": "CODE_OF_CONDUCT.md",
    "develop/changelog.md": "CHANGELOG.md",
}
PICTURES = [
    "pictures/gallery.png",
    "pictures/red_sea_charts.png",
    "pictures/waters.png",
    "trade/clear_irradiance.png",
    "trade/clear_photograph.png",
]


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages and pictures to those of the folder `docs`."""
    pages = {page: copied(page, source) for page, source in COPIES.items()} | table_pages()
    pages["command_line.md"] = command_line()
    for name, content in pages.items():
        listed = not name.startswith(tuple(f"trust/{folder}/" for folder in TABLES))
        level = InclusionLevel.INCLUDED if listed else InclusionLevel.NOT_IN_NAV
        files.append(File.generated(config, name, content=content, inclusion=level))
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        for name, content in notebook_page(path).items():
            files.append(File.generated(config, name, content=content))
    files.append(File.generated(config, "images/photo_bounds.png", content=photo_bounds()))
    for name in PICTURES:
        source = str(ROOT / "scenes" / name)
        files.append(File.generated(config, f"images/{Path(name).name}", abs_src_path=source))
    return files


def copied(page: str, source: str) -> str:
    """The text of `source`, a file of the repository, with its links as seen from `page`."""
    pages = {file: name for name, file in COPIES.items()}

    def link(found: re.Match[str]) -> str:
        target = pages.get(found[1], found[1].removeprefix("docs/"))
        return f"]({os.path.relpath(target, Path(page).parent)})"

    return re.sub(r"\]\(([\w/.]+\.md)\)", link, (ROOT / source).read_text(encoding="utf-8"))


def table_pages() -> dict[str, str]:
    """Every acceptance table and benchmark as a page, and the list of them."""
    pages, index = {}, ["# Tables", "", LIST_OF_TABLES]
    for folder, title in TABLES.items():
        index += ["", f"## {title}", ""]
        for path in sorted((ROOT / "tests" / folder).glob("*.md")):
            if path.stem == "README":
                continue
            text = path.read_text(encoding="utf-8")
            heading = text.splitlines()[0].removeprefix("# ")
            pages[f"trust/{folder}/{path.name}"] = f"{HIDDEN}{text}"
            index.append(f"- [{path.stem}]({folder}/{path.name}): {heading}")
    index += ["", "## How the acceptance tables come about", ""]
    scripts = (ROOT / "tests" / "acceptance" / "README.md").read_text(encoding="utf-8")
    index.append(scripts.partition("\n")[2])
    pages["trust/tables.md"] = "\n".join(index)
    return pages


# Pages of tables are reached from the list of them, not from the menu.
HIDDEN = "---\nhide: [navigation]\n---\n\n"
LIST_OF_TABLES = (
    "Each table below was written by a script of the repository and is shown as it was committed. "
    "A script compares oceaninv with an exact solution, an independent program, or measurements."
)


# Protocols of the table of bounds that are drawn, with a label each.
PROTOCOLS = {
    "background": "open water alone",
    "single photo": "one photograph with charts",
    "three depths": "photographs at three depths",
    "three depths, a_y to 10 %": "three depths, CDOM known to 10 %",
}


def photo_bounds() -> bytes:
    """A picture of what photographs could tell at best, from the acceptance table of bounds."""
    from matplotlib.figure import Figure

    path = ROOT / "tests" / "acceptance" / "photo_rows_design.md"
    lines = path.read_text(encoding="utf-8").splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if "|" in line]
    quantities, values = rows[0][1:], {row[0]: row[1:] for row in rows[2:]}
    figure = Figure(figsize=(8, 4), layout="constrained")
    axis = figure.subplots()
    for protocol, label in PROTOCOLS.items():
        here = [float(cell.split("/")[1]) for cell in values[protocol]]
        axis.plot(here, range(len(here)), "o-", label=label)
    axis.axvline(0.5, color="0.5", ls=":", label="not identifiable to the right")
    axis.set(xscale="log", xlabel="least standard deviation of the logarithm (0.1: about 10 %)")
    axis.set_yticks(range(len(quantities)), quantities)
    axis.invert_yaxis()
    axis.legend(frameon=False, fontsize="small")
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=120)
    return drawn.getvalue()


def notebook_page(path: Path) -> dict[str, str | bytes]:
    """A notebook as it was stored: a page, and the pictures in it."""
    lines, pictures = [], {}
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] != "code":
            lines += [source, ""]
            continue
        lines += ["```python", source, "```", ""]
        for output in cell["outputs"]:
            data = output.get("data", {})
            text = "".join(output.get("text", data.get("text/plain", "")))
            if "image/png" in data:
                name = f"{path.stem}_{len(pictures) + 1}.png"
                pictures[f"notebooks/{name}"] = base64.b64decode("".join(data["image/png"]))
                lines += [f"![Output of the lines above]({name})", ""]
            elif text and output.get("name") != "stderr":
                lines += ["```text", text.rstrip("\n"), "```", ""]
    return {f"notebooks/{path.stem}.md": "\n".join(lines)} | pictures


def command_line() -> str:
    """The help of all commands, as Typer writes it in Markdown."""
    import typer
    from typer.main import get_command

    from fitting.commands.main import app

    command = get_command(app)
    lines = ["# Command line", "", "The text below is what `oceaninv COMMAND --help` says.", ""]
    lines += [f"{app.info.epilog}", ""]
    context = typer.Context(command, info_name="oceaninv")
    for name in command.list_commands(context):
        one = command.get_command(context, name)
        inner = typer.Context(one, info_name=name, parent=context)
        lines += [f"## oceaninv {name}", "", one.help or "", "", "```text"]
        lines += [one.get_usage(inner).removeprefix("Usage: "), "```", ""]
        lines += ["| option | what it does |", "|---|---|"]
        for parameter in one.get_params(inner):
            record = parameter.get_help_record(inner)
            if record is not None:
                option, text = (part.replace("|", "\\|").replace("\n", " ") for part in record)
                lines.append(f"| `{option}` | {text} |")
        lines.append("")
    return "\n".join(lines)

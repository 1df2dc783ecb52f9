"""Figures as PNG files."""

from pathlib import Path

from oceaninv.foundation import provenance
from oceaninv.foundation.atomic_write import MARK, atomic_write


def save_figure(figure, path: str | Path, *, dpi: int, overwrite: bool = False) -> None:
    """Write a matplotlib figure as PNG; ValueError for names that end otherwise.

    What made it stands in the text chunks Software and Comment.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise ValueError(f"cannot write {path}: name a file that ends in .png.")
    made_by = provenance.current()
    notes = {"Software": f"{MARK} {provenance.version()}", "Comment": "\n".join(made_by.lines)}
    with atomic_write(path, overwrite=overwrite) as temporary:
        figure.savefig(temporary, dpi=dpi, metadata=notes)

"""Pictures as files, by OpenImageIO."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from oceaninv.foundation import provenance
from oceaninv.foundation.atomic_write import MARK, atomic_write


def write_image(
    path: Path,
    values: np.ndarray,
    names: list[str],
    bits: str,
    note: Mapping[str, Any],
    *,
    overwrite: bool = False,
) -> None:
    """Write `values` (row, column, channel), whose channels are `names`.

    `bits`: float, uint16 or uint8; `note`: what the picture is, which stands as JSON, with what
    made it, in the description of the image.
    """
    import OpenImageIO as oiio

    height, width, count = values.shape
    spec = oiio.ImageSpec(width, height, count, bits)
    spec.channelnames = tuple(names)
    spec.attribute("ImageDescription", json.dumps({**note, **provenance.current().facts}))
    spec.attribute("Software", f"{MARK} {provenance.version()}")
    if bits == "uint8":
        spec.attribute("oiio:ColorSpace", "sRGB")
    with atomic_write(path, overwrite=overwrite) as draft:
        out = oiio.ImageOutput.create(str(draft))
        if out is None or not out.open(str(draft), spec):
            reason = oiio.geterror() if out is None else out.geterror()
            raise ValueError(f"cannot write {path}: {reason}.")
        written = out.write_image(np.ascontiguousarray(values, dtype=np.float32))
        if not written or not out.close():
            raise ValueError(f"cannot write {path}: {out.geterror()}.")

"""Pictures as files, by OpenImageIO."""

from pathlib import Path

import numpy as np

from oceaninv.foundation.atomic_write import MARK, atomic_write


def write_image(
    path: Path,
    values: np.ndarray,
    names: list[str],
    bits: str,
    note: str,
    *,
    overwrite: bool = False,
) -> None:
    import OpenImageIO as oiio

    height, width, count = values.shape
    spec = oiio.ImageSpec(width, height, count, bits)
    spec.channelnames = tuple(names)
    spec.attribute("ImageDescription", note)
    spec.attribute("Software", MARK)
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

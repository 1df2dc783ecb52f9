"""Regenerate two_stream_exact.csv: exact radiances and irradiances of 24 of the acceptance cases.

    python -m tests.reference.regenerate_two_stream

About two minutes; PythonicDISORT through tests/reference/disort.py.
"""

from pathlib import Path

import jax
import numpy as np

from tests.acceptance import two_stream_accuracy as accuracy

PATH = Path(__file__).with_name("two_stream_exact.csv")


def chosen():
    """One or two waters of each of the fifteen sun-only settings with an odd place in the list."""
    plain = [s for s in accuracy.settings() if not s[4]]
    return [(*s, (5 * k + 3) % 16) for k, s in enumerate(plain) if k % 3 != 2]


def rows():
    for case in chosen():
        truth = accuracy.exact(case)
        for key in ("whole", "levels", "Ed", "Eu", "E0"):
            yield case, key, np.ravel(truth[key])


def main():
    jax.config.update("jax_enable_x64", True)
    lines = [
        "# title: Exact radiance and irradiance of 24 waters, light of a sunbeam of irradiance 1",
        "# source: PythonicDISORT, 24 streams per hemisphere (regenerate_two_stream.py)",
        "# columns: phase, sun in air (deg), index or 0, floor reflectance or 0, water, quantity,"
        " values (whole: depth x view zenith x azimuth, 1/sr; levels: m)",
    ]
    for (name, sun, index, floor, _, i), key, values in rows():
        numbers = [f"{v:.5g}" for v in values]
        lines.append(
            ",".join([name, f"{sun:g}", str(index or 0), str(floor or 0), str(i), key, *numbers])
        )
    PATH.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()

"""More than 100,000 points at and between the corners of every public forward function's domain.

    python -m tests.acceptance.extremes

Values and derivatives finite in both precisions, and single precision beside double.  Prints the
table and writes extremes.md beside this file; ends with status 1 if anything fails.  Seeded; under
eight minutes of one core.
"""

import sys
import time
from pathlib import Path

import jax
import numpy as np

QUICK_POINTS, SLOW_POINTS, BATCH = 2000, 1000, 1000


def main() -> int:
    from fitting.commands.main import quick_compilation

    quick_compilation()
    jax.config.update("jax_enable_x64", True)
    from tests.reference import extremes as _extremes
    from tests.reference import extremes_more as _extremes_more

    start, total, failed, lines = (time.perf_counter(), time.process_time()), 0, 0, []
    cases = (*_extremes.table(), *_extremes_more.more(), *_extremes_more.exact())
    for case in cases:
        count = SLOW_POINTS if case.slow else QUICK_POINTS
        bad = [
            sentence
            for part in np.split(case.points(count, 7), count // BATCH)
            for sentence in _extremes.failures(case, part)
        ]
        total, failed = total + 2 * count, failed + len(bad)
        lines.append(
            f"| {case.name} | {len(case.corners)} | {2 * count} | {'; '.join(bad) or 'none'} |"
        )
        print(lines[-1], flush=True)
    head = (
        "# Extremes\n\n`python -m tests.acceptance.extremes`: "
        f"{total} points (each precision counted), {failed} failures, "
        f"{time.process_time() - start[1]:.0f} processor seconds, "
        f"{time.perf_counter() - start[0]:.0f} s.  Domains: "
        "`tests/reference/extremes.py`, `tests/reference/extremes_more.py`.\n\n"
        "| function | arguments | points | failures |\n|---|---|---|---|\n"
    )
    Path(__file__).with_suffix(".md").write_text(head + "\n".join(lines) + "\n")
    print(head)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())

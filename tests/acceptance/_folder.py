"""The folder of published data that a script is given on its command line."""

import sys
from pathlib import Path


def data_folder(script: str, *files: str) -> Path:
    """The first argument as a folder that holds `files`; else ends with a sentence."""
    words = [word for word in sys.argv[1:] if not word.startswith("-")]
    usage = f"python -m tests.acceptance.{script} FOLDER"
    if not words:
        sys.exit(
            f"{script} needs data that are not part of the project: {usage}, "
            f"where FOLDER holds {' and '.join(files)}."
        )
    folder = Path(words[0])
    missing = [name for name in files if not (folder / name).exists()]
    if missing:
        sys.exit(f"{folder} lacks {' and '.join(missing)}: {usage}.")
    return folder

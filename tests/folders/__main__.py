"""Train on some fifty folders with one fault each: ``python -m tests.folders [PART OF A NAME]``."""

import argparse
import sys
import tempfile
import time
from pathlib import Path

from tests.folders.catalogue import FOLDERS
from tests.folders.holding import hold


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", default="", help="only folders whose name has this part")
    given = parser.parse_args()
    wrong = []
    for folder in FOLDERS:
        if given.folder not in folder.name:
            continue
        began = time.monotonic()
        with tempfile.TemporaryDirectory() as place:
            try:
                outcome = hold(folder, Path(place))
            except Exception as error:
                outcome = f"WRONG: {type(error).__name__}: {error}"
                wrong.append(folder.name)
        print(f"{folder.name:28} {time.monotonic() - began:4.0f} s  {outcome}", flush=True)
    print(f"{len(wrong)} wrong" + "".join(f"\n  {name}" for name in wrong))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())

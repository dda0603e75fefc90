"""Remove from an environment what a server never loads: parts of MKL, and the tests of other libraries.

    python scripts/slim.py ENVIRONMENT

Shapespace calls MKL with 32-bit integers, on one thread, in one process. So it never loads the other threading layers
with their runtimes, the interface with 64-bit integers, and the libraries for clusters. The kernels for every kind of
processor stay.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

#: Wheels that MKL's other threading layers need: runtimes of OpenMP, of TBB and of accelerators.
UNUSED_WHEELS = ("intel-cmplr-lib-ur", "intel-openmp", "tbb", "tcmlib", "umf")
UNUSED_LIBRARIES = re.compile(
    r"libmkl_(intel_thread|tbb_thread|gnu_thread|intel_ilp64|gf_\w+|blacs_\w+|scalapack_\w+|cdft_core)\.so\b.*"
)
#: Wheels that bring their own tests, and the folders that hold them.
TESTED_WHEELS = ("numpy", "onnx", "scipy")
TESTS = re.compile(r"(numpy|scipy)/(.+/)?tests/.*|onnx/(backend/)?test/.*")


def unused(environment: Path) -> Iterator[Path]:
    """Yield the files of an environment that are never loaded."""
    (packages,) = environment.glob("lib/python3*/site-packages")
    for wheel in metadata.distributions(path=[str(packages)]):
        name = re.sub(r"[-_.]+", "-", wheel.metadata["Name"]).lower()
        for file in wheel.files or ():
            library = name == "mkl" and UNUSED_LIBRARIES.fullmatch(file.name)
            if name in UNUSED_WHEELS or library or (name in TESTED_WHEELS and TESTS.fullmatch(file.as_posix())):
                yield Path(os.path.normpath(str(wheel.locate_file(file))))


def main() -> None:
    """Remove them, and say how much room that makes."""
    environment, size = Path(sys.argv[1]).absolute(), 0
    for file in filter(Path.exists, list(unused(environment))):
        size += file.stat().st_size
        file.unlink()
        for folder in file.parents:
            if folder == environment or any(folder.iterdir()):
                break
            folder.rmdir()
    print(f"removed {size / 1e6:.0f} MB that a server never loads")


if __name__ == "__main__":
    main()

"""What made a file of figures: version, commit and kind of machine."""

import os
import platform
import subprocess
from pathlib import Path

import shapespace

#: Name of these facts in a file of figures.
MADE_BY = "made_by"


def made_by() -> dict[str, str | None]:
    """Return ``version``, ``commit`` and kind of ``machine``. The commit is None outside of a checkout with Git; a plus
    sign means that files were changed since.
    """
    machine = f"{platform.system()} {platform.machine()}, {os.cpu_count()} processors"
    return {"version": shapespace.__version__, "commit": _commit(), "machine": machine}


def _commit() -> str | None:
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():  # a package, which may lie in somebody else's repository
        return None
    command = ["git", "-C", str(root), "describe", "--always", "--exclude=*", "--dirty=+"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True)  # noqa: S603 - fixed arguments
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()

"""``python -m tests.firefox``: the page in Firefox, driven by WebDriver BiDi; ``make long firefox`` sets it up."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.service.conftest import ROOT, starting

FIREFOX = next(filter(None, map(shutil.which, ("firefox-esr", "firefox"))), None)


def main() -> int:
    """Start a server, run page.mjs with it, and return the script's exit status."""
    if FIREFOX is None:
        print("There is no Firefox: install Debian's firefox-esr, or another one as `firefox`.", file=sys.stderr)
        return 2
    screen = [] if "DISPLAY" in os.environ else ["xvfb-run", "--auto-servernum"]
    with TemporaryDirectory() as scratch, starting() as start:
        script = str(Path(__file__).parent / "page.mjs")
        command = [*screen, "node", script, FIREFOX, start(ROOT / "models").url, scratch]
        return subprocess.run(command, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())

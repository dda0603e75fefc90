"""Make a site of docs/ in build/site: ``python -m scripts.site``. A link that leads nowhere ends it.

The site holds this folder only, so links to other places of the repository become plain text in a copy of the pages.
"""

import posixpath
import re
import shutil
import subprocess
import sys
from pathlib import Path

LINK = re.compile(r"(?<!!)\[([^\]]+)\]\(([^)\s]+)\)")
BUILD = Path("build")


def main() -> int:
    """Copy the pages, build the site, and return the exit status of the builder."""
    pages = BUILD / "docs"
    shutil.rmtree(pages, ignore_errors=True)
    shutil.copytree("docs", pages)
    shutil.copy("mkdocs.yml", BUILD)
    for page in pages.rglob("*.md"):
        page.write_text(without_links_out(page.read_text(), page.parent.relative_to(pages).as_posix()))
    return subprocess.run(["zensical", "build", "--strict", "--clean", "-f", BUILD / "mkdocs.yml"], check=False).returncode


def without_links_out(markdown: str, folder: str) -> str:
    """Return a page without the links that lead out of docs/; ``folder`` is the page's own, relative to docs/."""

    def kept(link: re.Match[str]) -> str:
        leaves = posixpath.normpath(posixpath.join(folder, link[2])).startswith("..")
        return link[1] if leaves else link[0]

    return LINK.sub(kept, markdown)


if __name__ == "__main__":
    sys.exit(main())

"""Copy docs/ to build/, as the source of the site that `make docs` builds: ``python -m scripts.site``.

The site holds this folder only, so links to other places of the repository become plain text in the copy.
"""

import posixpath
import re
import shutil
from pathlib import Path

LINK = re.compile(r"(?<!!)\[([^\]]+)\]\(([^)\s]+)\)")
BUILD = Path("build")


def main() -> None:
    """Copy the pages and the configuration of the site."""
    pages = BUILD / "docs"
    shutil.rmtree(pages, ignore_errors=True)
    shutil.copytree("docs", pages)
    shutil.copy("mkdocs.yml", BUILD)
    for page in pages.rglob("*.md"):
        page.write_text(without_links_out(page.read_text(), page.parent.relative_to(pages).as_posix()))


def without_links_out(markdown: str, folder: str) -> str:
    """Return a page without the links that lead out of docs/; ``folder`` is the page's own, relative to docs/."""

    def kept(link: re.Match[str]) -> str:
        leaves = posixpath.normpath(posixpath.join(folder, link[2])).startswith("..")
        return link[1] if leaves else link[0]

    return LINK.sub(kept, markdown)


if __name__ == "__main__":
    main()

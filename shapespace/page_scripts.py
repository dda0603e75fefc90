"""The scripts of the web page: its modules, joined into the two files that it loads.

A browser asks a server for six files at once, and each takes a round trip. So on a slow line fifty modules come a
second later than two files with the same content. The modules have the form that prettier gives them.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

#: The web page of the server.
PAGE = Path(__file__).parent / "service" / "page"
#: The modules that end the two files: the first requests, and all else.
FIRST, MAIN = "server/first.js", "main.js"

_IMPORT = re.compile(r'^import (?:\* as (?P<all>\w+)|\{(?P<some>[^}]*)\}) from "(?P<source>[^"]+)";$', re.MULTILINE)
_EXPORT = re.compile(r"^export (?=(?:async )?(?:function\*?|class|const) (\w+))", re.MULTILINE)
_EXPORT_ALL = re.compile(r'^export \* from "(?P<source>[^"]+)";\n', re.MULTILINE)
_IMPORT_LATER = re.compile(r'\bimport\("(?P<source>\.[^"]+)"\)')
_UNKNOWN = re.compile(r"^(?:import|export)\b(?!\().*", re.MULTILINE)


def joined_scripts(folder: Path = PAGE / "js", instead: Mapping[str, str] | None = None) -> dict[str, bytes]:
    """Return the contents of `first.js` and `main.js`, which stand beside the folder of the modules.

    Args:
        folder: the modules.
        instead: paths of modules, each with the path of one that takes its place. That one alone still imports it.

    Raises:
        ValueError: a module has an import or export of an unknown form, or imports itself by way of others; or one
            of `first.js` imports a library.
    """
    parts = _Parts(folder, instead or {})
    first = [*parts.added(FIRST)]
    if parts.libraries:
        raise ValueError(f"the first requests would wait for {', '.join(parts.libraries)}: import it later")
    names = ", ".join(parts.names)
    main = [*parts.added(MAIN)]
    libraries = [f'import * as {_name(library)} from "{library}";' for library in parts.libraries]
    return {
        "first.js": "\n".join([*first, f"export {{ {names} }};", ""]).encode(),
        "main.js": "\n".join([*libraries, f'import {{ {names} }} from "./first.js";', *main, ""]).encode(),
    }


def _name(path: str) -> str:
    """Return the name of the constant with all that a module exports."""
    return "$" + re.sub(r"\W", "_", path.removesuffix(".js"))


class _Parts:
    """Modules as statements that define constants, each after the modules that it imports.

    Attributes:
        names: constants of the modules so far.
        libraries: what they import from outside the folder.
    """

    def __init__(self, folder: Path, instead: Mapping[str, str]) -> None:
        self.names: list[str] = []
        self.libraries: list[str] = []
        self._folder, self._instead = folder, instead
        self._begun: set[str] = set()

    def added(self, path: str) -> Iterator[str]:
        """Yield the statements of a module and its imports, except modules that are there already."""
        self._begun.add(path)
        text = (self._folder / path).read_text("utf-8")
        for match in [*_IMPORT.finditer(text), *_EXPORT_ALL.finditer(text)]:
            source = self._found(path, match["source"])
            if source == match["source"]:
                self.libraries += [source] * (source not in self.libraries)
            elif source not in self._begun:
                yield from self.added(source)
            elif _name(source) not in self.names:
                raise ValueError(f"js/{path} imports js/{source}, which imports it by way of others")
        yield self._statement(path, text)
        self.names.append(_name(path))

    def _found(self, path: str, source: str) -> str:
        """Return the path of a module that another one imports; a library's name as it is."""
        if not source.startswith("."):
            return source
        found = posixpath.normpath(posixpath.join(posixpath.dirname(path), source))
        replaced = self._instead.get(found, found)
        return found if replaced == path else replaced

    def _statement(self, path: str, text: str) -> str:
        def constant(match: re.Match[str]) -> str:
            names = match["all"] or f"{{{match['some'].replace(' as ', ': ')}}}"
            return f"const {names} = {_name(self._found(path, match['source']))};"

        exports = [f"...{_name(self._found(path, source))}" for source in _EXPORT_ALL.findall(text)]
        exports += _EXPORT.findall(text)
        text = _EXPORT.sub("", _EXPORT_ALL.sub("", _IMPORT.sub(constant, text)))
        if unknown := _UNKNOWN.search(text):
            raise ValueError(f"js/{path} has an import or export of a form that can't be joined: {unknown[0]}")
        # The files are beside the folder, not in it.
        text = text.replace("import.meta.url", f'new URL("js/{path}", import.meta.url)')
        text = _IMPORT_LATER.sub(lambda match: f'import("./js/{self._found(path, match["source"])}")', text)
        # What exports nothing comes last, and may wait for answers.
        return f"const {_name(path)} = (() => {{\n{text}return {{ {', '.join(exports)} }};\n}})();" if exports else text

"""Names in JSON that an object has twice, for bodies and for uploaded files, whose reader imports little."""

from __future__ import annotations

import json
import re

#: A string of JSON, with the colon after the name of a member; or a bracket of an object.
_NAME = re.compile(rb'[{}]|"((?:[^"\\]++|\\.)*+)"(\s*+:)?', re.DOTALL)


def repeated_member(text: bytes) -> str | None:
    """Return a name that an object in valid JSON has twice, cut to 60 characters; None if there is none.

    Parsers silently take the last of both. Numbers cost nothing here, because only names and brackets are looked at.
    """
    objects: list[set[bytes]] = []
    for found in _NAME.finditer(text):
        if found[0] == b"{":
            objects.append(set())
        elif found[0] == b"}":
            objects.pop()
        elif found[2]:
            name = json.loads(b'"%b"' % found[1]).encode(errors="replace") if b"\\" in found[1] else found[1]
            if name in objects[-1]:
                return name.decode()[:60]
            objects[-1].add(name)
    return None

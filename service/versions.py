"""Default versions: which version of a model answers a request that names none.

``figure=3`` names one version. ``figure=3:95,4:5`` divides the requests: 95 % of the codes get version 3, and 5 % get
version 4. A hash of the code decides, so a code has the same version in every process. Whoever raises the share of
version 4 moves codes from 3 to 4, and none back. Entries are separated by commas or line breaks. In a file, ``#``
begins a comment.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path

from shapespace.bundle.schema import NAME_PATTERN, VERSION_PATTERN

#: Name of the file with default versions in the models folder, unless a setting names another file.
FILE_NAME = "default-versions"
EXAMPLE = "Write for example figure=3 or figure=3:95,4:5"
_WHOLE = 100


class DefaultVersionsError(ValueError):
    """A text that is no list of default versions, or a file that cannot be read."""


@dataclass(frozen=True)
class DefaultVersions:
    """Versions that answer requests without a version, by model.

    Attributes:
        shares: per cent of the requests by version, by name of the model. The sum of each model is 100.
    """

    shares: Mapping[str, Mapping[int, float]] = field(default_factory=dict)

    @classmethod
    def parse(cls, text: str) -> DefaultVersions:
        """Read a list of default versions; raises DefaultVersionsError."""
        shares: dict[str, dict[int, float]] = {}
        name = ""
        for entry in filter(None, (part.strip() for part in re.split(r"[,\n]", text))):
            before, separator, rest = entry.rpartition("=")
            if separator:
                name = before.strip()
                if not re.fullmatch(NAME_PATTERN, name):
                    raise DefaultVersionsError(f"{name[:64]!r} is not the name of a model. {EXAMPLE}.")
                if name in shares:
                    raise DefaultVersionsError(f"{name} is named twice. Name each model once.")
            elif not name:
                raise DefaultVersionsError(f"{entry[:64]!r} has no name of a model. {EXAMPLE}.")
            version, colon, share = (part.strip() for part in rest.partition(":"))
            fault = f"{name}={rest.strip()[:64]} names no"
            if not re.fullmatch(VERSION_PATTERN, version):
                raise DefaultVersionsError(f"{fault} version. A version is a whole number. {EXAMPLE}.")
            if colon and not re.fullmatch(r"[0-9]{1,3}(\.[0-9]+)?", share):
                raise DefaultVersionsError(f"{fault} share in per cent. {EXAMPLE}.")
            if int(version) in shares.setdefault(name, {}):
                raise DefaultVersionsError(f"{name} names version {version} twice. Name each version once.")
            shares[name][int(version)] = float(share) if colon else _WHOLE
        for name, each in shares.items():
            if not math.isclose(total := sum(each.values()), _WHOLE):
                raise DefaultVersionsError(
                    f"The shares of {name} add up to {total:g} per cent, where a version without a share has 100. "
                    "Let them add up to 100."
                )
        # In whatever order they are written.
        return cls({name: dict(sorted(each.items())) for name, each in shares.items()})

    @classmethod
    def read(cls, file: Path) -> DefaultVersions:
        """Read a file; a missing one names no version. Raises DefaultVersionsError."""
        try:
            text = file.read_text(encoding="utf-8")
        except FileNotFoundError:
            return cls()
        except UnicodeDecodeError:
            raise DefaultVersionsError(
                f"{file.name} is not text in UTF-8. {EXAMPLE}, one model on each line."
            ) from None
        except OSError as error:
            raise DefaultVersionsError(f"{file.name} can't be read: {error.strerror}.") from None
        try:
            return cls.parse("\n".join(line.partition("#")[0] for line in text.splitlines()))
        except DefaultVersionsError as error:
            raise DefaultVersionsError(f"{file.name}: {error}") from None

    def over(self, others: DefaultVersions) -> DefaultVersions:
        """Return these versions, and the others for models that have none here."""
        return DefaultVersions({**others.shares, **self.shares})

    def choose(self, name: str, served: Collection[int], key: bytes | None = None) -> int:
        """Return the version of a model that answers a request.

        Args:
            name: name of the model.
            served: its versions, at least one.
            key: what a request with a code is divided by; a request without one gets the version with the largest
                share.

        Versions that are not served leave their share to the others. If none is served, the next older version
        answers, and without an older one the oldest. Without a default version, the newest answers.
        """
        if name not in self.shares:
            return max(served)
        shares = self._served(name, served)
        if not shares:
            named = self.shares[name]
            older = [version for version in served if version < max(named, key=named.__getitem__)]
            return max(older) if older else min(served)
        if key is None or len(shares) == 1:
            return max(shares, key=shares.__getitem__)
        digest = hashlib.sha256(name.encode() + b"\0" + key).digest()
        point = int.from_bytes(digest[:6]) / 2**48 * sum(shares.values())
        return next(version for version, end in zip(shares, accumulate(shares.values()), strict=True) if point < end)

    def divides(self, name: str, served: Collection[int]) -> bool:
        """Return whether several versions of a model answer, so that a request needs a key."""
        return name in self.shares and len(self._served(name, served)) > 1

    def share(self, name: str, version: int, served: Collection[int]) -> float:
        """Return the share of the codes, from 0 to 1, that a version answers."""
        if not self.divides(name, served):
            return float(version == self.choose(name, served))
        shares = self._served(name, served)
        return shares.get(version, 0.0) / sum(shares.values())

    def faults(self, served: Mapping[str, Collection[int]]) -> list[str]:
        """Return a sentence for each version that is named and not served."""
        found = []
        for name, shares in self.shares.items():
            instead = (
                f"{name}/{self.choose(name, served[name])} answers instead" if name in served else "add its bundle"
            )
            found += [
                f"The default versions name {name}/{version}, which is not served: {instead}."
                for version in shares
                if version not in served.get(name, ())
            ]
        return found

    def _served(self, name: str, served: Collection[int]) -> dict[int, float]:
        return {version: share for version, share in self.shares[name].items() if share and version in served}

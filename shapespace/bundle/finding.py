"""Find bundles by the names of models: in a folder of models, and among the installed models."""

from __future__ import annotations

import os
import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from shapespace.bundle.reader import BundleError, read_manifest
from shapespace.bundle.schema import MANIFEST, NAME_PATTERN, VERSION_PATTERN
from shapespace.files.limits import in_words

#: Folder of the models that are installed with the package.
BUNDLED = Path(__file__).parents[1] / "models"
#: Environment variable with the folder of models; by default it is ``models`` in the working directory.
MODELS_DIR = "SHAPESPACE_MODELS_DIR"


@dataclass(frozen=True)
class ListedModel:
    """A model that can be loaded by its name.

    Attributes:
        name, version: name of the model, and its highest version.
        title, licence: title and licence in words.
        dimension: number m of coordinates of a code.
        folder: folder NAME/VERSION of its bundle.
    """

    name: str
    version: str
    title: str
    licence: str
    dimension: int
    folder: Path


def models() -> dict[str, ListedModel]:
    """Return the models that can be loaded by their names, sorted by name.

    These are the models in the folder ``models`` of the working directory, or in ``SHAPESPACE_MODELS_DIR``, and the
    models that are installed with the package. Of two with one name, the model in the folder counts. A model without a
    readable manifest is left out; ``load`` says what is wrong with it.

    >>> import shapespace
    >>> list(shapespace.models())
    ['figure', 'freaky-torus']
    >>> shapespace.models()["figure"].dimension
    20
    """
    found: dict[str, ListedModel] = {}
    for root in _roots():
        with suppress(OSError):
            for entry in root.iterdir():
                with suppress(OSError, BundleError):
                    if entry.name not in found and re.fullmatch(NAME_PATTERN, entry.name):
                        found[entry.name] = _listed(_bundle_in(entry))
    return dict(sorted(found.items()))


def find_bundle(model: str | os.PathLike[str]) -> Path:
    """Return the absolute folder NAME/VERSION of a model.

    Args:
        model: folder NAME/VERSION; folder NAME, for the highest version in it; or a name or NAME/VERSION that
            `models` lists.

    Raises:
        BundleError: there is no such model. The message lists the names that can be loaded.
    """
    given = os.fspath(model)
    path = Path(os.path.abspath(given))  # makes "." absolute: the names of the last two folders matter
    try:
        return _bundle_in(path)
    except BundleError as error:
        refusal = error
    parts = Path(given).parts
    is_name = 1 <= len(parts) <= 2 and all(map(re.fullmatch, (NAME_PATTERN, VERSION_PATTERN), parts))
    for root in _roots() if is_name else ():
        with suppress(BundleError):
            return _bundle_in(root / given)
    if path.is_dir() or not (is_name or (len(parts) == 1 and not path.exists())):
        raise refusal
    known = ", ".join(models())
    choice = f"choose among {known}, or" if known else "none is installed;"
    raise BundleError(f"there is no model {given} here: {choice} name a folder NAME/VERSION")


def _roots() -> tuple[Path, Path]:
    return Path(os.environ.get(MODELS_DIR) or "models").absolute(), BUNDLED


def _bundle_in(folder: Path) -> Path:
    """Return a folder if it holds a bundle, otherwise the highest version in it; raises BundleError."""
    if (folder / MANIFEST).exists():
        return folder
    try:
        versions = [int(entry.name) for entry in folder.iterdir() if re.fullmatch(VERSION_PATTERN, entry.name)]
    except OSError as error:
        raise BundleError(f"{folder} can't be read: {in_words(error, named=False)}") from None
    if not versions:
        raise BundleError(f"{folder} holds no bundle: name a folder NAME/VERSION, or a folder NAME with versions in it")
    return folder / str(max(versions))


def _listed(folder: Path) -> ListedModel:
    facts = read_manifest(folder)
    return ListedModel(facts.name, facts.version, facts.title, facts.licence, facts.latent_dimension, folder)

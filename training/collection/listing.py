"""Which files of a folder are shapes of a collection, and which are left out and why."""

from __future__ import annotations

import re
import shlex
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from shapespace.counted import counted
from shapespace.files.archives import natural_order
from shapespace.files.reading import READ_FORMATS
from shapespace.training.collection.checks import ShapeSource
from shapespace.training.collection.faults import Fault, IngestError, shown

#: With fewer shapes a mean and modes say nothing about a collection.
MIN_SHAPES = 3
TOO_FEW = f"has {{}}; at least {MIN_SHAPES} are needed"
#: Most names of files in one sentence.
_MOST_NAMES = 200
#: Extensions of files that accompany meshes, with the formats whose files may refer to them.
_COMPANIONS = {
    "bin": {"gltf"},
    "mtl": {"obj"},
    "png": {"gltf", "glb", "obj", "ply"},
    "jpg": {"gltf", "glb", "obj", "ply"},
    "jpeg": {"gltf", "glb", "obj", "ply"},
}


@dataclass(frozen=True)
class MeshFiles:
    """The files of a collection in natural order.

    Attributes:
        folder: the folder.
        paths: file of each shape.
        sources: the same files with the shapes' names.
        left_out: a sentence for each reason to leave files out, with the files.
        faults: faults of the folder.
    """

    folder: Path
    paths: tuple[Path, ...]
    sources: tuple[ShapeSource, ...]
    left_out: tuple[str, ...]
    faults: tuple[Fault, ...]


def extension(path: Path) -> str:
    """Return the extension of a path in small letters, without its dot."""
    return path.suffix.lstrip(".").lower()


def data_files(path: Path, file: str | None = None) -> list[Path]:
    """Return the files that a collection is read from, sorted; none if the path doesn't exist.

    Args:
        path: the collection.
        file: see `mesh_files`.
    """
    if path.is_file():
        beside = _visible(path.parent) if extension(path) == "gltf" else ()
        return [path, *sorted(p for p in beside if extension(p) in _COMPANIONS and p.is_file())]
    if not path.is_dir():
        return []
    if not file:
        return sorted(p for p in _visible(path) if extension(p) in (*READ_FORMATS, *_COMPANIONS) and p.is_file())
    found = {p for paths in _files_of_subjects(path, file).values() for p in paths}
    beside = (p for folder in {p.parent for p in found} for p in _visible(folder) if extension(p) in _COMPANIONS)
    return sorted(found | {p for p in beside if p.is_file()})


def mesh_files(folder: Path, file: str | None = None) -> MeshFiles:
    """List the shapes of a folder.

    Args:
        folder: the folder.
        file: name of the file to read from each folder in it, which may have * and ? in it; by default all mesh files
            of the folder itself are read.

    Raises:
        IngestError: there are fewer than 3 shapes.
    """
    found = _subjects(folder, file) if file else _flat(folder)
    # Python has surrogates for bytes that are no text.
    unnamed = [each.label for each in found.sources if re.search("[\ud800-\udfff]", each.label)]
    if unnamed:
        raise IngestError(*(Fault(path, "its name is not valid UTF-8", "rename it") for path in unnamed))
    if len(found.paths) < MIN_SHAPES:
        if file and found.faults:
            raise IngestError(*found.faults)
        if hint := "" if file else _nested(folder):
            raise IngestError(Fault(str(folder), f"has {len(found.paths) or 'no'} meshes, but its folders have", hint))
        if not found.paths:
            raise IngestError(_nothing(folder, file))
        npz = not file and extension(found.paths[0]) == "npz"
        hints = ["if one NPZ holds all shapes, name that file, not its folder"] if npz else []
        sentence = "; ".join([TOO_FEW.format(counted(len(found.paths), "shape")), *hints, *found.left_out])
        raise IngestError(Fault.of(str(folder), sentence))
    return found


def _visible(folder: Path) -> Iterable[Path]:
    return (path for path in folder.iterdir() if not path.name.startswith("."))


def _flat(folder: Path) -> MeshFiles:
    """List the mesh files of a folder itself; of files with one name the first counts."""
    every = sorted(folder.iterdir(), key=lambda path: (natural_order(path.stem), path.name))
    files = [path for path in every if not path.name.startswith(".") and not path.is_dir()]
    first: dict[str, Path] = {}
    faults = []
    for path in files:
        if extension(path) not in READ_FORMATS:
            continue
        if path.stem in first:
            what = f"{first[path.stem].name} has the same name"
            faults.append(Fault(str(path), what, "remove or rename one of them"))
        first.setdefault(path.stem, path)
    formats = {extension(path) for path in first.values()}
    others = [path for path in files if extension(path) not in READ_FORMATS and not _accompanies(path, formats)]
    left_out = (
        _left_out("their formats are not read", [path.name for path in others]),
        _left_out("their names begin with a dot", [path.name for path in every if path.name.startswith(".")]),
        _left_out(
            "they are folders; --file reads one file from each",
            [f"{path.name}/" for path in every if path.is_dir() and not path.name.startswith(".")],
        ),
    )
    paths = tuple(first.values())
    return MeshFiles(
        folder, paths, tuple(map(ShapeSource.of_file, paths)), tuple(filter(None, left_out)), tuple(faults)
    )


def _accompanies(path: Path, formats: set[str]) -> bool:
    return bool(_COMPANIONS.get(extension(path), set()) & formats)


def _subjects(folder: Path, file: str) -> MeshFiles:
    """List one file of each subject's folder, or of each of its folders that match a pattern."""
    found = _files_of_subjects(folder, file)
    faults = [
        Fault(
            str(paths[0].parent), f"has {len(paths)} files {file}", "give the whole name of the file, without * and ?"
        )
        for paths in found.values()
        if len(paths) > 1
    ]
    chosen = {name: paths[0] for name, paths in found.items() if len(paths) == 1}
    paths = set(chosen.values())
    formats, parents = {extension(path) for path in paths}, {path.parent for path in paths}
    beside: Counter[str] = Counter()
    for subject in {folder / path.relative_to(folder).parts[0] for path in paths}:
        beside.update(
            p.relative_to(subject).as_posix()
            for p in subject.rglob("*")
            if p not in paths and not p.is_dir() and not (p.parent in parents and _accompanies(p, formats))
        )
    times = [f"{name} ({count} times)" if count > 1 else name for name, count in sorted(beside.items())]
    subjects = {p.name for p in _folders(folder)}
    tops = sorted((p.name for p in folder.iterdir() if p.name not in subjects), key=natural_order)
    left_out = (
        _left_out(f"they have no file {file}", [f"{name}/" for name, paths in found.items() if not paths]),
        _left_out(f"only {file} is read from each folder", times),
        _left_out("they are not in a subject's folder", tops),
    )
    return MeshFiles(
        folder,
        tuple(chosen.values()),
        tuple(ShapeSource.of_file(path, name, folder) for name, path in chosen.items()),
        tuple(filter(None, left_out)),
        tuple(faults),
    )


def _files_of_subjects(folder: Path, file: str) -> dict[str, list[Path]]:
    """Return the files that have a name or match a pattern, by the name of the shape.

    A shape has the name of the subject's folder. Where folders inside it match a pattern, such as ``ses-*/surf.ply``,
    their names follow. Raises IngestError for paths that are none of a file within a folder.
    """
    if PurePosixPath(file).is_absolute() or ".." in PurePosixPath(file).parts or not PurePosixPath(file).name:
        raise IngestError(
            Fault(str(folder), f"{file!r} is not a path within a folder", "name the file that each folder has")
        )
    if extension(Path(file)) not in READ_FORMATS:
        raise IngestError(
            Fault(str(folder), f"the format of {file!r} is not read", f"these are: {', '.join(READ_FORMATS)}")
        )
    found: dict[str, list[Path]] = {}
    for subject in sorted(_folders(folder), key=lambda path: natural_order(path.name)):
        named = subject / file
        if named.is_file():  # also where the name looks like a pattern
            found[subject.name] = [named]
            continue
        matching = [p for p in subject.glob(file) if p.is_file()]
        if not matching:
            found[subject.name] = []
        for path in sorted(matching, key=lambda path: natural_order(path.as_posix())):
            found.setdefault("_".join([subject.name, *_matched(path.relative_to(subject), file)]), []).append(path)
    return found


def _folders(folder: Path) -> list[Path]:
    return [path for path in _visible(folder) if path.is_dir()]


def _matched(path: Path, file: str) -> list[str]:
    """Return the folders of a path that match a pattern in the path of a file, from outside to inside."""
    if "**" in PurePosixPath(file).parts:
        return list(path.parts[:-1])
    both = zip(path.parts[:-1], PurePosixPath(file).parts[:-1], strict=True)
    return [name for name, given in both if re.search(r"[*?\[]", given)]


def _nested(folder: Path) -> str:
    """Return what to do about a folder whose folders have meshes; empty if they have none."""
    names: Counter[str] = Counter()
    for subject in _folders(folder):
        inside = (
            p for pattern in ("*", "*/*", "*/*/*") for p in subject.glob(pattern) if p.name[0] != "." and p.is_file()
        )
        meshes = {p.relative_to(subject).as_posix() for p in inside if extension(p) in READ_FORMATS}
        # A name that repeats the folder's: sub-01/sub-01_mesh.ply. Several folders of a subject: sub-01/ses-1/mesh.ply.
        names.update(meshes | {name.replace(subject.name, "*") for name in meshes})
        names.update(re.sub(r"^[^/]+/", "*/", name) for name in meshes if "/" in name)
    if not names:
        return ""
    file, count = max(names.items(), key=lambda item: (item[1], "*" not in item[0]))
    return (
        f"read one file from each folder: init {shlex.quote(str(folder))} --file {shlex.quote(file)} "
        f"({counted(count, 'file')}), or set file in [collection] of the configuration"
    )


def _nothing(folder: Path, file: str | None) -> Fault:
    """Return the fault of a folder without meshes."""
    if file:
        return Fault(
            str(folder), f"none of its folders has a file {file}", _nested(folder) or "name another folder or file"
        )
    others = sorted({path.suffix or path.name for path in _visible(folder) if not path.is_dir()})
    found = f"only {', '.join(others[:8])}" if others else "it has no files"
    return Fault(str(folder), f"holds no meshes ({found})", f"these can be read: {', '.join(READ_FORMATS)}")


def _left_out(why: str, names: list[str]) -> str:
    """Return a sentence on files that are left out for one reason; empty if there are none."""
    if not names:
        return ""
    more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    return f"left out, as {why}: {', '.join(map(shown, names[:_MOST_NAMES]))}{more}"

"""Folders with one fault each: the messages of a run, its exit code, and whether it exports a bundle."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.folders.shapes import Meshes, figures, full, head, large, seam, twins, write

#: Number of the shape with the fault, and its name.
ODD, NAME = 4, ("pose4",)


@dataclass(frozen=True)
class Folder:
    """One folder and the expected outcome.

    Attributes:
        build: makes the folder of meshes.
        says: a pattern that the run's messages contain, or those of init if it already stops or warns.
        codes: exit codes that are right.
        arguments: of the run.
        later: changes the folder after a first run; the second run's messages are tested.
        back: largest mean distance of training shapes from those of their codes, as a share of the diagonal.
        odd: names of shapes that are left out of ``back``.
    """

    name: str
    build: Callable[[Path], None]
    says: str = r"is ready\. Next: "
    codes: tuple[int, ...] = (0,)
    arguments: tuple[str, ...] = ()
    later: Callable[[Path], None] | None = None
    back: float = 0.02
    odd: tuple[str, ...] = ()

    @property
    def quick(self) -> bool:
        """Whether it ends with a message before anything is computed."""
        return self.codes == (1,)


def of_one(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    """A folder in which one shape's vertices are changed."""

    def build(folder: Path) -> None:
        vertices, faces = figures()
        vertices[ODD] = change(vertices[ODD])
        write(folder, (vertices, faces))

    return build


def of_all(change: Callable[[Meshes], Meshes], format: str = "obj") -> Callable[[Path], None]:
    """A folder in which all shapes are changed in the same way."""
    return lambda folder: write(folder, change(figures()), format)


def of_file(change: Callable[[bytes], bytes], format: str = "obj") -> Callable[[Path], None]:
    """A folder in which the bytes of one file are changed."""

    def build(folder: Path) -> None:
        write(folder, figures(), format)
        path = folder / f"pose{ODD}.{format}"
        path.write_bytes(change(path.read_bytes()))

    return build


def of_faces(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    """A folder in which the faces of one file are changed."""

    def build(folder: Path) -> None:
        vertices, faces = figures()
        write(folder, (vertices, faces))
        write(folder, (vertices[ODD : ODD + 1], change(faces)), names=[""] * ODD + [f"pose{ODD}"], first=ODD)

    return build


def moved(vertex: int, to: list[float]) -> Callable[[np.ndarray], np.ndarray]:
    def change(shape: np.ndarray) -> np.ndarray:
        shape = shape.copy()
        shape[vertex] = to
        return shape

    return change


def exchanged(count: int | None) -> Callable[[np.ndarray], np.ndarray]:
    def change(shape: np.ndarray) -> np.ndarray:
        rng = np.random.default_rng(3)
        chosen = rng.choice(len(shape), count or len(shape), replace=False)
        shape = shape.copy()
        shape[chosen] = shape[np.roll(chosen, 1)]
        return shape

    return change


def folded_lid(shape: np.ndarray) -> np.ndarray:
    """A shape with a patch of the face folded onto the surface below it."""
    shape = shape.copy()
    front = (np.abs(shape[:, 0]) < 0.06) & (shape[:, 2] > 0.02) & (shape[:, 1] > 1.62) & (shape[:, 1] < 1.70)
    shape[front, 1] = 2 * 1.62 - shape[front, 1]
    shape[front, 2] += 0.01
    return shape


def slivers(meshes: Meshes) -> Meshes:
    vertices, faces = meshes
    for a, b, _ in faces[10::90]:
        vertices[:, a] = vertices[:, b] + 1e-3 * (vertices[:, a] - vertices[:, b])
    return vertices, faces


def needles(meshes: Meshes) -> Meshes:
    vertices, faces = meshes
    for vertex in (17, 200, 410):
        vertices[:, vertex] += 0.4 * (vertices[:, vertex] - vertices.mean(axis=1))
    return vertices, faces


def slit(meshes: Meshes) -> Meshes:
    vertices, _ = meshes
    middle = seam(meshes)
    _, y, z = vertices[0][middle].T
    return twins(meshes, middle[(z > 0.02) & (y > 1.0) & (y < 1.35)], 2e-5)


def beside(meshes: Meshes) -> Meshes:
    vertices, faces = meshes
    return np.concatenate([vertices, vertices + np.array([3, 0, 0])], axis=1), np.concatenate(
        [faces, faces + vertices.shape[1]]
    )


def third_face(meshes: Meshes) -> Meshes:
    vertices, faces = meshes
    a, b, _ = faces[0]
    return (
        np.concatenate([vertices, np.full_like(vertices[:, :1], 9)], axis=1),
        np.concatenate([faces, [[a, b, vertices.shape[1]]]]),
    )


def flat_face(meshes: Meshes) -> Meshes:
    vertices, faces = meshes
    _, b, c = faces[5]
    vertices[ODD, c] = vertices[ODD, b]
    return vertices, faces


def one_turned(faces: np.ndarray) -> np.ndarray:
    return np.concatenate([faces[:7], faces[7:8, ::-1], faces[8:]])


def all_equal(meshes: Meshes) -> Meshes:
    return np.repeat(meshes[0][:1], 5, axis=0) + np.arange(5)[:, None, None], meshes[1]


def unused(meshes: Meshes) -> Meshes:
    vertices, faces = meshes
    return np.concatenate([np.full_like(vertices[:, :2], 7), vertices], axis=1), faces + 2


def named_twice(folder: Path) -> None:
    write(folder, figures(5))
    write(folder, (figures(1)[0], figures()[1]), "ply")


def other_words(folder: Path) -> None:
    folder.mkdir()
    (folder / "figure.fbx").touch()


def mixed(folder: Path) -> None:
    vertices, faces = figures()
    for k, format in enumerate(("obj", "ply", "glb", "npz", "stl") * 2):
        write(folder, (vertices[k : k + 1], faces), format, [""] * k + [f"pose{k}"], first=k)


def one_npz(folder: Path) -> None:
    vertices, faces = figures()
    folder.mkdir()
    np.savez(folder / "all.npz", vertices=vertices, faces=faces)
    # The configuration names the file, not the folder.
    (folder / "all.npz").rename(folder.with_name("all.npz"))
    folder.rmdir()
    folder.with_name("all.npz").rename(folder.with_suffix(".npz"))


def mirrored_head(folder: Path) -> None:
    vertices, faces = head()
    vertices[ODD] *= [-1, 1, 1]
    write(folder, (vertices, faces))


def stl_in_another_order(folder: Path) -> None:
    vertices, faces = figures(5)
    write(folder, (vertices, faces), "stl")
    other = np.random.default_rng(0).permutation(faces)
    write(folder, (vertices[ODD:], other), "stl", [""] * ODD + [f"pose{ODD}"], first=ODD)


def add(folder: Path) -> None:
    write(folder, (figures(12)[0][11:], figures()[1]), names=[""] * 11 + ["pose11"], first=11)


def remove(folder: Path) -> None:
    (folder / "pose7.obj").unlink()


UMLAUTS = ["Ä b", "ö'c", "日本", "é", "ñ", "x y z", "#7", "%s", "ß", "&"]
SIZE, ORDER = r"pose4\.obj: has another size", r"pose4\.obj: has its vertices in another order"
SOME = r"pose4\.obj: has some vertices in another order"
UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
#: Grouped by the kind of fault and its outcome.
FOLDERS = [
    # Nothing to learn from.
    Folder("empty", lambda folder: folder.mkdir(), "holds no meshes", (1,)),
    Folder("other files only", other_words, r"holds no meshes \(only \.fbx\)", (1,)),
    Folder("two shapes", lambda folder: write(folder, figures(2)), "has 2 shapes; at least 3", (1,)),
    Folder("all equal", of_all(all_equal), "all 5 shapes are the same", (1,)),
    Folder("one name twice", named_twice, r"pose0\.ply: pose0\.obj has the same name", (1,)),
    # Files.
    Folder("cut short in a line", of_file(lambda data: data[:12_000]), r"pose4\.obj: .* file may be cut short", (1,)),
    Folder(
        "cut short after a line",
        of_file(lambda data: b"".join(data.splitlines(keepends=True)[:-50])),
        r"pose4\.obj: seems to be cut short: it ends after \d+ of \d+ vertices and \d+ of \d+ faces",
        (1,),
    ),
    Folder("PLY cut short", of_file(lambda data: data[:-40], "ply"), r"pose4\.ply: not a readable ply file", (1,)),
    Folder("GLB cut short", of_file(lambda data: data[:-40], "glb"), r"pose4\.glb: not a readable glb file", (1,)),
    Folder("letters", of_file(lambda data: b"v 0 o 0\n" + data), r"pose4\.obj: not a readable obj file: line 1", (1,)),
    Folder("not a number", of_one(moved(7, [0, np.nan, 0])), r"pose4\.obj: vertex 8 .* \(counted from 1\)", (1,)),
    Folder("infinite", of_one(moved(7, [0, np.inf, 0])), r"pose4\.obj: vertex 8 .* not finite", (1,)),
    Folder(
        "a vertex too many named",
        of_file(lambda data: data + b"f 1 2 601\n"),
        r"pose4\.obj: faces name vertices 1 to 601, but there are 600",
        (1,),
    ),
    Folder("nothing in a file", of_file(lambda data: b""), r"pose4\.obj: has no faces", (1,)),
    # Correspondence.
    Folder("a face less", of_faces(lambda faces: faces[1:]), r"pose4\.obj: has 600 vertices and 1195 faces", (1,)),
    Folder("faces in another order", of_faces(lambda faces: faces[::-1]), r"pose4\.obj: face 1 joins", (1,)),
    Folder("STL in another order", stl_in_another_order, r"pose4\.stl: its triangles don't meet", (1,)),
    Folder("another order", of_one(exchanged(None)), ORDER, (1,)),
    Folder("60 in another order", of_one(exchanged(60)), SOME, (1,)),
    Folder("another order and unit", of_one(lambda shape: 1000 * exchanged(None)(shape)), ORDER, (1,)),
    Folder("millimetres", of_one(lambda shape: 1000 * shape), SIZE + r": its lengths are [\d,]+ times", (1,)),
    Folder("inches", of_one(lambda shape: shape / 39.37), SIZE + r": its lengths are 0\.02\d* times", (1,)),
    Folder("accepting another", of_one(lambda shape: 1000 * shape), SIZE, (1,), ("--accept", "pose3.obj")),
    Folder("accepting nothing", of_one(lambda shape: 1000 * shape), "no shape is called x", (1,), ("--accept", "x")),
    # Surfaces.
    Folder("separate parts", of_all(beside), "2 separate parts", (1,)),
    Folder("a seam that nearly closes", of_all(lambda m: twins(m, seam(m), 2e-5)), r"\d parts that almost meet", (1,)),
    Folder("three faces at an edge", of_all(third_face), r"pose0\.obj: edge \(\d+, \d+\) has 3 faces", (1,)),
    Folder("one face turned", of_all(lambda m: (m[0], one_turned(m[1]))), "are oriented oppositely", (1,)),
    Folder("a face without area", of_all(flat_face), r"pose4\.obj: face \d+ has no area", (1,)),
    Folder("mirrored", of_one(lambda shape: shape * [-1, 1, 1]), r"pose4\.obj: is inside out", (1,)),
    # These end with a bundle and a note.
    Folder("nothing wrong", of_all(lambda meshes: meshes)),
    Folder("a file added", of_all(lambda meshes: meshes), r"data: 1 added \(pose11\.obj\)", later=add),
    Folder("a file removed", of_all(lambda meshes: meshes), r"data: 1 removed \(pose7\.obj\)", later=remove),
    Folder("a duplicate", of_one(lambda shape: figures()[0][2]), r"pose4\.obj: is the same shape as pose2"),
    Folder("turned", of_one(lambda shape: shape @ UP), r"pose4\.obj: is rotated"),
    # Samples of such a collection may fail so often that the run stops, as in 0.2.
    Folder("a mirrored sheet", mirrored_head, r"pose4\.obj: is a mirror image", (0, 1), odd=NAME),
    Folder("a vertex far off", of_one(moved(77, [0, 1, 9])), r"pose4\.obj: .* far off the surface: 78", odd=NAME),
    Folder("size accepted", of_one(lambda shape: 1000 * shape), SIZE, (0, 1), ("--accept", "pose4.obj"), back=np.inf),
    Folder("order accepted", of_one(exchanged(60)), SOME, (0, 1), ("--accept", "pose4"), back=np.inf),
    Folder("inside out", of_all(lambda meshes: (meshes[0], meshes[1][:, ::-1])), "wound inside out"),
    Folder("unused vertices", of_all(unused), "left out 2 vertices"),
    Folder("a seam of twins", of_all(lambda meshes: twins(meshes, seam(meshes), 0)), "merged 6.. vertices into 600"),
    Folder("a slit that nearly closes", of_all(slit), "of border vertices that almost coincide"),
    Folder("names beyond ASCII", lambda folder: write(folder, figures(), names=UMLAUTS)),
    Folder("mixed formats", mixed),
    Folder("STL", of_all(lambda meshes: meshes, "stl")),
    Folder("one NPZ", one_npz),
    Folder("nanometres", of_all(lambda meshes: (1e-9 * meshes[0], meshes[1]))),
    Folder("a thousand million", of_all(lambda meshes: (1e9 * meshes[0], meshes[1]))),
    Folder("far from the origin", of_all(lambda meshes: (meshes[0] + 3000, meshes[1]), "npz")),
    Folder("slivers", of_all(slivers), "is ready"),
    Folder("needles", of_all(needles), "is ready"),
    Folder("an eyelid that folds", of_one(folded_lid), "is ready", odd=NAME),
    Folder("3 shapes", lambda folder: write(folder, figures(3)), r"found 2 of 4 modes, because 3 shapes", back=0.05),
    Folder("300 shapes", lambda folder: write(folder, figures(300), "npz")),
    Folder("4601 vertices", lambda folder: write(folder, full(10), "npz")),
    Folder("160,000 vertices", lambda folder: write(folder, large(5))),
]  # fmt: skip

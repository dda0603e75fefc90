"""Archives written in pieces: standard readers read them; each piece is ready before the next is made."""

import io
import zipfile
from collections.abc import Iterator

import numpy as np

from shapespace.files import npz
from shapespace.files.archives import zip_pieces
from shapespace.files.npz import npz_pieces


def test_members_are_read_back_whole(rng: np.random.Generator) -> None:
    noise = rng.bytes(300_000)
    members = {"first.bin": [noise[:100_000], noise[100_000:]], "empty.txt": [], "last.txt": [b"a ", b"word"]}
    content = b"".join(zip_pieces(members.items()))
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        assert archive.testzip() is None
        assert {name: archive.read(name) for name in archive.namelist()} == {
            name: b"".join(parts) for name, parts in members.items()
        }
    assert b"".join(zip_pieces(members.items())) == content


def test_a_piece_is_there_before_the_rest_is_made(rng: np.random.Generator) -> None:
    made = []

    def parts() -> Iterator[bytes]:
        for k in range(5):
            made.append(k)
            yield rng.bytes(100_000)

    pieces = zip_pieces([("noise.bin", parts())])
    assert next(pieces)
    assert made == [0]
    assert max(map(len, pieces)) < 250_000


def test_arrays_of_every_form_are_read_back(rng: np.random.Generator) -> None:
    arrays = {
        "shapes": rng.standard_normal((3, 50, 3)).astype(np.float32),
        "faces": np.arange(12).reshape(4, 3),
        "columns": np.asfortranarray(rng.standard_normal((7, 5))),
        "names": np.array(["left", "right"]),
        "number": np.float64(2.5),
    }
    with np.load(io.BytesIO(b"".join(npz_pieces(**arrays)))) as found:
        assert set(found) == set(arrays)
        for name, array in arrays.items():
            assert found[name].dtype == array.dtype
            np.testing.assert_array_equal(found[name], array)


def test_rows_are_written_many_at_a_time_and_large_ones_alone(rng: np.random.Generator) -> None:
    faces = rng.integers(5000, size=(10_000, 3))
    parts = list(npz._npy_pieces(faces))[1:]
    assert b"".join(parts) == faces.tobytes()
    assert {len(part) > 0.9 * npz.PIECE for part in parts[:-1]} == {True}
    assert max(map(len, parts)) <= npz.PIECE
    shapes = rng.standard_normal((4, 20_000, 3))
    assert [len(part) for part in npz._npy_pieces(shapes)][1:] == [shapes[0].nbytes] * 4
    assert [*npz._npy_pieces(np.empty((0, 3)))][1:] == []

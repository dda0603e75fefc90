"""Files and folders are replaced as a whole, or not at all."""

import contextlib
from pathlib import Path

import pytest

from shapespace.files.atomic import replaced_file, replaced_folder


def test_a_file_keeps_its_old_content_until_the_new_one_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "made" / "a.json"
    with replaced_file(path) as file:
        file.write(b"old")
    with contextlib.suppress(RuntimeError), replaced_file(path) as file:
        file.write(b"half of the n")
        raise RuntimeError
    assert path.read_bytes() == b"old"
    (path.parent / "a.part").write_text("mine")
    with replaced_file(path) as file:
        file.write(b"new")
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"
    assert {each.name: each.read_text() for each in path.parent.iterdir()} == {"a.json": "new", "a.part": "mine"}


def test_an_error_names_the_file_itself(tmp_path: Path) -> None:
    (tmp_path / ".a.json.part").mkdir()
    with pytest.raises(IsADirectoryError) as caught, replaced_file(tmp_path / "a.json"):
        pass
    assert caught.value.filename == str(tmp_path / "a.json")


def test_a_folder_keeps_its_old_files_until_the_new_ones_are_there(tmp_path: Path) -> None:
    folder = tmp_path / "name" / "1"
    for content in ("old", "new"):
        with replaced_folder(folder) as part:
            assert part.name.startswith(".")
            (part / content).write_text(content)
        assert [path.name for path in folder.iterdir()] == [content]
        with contextlib.suppress(RuntimeError), replaced_folder(folder) as part:
            (part / "half").write_text("")
            raise RuntimeError
        assert [path.name for path in folder.iterdir()] == [content]
    with replaced_folder(folder) as part:
        (part / "last").write_text("")
    assert [path.name for path in folder.parent.iterdir()] == ["1"]

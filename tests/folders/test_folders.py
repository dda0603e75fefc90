"""Folders that end with a message before anything is computed; ``python -m tests.folders`` runs all."""

from pathlib import Path

import pytest

from tests.folders.catalogue import FOLDERS, Folder
from tests.folders.holding import hold


@pytest.mark.parametrize("folder", [folder for folder in FOLDERS if folder.quick], ids=lambda folder: folder.name)
def test_a_folder_with_a_fault_ends_in_words(folder: Folder, tmp_path: Path) -> None:
    hold(folder, tmp_path)

"""Groups of related shapes, by their names."""

import pytest

from shapespace.training.collection.faults import IngestError
from shapespace.training.collection.groups import SUBJECT, groups_of, subjects_repeat

SCANS = ["sub-01_ses-1", "sub-01_ses-2", "sub-02_ses-1", "control", "sub-3_ses-1"]


def test_names_with_the_same_part_are_in_one_group() -> None:
    groups = groups_of(SCANS, SUBJECT)
    assert groups[0] == groups[1]
    assert len(set(groups)) == 4, "a name without the part is a group by itself"
    assert set(groups) == set(range(4))


@pytest.mark.parametrize(
    ("expression", "sentence"),
    [
        ("patient [0-9]+", "collection.related: finds 'patient [0-9]+' in no name of a shape, such as 'sub-01_ses-1'"),
        ("s", "collection.related: makes 2 groups of the shapes, but 3 are needed"),
    ],
)
def test_an_expression_has_to_make_groups(expression: str, sentence: str) -> None:
    with pytest.raises(IngestError) as refused:
        groups_of(SCANS, expression)
    assert str(refused.value).startswith(sentence)


@pytest.mark.parametrize(
    ("names", "repeat"),
    [
        (["sub-01_ses-1", "sub-01_ses-2", "sub-02_ses-1", "sub-03_ses-1"], True),
        (["sub-01", "sub-02", "sub-03"], False),
        (["sub-01_ses-1", "sub-01_ses-2", "sub-02_ses-1", "control"], False),
        (["sub-01_ses-1", "sub-01_ses-2", "sub-02_ses-1"], False),
    ],
)
def test_only_repeated_subjects_of_all_shapes_are_related(names: list[str], repeat: bool) -> None:
    assert subjects_repeat(names) == repeat

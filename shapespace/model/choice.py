"""The base of options that are one of several words."""

from enum import StrEnum


class Choice(StrEnum):
    """Words to choose from; the message about another one lists them."""

    @classmethod
    def _missing_(cls, value: object) -> None:
        raise ValueError(f"{value!r} is not a valid {cls.__name__}: choose among {', '.join(cls)}")

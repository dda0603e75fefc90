"""Numbers with their nouns in messages."""


def counted(count: float, noun: str, plural: str = "") -> str:
    """Return a number with its noun: "1 shape", "2 shapes", or "2 vertices" where the plural is given."""
    return f"{count} {noun if count == 1 else plural or f'{noun}s'}"

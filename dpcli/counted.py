"""Numbers with their nouns, for what people read."""


def counted(number: int, noun: str) -> str:
    """Returns a number and its noun, which takes an s in the plural.

    >>> counted(1, "sequence"), counted(0, "view"), counted(1200, "point")
    ('1 sequence', '0 views', '1200 points')
    """
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"

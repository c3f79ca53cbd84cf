"""Numbers with their nouns, for what people read."""


def counted(number: int, noun: str, plural: str = "", form: str = "") -> str:
    """Returns a number and its noun, which takes an s in the plural, behind another s an es, where no plural is given.

    form: how the number is written, such as "," for thousands apart.

    >>> counted(1, "sequence"), counted(0, "view"), counted(1200, "point"), counted(2, "class")
    ('1 sequence', '0 views', '1200 points', '2 classes')
    >>> counted(8, "category", "categories")
    '8 categories'
    """
    return f"{number:{form}} {noun if number == 1 else plural or noun + ('es' if noun.endswith('s') else 's')}"

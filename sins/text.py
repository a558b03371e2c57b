"""Texts of the user's own, as one line of a message can hold them."""


def printable(text: str) -> str:
    """A text in which all that a terminal would not show as such is escaped."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def shortened(text: str, most: int = 60) -> str:
    """A text of at most so many characters."""
    return text if len(text) <= most else f"{text[: most - 3]}..."

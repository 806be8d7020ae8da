"""The error that every layer raises for input that the user can correct."""


class InputError(ValueError):
    """Input that cannot be used.  The text is one line: the file or option, the field, the value and the fix.

    Commands exit with 2 for this error, and with 1 for every other exception.
    """

    def __init__(self, where: object, problem: str):
        super().__init__(" ".join(f"{printable(str(where))}: {printable(problem)}".split()))
        self.where, self.problem = where, problem

    def __reduce__(self):
        return type(self), (self.where, self.problem)  # ``args`` holds the joined text


def printable(text: str) -> str:
    """``text`` with control characters and undecodable bytes as escapes."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape", "replace").decode() for c in text)


def shown(value: object, limit: int = 60) -> str:
    """The repr of ``value`` on one line, cut after ``limit`` characters."""
    try:
        if isinstance(value, list | dict) and len(value) > 16:
            text = f"{type(value).__name__} of {len(value)}"
        else:
            text = repr(value)
    except (ValueError, RecursionError):  # an int of more digits than Python prints, a list nested without end
        text = type(value).__name__
    return text if len(text) <= limit else text[: limit - 3] + "..."

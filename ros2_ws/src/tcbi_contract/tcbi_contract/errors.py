"""The base of every error that a user can cause and mend."""


class TcbiError(Exception):
    """An error whose text tells a user what is wrong and what to do.

    The command line prints it in one line and exits with status 1; a node logs it and exits with 1.
    """


class UsageError(TcbiError):
    """A name that does not exist, or a value that cannot be: wrong usage, with which a command exits with status 2."""


def describe(what: str, value: object, allowed: str, remedy: str = "") -> str:
    """One line: what is wrong, the value seen, what is allowed, what to do."""
    text = f"{what}: got {value!r}, allowed is {allowed}"
    return f"{text}; {remedy}" if remedy else text

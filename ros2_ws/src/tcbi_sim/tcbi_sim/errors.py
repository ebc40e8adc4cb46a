"""Errors of this package that a user can cause and mend."""

from tcbi_contract.errors import TcbiError


class SimError(TcbiError):
    """Base of all errors of tcbi_sim."""


class UnknownNameError(SimError):
    """A name that is not in a registry, with the nearest ones that are."""

    def __init__(self, what: str, name: str, known: "list[str] | tuple[str, ...]"):
        import difflib

        near = difflib.get_close_matches(name, known, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        super().__init__(f"unknown {what} {name!r}{hint}; known: {', '.join(known) or 'none'}")

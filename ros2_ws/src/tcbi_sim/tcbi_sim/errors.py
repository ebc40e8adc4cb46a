"""Errors of this package that a user can cause and mend."""

import traceback

from tcbi_contract.errors import TcbiError, UsageError


class SimError(TcbiError):
    """Base of all errors of tcbi_sim."""


class EffectError(SimError):
    """The code of an effect that failed while it was used."""

    def __init__(self, key: str, part: str, cause: Exception, file: str):
        self.part, self.cause, self.file = part, cause, file
        lines = [f.lineno for f in traceback.extract_tb(cause.__traceback__) if f.filename == file]
        at = f" in line {lines[-1]}" if lines else ""
        text = " ".join(str(cause).split())
        super().__init__(
            f"effect {key!r}: {part}() raised {type(cause).__name__}{at} of {file}: {text}; mend it, "
            "./tcbi effects check tells more"
        )


class UnknownSiteError(SimError, UsageError):
    """A place that an effect does not have on this rig."""

    def __init__(self, effect: str, site: str, sites: tuple[str, ...]):
        if tuple(sites) == ("",):
            text = f"got {effect}:{site}, but this effect has no choice of place; write {effect}"
        else:
            got = f"place {site!r}" if site else "no place"
            text = f"effect {effect!r}: got {got}, allowed is one of {', '.join(sites)}; write {effect}:{sites[0]}"
        super().__init__(text)


class UnknownNameError(SimError, UsageError):
    """A name that is not in a registry, with the nearest ones that are."""

    def __init__(self, what: str, name: str, known: "list[str] | tuple[str, ...]"):
        import difflib

        near = difflib.get_close_matches(name, known, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        super().__init__(f"unknown {what} {name!r}{hint}; known: {', '.join(known) or 'none'}")

"""Errors of this package that a user can cause and mend."""

from tcbi_contract.errors import TcbiError


class DashboardError(TcbiError):
    """Something that the page cannot do, and what to do instead."""

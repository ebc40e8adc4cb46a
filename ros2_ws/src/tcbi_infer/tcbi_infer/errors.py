"""Errors of this package that a user can cause and mend."""

from tcbi_contract.errors import TcbiError


class InferError(TcbiError):
    """Base of all errors of tcbi_infer."""


class BagError(InferError):
    """A bag cannot be read, written or repaired."""


class RecordingError(InferError):
    """A rollout cannot be recorded: the folder is taken, the disk is full, a node is missing."""


class MappingError(InferError):
    """A mapping file does not describe its logs."""

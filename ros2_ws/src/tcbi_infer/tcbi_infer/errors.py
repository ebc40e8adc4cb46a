"""Errors of this package that a user can cause and mend."""

from tcbi_contract.errors import TcbiError, UsageError


class InferError(TcbiError):
    """Base of all errors of tcbi_infer."""


class BagError(InferError):
    """A bag cannot be read, written or repaired."""


class EmptyRolloutError(BagError):
    """A rollout ended, or its recording did, before the robot was measured."""


class RecordingError(InferError):
    """A rollout cannot be recorded: the folder is taken, the disk is full, a node is missing."""


class RequestError(RecordingError, UsageError):
    """Rollouts are asked for that cannot be recorded."""


class MappingError(InferError):
    """A mapping file does not describe its logs."""


class SettingError(InferError, UsageError):
    """A setting that a method cannot have, or not with this value."""


class MissingExtraError(InferError):
    """A method needs a library that is not part of the default installation."""

    def __init__(self, method: str, library: str):
        super().__init__(
            f"method {method} needs {library}, which is an optional extra; install it with "
            "`.tcbi/boot/bin/uv pip install --python .venv -r requirements-baselines.in`"
        )

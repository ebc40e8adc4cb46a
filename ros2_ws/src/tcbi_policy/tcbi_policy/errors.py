"""The errors of this package, each with its cause and its remedy in one line."""

from tcbi_contract.errors import TcbiError, UsageError


class PolicyError(TcbiError):
    """The base of every error of policies, training and their nodes."""


class PolicyNotFound(PolicyError, UsageError):
    """A policy was asked for that is neither a file, nor in the store, nor shipped, nor a gait."""


class PolicyDamaged(PolicyError):
    """A policy file or its card cannot be read, or the two do not belong together."""


class PolicyMisfit(PolicyError):
    """A policy's card describes another robot than the one at hand."""


class PolicyReplaced(PolicyError):
    """A policy was to take the place of another that is not in use by now."""


class RewardError(PolicyError):
    """A reward was asked for that the data at hand cannot give."""


class TrainingError(PolicyError):
    """A training run cannot start, go on, or be read."""

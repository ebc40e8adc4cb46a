"""Body attitude: roll and pitch of the body in the world (one of the paper's three statistics)."""

from tcbi_infer.statistics.base import Statistic

STATISTIC = Statistic(
    name="attitude",
    unit="rad",
    description="roll and pitch of the body in the world",
    needs=("attitude",),
    channels=lambda arrays: ("roll", "pitch"),
    compute=lambda arrays: arrays.roll_pitch.swapaxes(-1, -2),
)

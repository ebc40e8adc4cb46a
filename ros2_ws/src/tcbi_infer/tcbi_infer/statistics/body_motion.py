"""Body attitude in time: roll and pitch."""

from tcbi_infer.statistics.base import Statistic

STATISTIC = Statistic(
    name="body_motion",
    unit="rad",
    description="roll and pitch of the body, compared in time",
    needs=("attitude",),
    channels=lambda arrays: ("roll", "pitch"),
    compute=lambda arrays: arrays.roll_pitch.swapaxes(-1, -2),
    in_time=True,
)

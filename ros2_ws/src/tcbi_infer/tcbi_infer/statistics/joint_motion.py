"""Joint angles in time: where each joint is."""

from tcbi_infer.statistics.base import Statistic

STATISTIC = Statistic(
    name="joint_motion",
    unit="rad",
    description="joint positions, compared in time",
    needs=(),
    channels=lambda arrays: arrays.joint_names,
    compute=lambda arrays: arrays.joint_position.swapaxes(-1, -2),
    in_time=True,
)

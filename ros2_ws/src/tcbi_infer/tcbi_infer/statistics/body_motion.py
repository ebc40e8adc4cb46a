"""Body attitude in time: roll and pitch."""

import dataclasses

from tcbi_infer.statistics import attitude

STATISTIC = dataclasses.replace(
    attitude.STATISTIC, name="body_motion", description="roll and pitch of the body, compared in time", in_time=True
)

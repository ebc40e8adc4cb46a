"""How often the search raises a false alarm on this robot, as its own null simulations say, and how sure that is."""

import numpy as np
from scipy.stats import binomtest

from tcbi_infer.compare.replicates import MIN_KINDS
from tcbi_infer.diagnose.evidence import FalseAlarms
from tcbi_infer.diagnose.null import Null, threshold_of
from tcbi_infer.diagnose.paired import LEVEL, level

_FEW = (
    " With {kinds} kinds of motion the threshold aims at {level}: what all of them share by chance cannot be held off "
    "at 5 %, and one kind more brings it there."
)


def false_alarms(null: Null) -> FalseAlarms:
    """The share of data sets with nothing missing in which the search passes the threshold, with a 90 % interval.

    Each data set is held against a threshold that the other half of them sets: against their own, as many pass as its
    level says, whatever they are. The interval is Clopper and Pearson's: a handful of exceedances among some hundred
    data sets is not sharply known. Nothing is claimed with fewer than five kinds of motion, whose spread is known too
    badly.
    """
    count = len(null.maxima)
    if not count:
        return FalseAlarms("Nothing was searched, so there is no false-alarm rate.")
    if null.kinds < MIN_KINDS:
        kinds = f"{null.kinds} kind{'s' if null.kinds != 1 else ''} of motion"
        return FalseAlarms(f"With {kinds}, fewer than {MIN_KINDS}, no false-alarm rate is claimed.", count)
    passed = _passed(null)
    rate, interval = passed / count, binomtest(passed, count).proportion_ci(0.9)
    low, high = float(interval.low), float(interval.high)
    few = _FEW.format(kinds=null.kinds, level=_percent(1 - level(null.kinds))) if level(null.kinds) < LEVEL else ""
    return FalseAlarms(
        f"False alarms: in {passed} of {count} simulated data sets of this robot with nothing missing the search, "
        "one linear step for every candidate, passed the threshold (that of the other half of them, about "
        f"{null.threshold:.1f} standard errors), {_percent(rate)} (90 % interval {_percent(low)} to {_percent(high)}). "
        "What else is required of an effect can only lower how often one is named. The full fits, which judge the "
        "candidates, can gain more than that step, and what these simulations do not hold may raise it, too. That "
        "something may be missing, or is not in the library, rests on limits of the error, whose false alarms this "
        "does not count."
        f"{few}",
        count,
        rate,
        low,
        high,
    )


def _passed(null: Null) -> int:
    halves = slice(None, None, 2), slice(1, None, 2)
    return sum(
        int(np.sum(null.maxima[own] > threshold_of(null.maxima[other], null.kinds)))
        for own, other in (halves, halves[::-1])
        if len(null.maxima[other])
    )


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"

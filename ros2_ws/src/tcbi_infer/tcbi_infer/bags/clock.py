"""Where the clock of a recording was set back, and which messages lie between two such moments."""

import numpy as np

JUMP_S = 0.5  # s back in time: less is messages overtaking each other, more is a clock that was set


def set_back(stamp: np.ndarray) -> np.ndarray:
    """Indices of the last samples before a clock was set back, of stamps (ns) in the order of their file."""
    return np.flatnonzero(np.diff(stamp) < -JUMP_S * 1e9)


def how_often(stamp: np.ndarray) -> str:
    """In words, how often and how far the clock of these stamps (ns) was set back."""
    times = len(set_back(stamp))
    worst = -np.diff(stamp).min() * 1e-9
    return f"time goes back {'once' if times == 1 else f'{times} times'}, by up to {worst:.3g} s (a clock was set)"


def stretches(stamp: np.ndarray, beat: np.ndarray) -> np.ndarray:
    """(N,) the number of the stretch of even time that each message of a recording belongs to, from 0; -1 for none.

    A message goes with the nearer in time of the two beats that it stands between; one that is far from the whole of
    that stretch overtook others as the clock was set.

    Args:
      stamp: (N,) ns, of messages in the order of their file.
      beat: (B,) indices of those of one topic, at least one, which tells where the clock was set back.
    """
    beats = stamp[beat]
    back = set_back(beats)
    if not back.size:
        return np.zeros(len(stamp), int)
    following = np.searchsorted(beat, np.arange(len(stamp)))
    before, after = np.maximum(following - 1, 0), np.minimum(following, len(beat) - 1)
    nearest = np.where(np.abs(stamp - beats[before]) < np.abs(stamp - beats[after]), before, after)
    number = np.searchsorted(back, np.arange(len(beats)))
    starts = np.r_[0, back + 1]
    low, high = np.minimum.reduceat(beats, starts), np.maximum.reduceat(beats, starts)
    mine, margin = number[nearest], round(JUMP_S * 1e9)
    near = (stamp >= low[mine] - margin) & (stamp <= high[mine] + margin)
    return np.where(near, mine, -1)

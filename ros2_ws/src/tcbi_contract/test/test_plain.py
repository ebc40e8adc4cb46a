"""What is written as JSON can be read by any reader."""

import dataclasses
import json

import numpy as np

from tcbi_contract.plain import plain


@dataclasses.dataclass
class Found:
    error: float
    counts: np.ndarray


def test_numbers_arrays_and_dataclasses_become_json_and_what_is_not_finite_null():
    value = {1: Found(np.nan, np.array([[1, 2]])), "share": np.float64(0.123456), "told": (np.True_, np.inf, None)}
    assert plain(value) == {"1": {"error": None, "counts": [[1, 2]]}, "share": 0.123456, "told": [True, None, None]}
    assert plain(value, 2)["share"] == 0.12
    assert json.loads(json.dumps(plain(value), allow_nan=False)) == plain(value)

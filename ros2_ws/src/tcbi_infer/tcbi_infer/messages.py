"""The worker's events as messages; needs ROS."""

import math
from typing import Any

from builtin_interfaces.msg import Time

from tcbi_msgs.msg import Diagnosis, EffectParameter, Evidence, ModelError, Posterior, SignalError

Content = dict[str, Any]
SI = {"deg": ("rad", math.pi / 180), "deg/s": ("rad/s", math.pi / 180)}


def number(value: float | None) -> float:
    """None, which stands for not a number in JSON, as NaN."""
    return math.nan if value is None else float(value)


def posterior_message(content: Content, stamp: Time) -> Posterior:
    """From a `posterior` or a `generation` event."""
    names = Posterior.get_fields_and_field_types().keys() - {"header"}
    message = Posterior(**{name: content[name] for name in names})
    message.header.stamp = stamp
    return message


def model_error_message(content: Content, stamp: Time) -> ModelError:
    """From a `model_error` event."""
    message = ModelError(
        model=content["model"],
        rollouts=content["rollouts"],
        floor_from_replicates=bool(content["floor_from_replicates"]),
        signals=[_signal_error(s) for s in content["signals"]],
        error_over_floor=number(content["error_over_floor"]),
    )
    message.header.stamp = stamp
    return message


def _signal_error(signal: Content) -> SignalError:
    """In SI units, as all topics are."""
    unit, factor = SI.get(signal["unit"], (signal["unit"], 1.0))
    return SignalError(
        name=signal["name"],
        unit=unit,
        error=factor * number(signal["error"]),
        noise_floor=factor * number(signal["noise_floor"]),
        ratio=number(signal["ratio"]),
        coverage90=number(signal["coverage90"]),
    )


def diagnosis_message(content: Content, stamp: Time) -> Diagnosis:
    """From a `diagnosis` event; effects are named with their place, as `add_effect` takes them."""
    message = Diagnosis(
        model=content["model"],
        rollouts=content["rollouts"],
        verdict=content["verdict"],
        effects=content.get("uses") or content["effects"],
        ranking=[_evidence(e) for e in content["ranking"]],
        statement=content["statement"],
    )
    message.header.stamp = stamp
    return message


def _evidence(content: Content) -> Evidence:
    keys = ("elpd_gain", "elpd_se", "error_before", "error_after")
    return Evidence(
        effect=content.get("use") or content["effect"],
        parameters=[
            EffectParameter(
                name=p["name"],
                unit=p["unit"],
                value=number(p["value"]),
                low90=number(p["low90"]),
                high90=number(p["high90"]),
                null_value=number(p["null"]),
            )
            for p in content["parameters"]
        ],
        confused_with=list(content["confused_with"]),
        **{key: number(content[key]) for key in keys},
    )

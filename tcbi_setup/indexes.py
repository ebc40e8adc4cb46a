"""uv's settings from pip's, so that a machine on which pip works needs nothing more."""

import shlex
import subprocess
from collections.abc import Mapping, Sequence


def pip_settings(pip: Sequence[str], environment: Mapping[str, str]) -> dict[str, str]:
    """What pip is configured with (files and environment), the environment winning; keys such as `find-links`.

    Args:
      pip: command that runs it.
      environment: to run it in.
    """
    command = [*pip, "config", "list"]
    listing = subprocess.run(command, env=dict(environment), capture_output=True, text=True, check=False).stdout
    ranked: dict[str, tuple[int, str]] = {}
    for line in listing.splitlines():
        name, _, value = line.partition("=")
        section, _, key = name.rpartition(".")
        rank = {"global": 0, "install": 1, ":env:": 2}.get(section)
        if rank is None or (key in ranked and ranked[key][0] > rank):
            continue
        try:
            ranked[key] = (rank, " ".join(shlex.split(value)[0].split()))
        except (ValueError, IndexError):
            continue
    return {key: value for key, (_, value) in ranked.items()}


def uv_environment(base: Mapping[str, str], pip: Mapping[str, str]) -> dict[str, str]:
    """`base` with uv's variables where pip has a setting and uv has none.

    Args:
      base: the environment of the caller; what it says about uv stands.
      pip: from `pip_settings`.
    """
    result = dict(base)
    translated = {
        "UV_FIND_LINKS": pip.get("find-links", "").replace(" ", ","),
        "UV_DEFAULT_INDEX": pip.get("index-url", ""),
        "UV_INDEX": pip.get("extra-index-url", ""),
        "SSL_CERT_FILE": pip.get("cert", ""),
        "UV_HTTP_TIMEOUT": "60",
        "UV_CONCURRENT_DOWNLOADS": "16",
        "UV_NO_PROGRESS": "1",
        "UV_NO_CONFIG": "1",
    }
    if pip.get("extra-index-url"):
        translated["UV_INDEX_STRATEGY"] = "unsafe-best-match"  # pip's own rule
    for key, value in translated.items():
        if value:
            result.setdefault(key, value)
    return result

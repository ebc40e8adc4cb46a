"""For all tests, those beside the packages and those in tests/."""

import os
import signal
from pathlib import Path

import hypothesis
import pytest

ROOT = Path(__file__).resolve().parent

os.environ.setdefault("MUJOCO_GL", "egl")
hypothesis.settings.register_profile("tcbi", derandomize=True, deadline=None, database=None)
hypothesis.settings.load_profile("tcbi")
# a shell that starts the tests in the background has SIGINT ignored, by them and by all that they start and interrupt
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder with the real recordings (xl330_pendulum/ and others): TCBI_DATA, or shared/data beside the checkout."""
    given = os.environ.get("TCBI_DATA")
    folder = Path(given) if given else ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"no real recordings: {folder} is not there; set TCBI_DATA to their folder")
    return folder


@pytest.fixture(autouse=True, scope="session")
def _own_store(tmp_path_factory: pytest.TempPathFactory):
    """No test touches the user's models, policies and rollouts."""
    before = {name: os.environ.get(name) for name in ("TCBI_STORE", "XDG_DATA_HOME")}
    folder = tmp_path_factory.mktemp("data")
    os.environ.update(TCBI_STORE=str(folder / "tcbi"), XDG_DATA_HOME=str(folder))
    yield
    for name, value in before.items():
        if value is None:
            os.environ.pop(name)
        else:
            os.environ[name] = value

"""A training as a process of its own: killed, orphaned, failing, and the only one in its folder."""

import dataclasses
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from training_cases import KEPT, TINY, train

from tcbi_contract.files import replacement
from tcbi_policy import training_process
from tcbi_policy.artefact import load_policy
from tcbi_policy.errors import TrainingError
from tcbi_policy.runs import Run, TrainingProcess, alone, write_run

SUBPROCESS = pytest.mark.timeout(400)  # it imports torch, which takes its time on a busy machine


@SUBPROCESS
def test_a_process_that_is_killed_says_so_and_the_next_one_ends_with_the_same_weights(tmp_path: Path) -> None:
    whole = train(tmp_path / "whole", model=KEPT)
    folder = write_run(tmp_path / "run", Run(TINY, "hexapod-v0", str(tmp_path)))
    with TrainingProcess(folder) as process, pytest.raises(TrainingError, match="signal 9"):
        for event in process.events():
            if event["event"] == "progress" and event["steps"] >= 160:
                os.kill(process.pid, signal.SIGKILL)
    with TrainingProcess(folder) as process:
        events = list(process.events())
    assert events[0]["event"] == "resumed" and events[0]["steps"] >= 160
    assert events[-1]["event"] == "done"
    assert load_policy(Path(events[-1]["policy"])).card.sha256 == whole.card.sha256


def test_a_folder_of_another_run_is_refused(tmp_path: Path) -> None:
    write_run(tmp_path, Run(TINY, "hexapod-v0"))
    with pytest.raises(TrainingError, match="another training run"):
        write_run(tmp_path, Run(dataclasses.replace(TINY, seed=1), "hexapod-v0"))


@SUBPROCESS
def test_a_training_ends_with_the_process_that_asked_for_it_however_that_ends(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run", Run(dataclasses.replace(TINY, steps=4_800_000), "hexapod-v0", str(tmp_path)))
    code = (
        "import sys, time; from pathlib import Path; from tcbi_policy.runs import TrainingProcess\n"
        "process = TrainingProcess(Path(sys.argv[1])); print(process.pid, flush=True)\n"
        "process.poll(100.0); print('trains', flush=True); time.sleep(600)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(folder)], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        pid, said = int(parent.stdout.readline()), parent.stdout.readline()
        assert said == "trains\n"
        parent.kill()
    with alone(folder, patience_s=5.0):
        assert not Path(f"/proc/{pid}").exists() or "Z" in Path(f"/proc/{pid}/stat").read_text().split()[2]


@SUBPROCESS
def test_a_failing_process_tells_its_last_line(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run", Run(TINY, "hexapod-v99", str(tmp_path)))
    with TrainingProcess(folder) as process, pytest.raises(TrainingError, match="hexapod-v99"):
        list(process.events())


FULL_DISK = """
import errno, os
from pathlib import Path

sync = os.fsync

def full(file):
    path = Path(os.readlink(f"/proc/self/fd/{file}"))
    if path.name.startswith(".checkpoint") and (path.parent / "checkpoint.safetensors").exists():
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    sync(file)

os.fsync = full
"""


@SUBPROCESS
def test_a_full_disk_is_told_and_the_training_goes_on_when_there_is_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = train(tmp_path / "whole", model=KEPT)
    folder = write_run(tmp_path / "run", Run(TINY, "hexapod-v0", str(tmp_path)))
    (tmp_path / "sitecustomize.py").write_text(FULL_DISK)
    words = f"status 1: {folder}: No space left on device; see that there is room"
    with monkeypatch.context() as patch:
        patch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
        with TrainingProcess(folder) as process, pytest.raises(TrainingError, match=re.escape(words)):
            list(process.events())
    assert not (folder / "errors.log").read_bytes(), "what is told needs no room on the disk"
    with TrainingProcess(folder) as process:
        events = list(process.events())
    assert events[0]["event"] == "resumed"
    assert load_policy(Path(events[-1]["policy"])).card.sha256 == whole.card.sha256


def test_a_process_that_stands_by_ends_with_its_owner() -> None:
    process = TrainingProcess()
    process.close()
    assert process.poll(5.0) == (None, True)


def test_what_a_killed_training_left_half_written_is_gone_when_the_next_one_begins(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run", Run(TINY, "hexapod-v0"))
    (folder / "checkpoint.safetensors").touch()
    for name in ("checkpoint.safetensors", "replay-160.npz"):
        replacement(folder / name).__enter__().touch()  # and killed here
    with alone(folder):
        assert sorted(path.name for path in folder.iterdir()) == ["checkpoint.safetensors", "run.json"]


def test_two_processes_do_not_train_one_run(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run", Run(TINY, "hexapod-v0"))
    words = "another process trains this run"
    with alone(folder), pytest.raises(TrainingError, match=words), alone(folder, patience_s=0.2):
        pass
    with alone(folder, patience_s=0.0):
        pass


def test_a_run_that_another_process_ended_meanwhile_is_told_as_ended(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "run", Run(TINY, "hexapod-v0"))
    with ThreadPoolExecutor(1) as pool:
        with alone(folder):
            waiting = pool.submit(alone(folder, patience_s=5.0).__enter__)
            time.sleep(0.3)
            shutil.rmtree(folder)
        with pytest.raises(TrainingError, match="has ended meanwhile"):
            waiting.result()
    gone = FileNotFoundError(2, "No such file or directory", str(folder / "errors.log"))
    assert "has ended meanwhile" in training_process._told(gone, folder)

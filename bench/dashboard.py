"""How fast and how large the dashboard is: first page, slider, memory with many rollouts, growth while it is looked at.

    ./tcbi bench dashboard -- --rollouts 500 --minutes 60

Needs Playwright and Chromium. The rollouts are one second of a servo bench each; the slider is moved on a hexapod.
"""

import argparse
import json
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import psutil
from playwright.sync_api import sync_playwright

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from tcbi_bringup.commands.bench import figure
from tests.dashboard_cases import BROWSERS, SOFTWARE_GL, Server, bench_rollouts, record

FIRST_PAGES = 5
VIEWS = ("Live", "Where", "Why", "Add", "Reports", "Compare")
SLIDER = """async () => {
  const slider = document.querySelector('.tcbi-transport input'), player = document.querySelector('.tcbi-player');
  const before = player.frames(), began = performance.now();
  for (let k = 0; performance.now() - began < 5000; k++) {
    slider.value = k % (Number(slider.max) + 1);
    slider.dispatchEvent(new Event('input'));
    await new Promise(requestAnimationFrame);
  }
  return 1000 * (player.frames() - before) / (performance.now() - began);
}"""


def main() -> int:
    """Measure and print one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="20 rollouts")
    parser.add_argument("--rollouts", type=int, default=500)
    parser.add_argument("--minutes", type=float, default=0.0, help="look at the page for so long")
    parser.add_argument("--motion", type=Path, nargs="*", default=[], help="bags of a hexapod, for the slider")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        store = Path(folder)
        record(store, bench_rollouts((20 if args.quick else args.rollouts) // 2, seconds=1.0))
        if args.motion:
            _compare(store, args.motion)
        with Server(store) as server, sync_playwright() as playwright:
            figures = _measure(server, playwright, args.minutes, bool(args.motion))
    print(json.dumps({"name": "dashboard", "figures": figures}, indent=2))
    return 0


def _compare(store: Path, bags: list[Path]) -> None:
    """A comparison for the slider, as the page's own worker makes it."""
    from tcbi_dashboard.task import COMPARE, MODULE, Task

    task = Task(COMPARE, str(store), "hexapod-v0", tuple(str(b.absolute()) for b in bags))
    line = task.to_json() + "\n"
    subprocess.run([sys.executable, "-m", MODULE], input=line, stdout=subprocess.DEVNULL, text=True, check=True)


def _measure(server: Server, playwright, minutes: float, slider: bool) -> list[dict[str, Any]]:
    path = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox", *SOFTWARE_GL])
    process = psutil.Process(server.pid)
    seconds = []
    for _ in range(FIRST_PAGES):
        page = browser.new_context(viewport={"width": 1280, "height": 800}).new_page()
        began = time.perf_counter()
        page.goto(server.address)
        page.wait_for_selector(".tcbi-main .tcbi-card")
        seconds.append(time.perf_counter() - began)
        page.context.close()
    page = browser.new_page()
    page.goto(server.address)
    page.wait_for_selector(".tcbi-main .tcbi-card")
    figures = [
        figure("first page, median", statistics.median(seconds), "s", most=2.0),
        figure("first page, slowest", max(seconds), "s", most=2.0),
    ]
    if slider:
        page.wait_for_function("Number(document.querySelector('.tcbi-transport input')?.max) > 10")
        figures.append(figure("slider", page.evaluate(SLIDER), "frames/s", least=20.0))
    for view in VIEWS:
        _look_at(page, view, 2.0)
    memory = [process.memory_info().rss / 1e6]
    ends = time.monotonic() + 60 * minutes
    while time.monotonic() < ends:
        for view in VIEWS:
            _look_at(page, view, 5.0)
        page.reload()
        memory.append(process.memory_info().rss / 1e6)
    browser.close()
    return [
        *figures,
        figure("memory after all views", memory[0], "MB", most=300.0),
        figure("memory at the end", memory[-1], "MB", most=300.0),
        figure("memory at most", max(memory), "MB", most=300.0),
        figure("growth over the second half", memory[-1] - memory[len(memory) // 2], "MB"),
    ]


def _look_at(page, view: str, seconds: float) -> None:
    page.get_by_role("tab", name=view, exact=True).click()
    page.wait_for_timeout(1000 * seconds)


if __name__ == "__main__":
    sys.exit(main())

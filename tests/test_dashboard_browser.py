"""The page in a real browser: no rollouts, one and many, a restart, a token."""

import urllib.error
import urllib.request

import pytest

pytest.importorskip("nicegui", reason="the dashboard needs nicegui")
playwright = pytest.importorskip("playwright.sync_api", reason="no Playwright to look at the page with")
from tests.dashboard_cases import DEADLINE_S, Server, bench_rollouts, launch, record  # noqa: E402

VIEWS = ("Live", "Compare", "Where", "Why", "Add", "Reports")
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def browser():
    """Chromium."""
    with playwright.sync_playwright() as running:
        opened = launch(running)
        yield opened
        opened.close()


@pytest.fixture
def look(browser):
    """`look(server, width)` opens the page; at the end nothing may have gone wrong in the browser."""
    faults: list[str] = []
    contexts = []

    def open_page(server: Server, view: str = "", width: int = 1280):
        context = browser.new_context(viewport={"width": width, "height": 860})
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(1000 * DEADLINE_S)
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.goto(f"{server.address}/{f'?view={view}' if view else ''}")
        page.wait_for_selector(".tcbi-main section, .tcbi-main .tcbi-empty")
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert faults == []


def go_to(page, view: str) -> None:
    """Click a view's name, and wait until something of it is seen."""
    page.get_by_role("tab", name=view, exact=True).click()
    page.wait_for_selector(".q-tab-panel section:visible, .q-tab-panel .tcbi-empty:visible")


def fits(page) -> bool:
    """Whether the page is no wider than the screen."""
    return page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")


@pytest.mark.parametrize("width", [1280, 390])
def test_every_view_of_an_empty_store_says_what_to_do_first(tmp_path, look, width):
    with Server(tmp_path) as server:
        page = look(server, width=width)
        for view in VIEWS:
            go_to(page, view)
            page.locator(".tcbi-empty:visible").first.wait_for()
            assert fits(page), view


def test_every_view_works_with_one_rollout(tmp_path, look):
    record(tmp_path, iter([next(bench_rollouts())]))
    with Server(tmp_path) as server:
        page = look(server, width=390)
        page.get_by_text("1 of 1 rollout").first.wait_for()
        page.get_by_role("button", name="Compare").click()
        page.get_by_text("times the noise floor: servo_bench-v0").wait_for()
        for view in VIEWS:
            go_to(page, view)
            assert fits(page), view


def test_five_hundred_rollouts_are_listed_and_chosen_from(tmp_path, look):
    record(tmp_path, bench_rollouts(250, seconds=1.0))
    with Server(tmp_path) as server:
        page = look(server)
        page.get_by_text("40 of 500 rollouts").first.wait_for()
        page.get_by_role("button", name="Choose rollouts").click()
        page.get_by_placeholder("filter").fill("motion:249")
        page.get_by_text("swing249b").wait_for()
        page.get_by_role("button", name="None").click()
        page.get_by_role("row", name="swing249b").get_by_role("checkbox").click()
        page.get_by_role("button", name="Use these").click()
        page.get_by_text("1 of 500 rollouts").first.wait_for()


def test_a_page_finds_its_server_again_after_a_restart(tmp_path, look):
    with Server(tmp_path) as server:
        page = look(server)
        page.get_by_text("There are no rollouts yet.").wait_for()
        server.stop()
        record(tmp_path, iter([next(bench_rollouts())]))
        server.start()
        page.get_by_text("1 of 1 rollout").first.wait_for()


def test_another_machine_needs_the_token_and_cannot_move_the_robot(tmp_path, look, browser):
    with Server(tmp_path, "--host", "0.0.0.0") as server:
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(server.address)
        assert refused.value.code == 401
        page = browser.new_page()
        page.goto(server.said["address"].replace("0.0.0.0", "localhost"))
        page.wait_for_selector(".tcbi-main")
        assert "token" not in page.url
        go_to(page, "Live")
        page.get_by_text("This page may stop the robot, but not move it").wait_for()
        assert page.get_by_role("button", name="EMERGENCY STOP").is_visible()
        assert page.get_by_role("button", name="Record").count() == 0
        page.close()

"""The page in a real browser: a newcomer's whole way, few and many rollouts, two browsers, a restart, a token."""

import urllib.error
import urllib.request

import pytest

pytest.importorskip("nicegui", reason="the dashboard needs nicegui")
playwright = pytest.importorskip("playwright.sync_api", reason="no Playwright to look at the page with")
from tests.dashboard_cases import DEADLINE_S, HIDDEN, Server, bench_rollouts, launch, record  # noqa: E402

VIEWS = ("Live", "Compare", "Where", "Why", "Add", "Reports")
pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]


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
        context = browser.new_context(viewport={"width": width, "height": 860}, reduced_motion="reduce")
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
    """Click a view's name, and wait until the server has taken the click and something of the view is seen."""
    page.get_by_role("tab", name=view, exact=True).click()
    page.wait_for_url(f"**/?view={view.lower()}")
    page.wait_for_selector(".q-tab-panel section:visible, .q-tab-panel .tcbi-empty:visible")


def saved(page, kind: str) -> bytes:
    """What the page gives as the view that is seen, "HTML" or "PNG"."""
    page.get_by_role("button", name="save this view").click()
    with page.expect_download() as download:
        page.get_by_text(f"Save this view as {kind}").click()
    return download.value.path().read_bytes()


def fits(page) -> bool:
    """Whether the page is no wider than the screen."""
    return page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")


def test_a_newcomer_sees_learns_adds_and_watches_the_error_fall(tmp_path, look):
    with Server(tmp_path) as server:
        page = look(server)
        page.get_by_text("There are no rollouts yet.").wait_for()
        page.get_by_text("./tcbi collect").first.wait_for()
        record(tmp_path, bench_rollouts())
        page.get_by_text("12 of 12 rollouts").first.wait_for()

        page.get_by_role("button", name="Compare").click()
        page.get_by_text("times the noise floor: servo_bench-v0").wait_for()
        before = float(page.locator(".tcbi-figure").inner_text())
        assert before > 2
        page.wait_for_function("Number(document.querySelector('.tcbi-transport input')?.max) > 10")
        page.evaluate(
            "() => { const s = document.querySelector('.tcbi-transport input'); s.value = s.max;"
            " s.dispatchEvent(new Event('input')) }"
        )
        page.wait_for_function(
            "(([now, end]) => end > 0 && now === end)"
            "(document.querySelector('.tcbi-transport output').innerText.split('/').map(parseFloat))"
        )

        go_to(page, "Where")
        page.get_by_text("Where the error lives").wait_for()
        page.get_by_role("button", name="Show").first.click()
        page.get_by_text("Measured and predicted motion").wait_for()
        page.wait_for_function("(s => s && s.value !== s.max)(document.querySelector('.tcbi-transport input'))")

        go_to(page, "Why")
        page.get_by_role("button", name="Quick look").click()
        page.locator(".tcbi-verdict").wait_for()
        assert HIDDEN in page.locator(".tcbi-verdict").inner_text()

        page.get_by_role("button", name=f"Add {HIDDEN} to servo_bench-v0").click()
        page.get_by_role("button", name=f"Add {HIDDEN}", exact=True).click()
        page.get_by_text("servo_bench-v1", exact=True).first.wait_for()
        page.locator(".tcbi-job").wait_for(state="detached")
        record(tmp_path, bench_rollouts(2, first=20))
        page.get_by_text("16 of 16 rollouts").first.wait_for()
        page.get_by_role("button", name="Measure all versions on these").click()
        page.get_by_text("Measured on 4 rollouts that no fit has seen").wait_for()
        lines = page.locator(".tcbi-version-error").all_inner_texts()
        after, base = (float(line.split()[0]) for line in lines)
        assert after < 0.6 * base

        page.get_by_role("button", name=f"Add {HIDDEN}", exact=True).click()
        page.get_by_text(f"servo_bench-v0 with {HIDDEN} already, from this very diagnosis").wait_for()
        page.get_by_role("button", name="Show servo_bench-v1").click()
        page.get_by_role("button", name=f"Take out {HIDDEN}").click()
        page.get_by_text("servo_bench-v2 is then the newest version").wait_for()
        page.get_by_role("button", name="Cancel").click()
        page.get_by_label("time for training").fill("-5")
        page.get_by_role("button", name="Retrain", exact=True).click()
        page.get_by_text("allowed: 10 to 86400").wait_for()
        assert [p.name for p in (tmp_path / "models").glob("*-v*")] == ["servo_bench-v1"]

        go_to(page, "Reports")
        page.get_by_role("link", name="add-servo_bench-v1").wait_for()
        with urllib.request.urlopen(f"{server.address}/report/add-servo_bench-v1.html") as report:
            assert b"<svg" in report.read()
        assert server.stop() == 130


@pytest.mark.parametrize("width", [1280, 390])
def test_every_view_of_an_empty_store_says_what_to_do_first(tmp_path, look, width):
    with Server(tmp_path) as server:
        page = look(server, width=width)
        for view in VIEWS:
            go_to(page, view)
            page.locator(".tcbi-empty:visible").first.wait_for()
            assert fits(page), view


def test_an_address_that_is_none_says_what_there_is(tmp_path, look):
    with Server(tmp_path) as server:
        page = look(server, "foo")
        page.get_by_text('There is no view "foo". The views are Live, Compare').wait_for()
        page.goto(f"{server.address}/nowhere")
        page.get_by_text("There is no page /nowhere here.").wait_for()
        page.get_by_role("link", name="Open the dashboard").click()
        page.get_by_text("There are no rollouts yet.").wait_for()


def test_every_view_works_with_one_rollout(tmp_path, look):
    record(tmp_path, iter([next(bench_rollouts())]))
    with Server(tmp_path) as server:
        page = look(server, width=390)
        page.get_by_text("1 of 1 rollout").first.wait_for()
        page.get_by_role("button", name="Compare").click()
        page.get_by_text("times the noise floor: servo_bench-v0").wait_for()
        (report,) = (tmp_path / "reports").glob("compare-*.html")
        assert saved(page, "HTML") == report.read_bytes()
        for view in VIEWS:
            go_to(page, view)
            assert fits(page), view
        picture = saved(page, "PNG")
        assert picture.startswith(b"\x89PNG") and int.from_bytes(picture[16:20], "big") > 700
        page.evaluate("() => { HTMLCanvasElement.prototype.toDataURL = () => { throw new Error('no memory') } }")
        page.get_by_role("button", name="save this view").click()
        page.get_by_text("Save this view as PNG").click()
        page.get_by_text("could not be saved (Error: no memory); save it as HTML instead.").wait_for()


def test_five_hundred_rollouts_are_listed_compared_and_chosen_from(tmp_path, look):
    record(tmp_path, bench_rollouts(250, seconds=1.0))
    with Server(tmp_path) as server:
        page = look(server)
        page.get_by_text("40 of 500 rollouts").first.wait_for()
        page.get_by_role("button", name="Compare").click()
        page.get_by_text("times the noise floor: servo_bench-v0").wait_for()
        for view in (*VIEWS, "Compare"):
            go_to(page, view)
            assert fits(page), view
        page.get_by_role("button", name="Choose rollouts").click()
        page.get_by_placeholder("filter").fill("motion:249")
        page.get_by_text("swing249b").wait_for()
        page.get_by_role("button", name="None").click()
        page.get_by_role("button", name="Use 0 rollouts").wait_for()
        page.get_by_role("row", name="swing249b").get_by_role("checkbox").click()
        page.get_by_role("button", name="Use 1 rollout").click()
        page.get_by_text("1 of 500 rollouts").first.wait_for()
        page.get_by_role("button", name="Choose rollouts").click()
        page.get_by_placeholder("filter").fill("motion:249")
        page.get_by_text("swing249a").wait_for()
        page.get_by_role("button", name="All").click()
        page.get_by_role("button", name="Use 2 rollouts").click()
        page.get_by_text("2 of 500 rollouts").first.wait_for()


def test_two_browsers_see_the_same_job_and_either_may_cancel_it(tmp_path, look):
    record(tmp_path, bench_rollouts(2))
    with Server(tmp_path) as server:
        one, other = look(server, "why"), look(server)
        one.get_by_text("4 of 4 rollouts").first.wait_for()
        one.get_by_role("button", name="Diagnose").click()
        other.get_by_text("Diagnosing: ").wait_for()
        other.get_by_role("button", name="Cancel").click()
        one.get_by_text("Diagnosing was cancelled.").wait_for()
        other.get_by_role("button", name="Compare").click()
        go_to(one, "Compare")
        for page in (one, other):
            page.get_by_text("times the noise floor: servo_bench-v0").wait_for()


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
        page.goto(server.said["address"])
        page.wait_for_selector(".tcbi-main")
        assert "token" not in page.url
        go_to(page, "Live")
        page.get_by_text("This page may stop the robot, but not move it").wait_for()
        assert page.get_by_role("button", name="EMERGENCY STOP").is_visible()
        assert page.get_by_role("button", name="Record").count() == 0
        page.close()


@pytest.mark.graph
def test_the_robot_is_seen_stopped_and_its_unplugging_noticed(tmp_path, look, domain, start_graph, peer):
    from std_srvs.srv import Trigger

    from tcbi_bringup.launcher import NodeProcess
    from tcbi_contract import names

    graph = start_graph(NodeProcess("tcbi_sim", "sim_node", parameters={"mode": "realtime"}))
    with Server(tmp_path, domain=domain) as server:
        page = look(server, "live")
        page.get_by_text("°, pitch ").wait_for()
        peer.call(names.EMERGENCY_STOP, Trigger.Request(), Trigger)  # somebody else's stop is seen, too
        page.get_by_text("STOPPED: torque is off").wait_for()
        page.get_by_role("button", name="Release the stop").click()
        page.get_by_text("Torque is off: emergency stop released").wait_for()
        page.get_by_role("button", name="Reset the robot").click()
        page.get_by_role("button", name="Reset the robot").wait_for(state="hidden")

        phone = look(server, "why", width=390)
        phone.get_by_role("button", name="Choose rollouts").click()
        phone.get_by_placeholder("filter").wait_for()
        phone.get_by_role("button", name="STOP", exact=True).click()  # over an open dialog, too
        phone.get_by_role("button", name="STOPPED", exact=True).wait_for()
        page.get_by_text("STOPPED: torque is off").wait_for()
        assert fits(phone)
        phone.close()

        record_button = page.get_by_role("button", name="Record")
        page.get_by_label("slope, roll").fill("95")
        record_button.click()
        page.get_by_text("allowed: -30 to 30, or empty (drawn)").wait_for()
        page.get_by_label("slope, roll").fill("")
        record_button.click()
        page.get_by_text("The graph has no recorder_node").wait_for()
        graph.stop()
        page.get_by_text("No joint states arrive.").wait_for()
        page.get_by_text("STOPPED: torque is off (not heard for").wait_for()
